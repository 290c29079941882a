"""The front of two objectives, and the surfaces on it."""

from typing import Any

import numpy as np

from .._design.pareto import Front
from .axes import Axes, ensure_axes, legend_above


def pareto(front: Front, ax: Axes | None = None) -> Axes:
    """First against second objective, in their own units, coloured by the fractal dimension.

    **Arguments:**

    - `front`: as `pareto` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    """
    ax = ensure_axes(ax)
    handles: list[Any] = ax.plot(front.first, front.second, color="0.6", lw=1.1, label="front")
    order = np.argsort(front.D)
    first, second = front.first[order], front.second[order]
    style: dict[str, Any] = {"s": 42, "edgecolors": "k", "linewidths": 0.7, "zorder": 2}
    style["label"] = "surfaces on the front"
    dots = ax.scatter(first, second, c=front.D[order], cmap="cividis", **style)
    ax.figure.colorbar(dots, ax=ax, pad=0.02).set_label("fractal dimension D [-]")
    for i, offset, side in ((0, (9, 4), "left"), (-1, (-9, -13), "right")):
        place: dict[str, Any] = {"xytext": offset, "textcoords": "offset points", "ha": side}
        at = front.first[i], front.second[i]
        ax.annotate(f"G = {front.G[i]:.3g} m", at, fontsize="small", **place)
    ax.margins(x=0.14, y=0.1)
    ax.set_xlabel(front.names[0])
    ax.set_ylabel(front.names[1])
    legend_above(ax, [*handles, dots])
    return ax
