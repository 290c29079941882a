"""Ranges of a quantity, and the axis they are sampled and shown on."""

from typing import Any


def is_logarithmic(low: float, high: float) -> bool:
    """Whether a range has a logarithmic axis: it is positive and spans a decade or more."""
    return low > 0 and high >= 10 * low


def within(low: float, high: float, at: Any) -> Any:
    """The value at a fraction `at` of a range, 0 at its low end and 1 at its high end.

    Both ends are met to the last bit, since an end may be that of a domain.
    """
    if is_logarithmic(low, high):
        return low ** (1 - at) * high**at
    return low * (1 - at) + high * at
