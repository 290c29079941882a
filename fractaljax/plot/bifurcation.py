"""Where a mechanism is quiet, squeals, or does what the kick decides, over two quantities."""

from typing import Any

import numpy as np

from .._base.parts import whole
from .._base.ranges import within
from .._dynamics.bifurcation import BifurcationMap
from .._stability.stability import growth_rate
from .._sweep.sweep import sweep
from .axes import Axes, ensure_axes, legend_above, set_quantity_axis

_STYLES: dict[str, tuple[str, str]] = {
    "fold": ("tab:blue", "solid"),
    "grazing": ("tab:green", "dashed"),
    "order of switches": ("tab:green", "dotted"),
    "period doubling": ("tab:purple", "dashdot"),
    "Neimark-Sacker": ("tab:red", "dotted"),
}


def bifurcation_map(result: BifurcationMap, ax: Axes | None = None, *, points: int = 160) -> Axes:
    """The curves of a map, with ticks towards the stable cycles; a star is the mechanism.

    The region where small disturbances grow is shaded. Elsewhere the mechanism is quiet if there
    are no stable cycles, and the kick decides if there are.

    **Arguments:**

    - `result`: as `bifurcation_map` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    - `points`: values of each quantity at which the growth rate is computed, 160 by default.

    **Raises:** `ValueError` unless points >= 2.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.patheffects import withTickedStroke

    ax, windows = ensure_axes(ax), (result.x, result.y)
    places = np.linspace(0, 1, whole("points", points, 2))
    x, y = (within(low, high, places) for _, low, high in windows)
    axes: Any = {result.x[0]: x, result.y[0]: y}
    slope = result.boundary.friction_slope
    growth = sweep(lambda x: growth_rate(x, slope), result.mechanism, progress=False, **axes).values
    handles: list[Any] = [Patch(color="#fbe3c5", label="small disturbances grow")]
    if np.nanmax(growth) > 0:
        shade: dict[str, Any] = {"colors": ["#fbe3c5"], "zorder": 0}
        ax.contourf(x, y, np.ma.masked_invalid(growth).T, [0, np.inf], **shade)
    for branch in result.boundary.branches:
        ax.plot(branch.x, branch.y, color="k", lw=1.6)
    handles.append(Line2D([], [], color="k", lw=1.6, label="Hopf"))
    for kind, (colour, style) in _STYLES.items():
        mine = [curve for curve in result.curves if curve.kind == kind]
        for curve in mine:
            ax.plot(curve.x, curve.y, color=colour, ls=style, lw=1.3)
            if curve.side:
                tick = withTickedStroke(angle=90 * curve.side, spacing=14, length=0.5)
                ax.plot(curve.x, curve.y, color=colour, lw=0.5, path_effects=[tick])
        if mine:
            handles.append(
                Line2D([], [], color=colour, ls=style, lw=1.3, label=f"{kind} of a cycle")
            )
    if any(curve.side for curve in result.curves):
        ticks: dict[str, Any] = {"color": "0.4", "marker": "|", "ls": "none"}
        handles.append(Line2D([], [], label="ticks: stable cycles on this side", **ticks))
    star: dict[str, Any] = {"ms": 11, "mfc": "tab:cyan", "mec": "k", "ls": "none", "zorder": 5}
    handles += ax.plot(*([value] for value in result.nominal), "*", label="the mechanism", **star)
    for which, (name, *_), values in zip("xy", windows, (x, y), strict=True):
        set_quantity_axis(ax, which, result.mechanism, name, values)
    legend_above(ax, handles)
    return ax
