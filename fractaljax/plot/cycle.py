"""Phase portraits and spectra of a limit cycle."""

from typing import Any

import numpy as np

from .._dynamics.cycle import CycleResult, LimitCycle
from .axes import DIRECTIONS, Axes, Figure, component, given_or_new, legend_above, new_figure

_HARMONICS = 20  # for every return of a period
_FLOOR = 1e-6  # of the strongest harmonic; weaker ones lie below the axis


def phase_portrait(cycle: LimitCycle, ax: Axes | None = None, *, direction: int = 1) -> Axes:
    """The orbit of one direction, x_i [um] against dx_i/dt [m/s], and where it sticks.

    **Raises:** `ValueError` if there is no limit cycle, for a batch, or a direction not 1 or 2.
    """
    i = _component(cycle, direction)
    ax = given_or_new(ax)
    period, V = float(cycle.period), float(cycle._system.speed)
    t, states = (np.asarray(x) for x in cycle.orbit())
    x, v = states[:, i] * 1e6, states[:, 2 + i]
    style: dict[str, Any] = {"color": "tab:blue", "lw": 1.4, "solid_capstyle": "round"}
    handles = ax.plot(np.append(x, x[0]), np.append(v, v[0]), label="limit cycle", **style)
    words = f"belt velocity {V:.4g} m/s"
    handles.append(ax.axhline(V, color="0.35", ls="dashed", lw=1.1, label=words))
    words = f"sticks, {cycle.stick_fraction[i]:.1%} of the period"
    style = {"color": "tab:orange", "lw": 4.5, "solid_capstyle": "butt"}
    for begin, end in _sticking(cycle, direction):
        ends = np.interp([begin, end], t, x, period=period)
        handles[2:] = ax.plot(ends, [V, V], label=words, **style)
    ax.set_xlabel(f"x{direction}, {DIRECTIONS[i]} [µm]")
    ax.set_ylabel(f"dx{direction}/dt [m/s]")
    legend_above(ax, handles)
    return ax


def spectrum(cycle: LimitCycle, ax: Axes | None = None, *, direction: int = 1) -> Axes:
    """Peak amplitudes [um] of the harmonics of x_i over frequency [kHz], from the fundamental on.

    **Raises:** `ValueError` if there is no limit cycle, for a batch, or a direction not 1 or 2.
    """
    i = _component(cycle, direction)
    ax = given_or_new(ax)
    frequencies, amplitudes = (np.asarray(x) for x in cycle.spectrum())
    shown = _HARMONICS * int(cycle.returns)
    f, a = frequencies[:shown] / 1e3, amplitudes[:shown, i] * 1e6
    bottom = max(a.min() / 2, a.max() * _FLOOR)
    ax.vlines(f, bottom, a, color="tab:blue", lw=1.4)
    words = f"fundamental {f[0]:.4g} kHz"
    handles = ax.plot(f[:1], a[:1], "D", ms=6, mfc="tab:orange", mec="k", label=words, zorder=3)
    handles += ax.plot(f[1:], a[1:], "o", ms=3.5, color="tab:blue", label="harmonics")
    ax.set(yscale="log", ylim=(bottom, a.max() * 3), xlim=(0, f[-1] + f[0]))
    ax.set_xlabel("frequency [kHz]")
    ax.set_ylabel(f"peak amplitude of x{direction} [µm]")
    legend_above(ax, handles)
    return ax


def cycle(result: LimitCycle) -> Figure:
    """Phase portraits and spectra, a row for each direction; returns the figure.

    **Raises:** `ValueError` if there is no limit cycle, or for a batch.
    """
    figure = new_figure(10.4, 7.6)
    for row, direction in zip(figure.subplots(2, 2), (1, 2), strict=True):
        phase_portrait(result, row[0], direction=direction)
        spectrum(result, row[1], direction=direction)
    return figure


def _sticking(cycle, direction):
    """Times [s] at which each sticking begins and ends; the last may end in the next period."""
    if cycle.regularisation_error != 0:  # the regularised law creeps instead
        return
    own = [switch for switch in cycle.switches() if switch.direction == direction]
    for switch, following in zip(own, own[1:] + own[:1], strict=True):
        if switch.after == "stick":
            yield switch.time, following.time


def _component(cycle, direction):
    i = component(direction, cycle.period, batch=0)
    if not np.isfinite(cycle.period):
        raise ValueError(f"there is no limit cycle to draw: {CycleResult[cycle.result]}")
    return i
