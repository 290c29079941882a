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
from .._mechanism.quantities import has_memory
from .._mechanism.structure import ParametricStructure
from .._stability.linearise import assembled
from .._stability.quadratic import solve
from .._stability.reduced_space import decomposed
from .._stability.snapshots import projected
from .problem import DesignProblem


def project_on_modes(problem: DesignProblem, us: np.ndarray) -> DesignProblem | None:
    """The problem in the space of the modes that grow most in us (n, v); None if it saves little.

    It is also None with functions of the user's, which may need all degrees of freedom.
    """
    x = problem.x
    needs_all = (problem.objective is not None and not problem.least_growth) or problem.constraints
    if not problem.modes or x.band is not None or needs_all or problem.cycles:
        return None
    if x.n < 60 or has_memory(x):  # eigenvalues take little time, or are those of a field
        return None
    vectors, size = in_batches(functools.partial(_growing_modes, problem), 1, us)
    vectors = vectors[np.isfinite(vectors).all(axis=(1, 2))]
    # Directions with less than this share of the largest one are left out.
    V = decomposed(list(vectors), np.sqrt(size[0]), 1e-5)
    if V.shape[1] > 0.7 * x.n:  # eigenvalues take a third of the time at least
        return None
    return problem.with_fields(x=ParametricStructure(**projected(x, V, V)))


@exported_jit
def _growing_modes(problem: DesignProblem, us):
    """Right and left vectors (n, dofs, k) of the modes that grow most, and the diagonals of M."""

    def one(u):
        _, x = problem.stiffened(problem.mechanism_at(u, problem.nominal_condition))
        attached = assembled(x, problem.friction_slope, refuse=False)
        modes = solve(*attached.matrices)
        order = jnp.argsort(jnp.where(modes.s.imag >= 0, -modes.s.real, jnp.inf))
        chosen = order[: 3 * problem.modes]  # other modes come up at other designs
        vectors = jnp.concatenate([modes.x[chosen], modes.y[chosen]]).T
        return vectors, jnp.diagonal(attached.M)

    return jax.vmap(one)(us)
