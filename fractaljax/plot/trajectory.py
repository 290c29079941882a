"""The motion of a simulation over time."""

import numpy as np

from .._base.parts import whole
from .._dynamics.contact_state import STICK
from .._dynamics.simulate import Trajectory
from .axes import Axes, coordinate, ensure_axes, legend_above


def trajectory(
    result: Trajectory,
    ax: Axes | None = None,
    *,
    direction: int = 1,
    joint: int | None = None,
    samples: int = 6000,
) -> Axes:
    """A displacement [um] over time [ms], and where it sticks.

    **Arguments:**

    - `result`: as `simulate` returns it, without `saveat`.
    - `ax`: axes to draw in, by default those of a new figure.
    - `direction`: the degree of freedom, from 1; 1 by default.
    - `joint`: the number of a joint, from 1, whose displacement t.x is shown instead; by default
      none.
    - `samples`: evenly spaced times at which it is drawn beside the steps of the simulation, 6000
      by default.

    **Raises:** `ValueError` for an unknown direction or joint, a batch, or a simulation with
    `saveat`, and unless samples >= 2.
    """
    shown = coordinate(result._continuous(), direction, joint, result.times, batch=1)
    ax, times = ensure_axes(ax), np.asarray(result.times)
    even = np.linspace(times[0], times[-1], whole("samples", samples, 2))
    t = np.sort(np.concatenate([even, times]))
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
