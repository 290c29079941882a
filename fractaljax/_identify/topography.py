"""Topographies of the SurfaceTopography package, through their documented public interface.

Nothing is imported from it: any object with `heights()`, `unit`, and `pixel_size` or `positions()`
will do.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .grid import profile_on_grid
from .measurement import Measurement, measurement
from .units import metres, reconcile

_LIMITS = {"resolution": "resolution", "tip_radius": "stylus_radius"}
_ANGSTROM = {"A": "Å"}  # as SurfaceTopography may spell it


def is_topography(x: Any) -> bool:
    """True if `x` has the interface of a topography."""
    return callable(getattr(x, "heights", None)) and hasattr(x, "unit")


def from_topography(topography: Any, dx: float | None, dy: float | None) -> Measurement:
    """The heights of a topography in metres, NaN where undefined, with its instrument's limits.

    **Raises:** `ValueError` for a topography without a unit or steps, for positions that are not
    equidistant, and for `dx` or `dy` [m] that contradict it.
    """
    if not isinstance(topography.unit, str):
        raise ValueError(
            f"z must have a unit of length, got {topography.unit!r}: make the topography with one, "
            "such as unit='um'"
        )
    metre = metres(_ANGSTROM.get(topography.unit, topography.unit), " of z")
    z = np.ma.filled(np.ma.asarray(topography.heights(), float), np.nan) * metre
    if hasattr(topography, "pixel_size"):
        steps = [float(step) * metre for step in np.ravel(topography.pixel_size)]
    elif z.ndim == 1 and callable(getattr(topography, "positions", None)):
        x = np.asarray(topography.positions(), float) * metre
        z, step = profile_on_grid(x, z)
        steps = [step]
    else:
        raise ValueError("z must have a pixel_size, or be a profile with positions()")
    where = "of the topography"
    dx = reconcile("dx", steps[0], dx, where)
    dy = reconcile("dy", steps[1], dy, where) if z.ndim == 2 else dy
    info = getattr(topography, "info", None) or {}
    return measurement(z, dx, dy, type(topography).__name__, **instrument_limits(info))


def instrument_limits(info: Mapping[str, Any]) -> dict[str, float]:
    """The lateral resolution and the tip radius [m] in the `info` of a topography, if any."""
    parameters = (info.get("instrument") or {}).get("parameters") or {}
    return {
        name: float(parameters[key]["value"]) * metres(parameters[key]["unit"])
        for key, name in _LIMITS.items()
        if parameters.get(key)
    }
