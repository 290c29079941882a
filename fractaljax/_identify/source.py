"""Inputs of `identify`: heights with their steps, a measurement, a file or a topography."""

import os
from typing import Any

from .files import read_measurement
from .measurement import Measurement
from .preparation import Preprocessing, check_heights, spacing
from .topography import from_topography, is_topography
from .units import reconcile


def read_heights(
    z: Any, dx: float | None, dy: float | None, options: Preprocessing = Preprocessing()
) -> Measurement:
    """Heights (n,) or (n, m) with their steps [m], checked.

    **Raises:** `ValueError` as `identify` does; `OSError` if a file cannot be read.
    """
    dx, dy = (
        None if step is None else spacing(name, step) for name, step in (("dx", dx), ("dy", dy))
    )
    source = "heights"
    limits: dict[str, float | None] = {}
    if isinstance(z, str | os.PathLike):
        z = read_measurement(z, dx=dx, dy=dy)
    elif is_topography(z):
        z = from_topography(z, dx, dy)
    if isinstance(z, Measurement):
        where = "of the measurement"
        dx, dy = reconcile("dx", z.dx, dx, where), reconcile("dy", z.dy, dy, where)
        limits = {"resolution": z.resolution, "stylus_radius": z.stylus_radius}
        z, source = z.z, z.source
    z = check_heights(z, options)
    if dx is None:
        raise ValueError("dx is needed beside heights: the step between them in m, such as dx=1e-6")
    if z.ndim == 1 and dy is not None:
        raise ValueError(f"dy is for maps, got {dy:g} m for a profile: leave it out")
    return Measurement(z, dx, dx if z.ndim == 2 and dy is None else dy, source, **limits)
