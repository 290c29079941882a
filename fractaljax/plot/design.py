"""Growth rate over two quantities of a scene, and the path of a design."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._base.parts import whole
from .._base.ranges import within
from .._contact.contact import Regime
from .._design.design import Design
from .._mechanism.scene import Scene, stiffness
from .._mechanism.structure import Structure
from .._stability.stability import growth_rate
from .._sweep.sweep import sweep
from .axes import Axes, ensure_axes, legend_above, set_quantity_axis
from .maps import contact_regime, shade_regimes, shade_unsteady


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

    ax, window = ensure_axes(ax), dict(bounds or {})
    if len(window) < 2:
        window = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)} | window  # of most machined surfaces
    places = np.linspace(0, 1, whole("points", points, 2))
    axes: Any = {name: within(*ends, places) for name, ends in list(window.items())[:2]}
    single = isinstance(scene, Scene)
    fractal = single and scene.contact.fractal

    def measure(scene):
        K_n = stiffness(scene)[0] if single else jnp.nan
        return growth_rate(scene, friction_slope), K_n, contact_regime(scene) if fractal else None

    growth, K_n, regime = sweep(measure, scene, progress=False, **axes).values
    x, y = axes.values()
    inelastic = (
        np.asarray(regime != Regime.elastic_plastic) if fractal else np.zeros_like(K_n, bool)
    )
    # Outside the elastic-plastic regime the growth rate belongs to another mechanism.
    none = np.isnan(growth)
    valid = np.ma.masked_where(inelastic | none, growth)
    if valid.count() and valid.max() > 0:
        top = 10 ** np.ceil(np.log10(valid.max()))
        norm = LogNorm(top / 1e4, top)  # four decades; less is as pale as stable
        shown = np.ma.masked_where(inelastic | ~(growth > 0), np.clip(growth, norm.vmin, None))
        mesh = ax.pcolormesh(x, y, shown.T, norm=norm, cmap="YlOrBr", shading="nearest")
        mesh.set_rasterized(True)
        bar = ax.figure.colorbar(mesh, ax=ax, extend="min", pad=0.02)
        bar.set_label("growth rate where it squeals [1/s]")
    handles: list[Any] = shade_regimes(ax, x, y, regime) if fractal else []
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


def design(result: Design, ax: Axes | None = None) -> Axes:
    """The stability map of a design, and the path from the given scene to the designed one.

    **Arguments:**

    - `result`: as `design` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    """
    limits: Any = {key: getattr(result, key) for key in ("target", "K_n_min", "friction_slope")}
    ax = stability_map(result.initial, result.bounds, ax, **limits)
    names = list(result.bounds)[:2]
    path = [result.history[name] for name in names]
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
