"""Quantised, held and interpolated heights: the frequency up to which a spectrum is valid.

Rounding to a step q adds q^2/12 to the variance. Where heights change by more than q from point to
point this is white noise, q^2 dx/6 in a one-sided profile spectrum. Where they change by less, it
is at lower frequencies and looks like a rougher surface. Second differences, free of offset and
tilt, reveal it: no two are equal for continuous heights, a share q/(sqrt(2 pi) sigma) is for
quantised ones, sigma being their standard deviation. The steps do not matter at lags where that
share is small. Heights held over two points repeat in first differences instead.
"""

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class QuantisationTest:
    """When differences of heights count as equal, and how many equal ones matter.

    **Fields:**

    - `repeated`: share of equal second differences; with less of them, D changes by less than its
      error.
    - `first`: factor by which the share of equal first differences is larger.
    - `interpolated`: share below which that of interpolated heights falls at once.
    - `window`: largest distance of equal differences, relative to the rms second difference.
    - `fewest`: number of differences; with fewer, the test tells nothing.
    """

    repeated: float = 0.2
    first: float = 1.5
    interpolated: float = 0.05
    window: float = 0.01
    fewest: int = 32


def quantisation_limit(
    z: np.ndarray, steps: tuple[float, ...], test: QuantisationTest = QuantisationTest()
) -> float:
    """Frequency [1/m] up to which quantisation does not matter: infinite if it never does.

    z (n,) or (n, m) with NaN for gaps, `steps` [m] between points along its axes. 0 if it matters
    everywhere.
    """
    limit = math.inf
    for axis, step in enumerate(steps):
        lines, lag = np.moveaxis(z, axis, 0), 1
        while (share := _repeated(lines, lag, test)) >= test.repeated:
            lag = max(lag + 1, int(1.25 * lag))
            if 2 * lag >= len(lines):
                return 0.0
        if lag > 1:
            lag *= 1 if share > test.interpolated else 2  # interpolation is also a filter
            limit = min(limit, 0.25 / (lag * step))  # half the Nyquist frequency of these points
    return limit


def differences(z: np.ndarray, order: int, lag: int = 1, most: int = 2**16) -> np.ndarray:
    """First or second differences along the first axis, without gaps, thinned to at most `most`."""
    for _ in range(order):
        z = z[lag:] - z[:-lag]
    finite = z[np.isfinite(z)]
    return finite[:: -(-finite.size // most) or 1]


def rounding(z: np.ndarray) -> float:
    """Rounding error of a difference."""
    return 8 * np.finfo(float).eps * np.nanmax(np.abs(z))


def _repeated(z, lag, test) -> float:
    """Share of the most frequent difference, beyond that of a continuous density."""
    shares, around = [], 5  # windows, to estimate the density of continuous heights
    for order, usual in ((2, 1.0), (1, test.first)):
        ordered = np.sort(differences(z, order, lag))
        if ordered.size < test.fewest:
            return 1.0
        half = max(test.window * ordered.std(), rounding(z))
        inner, outer = (
            np.searchsorted(ordered, ordered + width, "right")
            - np.searchsorted(ordered, ordered - width)
            for width in (half, around * half)
        )
        beyond = inner - (outer - inner) / (around - 1)
        shares.append(float(beyond.max() / ordered.size / usual))
    return max(shares)
