"""Quantised, held and interpolated heights: the frequency up to which a spectrum is valid.

Rounding to a step q adds q^2/12 to the variance. Where heights change by more than q from point to
point this is white noise, q^2 dx/6 in a one-sided profile spectrum. Where they change by less, it
is at lower frequencies and looks like a rougher surface. Second differences, free of offset and
tilt, reveal it: no two are equal for continuous heights, a share q/(sqrt(2 pi) sigma) is for
quantised ones, sigma being their standard deviation. The steps do not matter at lags where that
share is small. Heights held over two points repeat in first differences instead.
"""

import math

import numpy as np

_REPEATED = 0.2  # share of equal second differences below which D changes by less than its error
_FIRST = 1.5  # the share of equal first differences is larger by this factor
_INTERPOLATED = 0.05  # interpolated heights fall below this share at once
_WINDOW = 0.01  # of the rms second difference: closer ones are equal
_AROUND = 5  # windows that estimate the density of continuous heights
FEWEST = 32  # differences
_MOST = 2**16  # differences used
_GROWTH = 1.25  # of the lags tried
_HIGHEST = 0.25  # cycles per step: half the Nyquist frequency


def quantisation_limit(z: np.ndarray, steps: tuple[float, ...]) -> float:
    """Frequency [1/m] up to which quantisation does not matter: infinite if it never does.

    z (n,) or (n, m) with NaN for gaps, `steps` [m] between points along its axes. 0 if it matters
    everywhere.
    """
    limit = math.inf
    for axis, step in enumerate(steps):
        lines, lag = np.moveaxis(z, axis, 0), 1
        while (share := _repeated(lines, lag)) >= _REPEATED:
            lag = max(lag + 1, int(_GROWTH * lag))
            if 2 * lag >= len(lines):
                return 0.0
        if lag > 1:
            lag *= 1 if share > _INTERPOLATED else 2  # interpolation is also a filter
            limit = min(limit, _HIGHEST / (lag * step))
    return limit


def differences(z: np.ndarray, order: int, lag: int = 1) -> np.ndarray:
    """First or second differences along the first axis, without gaps, thinned if very many."""
    for _ in range(order):
        z = z[lag:] - z[:-lag]
    finite = z[np.isfinite(z)]
    return finite[:: -(-finite.size // _MOST) or 1]


def rounding(z: np.ndarray) -> float:
    """Rounding error of a difference."""
    return 8 * np.finfo(float).eps * np.nanmax(np.abs(z))


def _repeated(z, lag) -> float:
    """Share of the most frequent difference, beyond that of a continuous density."""
    shares = []
    for order, usual in ((2, 1.0), (1, _FIRST)):
        ordered = np.sort(differences(z, order, lag))
        if ordered.size < FEWEST:
            return 1.0
        half = max(_WINDOW * ordered.std(), rounding(z))
        inner, outer = (
            np.searchsorted(ordered, ordered + width, "right")
            - np.searchsorted(ordered, ordered - width)
            for width in (half, _AROUND * half)
        )
        beyond = inner - (outer - inner) / (_AROUND - 1)
        shares.append(float(beyond.max() / ordered.size / usual))
    return max(shares)
