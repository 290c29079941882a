"""The stability boundary in a window of two quantities."""

from typing import Any

import numpy as np

from ..base.ranges import is_logarithmic
from ..mechanism.quantities import label
from ..modes.boundary import Boundary, BranchEnd
from .axes import legend_above, new_axes


def boundary(result: Boundary, ax: Any = None) -> Any:
    """The branches of a boundary, coloured by frequency [kHz], with ticks on the squealing side."""
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D
    from matplotlib.patheffects import withTickedStroke

    ax = new_axes() if ax is None else ax
    for name, window in (("x", result.x), ("y", result.y)):
        getattr(ax, f"set_{name}scale")("log" if is_logarithmic(*window[1:]) else "linear")
        getattr(ax, f"set_{name}lim")(window[1], window[2])
        getattr(ax, f"set_{name}label")(label(result.scene, window[0]))
    if not result.branches:
        words = "it squeals" if result.squeals else "stable"
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center")
        return ax
    ticks = withTickedStroke(angle=-90, spacing=9, length=0.7)
    segments, frequencies = [], []
    for branch in result.branches:
        style: dict[str, Any] = {"color": "0.25", "lw": 0.9, "path_effects": [ticks]}
        ax.plot(branch.x, branch.y, **style)
        points = np.stack([branch.x, branch.y], axis=-1)
        segments += list(np.stack([points[:-1], points[1:]], axis=1))
        frequencies.append((branch.frequency[:-1] + branch.frequency[1:]) / 2e3)
    lines = LineCollection(segments, array=np.concatenate(frequencies), cmap="viridis", lw=2.6)
    ax.add_collection(lines, autolim=False)
    bar = ax.figure.colorbar(lines, ax=ax, pad=0.02)
    bar.set_label("frequency at the boundary [kHz]")
    handles = [
        Line2D([], [], color="tab:cyan", lw=2.6, label="stability boundary"),
        Line2D([], [], color="0.25", marker="|", ls="none", label="ticks: it squeals on this side"),
    ]
    broken = [
        (branch.x[i], branch.y[i])
        for branch in result.branches
        for i, end in ((0, branch.start), (-1, branch.end))
        if not bool((end == BranchEnd.window) | (end == BranchEnd.closed))
    ]
    if broken:
        style = {"mfc": "white", "mec": "k", "ls": "none", "label": "ends inside the window"}
        handles += ax.plot(*np.transpose(broken), "o", ms=5, **style)
    legend_above(ax, handles)
    return ax
