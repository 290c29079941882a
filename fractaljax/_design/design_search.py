"""How thorough the search for a design is."""

import dataclasses
from collections.abc import Sequence

from .._base.options import check_numbers
from .._base.parts import brief, whole


@dataclasses.dataclass(frozen=True)
class DesignSearch:
    """How `design` goes about its search, besides `starts` and `lattice`.

    The defaults suit most mechanisms. What concerns more than two joints has no meaning for fewer,
    or where a `solver` is given.

    **Fields:**

    - `exchange_rounds`: under an envelope, how often the worst conditions may join those that a
      design is solved for.
    - `restoring_steps`: most steps to where all requirements are met, from starts far from it.
    - `descent_steps`: steps of an `optimiser`.
    - `descent_ends`: distinct ends of these descents from which the solver starts.
    - `settled_paths`: for more than two joints, how many of the rough paths are continued.
    - `finished_paths`: how many of these are continued to the end.
    - `renewals`: for more than two joints, most rounds of new starts near the best design so far.
    - `renewed_starts`: new starts of a round.
    - `renewed_paths`: how many of their paths are continued.
    - `renewal_gain`: relative decrease of the objective that counts as a gain of a round; ends
      closer than this agree.
    - `idle_renewals`: rounds without a gain before the last one ends; one with two ends that agree
      with the best counts twice.
    - `kick_starts`: with `quiet_within`, how many starts each draw has that tries a design; the
      last draw verifies it.
    - `kick_rounds`: most designs that are solved for, each to avoid the failures of those before.
    - `kick_exclusion`: the least distance from a design that failed, as a share of the bounds,
      unless the end of its limit cycle is crossed; it is halved where no design is left.
    - `kick_bisections`: most steps back from the first design that survives to one that failed.

    **Raises:** `ValueError` for a field outside its domain, `TypeError` for one of another type.
    """

    exchange_rounds: int = 12
    restoring_steps: int = 30
    descent_steps: int = 100
    descent_ends: int = 4
    settled_paths: int = 8
    finished_paths: int = 2
    renewals: int = 12
    renewed_starts: int = 12
    renewed_paths: int = 4
    renewal_gain: float = 1e-3
    idle_renewals: int = 3
    kick_starts: Sequence[int] = (64, 256, 4000)
    kick_rounds: int = 16
    kick_exclusion: float = 0.1
    kick_bisections: int = 6

    def __post_init__(self):
        check_numbers(self, most_count=10_000, most=1)
        if not isinstance(self.kick_starts, (tuple, list)) or not self.kick_starts:
            raise TypeError(
                f"kick_starts must be a tuple of whole numbers, got {brief(self.kick_starts)}"
            )
        counts = tuple(whole("kick_starts", count, 1, 1_000_000) for count in self.kick_starts)
        object.__setattr__(self, "kick_starts", counts)  # a list where a file is read
