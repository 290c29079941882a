"""The modes that may grow, where there is no closed form; each has a growth rate to keep low."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.programs import exported_jit
from .._base.ranges import low_discrepancy
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import has_memory
from .._stability.linearise import linearised
from .._stability.quadratic import Leading
from .joints import with_contact_law
from .rows import paired, rows_in_batches

if TYPE_CHECKING:
    from .problem import DesignProblem


def needs_modes(x: Mechanism) -> bool:
    """True for what has no closed form: a structure, or friction with memory."""
    return not x.uncoupled or has_memory(x)


def largest_mode_count(x: Mechanism) -> int:
    """The largest number of modes that requirements can include."""
    return min(16, x.n)


def leading_modes(x: Any, friction_slope: bool, count: int) -> tuple[Leading, Float[Array, " k"]]:
    """The modes that grow most, and their growth rates, NaN where there is no steady sliding."""
    system: Any = linearised(x, friction_slope, refuse=False)  # LAPACK gets numbers even so
    modes = system.leading(count)
    return modes, jnp.where(system.lost, jnp.nan, modes.s.real)


def modes_to_keep(problem: "DesignProblem") -> int:
    """The number of modes that may grow: two more than grow in any of a few designs."""
    spread = low_discrepancy(15, len(problem.names))  # few, for each takes long
    designs = np.concatenate([np.asarray(problem.start)[None], spread])
    modes = max(2, largest_mode_count(problem.x))
    counting = problem.with_fields(modes=modes)
    pairs = paired(designs, np.asarray(problem.nominal_condition)[None])
    growing = rows_in_batches(_rates, counting, *pairs) > float(problem.target)
    return min(int(growing.sum(axis=2).max()) + 2, modes)


@exported_jit
def _rates(problem: "DesignProblem", us, conditions):
    """The largest growth rates (n, laws, modes), NaN where there is no steady sliding."""

    def one(u, condition):
        x = problem.mechanism_at(u, condition)
        rates = []
        for each in (problem.stiffened(x)[1], *(with_contact_law(x, law) for law in problem.laws)):
            rates.append(leading_modes(each, problem.friction_slope, problem.modes)[1])
        return jnp.stack(rates)

    return jax.vmap(one)(us, conditions)
