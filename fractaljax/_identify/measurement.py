"""A measured profile or map, in metres."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._base.parts import Record
from .preparation import spacing


class Measurement(Record):
    """Heights in metres, and what the file says about how they were measured."""

    z: Float[np.ndarray, " *shape"]  # (n,) or (n, m) [m]: NaN where nothing was measured
    dx: float  # step along the first axis [m]
    dy: float | None  # step along the second axis [m]; None for a profile
    source: str = eqx.field(static=True)  # file, format, channel and instrument
    resolution: float | None = None  # lateral resolution [m]
    stylus_radius: float | None = None  # [m]

    @property
    def missing(self) -> int:
        """Number of missing heights."""
        return int(np.isnan(self.z).sum())

    @property
    def description(self) -> str:
        """Size, steps and instrument limits in one line."""
        shape = " x ".join(map(str, self.z.shape))
        kind = "profile" if self.z.ndim == 1 else "map"
        words = [f"{kind} of {shape} heights, {self.missing} missing"]
        for name in ("dx", "dy", "resolution", "stylus_radius"):
            if getattr(self, name) is not None:
                words.append(f"{name} = {getattr(self, name):.6g} m")
        return ", ".join(words)

    def __repr__(self) -> str:
        return f"Measurement({self.description}, from {self.source})"


def measurement(
    z: np.ndarray, dx: float | None, dy: float | None, source: str, **limits: float
) -> Measurement:
    """Checked heights [m] and steps [m]. A map without dy has dx.

    **Raises:** `ValueError` for a step that is missing, not above 0 or not used, and for heights
    that are not a profile or map, or all missing.
    """
    if z.ndim == 2 and 1 in z.shape:  # a profile, along either axis
        dx = dx if z.shape[1] == 1 or dy is None else dy
        z, dy = z.ravel(), None
    if z.ndim not in (1, 2):
        raise ValueError(f"heights must be of shape (n,) or (n, m), got {z.shape}")
    z = np.where(np.isfinite(z), z, np.nan)
    if not np.isfinite(z).any():
        raise ValueError("there are no heights in it")
    if dx is None:
        raise ValueError("the step between heights is not known: give dx in metres (--dx 1e-6)")
    dx = spacing("dx", dx)
    if z.ndim == 2:
        dy = dx if dy is None else spacing("dy", dy)
    elif dy is not None:
        raise ValueError(f"dy is for maps, got {dy:g} for a profile")
    return Measurement(z, dx, dy, source, **limits)
