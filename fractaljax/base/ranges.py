"""Ranges of a quantity, and how they are gone along: evenly, or in logarithms where wide."""

from typing import Any


def is_logarithmic(low: float, high: float) -> bool:
    """Whether a range is gone along, and shown, in logarithms: a decade or more above 0."""
    return low > 0 and high >= 10 * low


def within(low: float, high: float, at: Any) -> Any:
    """The values (n,) at places (n,) from 0, at the low end of a range, to 1, at its high end."""
    # At 0 and 1 to the last bit: an end may be that of a domain.
    if is_logarithmic(low, high):
        return low ** (1 - at) * high**at
    return low * (1 - at) + high * at
