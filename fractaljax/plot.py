"""Pictures: each function takes a result and an optional Axes, and returns the Axes.

Without an Axes a new figure is made, outside pyplot and its global state; it is `ax.figure`.
`cycle` fills a figure of its own, and returns that.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .design import DEFAULT_BOUNDS, Design
from .limit_cycle import CycleResult, LimitCycle
from .parts import substitute
from .scene import Scene
from .stability import growth_rate_of

_POINTS = 240  # a side
_HARMONICS = 20  # for every turn of a period
_FLOOR = 1e-6  # of the strongest harmonic; what is weaker is below the axis
_DIRECTIONS = ("along the belt", "normal to the belt")


@functools.partial(jax.jit, static_argnames="friction_slope")
def _map(scene: Scene, Ds, Gs, friction_slope):
    def one(D, G):
        moved = substitute(scene, {"D": D, "G": G})
        state = moved.contact.state(moved.friction.mu_s, moved.friction.mu_m)
        growth = growth_rate_of(moved, state.K_n, state.K_t, friction_slope)
        slip = jnp.zeros_like(growth) if state.slip_ratio is None else state.slip_ratio
        return growth, state.log_area_ratio, slip, state.K_n

    # Row by row, so that the memory it takes does not grow with the square of the resolution.
    return jax.lax.map(lambda G: jax.vmap(lambda D: one(D, G))(Ds), Gs)


def stability_map(
    scene: Scene,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    ax: Any = None,
    *,
    target: float | None = None,
    K_n_min: float | None = None,
    friction_slope: bool = True,
) -> Any:
    """Growth rate [1/s] over D and G [m], with the stability boundary and the three regimes.

    `target` [1/s] and `K_n_min` [N/m] add the lines that a design keeps to.

    **Raises:** `ValueError` for a contact that is not fractal.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if not scene.contact.fractal:
        raise ValueError("a stability map needs a FractalContact: a FixedContact has no surface")
    ax = _axes() if ax is None else ax
    bounds = dict(DEFAULT_BOUNDS) | dict(bounds or {})
    Ds = jnp.linspace(*bounds["D"], _POINTS)
    Gs = jnp.geomspace(*bounds["G"], _POINTS)
    growth, log_area_ratio, slip, K_n = (np.asarray(x) for x in _map(scene, Ds, Gs, friction_slope))
    D, G = np.asarray(Ds), np.asarray(Gs)
    plastic, sliding = log_area_ratio <= 0, (slip >= 1) & (log_area_ratio > 0)
    handles = []

    squeals = (growth > 0) & ~plastic & ~sliding
    if squeals.any():
        top = 10 ** np.ceil(np.log10(growth[squeals].max()))
        shown = np.ma.masked_where(~squeals, np.clip(growth, top / 1e4, None))
        mesh = ax.pcolormesh(
            D, G, shown, norm=LogNorm(top / 1e4, top), cmap="YlOrBr", shading="nearest"
        )
        mesh.set_rasterized(True)
        bar = ax.figure.colorbar(mesh, ax=ax, extend="min", pad=0.02)
        bar.set_label("growth rate where it squeals [1/s]")
    for inside, grey, hatch, label in [
        (plastic, "0.80", "//", "fully plastic"),
        (sliding, "0.92", "..", "gross slip"),
    ]:
        if inside.any():
            style: dict[str, Any] = {"hatches": [hatch], "colors": [grey]}
            ax.contourf(D, G, inside.astype(float), levels=[0.5, 1.5], **style)
            handles.append(Patch(facecolor=grey, hatch=hatch, edgecolor="0.3", label=label))
    handles.append(Patch(facecolor="white", edgecolor="0.3", label="elastic-plastic, stable"))
    # Outside the elastic-plastic regime a growth rate is that of another mechanism.
    valid = np.ma.masked_where(plastic | sliding, growth)
    lines: list[tuple[Any, ...]] = [(valid, 0.0, "solid", 1.6, "stability boundary")]
    if target is not None:
        lines.append((valid, target, "dashed", 1.1, f"growth rate {target:.3g} 1/s"))
    if K_n_min:
        lines.append((K_n, K_n_min, "dotted", 1.4, f"K_n = {K_n_min:.3g} N/m"))
    for field, level, linestyle, width, label in lines:
        if np.ma.min(field) < level < np.ma.max(field):
            ax.contour(D, G, field, [level], colors="k", linestyles=linestyle, linewidths=width)
            handles.append(Line2D([], [], color="k", ls=linestyle, lw=width, label=label))
    ax.set_yscale("log")
    ax.set_xlim(*bounds["D"])
    ax.set_ylim(*bounds["G"])
    ax.set_xlabel("fractal dimension D [-]")
    ax.set_ylabel("fractal roughness G [m]")
    _legend(ax, handles)
    return ax


def design(result: Design, ax: Any = None) -> Any:
    """The stability map of a design, and the way from the given surface to the designed one."""
    ax = stability_map(
        result.initial,
        result.bounds,
        ax,
        target=result.target,
        K_n_min=result.K_n_min,
        friction_slope=result.friction_slope,
    )
    history = result.history
    (walk,) = ax.plot(
        history["D"], history["G"], "-", color="tab:blue", lw=1.3, label="path of the best start"
    )
    (given,) = _mark(ax, result.initial, "o", 6, "white", "given surface")
    words = "designed surface" if not result.violated else "best found, not a solution"
    (final,) = _mark(ax, result.scene, "*", 11, "tab:cyan", words)
    _legend(ax, [*ax.get_legend().legend_handles, walk, given, final])
    return ax


def phase_portrait(cycle: LimitCycle, ax: Any = None, *, direction: int = 1) -> Any:
    """The orbit of one direction, x_i [um] against dx_i/dt [m/s], and where it sticks.

    **Raises:** `ValueError` if there is no limit cycle, for a batch, or a direction not 1 or 2.
    """
    i = _component(cycle, direction)
    ax = _axes() if ax is None else ax
    period, V = float(cycle.period), float(cycle._system.V)
    t, states = (np.asarray(x) for x in cycle.orbit())
    x, v = states[:, i] * 1e6, states[:, 2 + i]
    belt = ax.axhline(V, color="0.35", ls="dashed", lw=1.1, label=f"belt velocity {V:.4g} m/s")
    closed = np.append(x, x[0]), np.append(v, v[0])
    style: dict[str, Any] = {"color": "tab:blue", "lw": 1.4, "solid_capstyle": "round"}
    handles = [*ax.plot(*closed, label="limit cycle", **style), belt]
    label = f"sticks, {cycle.stick_fraction[i]:.1%} of the period"
    style = {"color": "tab:orange", "lw": 4.5, "solid_capstyle": "butt"}
    for begin, end in _sticking(cycle, direction):
        ends = np.interp([begin, end], t, x, period=period)
        handles[2:] = ax.plot(ends, [V, V], label=label, **style)
    ax.set_xlabel(f"x{direction}, {_DIRECTIONS[i]} [µm]")
    ax.set_ylabel(f"dx{direction}/dt [m/s]")
    _legend(ax, handles)
    return ax


def _sticking(cycle, direction):
    """Times [s] at which each sticking begins and ends; the last may end in the next period."""
    if cycle.regularisation_error != 0:  # the regularised law creeps instead
        return
    own = [switch for switch in cycle.switches() if switch.direction == direction]
    for switch, following in zip(own, own[1:] + own[:1], strict=True):
        if switch.after == "stick":
            yield switch.time, following.time


def spectrum(cycle: LimitCycle, ax: Any = None, *, direction: int = 1) -> Any:
    """Peak amplitudes [um] of the harmonics of x_i over frequency [kHz], from the fundamental on.

    **Raises:** `ValueError` if there is no limit cycle, for a batch, or a direction not 1 or 2.
    """
    i = _component(cycle, direction)
    ax = _axes() if ax is None else ax
    frequencies, amplitudes = (np.asarray(x) for x in cycle.spectrum())
    shown = _HARMONICS * int(cycle.turns)
    f, a = frequencies[:shown] / 1e3, amplitudes[:shown, i] * 1e6
    bottom = max(a.min() / 2, a.max() * _FLOOR)
    ax.vlines(f, bottom, a, color="tab:blue", lw=1.4)
    (rest,) = ax.plot(f[1:], a[1:], "o", ms=3.5, color="tab:blue", label="harmonics")
    (first,) = ax.plot(
        f[:1], a[:1], "D", ms=6, mfc="tab:orange", mec="k", label=f"fundamental {f[0]:.4g} kHz"
    )
    ax.set_yscale("log")
    ax.set_ylim(bottom, a.max() * 3)
    ax.set_xlim(0, f[-1] + f[0])
    ax.set_xlabel("frequency [kHz]")
    ax.set_ylabel(f"peak amplitude of x{direction} [µm]")
    _legend(ax, [first, rest])
    return ax


def cycle(result: LimitCycle) -> Any:
    """Phase portraits and spectra, a row for each direction; returns the figure.

    **Raises:** `ValueError` if there is no limit cycle, or for a batch.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.4, 7.6), layout="constrained")
    for row, direction in zip(figure.subplots(2, 2), (1, 2), strict=True):
        phase_portrait(result, row[0], direction=direction)
        spectrum(result, row[1], direction=direction)
    return figure


def _component(cycle, direction):
    """The index of a direction, checked together with the cycle."""
    if direction not in (1, 2):
        raise ValueError(f"direction must be 1 or 2, got {direction!r}")
    if cycle.period.ndim:
        raise ValueError("a picture shows one cycle: index the batch first")
    if not np.isfinite(cycle.period):
        raise ValueError(f"there is no limit cycle to draw: {CycleResult[cycle.result]}")
    return direction - 1


def _mark(ax, scene, marker, size, colour, label):
    surface = scene.contact.surface
    return ax.plot(
        float(surface.D),
        float(surface.G),
        marker,
        ms=size,
        mfc=colour,
        mec="k",
        ls="none",
        label=label,
        clip_on=False,
        zorder=5,
    )


def _axes():
    from matplotlib.figure import Figure

    return Figure(figsize=(8.4, 6.4), layout="constrained").add_subplot()


def _legend(ax, handles):
    ax.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.01),
        ncols=3,
        fontsize="small",
        frameon=False,
    )
