"""A branch of limit cycles over its quantity."""

from typing import Any

import numpy as np

from .._dynamics.branch import Branch
from .axes import Axes, ensure_axes, legend_above

_MARKERS = {
    "fold": "s",
    "grazing": "o",
    "Hopf": "D",
    "period doubling": "^",
    "Neimark-Sacker": "v",
    "order of switches": "x",
}


def branch(
    result: Branch, ax: Axes | None = None, *, direction: int = 1, label: str | None = None
) -> Axes:
    """Peak-to-peak amplitude of one degree of freedom over the quantity of a branch.

    Stable cycles are solid, unstable ones dashed; markers are the branch's events.

    **Arguments:**

    - `result`: as `continue_cycle` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    - `direction`: the degree of freedom, from 1; 1 by default.
    - `label`: text at the abscissa, by default the name of the quantity with its unit.

    **Raises:** `ValueError` for an unknown degree of freedom.
    """
    n = result.amplitude.shape[1]
    if not 1 <= direction <= n:
        raise ValueError(f"direction must be from 1 to {n}, got {direction}")
    ax = ensure_axes(ax)
    x, y = result.parameter, result.amplitude[:, direction - 1]
    units = (1e6, "µm"), (1e3, "mm"), (1.0, "m")
    factor, unit = next(row for row in units if y.max() * row[0] < 1e3 or row[1] == "m")
    y = y * factor
    handles: list[Any] = []
    # A point where stability changes belongs to both parts.
    for stable, style in ((True, "-"), (False, "--")):
        mine = result.stable == stable
        shown = mine | np.append(mine[1:], False) if stable else mine
        if mine.any():
            drawn = np.where(shown, y, np.nan)
            name = "stable" if stable else "unstable"
            handles += ax.plot(x, drawn, style, color="C0", lw=1.5, label=name)
    for kind, marker in _MARKERS.items():
        at = [event.index for event in result.of_kind(kind)]
        if at:
            shape: dict[str, Any] = {
                "marker": marker,
                "ls": "",
                "color": "k",
                "ms": 5,
                "clip_on": False,
            }
            handles += ax.plot(x[at], y[at], label=kind, zorder=3, **shape)
    ax.set_xlabel(result.name if label is None else label)
    ax.set_ylabel(f"peak-to-peak amplitude [{unit}]")
    ax.set_ylim(bottom=0)
    legend_above(ax, handles)
    return ax
