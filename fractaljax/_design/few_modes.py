"""A design problem in the space of the modes that grow most in a few designs, for a rough search.

Eigenvalues take most of the time of a design, and at half the size they take an eighth of it. At
other designs they are in error by what the modes of these few leave out: a search ends in the full
problem.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from .._base.batches import in_batches
from .._base.programs import exported_jit
from .._mechanism.structure import ParametricStructure
from .._stability.linearise import assembled
from .._stability.quadratic import solve
from .._stability.reduced_space import decomposed
from .._stability.snapshots import projected
from .problem import DesignProblem

_LARGE = 60  # degrees of freedom, below which little is saved
_SHARE = 0.7  # of them, above which the space saves too little
_MODES = 3  # in the space, as a multiple of those that may grow
_CUT = 1e-5  # relative to the largest singular value


def in_few_modes(problem: DesignProblem, us: np.ndarray) -> DesignProblem | None:
    """The problem in the space of the modes that grow most in us (n, v); None if it saves little.

    It is also None with functions of the user's, which may need all degrees of freedom.
    """
    x = problem.x
    needs_all = (problem.objective is not None and not problem.least_growth) or problem.constraints
    if not problem.modes or x.n < _LARGE or x.band is not None or needs_all or problem.cycles:
        return None
    vectors, size = in_batches(functools.partial(_growing, problem), 1, us)
    V = decomposed(list(vectors[np.isfinite(vectors).all(axis=(1, 2))]), np.sqrt(size[0]), _CUT)
    if V.shape[1] > _SHARE * x.n:
        return None
    return problem.with_fields(x=ParametricStructure(**projected(x, V, V)))


@exported_jit
def _growing(problem: DesignProblem, us):
    """Right and left vectors (n, dofs, k) of the modes that grow most, and the diagonals of M."""

    def one(u):
        _, x = problem.stiffened(problem.mechanism_at(u, problem.nominal_condition))
        attached = assembled(x, problem.friction_slope, refuse=False)
        modes = solve(*attached[:3])
        sought = jnp.argsort(jnp.where(modes.s.imag >= 0, -modes.s.real, jnp.inf))
        chosen = sought[: _MODES * problem.modes]
        vectors = jnp.concatenate([modes.x[chosen], modes.y[chosen]]).T
        return vectors, jnp.diagonal(attached.M)

    return jax.vmap(one)(us)
