"""The motion of a simulation over time."""

import numpy as np

from .._dynamics.simulate import Trajectory
from .axes import DIRECTIONS, Axes, component, given_or_new, legend_above

_SAMPLES = 6000


def trajectory(result: Trajectory, ax: Axes | None = None, *, direction: int = 1) -> Axes:
    """Displacement x_i [um] of one direction over time [ms], and where it sticks.

    **Raises:** `ValueError` for a direction not 1 or 2, or a batch.
    """
    i = component(direction, result.times, batch=1)
    ax, times = given_or_new(ax), np.asarray(result.times)
    t = np.sort(np.concatenate([np.linspace(0, times[-1], _SAMPLES), times]))
    x = np.asarray(result.at(t))[:, i] * 1e6
    step = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
    sticks = np.asarray(result.contact_states)[step, i] == 0
    handles = ax.plot(t * 1e3, x, color="tab:blue", lw=0.9, label="motion")
    if sticks.any():
        stuck = np.where(sticks, x, np.nan)
        handles += ax.plot(t * 1e3, stuck, color="tab:orange", lw=2.6, label="sticks")
    ax.set_xlim(0, t[-1] * 1e3)
    ax.set_xlabel("time [ms]")
    ax.set_ylabel(f"x{direction}, {DIRECTIONS[i]} [µm]")
    legend_above(ax, handles)
    return ax
