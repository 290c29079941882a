"""The number of modes of a structure that may grow; each has a growth rate to keep low."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from .._base.programs import exported_jit
from .._base.ranges import low_discrepancy
from .._stability.linearise import assembled
from .._stability.quadratic import leading
from .joints import with_contact_law
from .rows import paired, rows_in_batches

if TYPE_CHECKING:
    from .problem import DesignProblem

_LOOKED_AT = 15  # designs, besides the initial one, in which growing modes are counted
MODES_MOST = 16  # that requirements can include


def modes_to_keep(problem: "DesignProblem") -> int:
    """The number of modes that may grow: two more than grow in any of a few designs."""
    designs = np.concatenate(
        [np.asarray(problem.start)[None], low_discrepancy(_LOOKED_AT, len(problem.names))]
    )
    modes = max(2, min(MODES_MOST, problem.x.n))
    looking = problem.with_fields(modes=modes)
    pairs = paired(designs, np.asarray(problem.nominal_condition)[None])
    growing = rows_in_batches(_rates, looking, *pairs) > float(problem.target)
    return min(int(growing.sum(axis=2).max()) + 2, modes)


@exported_jit
def _rates(problem: "DesignProblem", us, conditions):
    """The largest growth rates (n, laws, modes), NaN where there is no steady sliding."""

    def one(u, condition):
        x = problem.mechanism_at(u, condition)
        rates = []
        for each in (problem.stiffened(x)[1], *(with_contact_law(x, law) for law in problem.laws)):
            attached = assembled(each, problem.friction_slope, refuse=False)
            modes = leading(*attached[:3], problem.modes, x.band)
            rates.append(jnp.where(attached.lost, jnp.nan, modes.s.real))
        return jnp.stack(rates)

    return jax.vmap(one)(us, conditions)
