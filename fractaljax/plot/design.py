"""Growth rate over D and G, and the path of a design."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import substitute
from ..mechanism.scene import Scene
from ..modes.stability import growth_rate_of
from ..optimise.design import DEFAULT_BOUNDS, Design
from .axes import legend_above, new_axes

_POINTS = 240  # a side


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
    ax = new_axes() if ax is None else ax
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
    legend_above(ax, handles)
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
    legend_above(ax, [*ax.get_legend().legend_handles, walk, given, final])
    return ax


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
