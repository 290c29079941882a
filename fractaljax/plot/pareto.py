"""The front of two objectives, and the surfaces on it."""

from typing import Any

import numpy as np

from ..optimise.pareto import Front
from .axes import legend_above, new_axes


def pareto(front: Front, ax: Any = None) -> Any:
    """First against second objective, in their own units, coloured by the fractal dimension."""
    ax = new_axes() if ax is None else ax
    (line,) = ax.plot(front.first, front.second, "-", color="0.6", lw=1.1, zorder=1, label="front")
    order = np.argsort(front.D)
    dots = ax.scatter(
        front.first[order],
        front.second[order],
        c=front.D[order],
        cmap="cividis",
        s=42,
        edgecolors="k",
        linewidths=0.7,
        label="surfaces on it",
    )
    bar = ax.figure.colorbar(dots, ax=ax, pad=0.02)
    bar.set_label("fractal dimension D [-]")
    last = len(front.first) - 1
    for i, offset, side in ((0, (9, 4), "left"), (last, (-9, -13), "right")):
        ax.annotate(
            f"G = {front.G[i]:.3g} m",
            (front.first[i], front.second[i]),
            xytext=offset,
            textcoords="offset points",
            ha=side,
            fontsize="small",
        )
    ax.margins(x=0.14, y=0.1)
    ax.set_xlabel(front.names[0])
    ax.set_ylabel(front.names[1])
    legend_above(ax, [line, dots])
    return ax
