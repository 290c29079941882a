"""How `basin` runs many starts side by side, and when it labels them."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class BasinSearch:
    """How `basin` finds what starts end in; the defaults suit most mechanisms.

    Lengths of time are in units of 1/omega, with omega as in `limit_cycle`: no eigenfrequency
    exceeds 1. A distance is that of returns to the section, relative to their size.

    **Fields:**

    - `lanes`: starts that run side by side in one program; an eighth of it where few are left.
    - `chunks`: programs that run at a time, which the cores share. The result depends on it, but
      not on the number of cores.
    - `step`, `fine_rounds`: step of the coarse run, and the rounds in which it is half of that, for
      a start may be near the boundary of two basins.
    - `steps`, `samples`: steps in a round, and samples of the energy among them.
    - `rounds`: rounds after which the starts that are labelled make room for others, at the latest.
    - `window`: rounds over which the energy of a motion without switches is averaged.
    - `near_distance`, `near_rounds`: distance from a cycle within which a start is labelled after
      so many rounds of approach.
    - `approach_distance`, `approach_rounds`: the same for a larger distance; also the number of
      rounds within `near_distance` that label a start without an approach.
    - `patience`: rounds without a label after which a start is searched in full.
    - `failures`: full searches without an orbit, after which the coarse run alone decides.
    """

    lanes: int = 256
    chunks: int = 4
    step: float = 0.2
    fine_rounds: int = 64
    steps: int = 128
    samples: int = 32
    rounds: int = 16
    window: int = 4
    near_distance: float = 0.02
    near_rounds: int = 3
    approach_distance: float = 0.15
    approach_rounds: int = 8
    patience: int = 8
    failures: int = 8
