"""The number of modes of a structure that may grow; each has a growth rate to keep low."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from .._base.programs import exported_jit
from .._base.ranges import low_discrepancy
from .._mechanism.structure import Structure
from .._stability.linearise import assembled
from .._stability.quadratic import leading
from .joints import with_contact_law
from .rows import paired, rows_in_batches

if TYPE_CHECKING:
    from .problem import DesignProblem


def largest_mode_count(x: Structure) -> int:
    """The largest number of modes of a structure that requirements can include."""
    return min(16, x.n)


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
            attached = assembled(each, problem.friction_slope, refuse=False)
            modes = leading(*attached.matrices, problem.modes, x.band)
            rates.append(jnp.where(attached.lost, jnp.nan, modes.s.real))
        return jnp.stack(rates)

    return jax.vmap(one)(us, conditions)
