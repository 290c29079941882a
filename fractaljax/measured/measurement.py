"""Heights as an instrument gave them: what is known about them, their units and their grid."""

import math

import equinox as eqx
import numpy as np

from ..base.parts import Record
from .preparation import spacing

UNITS = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,  # micro sign
    "μm": 1e-6,  # Greek letter
    "micron": 1e-6,
    "microns": 1e-6,
    "micrometer": 1e-6,
    "micrometre": 1e-6,
    "nm": 1e-9,
    "nanometer": 1e-9,
    "nanometre": 1e-9,
    "Å": 1e-10,
    "angstrom": 1e-10,
    "pm": 1e-12,
}
_JITTER = 0.1  # of a step: how far from equal steps positions may lie
_FEW = 0.01  # of the points: as many may be left out before another reading is tried


class Measurement(Record):
    """A measured profile or map, in metres, and what the file says about how it was measured."""

    z: np.ndarray  # (n,) or (n, m) [m]: NaN where nothing was measured
    dx: float  # step along the first axis [m]
    dy: float | None  # step along the second axis [m]; None for a profile
    source: str = eqx.field(static=True)  # file, format, channel and instrument
    resolution: float | None = None  # lateral resolution [m]
    stylus_radius: float | None = None  # [m]

    @property
    def missing(self) -> int:
        """How many heights are missing."""
        return int(np.isnan(self.z).sum())

    @property
    def description(self) -> str:
        """Its size, its steps and what is known of the instrument, in a line."""
        shape = " x ".join(map(str, self.z.shape))
        kind = "profile" if self.z.ndim == 1 else "map"
        words = [f"{kind} of {shape} heights, {self.missing} of them missing"]
        for name in ("dx", "dy", "resolution", "stylus_radius"):
            if getattr(self, name) is not None:
                words.append(f"{name} = {getattr(self, name):.6g} m")
        return ", ".join(words)

    def __repr__(self) -> str:
        return f"Measurement({self.description}, from {self.source})"


def measurement(z: np.ndarray, dx, dy, source: str, **instrument) -> Measurement:
    """Check heights [m] and steps [m] or None, and put them together; a map without dy has dx.

    **Raises:** `ValueError` for a step that is missing, not above 0 or beside the point, and for
    heights that are no profile or map, or all missing.
    """
    if z.ndim == 2 and 1 in z.shape:  # a profile, along either axis
        dx = dx if z.shape[1] == 1 or dy is None else dy
        z, dy = z.ravel(), None
    if z.ndim not in (1, 2):
        raise ValueError(f"heights must be of shape (n,) or (n, m), got {z.shape}")
    z = np.where(np.isfinite(z), z, np.nan)
    if not np.isfinite(z).any():
        raise ValueError("there is no height in it")
    if dx is None:
        raise ValueError("the step between heights is not known: give dx in metres (--dx 1e-6)")
    dx = spacing("dx", dx)
    if z.ndim == 2:
        dy = dx if dy is None else spacing("dy", dy)
    elif dy is not None:
        raise ValueError(f"dy is for maps, got {dy:g} for a profile")
    return Measurement(z, dx, dy, source, **instrument)


def metres(unit: str, of: str = "") -> float:
    """One `unit` in metres; `of` says what it is the unit of.

    **Raises:** `ValueError` listing the units known.
    """
    known = known_unit(unit.strip())
    if known is None:
        raise ValueError(f"the unit{of} must be one of {', '.join(UNITS)}, got {unit!r}")
    return UNITS[known]


def known_unit(word: str) -> str | None:
    """The key of `UNITS` that a word is, words of more than two letters in any case, or None."""
    for spelling in (word, word.lower() if len(word) > 2 else word):
        if spelling in UNITS:
            return spelling
    return None


def scale(own: str | None, given: str | None, what: str, option: str) -> float:
    """The unit of `what`, in metres: as the file has it, or as given by `option`.

    **Raises:** `ValueError` if neither says it, if both differ, and as `metres`.
    """
    if own is None and given is None:
        raise ValueError(f"the file does not say in which unit {what} are: give it ({option} um)")
    if own is None or given is None:
        return metres(str(given if own is None else own), f" of {what}")
    agreed(f"the unit of {what}", metres(own, f" of {what}"), metres(given, f" of {what}"))
    return metres(own)


def agreed(name: str, own: float | None, given: float | None) -> float | None:
    """What the file says, or what was given where it does not say it; they must not differ."""
    if own is None or given is None:
        return given if own is None else own
    if abs(own - given) > 1e-6 * abs(own):
        raise ValueError(f"{name} is {own:g} m in the file, got {given:g}")
    return own


def equal_steps(x: np.ndarray) -> tuple[float, np.ndarray]:
    """The step of increasing positions x (n,), and their whole numbers of steps from the first.

    Points that are left out in a grid of equal steps are no obstacle, nor are few decimals.

    **Raises:** `ValueError` where positions do not increase, or lie on no such grid.
    """
    if x.size < 2:
        raise ValueError(f"there must be at least 2 positions, got {x.size}")
    steps = np.diff(x)
    if not (steps > 0).all():
        at = int(np.argmin(steps > 0))
        raise ValueError(
            f"positions must rise or fall throughout, got {x[at]:.6g} and then {x[at + 1]:.6g} m"
            " (decimal commas need semicolons or tabs between columns)"
        )
    counts = np.round(steps / np.quantile(steps, 0.5, method="lower"))
    k = np.concatenate([[0], np.cumsum(counts)])
    dx = (x[-1] - x[0]) / k[-1]
    off = x - x[0] - k * dx
    off -= (off.max() + off.min()) / 2
    fits = counts.min() > 0 and k[-1] < 2 * x.size and np.abs(off).max() <= _JITTER * dx
    # Many points left out, each alone and evenly spread, are none: positions have few decimals.
    if not fits or k[-1] > (1 + _FEW) * x.size:
        rounded = _rounded_step(x)
        if rounded is not None:
            return rounded, np.arange(x.size)
    if fits:
        return float(dx), k.astype(int)
    raise ValueError(
        f"positions are not equidistant, steps are {steps.min():.6g} to {steps.max():.6g} m:"
        " resample them at equal steps first"
    )


def _rounded_step(x: np.ndarray) -> float | None:
    """The step of positions that are equidistant but for the decimals they are rounded to, or None.

    Those decimals are finer than two steps; what is finer than a tenth of one needs no such care.
    """
    dx = (x[-1] - x[0]) / (x.size - 1)
    coarse, fine = (math.floor(math.log10(share * dx)) for share in (2, _JITTER))
    for digit in range(coarse, fine - 1, -1):
        quantum = 10.0**digit
        if np.abs(x / quantum - np.round(x / quantum)).max() < 1e-6:
            k = np.arange(x.size) - (x.size - 1) / 2
            dx = (x - x[0]) @ k / (k @ k)
            return float(dx) if np.ptp(x - dx * k) <= 1.1 * quantum else None
    return None


def profile_on_grid(x, z) -> tuple[np.ndarray, float]:
    """Heights at positions x (n,) in order, either way, as heights at equal steps, and the step."""
    if x.size > 1 and x[0] > x[-1]:
        x, z = x[::-1], z[::-1]
    dx, k = equal_steps(x)
    heights = np.full(k[-1] + 1, np.nan)
    heights[k] = z
    return heights, dx


def map_on_grid(x, y, z) -> tuple[np.ndarray, float, float]:
    """Heights at points (x, y) of a rectangular grid, in any order, as a map, with its steps."""
    (dx, i), (dy, j) = _axis(x), _axis(y)
    shape = i.max() + 1, j.max() + 1
    if np.unique(i * shape[1] + j).size < z.size:
        raise ValueError("two points have the same position")
    if 2 * z.size < shape[0] * shape[1]:
        raise ValueError(
            f"the points lie on no rectangular grid: {z.size} of them for {shape[0]} x {shape[1]}"
        )
    heights = np.full(shape, np.nan)
    heights[i, j] = z
    return heights, dx, dy


def _axis(x):
    """The step between the distinct positions among x, and the index of each x."""
    order = np.argsort(x, kind="stable")
    steps = np.diff(x[order])
    group = np.concatenate([[0], np.cumsum(steps > 0.3 * steps.max(initial=0))])
    dx, k = equal_steps(np.bincount(group, x[order]) / np.bincount(group))
    index = np.empty(x.size, int)
    index[order] = k[group]
    return dx, index
