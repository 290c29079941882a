"""What must be done to measured heights first: checks, spikes, gaps."""

import math
from typing import Any, NamedTuple

import numpy as np

FEWEST = 128  # points of a profile: a decade of frequencies between tilt and Nyquist
FEWEST_ACROSS = 48  # points of each side of a map
_SHORT = 4  # points: a longer gap divides a profile
_MOST_MISSING = 0.5  # of a map
_ABSURD = 1e50  # m, and 1/m: beyond, squares lose their digits
_SPIKE_ROUNDS = 3
_SPIKE = 8.0  # robust standard deviations of a height from the mean of its neighbours


class Heights(NamedTuple):
    """Heights ready for a spectrum, and what had to be done."""

    stretches: list[np.ndarray]  # of a profile, without gaps; or one map
    missing: int  # NaN in what was given
    outliers: int  # spikes taken out
    unused: int  # points in stretches too short to be of use
    known: np.ndarray  # what was given less spikes, NaN where missing


def spacing(name: str, value: Any) -> float:
    """A distance [m]. **Raises:** `ValueError` unless it is above 0 and finite, within reason."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a number in m, got {value!r}") from None
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be above 0 and finite, in m, got {value!r}")
    if not 1 / _ABSURD < number < _ABSURD:
        raise ValueError(f"{name} must be a length in m, got {value!r}")
    return number


def checked(z: Any) -> np.ndarray:
    """Heights as an array of float64 (n,) or (n, m). **Raises:** `ValueError` in one line."""
    z = np.ma.filled(z, np.nan) if np.ma.isMaskedArray(z) else np.asarray(z)
    if z.dtype.kind not in "fiu":
        raise ValueError(f"z must be real heights in m, got an array of {z.dtype}")
    if z.ndim not in (1, 2):
        raise ValueError(f"z must be a profile (n,) or a map (n, m), got shape {z.shape}")
    fewest = FEWEST if z.ndim == 1 else FEWEST_ACROSS
    if min(z.shape) < fewest:
        kind = "a profile" if z.ndim == 1 else "each side of a map"
        raise ValueError(f"z is too short: {kind} needs {fewest} points, got shape {z.shape}")
    z = z.astype(float)
    if np.isinf(z).any():
        raise ValueError(f"z must be finite (NaN where missing), got {np.isinf(z).sum()} infinite")
    if np.isnan(z).all():
        raise ValueError("z holds no heights: all are NaN")
    largest = np.nanmax(np.abs(z))
    if largest > 0 and not 1 / _ABSURD < largest < _ABSURD:
        raise ValueError(f"z must be heights in m, got up to {largest:.3g}")
    return z


def prepared(z: np.ndarray) -> Heights:
    """Spikes become gaps; short gaps are bridged, longer ones divide a profile.

    **Raises:** `ValueError` if too little is left, or nothing but a constant or a ramp.
    """
    missing = int(np.isnan(z).sum())
    _not_flat(z)
    spikes = _spikes(z)
    z = np.where(spikes, np.nan, z)
    if z.ndim == 2:
        share = np.isnan(z).mean()
        if share > _MOST_MISSING:
            raise ValueError(f"z has too many gaps: {share:.0%} of the map are missing")
        return Heights([_bridged_map(z)], missing, int(spikes.sum()), 0, z)
    stretches = _stretches(z)
    longest = max(stretch.size for stretch in stretches)
    if longest < FEWEST:
        raise ValueError(
            f"z has too many gaps: {FEWEST} points in a row are needed, gaps of up to {_SHORT} "
            f"among them, the longest stretch has {longest}"
        )
    used = [part for part in stretches if part.size >= max(FEWEST // 2, longest / 8)]
    unused = sum(part.size for part in stretches) - sum(part.size for part in used)
    return Heights(used, missing, int(spikes.sum()), unused, z)


def _not_flat(z):
    """Refuse heights that are nothing but a line or a plane, but for rounding."""
    known = ~np.isnan(z)
    places = np.stack([np.ones(known.sum()), *(axis.astype(float) for axis in np.nonzero(known))])
    heights = z[known]
    plane = np.linalg.lstsq(places.T, heights, rcond=None)[0] @ places
    if np.abs(heights - plane).max() <= 1e-12 * np.abs(heights).max():
        slope = "constant" if np.ptp(heights) <= 1e-12 * np.abs(heights).max() else "a ramp"
        raise ValueError(f"z has no roughness: it is {slope}")


def _spikes(z):
    """Heights much further from the mean of their neighbours than most are."""
    found = np.zeros(z.shape, bool)
    for _ in range(_SPIKE_ROUNDS):
        known = ~np.isnan(z)
        away = np.where(known, _from_neighbours(_filled(z)), 0.0)
        size = np.abs(away)
        # Of heights in steps most are in line: then the others are no spikes.
        usual = max(1.4826 * np.median(size[known]), 0.3 * np.quantile(size[known], 0.9))
        limit = _SPIKE * usual
        # A spike moves its neighbours' means as well: only the largest of them is one.
        new = (size > limit) & (size >= _largest_neighbour(size)) & (limit > 0)
        if not new.any():
            break
        found |= new
        z = np.where(new, np.nan, z)
    return found


def _filled(z):
    return _bridged(z) if z.ndim == 1 else _bridged_map(z)


def _from_neighbours(z):
    away = np.zeros(z.shape)
    for axis in range(z.ndim):
        moved = np.moveaxis(z, axis, 0)
        np.moveaxis(away, axis, 0)[1:-1] += moved[1:-1] - (moved[:-2] + moved[2:]) / 2
    return away / z.ndim


def _largest_neighbour(size):
    largest = np.zeros(size.shape)
    for axis in range(size.ndim):
        here, there = np.moveaxis(largest, axis, 0), np.moveaxis(size, axis, 0)
        np.maximum(here[1:], there[:-1], out=here[1:])
        np.maximum(here[:-1], there[1:], out=here[:-1])
    return largest


def _bridged(z):
    """A profile with every gap bridged by a line, and level beyond its ends."""
    known = np.flatnonzero(~np.isnan(z))
    return np.interp(np.arange(z.size), known, z[known])


def _bridged_map(z):
    """A map with its gaps filled by the mean of the bridges along x and along y."""
    gaps = np.isnan(z)
    if not gaps.any():
        return z
    filled, ways = np.zeros(z.shape), np.zeros(z.shape)
    for axis in (0, 1):
        lines, holes = np.moveaxis(z, axis, 1), np.moveaxis(gaps, axis, 1)
        sums, count = np.moveaxis(filled, axis, 1), np.moveaxis(ways, axis, 1)
        for i in np.flatnonzero(holes.any(axis=1) & ~holes.all(axis=1)):
            sums[i] += np.where(holes[i], _bridged(lines[i]), 0.0)
            count[i] += holes[i]
    level = np.nanmean(z)
    return np.where(gaps, np.where(ways > 0, filled / np.maximum(ways, 1), level), z)


def _stretches(z):
    """Stretches of a profile between long gaps, short ones bridged."""
    known = np.flatnonzero(~np.isnan(z))
    breaks = np.flatnonzero(np.diff(known) > _SHORT + 1)
    starts = known[np.concatenate([[0], breaks + 1])]
    ends = known[np.concatenate([breaks, [known.size - 1]])] + 1
    return [_bridged(z[a:b]) for a, b in zip(starts, ends, strict=True)]
