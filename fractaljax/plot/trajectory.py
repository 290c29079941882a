"""The motion of a simulation over time."""

from typing import Any

import numpy as np

from ..motion.simulate import Trajectory
from .axes import legend_above, new_axes

_SAMPLES = 6000
_DIRECTIONS = ("along the belt", "normal to the belt")


def trajectory(result: Trajectory, ax: Any = None, *, direction: int = 1) -> Any:
    """Displacement x_i [um] of one direction over time [ms], and where it sticks.

    As far as the simulation came. **Raises:** `ValueError` for a direction not 1 or 2, or a batch.
    """
    if direction not in (1, 2):
        raise ValueError(f"direction must be 1 or 2, got {direction!r}")
    if result.times.ndim != 1:
        raise ValueError("a picture shows one motion: index the batch first")
    ax = new_axes() if ax is None else ax
    i, times = direction - 1, np.asarray(result.times)
    t = np.sort(np.concatenate([np.linspace(0, times[-1], _SAMPLES), times]))
    x = np.asarray(result.at(t))[:, i] * 1e6
    step = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
    sticks = np.asarray(result.modes)[step, i] == 0
    handles = ax.plot(t * 1e3, x, color="tab:blue", lw=0.9, label="motion")
    if sticks.any():
        stuck = np.where(sticks, x, np.nan)
        handles += ax.plot(t * 1e3, stuck, color="tab:orange", lw=2.6, label="sticks")
    ax.set_xlim(0, t[-1] * 1e3)
    ax.set_xlabel("time [ms]")
    ax.set_ylabel(f"x{direction}, {_DIRECTIONS[i]} [µm]")
    legend_above(ax, handles)
    return ax
