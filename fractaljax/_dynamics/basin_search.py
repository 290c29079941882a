"""How `basin` runs many starts side by side, and when it labels them."""

import dataclasses

from .._base.options import check_numbers


@dataclasses.dataclass(frozen=True)
class BasinSearch:
    """How `basin` finds what starts end in; the defaults suit most mechanisms.

    Lengths of time are in units of 1/omega, with omega as in `limit_cycle`: no eigenfrequency
    exceeds 1. A distance is that of returns to the section, relative to their size.

    **Fields:**

    - `lanes`: starts that run side by side in one program; an eighth as many once few are left.
    - `chunks`: programs that run at a time, shared by the cores. A fixed number, so that no result
      depends on the number of cores.
    - `step`, `fine_rounds`: step of the coarse run, and the number of first rounds in which it is
      halved, for a start may be near the boundary of two basins.
    - `samples`, `sample_steps`: samples of the energy in a round, and steps for each of them.
    - `rounds`: rounds after which, at the latest, labelled starts make room for others.
    - `window`: rounds over which the energy of a motion without switches is averaged.
    - `near_distance`, `near_rounds`: a start this near a cycle gets its label after so many rounds
      of approach.
    - `approach_distance`, `approach_rounds`: the same at a larger distance. As many rounds within
      `near_distance` are enough without approach.
    - `patience`: rounds without a label after which a start is searched in full.
    - `failures`: full searches without an orbit, after which the coarse run alone decides.

    **Raises:** `ValueError` for a count that is not a whole number of at least 1 (`failures`: 0),
    and for another number that is not above 0 and finite.
    """

    lanes: int = 256
    chunks: int = 4
    step: float = 0.2
    fine_rounds: int = 64
    samples: int = 32
    sample_steps: int = 4
    rounds: int = 16
    window: int = 4
    near_distance: float = 0.02
    near_rounds: int = 3
    approach_distance: float = 0.15
    approach_rounds: int = 8
    patience: int = 8
    failures: int = 8

    def __post_init__(self):
        check_numbers(self, least={"failures": 0})
