"""How many modes of a structure may grow: each has a growth rate to keep low."""

import dataclasses

import numpy as np

from .._base.ranges import low_discrepancy
from .problem import DesignProblem
from .rows import evaluated, rows_in_batches

_LOOKED_AT = 15  # designs, besides the given one, in which growing modes are counted
_MODES_MOST = 16  # that requirements are made of


def modes_to_keep(problem: DesignProblem) -> int:
    """How many modes may grow: two more than grow in any of a few designs."""
    designs = np.concatenate(
        [np.asarray(problem.start)[None], low_discrepancy(_LOOKED_AT, len(problem.names))]
    )
    modes = max(2, min(_MODES_MOST, problem.x.n))
    looking = dataclasses.replace(problem, scatter=None, modes=modes)
    own = np.broadcast_to(
        np.asarray(problem.own_condition), (len(designs), len(problem.conditions))
    )
    rows = rows_in_batches(evaluated, looking, designs, own)[:, looking.growth_columns]
    growing = (rows > 0).reshape(len(rows), -1, modes).sum(axis=2)  # by each law
    return min(int(growing.max()) + 2, modes)
