"""The motion of a simulation over time."""

import numpy as np

from .._dynamics.contact_state import STICK
from .._dynamics.simulate import Trajectory
from .axes import Axes, coordinate, ensure_axes, legend_above

_SAMPLES = 6000


def trajectory(
    result: Trajectory, ax: Axes | None = None, *, direction: int = 1, joint: int | None = None
) -> Axes:
    """A displacement [um] over time [ms], and where it sticks.

    The displacement is that of the degree of freedom `direction`, or t.x of joint number `joint`;
    both count from 1.

    **Raises:** `ValueError` for an unknown direction or joint, a batch, or a simulation with
    `saveat`.
    """
    shown = coordinate(result._continuous(), direction, joint, result.times, batch=1)
    ax, times = ensure_axes(ax), np.asarray(result.times)
    t = np.sort(np.concatenate([np.linspace(times[0], times[-1], _SAMPLES), times]))
    x = np.asarray(result.at(t))[:, : len(shown.row)] @ shown.row * 1e6
    step = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
    sticks = np.zeros(len(t), bool)
    if shown.face is not None:
        sticks = np.asarray(result.contact_states)[step, shown.face] == STICK
    handles = ax.plot(t * 1e3, x, color="tab:blue", lw=0.9, label="motion")
    if sticks.any():
        stuck = np.where(sticks, x, np.nan)
        handles += ax.plot(t * 1e3, stuck, color="tab:orange", lw=2.6, label="sticks")
    ax.set_xlim(t[0] * 1e3, t[-1] * 1e3)
    ax.set_xlabel("time [ms]")
    ax.set_ylabel(f"{shown.symbol}{shown.meaning} [µm]")
    legend_above(ax, handles)
    return ax
