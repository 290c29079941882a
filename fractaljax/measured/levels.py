"""Heights that come in steps, are interpolated, clipped or put together: how far a spectrum holds.

Rounding to a step q adds q^2/12 to the variance: where heights change by more than q from point to
point this is white, q^2 dx/6 of a one-sided profile spectrum; where they do not, it lies at lower
frequencies and looks like a rougher surface. What tells is second differences, which know no
offset and no tilt: of heights without steps no two are the same; of heights in steps they are
multiples of q, and a share of q/(sqrt(2 pi) sigma) of those at a distance is the same, sigma being
their standard deviation. Where the share is small, the steps do not count at that distance. Heights
held over two points have no such second differences, but equal first ones.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np

_REPEATED = 0.2  # share of equal second differences below which D moves by less than its error
_FIRST = 1.5  # by as much the share of first differences is larger
_INTERPOLATED = 0.05  # the share falls below this at once where heights were put in between
_WINDOW = 0.01  # of the rms second difference: closer ones are equal
_AROUND = 5  # windows about it in which those of heights without steps are as many
_FEWEST = 32  # differences
_MOST = 2**16  # differences that are looked at
_GROWTH = 1.25  # of the distances that are tried
_HIGHEST = 0.25  # periods from point to point: half the Nyquist frequency
_EXACT = 1e-9  # of the range: rounding errors
_CLIPPED = 0.005  # share of the heights that is worth a line, if not a matter of chance
_CHANCE = 5  # times as many as at the next level, and points
_STRAIGHT = 0.01  # share of the heights
_JUMP = 10.0  # robust standard deviations of a difference of neighbours


def step_limit(z: np.ndarray, steps: tuple[float, ...]) -> float:
    """Frequency [1/m] up to which steps of heights z do not count; infinite if nowhere, or 0.

    z (n,) or (n, m) with NaN for gaps, `steps` [m] between points along its axes.
    """
    limit = math.inf
    for axis, step in enumerate(steps):
        lines, lag = np.moveaxis(z, axis, 0), 1
        while (share := _repeated(lines, lag)) >= _REPEATED:
            lag = max(lag + 1, int(_GROWTH * lag))
            if 2 * lag >= len(lines):
                return 0.0
        if lag > 1:
            lag *= 1 if share > _INTERPOLATED else 2  # a line between points is also a filter
            limit = min(limit, _HIGHEST / (lag * step))
    return limit


def _differences(z, order, lag=1):
    """First or second ones along the first axis, without gaps."""
    for _ in range(order):
        z = z[lag:] - z[:-lag]
    found = z[np.isfinite(z)]
    return found[:: -(-found.size // _MOST) or 1]


def _repeated(z, lag) -> float:
    """Share of the most frequent difference, beyond that of any continuous density."""
    shares = []
    for order, usual in ((2, 1.0), (1, _FIRST)):
        found = np.sort(_differences(z, order, lag))
        if found.size < _FEWEST:
            return 1.0
        half = max(_WINDOW * found.std(), _rounding(z))
        inner, outer = (
            np.searchsorted(found, found + width, "right") - np.searchsorted(found, found - width)
            for width in (half, _AROUND * half)
        )
        beyond = inner - (outer - inner) / (_AROUND - 1)
        shares.append(float(beyond.max() / found.size / usual))
    return max(shares)


def _rounding(z):
    return 8 * np.finfo(float).eps * np.nanmax(np.abs(z))


def level_flags(
    z: np.ndarray, limit: float, high: float, wanted: float, lowest: float
) -> Iterator[str]:
    """What to say of heights z whose steps count above `limit` [1/m], in a band up to `high`.

    Without steps the band would go up to `wanted`; none is left where `limit` is below `lowest`.
    """
    known = z[~np.isnan(z)]
    distinct = np.unique(known)
    which = "come in steps, or are clipped or interpolated"
    if 2 * distinct.size < known.size:
        step = np.median(np.diff(distinct))
        which = f"have only {distinct.size} levels (step {step:.3g} m)"
    if limit < lowest:
        yield f"too few levels: heights {which}, and D and G mean nothing"
    elif limit < high * (1 - 1e-9):
        yield f"heights {which}: D and G are in doubt, the band goes beyond {limit:.3g} 1/m"
    elif limit < wanted * (1 - 1e-9):
        yield f"heights {which}: the band ends at {high:.3g} 1/m"
    elif limit == math.inf:
        yield from _straight(z)
    yield from _clipped(z, distinct)
    yield from _jump(z)


def _clipped(z, distinct):
    """Many heights at an end of their range."""
    for what, end, next_one in (
        ("largest", distinct[-1], distinct[-2]),
        ("smallest", distinct[0], distinct[1]),
    ):
        count, others = np.sum(z == end), np.sum(z == next_one)
        if count >= max(_CHANCE * others, _CHANCE, _CLIPPED * z.size):
            yield f"clipped: {count / z.size:.1%} of the heights are the {what} one, {end:.4g} m"


def _straight(z):
    """Heights equal to or in line with their neighbours, more than there are of other changes."""
    for axis, order in itertools.product(range(z.ndim), (2, 1)):
        found = np.abs(_differences(np.moveaxis(z, axis, 0), order))
        if found.size < _FEWEST:
            continue
        exact = max(_EXACT * found.max(), _rounding(z))
        rest = np.sort(found[found > exact])
        flat = 1 - rest.size / found.size
        same = np.searchsorted(rest, rest + exact, "right") - np.arange(rest.size)
        if flat - same.max(initial=0) / found.size > _STRAIGHT and rest.size < found.size - 3:
            alike = "in line with their neighbours" if order == 2 else "equal to their neighbour"
            yield f"{flat:.1%} of the heights are {alike}: clipped, held or interpolated"
            return


def _jump(z):
    """One difference of neighbours, or of a map's lines, far beyond all others."""
    for axis in range(z.ndim):
        change = np.diff(np.moveaxis(z, axis, 0), axis=0)
        if z.ndim == 2:
            change = change[np.isfinite(change).any(axis=1)]
            change = np.nanmean(change, axis=1)
        change = change[np.isfinite(change)]
        away = np.abs(change - np.median(change)) if change.size else np.zeros(1)
        usual = 1.4826 * np.median(away)
        if away.max() > _JUMP * usual > 0:
            yield (
                f"a jump of {away.max():.3g} m, {away.max() / usual:.2g} times what is usual: "
                "were two scans put together?"
            )
            return
