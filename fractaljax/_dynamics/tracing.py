"""How finely a branch of cycles is resolved, and how hard each step tries."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class BranchTracing:
    """How a branch of cycles is followed.

    **Fields:**

    - `segment`: longest segment of an orbit at rtol 1e-9, in units of 1/omega.
    - `samples`: states of an orbit that show where friction is stiff, where t.x is largest, and how
      fast it slides.
    - `refinements`: attempts at a mesh that is fine enough.
    - `growth`: factor by which a phase may grow before its segments are cut anew.
    - `closings`: attempts at closing the gaps between segments in one evaluation.
    - `kept_gap`: gap from which on an evaluation predicts no others.
    - `memory`: evaluations that are kept; states between them are extrapolated from the nearest.
    - `small`: size of an orbit without switches, in units of V/omega, below which a Hopf point is
      near.
    """

    segment: float = 0.25
    samples: int = 512
    refinements: int = 8
    growth: float = 1.3
    closings: int = 4
    kept_gap: float = 0.3
    memory: int = 64
    small: float = 0.03
