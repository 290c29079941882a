"""Measured heights made fit for what takes no gaps, spikes or tilt."""

import os
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import flag, require_kind
from .measurement import Measurement
from .preparation import Preprocessing, prepare_heights
from .source import read_heights
from .spectrum import remove_plane

_SMALL = Preprocessing(fewest_points=32, fewest_per_side=16)  # as little as these options allow


def prepare_measurement(
    z: ArrayLike | Measurement | str | os.PathLike | Any,
    dx: float | None = None,
    dy: float | None = None,
    *,
    level: bool = True,
    preprocessing: Preprocessing = _SMALL,
) -> Measurement:
    """Heights without spikes, gaps and tilt, as `identify` and `spectrum_of` prepare them.

    What presses, wears or measures heights on a grid takes no NaN: `boundary_element`, `run_in`,
    `profile_parameters`, `areal_parameters`. The `z` and `dx` of the result suit all of them.

    Spikes become gaps. Gaps of a map are filled linearly along both axes; those of a profile too
    if they are short, and of what lies between longer ones the longest part is kept. Filled heights
    are smoother than measured ones: the slopes of a map with many of them are too small.

    **Arguments:**

    - `z`: heights (n,) or (n, m) [m], NaN where missing; a `Measurement`, the path of a file, or a
      topography of SurfaceTopography.
    - `dx`, `dy`: steps [m] along the first and the second axis, by default what z says; dy is dx by
      default.
    - `level`: True, the default, takes out the least-squares line or plane.
    - `preprocessing`: what is a spike and a gap, and the fewest heights; by default 32 of a profile
      and 16 along each side of a map.

    **Returns:** a `Measurement`; its source says how many heights were filled, and how
    many spikes there were.

    **Raises:** `ValueError` for heights and steps as `identify` does; `OSError` if a file cannot be
    read.
    """
    level = flag("level", level)
    require_kind("preprocessing", preprocessing, Preprocessing)
    return prepared(read_heights(z, dx, dy, preprocessing), level, preprocessing)[0]


def read_map(z: Any, dx: Any, dy: Any) -> Measurement:
    """The heights of a map that is to be pressed, NaN where missing.

    **Raises:** `ValueError` as `read_heights`, and for a profile.
    """
    read = read_heights(z, dx, dy, _SMALL)
    if read.dy is None:
        raise ValueError(
            f"z must be a map (n, m), got a profile of shape {read.z.shape}, which cannot be "
            "pressed: identify finds its surface, which a PerssonContact takes"
        )
    return read


def prepared(
    read: Measurement, level: bool = True, preprocessing: Preprocessing = _SMALL
) -> tuple[Measurement, int]:
    """A measurement without spikes and gaps, and the number of its spikes."""
    found = prepare_heights(read.z, preprocessing)
    longest = max(range(len(found.segments)), key=lambda i: found.segments[i].size)
    heights, filled = found.segments[longest], int(found.gaps[longest].sum())
    source = read.source
    if filled:
        source += f", {filled} heights filled"
    if found.outliers:
        source += f", {found.outliers} spikes taken out"
    if heights.size < read.z.size:
        source += f", {heights.size} of {read.z.size} points kept"
    if level:
        heights = _remove_line(heights) if heights.ndim == 1 else remove_plane(heights)
    result = Measurement(heights, read.dx, read.dy, source, read.resolution, read.stylus_radius)
    return result, found.outliers


def tilt_share(read: Measurement) -> float:
    """The share of the least-squares plane in the mean square height of a map without gaps."""
    total = float(np.var(read.z))
    return 1 - float(np.var(remove_plane(read.z))) / total if total > 0 else 0.0


def _remove_line(z: np.ndarray) -> np.ndarray:
    """A profile minus its least-squares line."""
    x, z = np.arange(z.size) - (z.size - 1) / 2, z - z.mean()
    return z - (x @ z) / (x @ x) * x
