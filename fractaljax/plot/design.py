"""Growth rate over two quantities of a scene, and the path of a design."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._base.parts import whole
from .._base.ranges import is_logarithmic, within
from .._design.design import Design
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .._stability.stability import growth_rate
from .._sweep.sweep import sweep
from .axes import Axes, ensure_axes, legend_above, set_quantity_axis
from .maps import regime_levels, shade_regimes, shade_unsteady


def stability_map(
    scene: Scene | Structure,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    ax: Axes | None = None,
    *,
    target: float | None = None,
    K_n_min: float | None = None,
    friction_slope: bool = True,
    points: int = 240,
) -> Axes:
    """Growth rate [1/s] over two quantities, the stability boundary and the regimes of the contact.

    **Arguments:**

    - `scene`: a scene or structure of scalars.
    - `bounds`: {name: (lower, upper)} in SI units, of which the first two are the axes; by default
      D and G.
    - `ax`: axes to draw in, by default those of a new figure.
    - `target`: growth rate [1/s] of which a line is drawn, by default none.
    - `K_n_min`: normal stiffness [N/m] of which a line is drawn, by default none.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `points`: values of each quantity, 240 by default.

    **Raises:** `ValueError` for a quantity that the scene does not have, and unless points >= 2.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from scipy.ndimage import binary_dilation

    ax, window = ensure_axes(ax), dict(bounds or {})
    if len(window) < 2:
        window = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)} | window  # of most machined surfaces
    places = np.linspace(0, 1, whole("points", points, 2))
    axes: Any = {name: within(*ends, places) for name, ends in list(window.items())[:2]}
    joint = scene.sole_joint
    fractal = joint is not None and joint.contact.fractal

    def measure(scene):
        K_n = jnp.nan if joint is None else scene.stiffness()[0]
        return growth_rate(scene, friction_slope), K_n, regime_levels(scene) if fractal else None

    growth, K_n, levels = sweep(measure, scene, progress=False, **axes).values
    x, y = axes.values()
    inelastic = levels.inelastic if fractal else np.zeros_like(K_n, bool)
    # Outside the elastic-plastic regime the growth rate belongs to another mechanism, and along its
    # edges it changes within less than the points resolve.
    inelastic = binary_dilation(inelastic, np.ones((3, 3)))
    none = np.isnan(growth)
    valid = np.ma.masked_where(inelastic | none, growth)
    if valid.count() and valid.max() > 0:
        top = 10 ** np.ceil(np.log10(valid.max()))
        norm = LogNorm(top / 1e4, top)  # four decades; less is as pale as stable
        # Hatches cover what is filled in, up to their smooth edges.
        filled = _nearest(np.asarray(growth), inelastic)
        shown = np.ma.masked_where(~(filled > 0), np.clip(filled, norm.vmin, None))
        mesh = ax.pcolormesh(x, y, shown.T, norm=norm, cmap="YlOrBr", shading="nearest")
        mesh.set_rasterized(True)
        bar = ax.figure.colorbar(mesh, ax=ax, extend="min", pad=0.02)
        bar.set_label("growth rate where it squeals [1/s]")
    handles: list[Any] = shade_regimes(ax, x, y, levels) if fractal else []
    handles += shade_unsteady(ax, x, y, none)
    handles.append(Patch(facecolor="white", edgecolor="0.3", label="stable"))
    limits = [(valid, 0.0, "solid", 1.6, "stability boundary")]
    if target is not None:
        limits.append((valid, target, "dashed", 1.1, f"growth rate {target:.3g} 1/s"))
    if K_n_min:
        limits.append((K_n, K_n_min, "dotted", 1.4, f"K_n = {K_n_min:.3g} N/m"))
    for field, level, style, width, words in limits:
        if np.ma.min(field) < level < np.ma.max(field):
            ax.contour(x, y, field.T, [level], colors="k", linestyles=style, linewidths=width)
            handles.append(Line2D([], [], color="k", ls=style, lw=width, label=words))
    for which, name in zip("xy", axes, strict=True):
        set_quantity_axis(ax, which, scene, name, axes[name])
    legend_above(ax, handles)
    return ax


def _nearest(values: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Values (n, m) with those of the nearest points of the grid where they are missing."""
    from scipy.ndimage import distance_transform_edt

    places: Any = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return values[tuple(places)]


def design(result: Design, ax: Axes | None = None) -> Axes:
    """The stability map of a design, and the path from the given scene to the designed one.

    The path has those iterates of the best start that show the way: each comes at least twice as
    near to the end, in the unit square of the bounds, as the one before.

    **Arguments:**

    - `result`: as `design` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    """
    limits: Any = {key: getattr(result, key) for key in ("target", "K_n_min", "friction_slope")}
    ax = stability_map(result.initial, result.bounds, ax, **limits)
    names = list(result.bounds)[:2]
    path = [np.asarray(result.history[name]) for name in names]
    kept = _approach(path, [result.bounds[name] for name in names])
    path = [values[kept] for values in path]
    handles = ax.plot(*path, "-", color="tab:blue", lw=1.3, label="path of the best start")
    final = "best found, not a solution" if result.violated else "designed surface"
    for scene, marker, size, colour, words in (
        (result.initial, "o", 6, "white", "given surface"),
        (result.scene, "*", 11, "tab:cyan", final),
    ):
        quantities: Any = scene.stored_quantities()
        style: dict[str, Any] = {"ms": size, "mfc": colour, "mec": "k", "ls": "none", "zorder": 5}
        at = [[float(quantities[name].value)] for name in names]
        handles += ax.plot(*at, marker, label=words, clip_on=False, **style)
    old: Any = ax.get_legend()
    legend_above(ax, [*old.legend_handles, *handles])
    return ax


def _approach(path: list[np.ndarray], bounds: list[tuple[float, float]]) -> list[int]:
    """The iterates that each halve the distance to the last one, from the first to the last."""
    rows = []
    for values, (low, high) in zip(path, bounds, strict=True):
        scale: Any = np.log if is_logarithmic(low, high) else np.asarray
        rows.append((scale(values) - scale(values[-1])) / (scale(high) - scale(low)))
    away, kept = np.hypot(*rows), [0]
    for i, distance in enumerate(away):
        if distance <= away[kept[-1]] / 2 and away[kept[-1]] > 0:
            kept.append(i)
    return kept
