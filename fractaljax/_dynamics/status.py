"""The states of a search in one lane, beside the results that they are reported as."""

import enum

from .cycle import CycleResult


class Status(enum.IntEnum):
    """Whether a lane is still searched, or how its search ended."""

    result: CycleResult

    def __new__(cls, code: int, result: CycleResult):
        """The state of that code; `result` is what a limit cycle reports for it."""
        status = int.__new__(cls, code)
        status._value_ = code
        status.result = result
        return status

    RUNNING = 0, CycleResult.exhausted  # never reported, as the search goes on
    CONVERGED = 1, CycleResult.converged
    EQUILIBRIUM = 2, CycleResult.equilibrium
    DIVERGED = 3, CycleResult.diverged
    NOT_PERIODIC = 4, CycleResult.not_periodic
    EXHAUSTED = 5, CycleResult.exhausted
    TOO_LONG = 6, CycleResult.too_long
    NOT_FINITE = 7, CycleResult.not_finite
