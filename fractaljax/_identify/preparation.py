"""Prepare measured heights for a spectrum: checks, spikes, gaps."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.options import require_number
from .._base.parts import whole


@dataclasses.dataclass(frozen=True)
class Preprocessing:
    """How `identify` removes spikes, fills gaps and refuses what is too short for a spectrum.

    **Fields:**

    - `fewest_points`: points of a profile between long gaps, at least 32; 128 of them have a decade
      of frequencies between tilt and the Nyquist frequency.
    - `fewest_per_side`: points along each side of a map, at least 16.
    - `longest_gap`: missing points of a profile in a row that are interpolated; a longer gap
      divides the profile.
    - `most_missing`: share of the points of a map that may be missing, from 0 to 1.
    - `spike`: robust standard deviations, at least 1, by which a spike is off the mean of its
      neighbours; infinite to keep all heights.

    **Raises:** `ValueError` or `TypeError` for an option that is no number or outside its domain.
    """

    fewest_points: int = 128
    fewest_per_side: int = 48
    longest_gap: int = 4
    most_missing: float = 0.5
    spike: float = 8.0

    def __post_init__(self):
        whole("fewest_points", self.fewest_points, 32)
        whole("fewest_per_side", self.fewest_per_side, 16)
        whole("longest_gap", self.longest_gap, 0)
        require_number("most_missing", self.most_missing, 0, 1)
        require_number("spike", self.spike, 1)


class Heights(NamedTuple):
    """Heights without gaps, and what was changed."""

    segments: list[np.ndarray]  # contiguous segments of a profile, or one map
    gaps: list[np.ndarray]  # which heights of each were filled
    missing: int  # NaN in the input
    outliers: int  # spikes taken out
    unused: int  # points in segments that are too short
    despiked: np.ndarray  # the input without spikes, NaN where missing


def spacing(name: str, value: float) -> float:
    """A length [m]. **Raises:** `TypeError`; `ValueError` if not above 0, finite and sensible."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a number in m, got {value!r}") from None
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be above 0 and finite, in m, got {value!r}")
    if not _is_sensible(number):
        raise ValueError(f"{name} must be a length in m, got {value!r}")
    return number


def _is_sensible(length: float) -> bool:
    """True unless squares of a length [m] lose their digits."""
    return 1e-50 < length < 1e50


def check_heights(z: ArrayLike, options: Preprocessing = Preprocessing()) -> np.ndarray:
    """Heights in float64, (n,) or (n, m), NaN where masked. **Raises:** `ValueError`."""
    z = np.ma.filled(z, np.nan) if np.ma.isMaskedArray(z) else np.asarray(z)
    if z.dtype.kind not in "fiu":
        raise ValueError(f"z must be real heights in m, got an array of {z.dtype}")
    if z.ndim not in (1, 2):
        raise ValueError(f"z must be a profile (n,) or a map (n, m), got shape {z.shape}")
    fewest, kind = options.fewest_points, "a profile"
    if z.ndim == 2:
        fewest, kind = options.fewest_per_side, "each side of a map"
    if min(z.shape) < fewest:
        raise ValueError(f"z is too short: {kind} needs {fewest} points, got shape {z.shape}")
    z = z.astype(float)
    if np.isinf(z).any():
        raise ValueError(f"z must be finite (NaN where missing), got {np.isinf(z).sum()} infinite")
    if np.isnan(z).all():
        raise ValueError("z holds no heights: all are NaN")
    largest = np.nanmax(np.abs(z))
    if largest > 0 and not _is_sensible(largest):
        raise ValueError(f"z must be heights in m, got up to {largest:.3g}")
    return z


def prepare_heights(z: np.ndarray, options: Preprocessing = Preprocessing()) -> Heights:
    """Take out spikes, interpolate short gaps, and split a profile at longer ones.

    **Raises:** `ValueError` if too few heights are left, or if they are constant or a ramp.
    """
    _refuse_flat(z)
    missing = int(np.isnan(z).sum())
    z = _remove_spikes(z, options.spike)
    outliers = int(np.isnan(z).sum()) - missing
    if z.ndim == 2:
        share = np.isnan(z).mean()
        if share > options.most_missing:
            raise ValueError(f"z has too many gaps: {share:.0%} of the map are missing")
        return Heights([fill_gaps(z)], [np.isnan(z)], missing, outliers, 0, z)
    indices = np.flatnonzero(~np.isnan(z))
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > options.longest_gap + 1) + 1)
    measured = [z[run[0] : run[-1] + 1] for run in runs]
    sizes = np.array([segment.size for segment in measured])
    fewest = options.fewest_points
    if sizes.max() < fewest:
        raise ValueError(
            f"z has too many gaps: {fewest} points in a row are needed (gaps of up to "
            f"{options.longest_gap} are interpolated), the longest segment has {sizes.max()}"
        )
    used = sizes >= max(fewest // 2, sizes.max() / 8)
    kept = [segment for segment, use in zip(measured, used, strict=True) if use]
    gaps = [np.isnan(segment) for segment in kept]
    return Heights([*map(fill_gaps, kept)], gaps, missing, outliers, int(sizes[~used].sum()), z)


def _refuse_flat(z):
    positions = np.nonzero(~np.isnan(z))
    heights = z[positions]
    plane = np.stack([np.ones(heights.size), *(axis.astype(float) for axis in positions)], 1)
    residual = heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]
    smallest = 1e-12 * np.abs(heights).max()  # rounding errors
    if np.abs(residual).max() <= smallest:
        kind = "constant" if np.ptp(heights) <= smallest else "a ramp"
        raise ValueError(f"z has no roughness: it is {kind}")


def _remove_spikes(z, limit):
    """Heights, with NaN for those much further from the mean of their neighbours than most.

    `limit` is the ratio to the usual distance. A kink, such as the cusp between two arcs of a tip,
    is not a spike: it is four times as far from the mean of the points four steps away, a spike of
    one or two points at most twice. Three times separates them.
    """
    from scipy import ndimage

    cross = ndimage.generate_binary_structure(z.ndim, 1)
    for _ in range(3):  # a spike may hide a smaller one beside it
        present = ~np.isnan(z)
        complete = fill_gaps(z)
        deviation = _from_neighbours(complete)
        size = np.where(present, np.abs(deviation), 0.0)
        # Most of a quantised profile may be straight, so the median alone is too small a scale.
        usual = max(1.4826 * np.median(size[present]), 0.3 * np.quantile(size[present], 0.9))
        # A spike shifts the means of its neighbours as well: only the largest counts.
        largest = ndimage.maximum_filter(size, footprint=cross, mode="constant")
        spikes = (size > limit * usual) & (size >= largest) & (usual > 0)
        if spikes.any():
            spikes &= _from_neighbours(complete, 4) * np.sign(deviation) < 3 * size
        if not spikes.any():
            break
        z = np.where(spikes, np.nan, z)
    return z


def _from_neighbours(z, lag=1):
    """Height above the mean of the two points `lag` away, averaged over the axes; 0 at the ends."""
    deviation = np.zeros(z.shape)
    for axis in range(z.ndim):
        inner, lines = np.moveaxis(deviation, axis, 0)[lag:-lag], np.moveaxis(z, axis, 0)
        inner -= (lines[2 * lag :] - 2 * lines[lag:-lag] + lines[: -2 * lag]) / 2
    return deviation / z.ndim


def fill_gaps(z):
    """Gaps filled linearly along each axis, the mean of both in a map, level beyond the ends."""

    def fill(line):
        indices = np.flatnonzero(~np.isnan(line))
        return np.interp(np.arange(line.size), indices, line[indices]) if indices.size else line

    if not np.isnan(z).any():
        return z
    filled = np.stack([np.apply_along_axis(fill, axis, z) for axis in range(z.ndim)])
    ways = (~np.isnan(filled)).sum(axis=0)
    return np.where(ways > 0, np.nansum(filled, axis=0) / np.maximum(ways, 1), np.nanmean(z))
