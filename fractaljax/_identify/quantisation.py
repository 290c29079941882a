"""Quantised, held and interpolated heights: how far up in frequency a spectrum holds.

Rounding to a step q adds q^2/12 to the variance. Where heights change by more than q from point to
point this is white noise, q^2 dx/6 of a one-sided profile spectrum. Where they do not, it is at
lower frequencies and looks like a rougher surface. Second differences tell, free of offset and
tilt: of continuous heights no two are the same, of quantised heights a share q/(sqrt(2 pi) sigma)
is, sigma being their standard deviation. At distances where it is small the steps do not count.
Heights held over two points repeat in first differences instead.
"""

import math

import numpy as np

_REPEATED = 0.2  # share of equal second differences below which D moves by less than its error
_FIRST = 1.5  # by as much the share of first differences is larger
_INTERPOLATED = 0.05  # interpolated heights fall below this share at once
_WINDOW = 0.01  # of the rms second difference: closer ones are equal
_AROUND = 5  # windows that estimate the density of continuous heights
FEWEST = 32  # differences
_MOST = 2**16  # differences that are used
_GROWTH = 1.25  # of the distances that are tried
_HIGHEST = 0.25  # periods from point to point: half the Nyquist frequency


def quantisation_limit(z: np.ndarray, steps: tuple[float, ...]) -> float:
    """Frequency [1/m] up to which steps of the heights do not count: infinite if they never do.

    z (n,) or (n, m) with NaN for gaps, `steps` [m] between points along its axes. 0 if they do
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
    found = z[np.isfinite(z)]
    return found[:: -(-found.size // _MOST) or 1]


def rounding(z: np.ndarray) -> float:
    """Rounding error of a difference."""
    return 8 * np.finfo(float).eps * np.nanmax(np.abs(z))


def _repeated(z, lag) -> float:
    """Share of the most frequent difference, beyond that of a continuous density."""
    shares = []
    for order, usual in ((2, 1.0), (1, _FIRST)):
        found = np.sort(differences(z, order, lag))
        if found.size < FEWEST:
            return 1.0
        half = max(_WINDOW * found.std(), rounding(z))
        inner, outer = (
            np.searchsorted(found, found + width, "right") - np.searchsorted(found, found - width)
            for width in (half, _AROUND * half)
        )
        beyond = inner - (outer - inner) / (_AROUND - 1)
        shares.append(float(beyond.max() / found.size / usual))
    return max(shares)
