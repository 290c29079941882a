"""Phase portraits and spectra of a limit cycle."""

from typing import Any

import numpy as np

from .._base.parts import whole
from .._dynamics.cycle import CycleResult, LimitCycle
from .axes import Axes, coordinate, ensure_axes, legend_above, new_figure
from .panels import Panels


def phase_portrait(
    cycle: LimitCycle, ax: Axes | None = None, *, direction: int = 1, joint: int | None = None
) -> Axes:
    """The orbit of one displacement [um] against its velocity [m/s], and where it sticks.

    **Arguments:**

    - `cycle`: as `limit_cycle` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    - `direction`: the degree of freedom, from 1; 1 by default.
    - `joint`: the number of a joint, from 1, whose displacement t.x is shown instead; by default
      none.

    **Raises:** `ValueError` if there is no limit cycle, for a batch, or an unknown direction or
    joint.
    """
    shown = _coordinate(cycle, direction, joint)
    ax = ensure_axes(ax)
    period, n = float(cycle.period), len(shown.row)
    t, states = (np.asarray(x) for x in cycle.orbit())
    x, v = states[:, :n] @ shown.row * 1e6, states[:, n:] @ shown.row
    style: dict[str, Any] = {"color": "tab:blue", "lw": 1.4, "solid_capstyle": "round"}
    handles = ax.plot(np.append(x, x[0]), np.append(v, v[0]), label="limit cycle", **style)
    if shown.face is not None:
        V = float(cycle._system.speed * cycle._system.V[shown.face])
        words = f"belt velocity {V:.4g} m/s"
        handles.append(ax.axhline(V, color="0.35", ls="dashed", lw=1.1, label=words))
        sticking = np.array([*_sticking(cycle, shown.face)]).reshape(-1, 2)
        share = ((sticking[:, 1] - sticking[:, 0]) % period).sum() / period
        words = f"sticks, {share:.1%} of the period"
        style = {"color": "tab:orange", "lw": 4.5, "solid_capstyle": "butt"}
        for between in sticking:
            ends = np.interp(between, t, x, period=period)
            handles[2:] = ax.plot(ends, [V, V], label=words, **style)
    ax.set_xlabel(f"{shown.symbol}{shown.meaning} [µm]")
    ax.set_ylabel(f"{shown.rate} [m/s]")
    legend_above(ax, handles)
    return ax


def spectrum(
    cycle: LimitCycle,
    ax: Axes | None = None,
    *,
    direction: int = 1,
    joint: int | None = None,
    harmonics: int = 20,
) -> Axes:
    """Peak amplitudes [um] of the harmonics of a displacement over frequency [kHz].

    They begin with the fundamental.

    **Arguments:**

    - `cycle`, `ax`, `direction`, `joint`: as in `phase_portrait`.
    - `harmonics`: harmonics for every return of the period, 20 by default.

    **Raises:** as `phase_portrait`, and `ValueError` unless harmonics >= 1.
    """
    shown = _coordinate(cycle, direction, joint)
    ax, most = ensure_axes(ax), whole("harmonics", harmonics, 1) * int(cycle.returns)
    frequencies, amplitudes = (np.asarray(x)[:most] for x in cycle.harmonics(shown.row[None]))
    f, a = frequencies / 1e3, amplitudes[:, 0] * 1e6
    bottom = max(a.min() / 2, 1e-6 * a.max())  # rounding errors lie below the axis
    ax.vlines(f, bottom, a, color="tab:blue", lw=1.4)
    words = f"fundamental {f[0]:.4g} kHz"
    handles = ax.plot(f[:1], a[:1], "D", ms=6, mfc="tab:orange", mec="k", label=words, zorder=3)
    handles += ax.plot(f[1:], a[1:], "o", ms=3.5, color="tab:blue", label="harmonics")
    ax.set(yscale="log", ylim=(bottom, a.max() * 3), xlim=(0, f[-1] + f[0]))
    ax.set_xlabel("frequency [kHz]")
    ax.set_ylabel(f"peak amplitude of {shown.symbol} [µm]")
    legend_above(ax, handles)
    return ax


def cycle(result: LimitCycle) -> Panels:
    """Phase portraits and spectra; returns their axes.

    A row for each direction of a scene, and for t.x of each joint of a structure.

    **Arguments:**

    - `result`: as `limit_cycle` returns it.

    **Raises:** `ValueError` if there is no limit cycle, or for a batch.
    """
    rows: list[dict[str, int]] = [{"direction": 1}, {"direction": 2}]
    if not result.of_scene:
        rows = [{"joint": k} for k in range(1, 1 + len(result._system.faces))]
    figure = new_figure(10.4, 3.8 * len(rows))
    for pair, chosen in zip(figure.subplots(len(rows), 2, squeeze=False), rows, strict=True):
        phase_portrait(result, pair[0], **chosen)
        spectrum(result, pair[1], **chosen)
    return Panels(figure)


def _sticking(cycle, face):
    """Yield times [s] at which sticking begins and ends; the last may end in the next period."""
    if cycle.regularisation_error != 0 or cycle.internal is not None:  # it creeps instead
        return
    switches = [switch for switch in cycle.switches() if switch.direction == face + 1]
    for switch, following in zip(switches, switches[1:] + switches[:1], strict=True):
        if switch.after == "stick":
            yield switch.time, following.time


def _coordinate(cycle, direction, joint):
    shown = coordinate(cycle._system, direction, joint, cycle.period, batch=0)
    if not np.isfinite(cycle.period):
        raise ValueError(f"there is no limit cycle to draw: {CycleResult[cycle.result]}")
    return shown
