"""Ranges of a quantity, their axes, and points that fill them evenly."""

from typing import Any

import numpy as np


def is_logarithmic(low: float, high: float) -> bool:
    """True if a range has a logarithmic axis: it is positive and spans a decade or more."""
    return low > 0 and high >= 10 * low


def within(low: float, high: float, at: Any) -> Any:
    """The value at a fraction `at` of a range, 0 at its low end and 1 at its high end.

    Both ends are exact to the last bit, since an end may be the limit of a domain.
    """
    if is_logarithmic(low, high):
        return low ** (1 - at) * high**at
    return low * (1 - at) + high * at


def low_discrepancy(count: int, dimensions: int) -> np.ndarray:
    """Points (count, dimensions) that fill the unit cube evenly: a rank-1 lattice.

    Its steps are powers of 1/g with g^dimensions = g + 1, as in R. Roberts' sequence; in the plane
    it is the Fibonacci lattice.
    """
    i, g = np.arange(count), 2.0
    for _ in range(50):
        g = (1 + g) ** (1 / dimensions)
    steps = [1, *np.round(count * g ** -np.arange(1.0, dimensions))]
    return np.stack([(step * i % count + 0.5) / count for step in steps], axis=1)
