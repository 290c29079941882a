"""The stability boundary in a window of two quantities."""

from typing import Any

import numpy as np

from .._base.ranges import within
from .._stability.boundary import Boundary, BoundaryEnd
from .axes import Axes, ensure_axes, legend_above, line_colours, set_quantity_axis


def boundary(result: Boundary, ax: Axes | None = None) -> Axes:
    """The branches of a boundary, coloured by frequency [kHz], with ticks on the squealing side.

    **Arguments:**

    - `result`: as `hopf_boundary` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap
    from matplotlib.lines import Line2D
    from matplotlib.patheffects import withTickedStroke

    ax = ensure_axes(ax)
    for which, (name, low, high) in (("x", result.x), ("y", result.y)):
        set_quantity_axis(ax, which, result.scene, name, within(low, high, np.array([0, 0.5, 1])))
    if not result.branches:
        words = "it squeals" if result.squeals else "stable"
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center")
        return ax
    ticks = [withTickedStroke(angle=-90, spacing=9, length=0.7)]
    segments, frequencies, broken = [], [], []
    for branch in result.branches:
        ax.plot(branch.x, branch.y, color="0.25", lw=0.9, path_effects=ticks)
        points = np.stack([branch.x, branch.y], axis=-1)
        segments += list(np.stack([points[:-1], points[1:]], axis=1))
        frequencies.append((branch.frequency[:-1] + branch.frequency[1:]) / 2e3)
        for point, end in ((points[0], branch.start), (points[-1], branch.end)):
            if not bool((end == BoundaryEnd.window) | (end == BoundaryEnd.closed)):
                broken.append(point)
    style: dict[str, Any] = {"cmap": ListedColormap(line_colours(256)), "lw": 2.6}
    lines = LineCollection(segments, array=np.concatenate(frequencies), **style)
    ax.add_collection(lines, autolim=False)
    bar = ax.figure.colorbar(lines, ax=ax, pad=0.02)
    bar.set_label("frequency at the boundary [kHz]")
    handles = [
        Line2D([], [], color="tab:cyan", lw=2.6, label="stability boundary"),
        Line2D([], [], color="0.25", marker="|", ls="none", label="ticks: it squeals on this side"),
    ]
    if broken:
        style: dict[str, Any] = {"mfc": "white", "mec": "k", "ls": "none", "ms": 5}
        handles += ax.plot(*np.transpose(broken), "o", label="ends inside the window", **style)
    legend_above(ax, handles)
    return ax
