"""Real parts and frequencies of all modes, from a sweep of `stability` over two quantities."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from .._mechanism.quantities import label
from .._sweep.result import Sweep
from .axes import (
    Axes,
    ensure_axes,
    format_value,
    legend_above,
    lines,
    new_figure,
    set_quantity_axis,
)
from .maps import frequency_map, growth_map, vibration_modes
from .panels import Panels

_LABELS = {"real": "real part [1/s]", "frequency": "frequency [kHz]"}
_COLOURS = "#9ecae1", "#d95f0e", "#31a354", "#756bb1"


def mode_lines(
    result: Sweep,
    ax: Axes | None = None,
    *,
    quantity: Literal["real", "frequency"] = "real",
    at: Sequence[float] | None = None,
) -> Axes:
    """Real part or frequency of all modes over y, a colour for each of some values of x.

    The nearest values of the sweep are shown, without interpolation.

    **Arguments:**

    - `result`: a `Sweep` of `stability` over two quantities, x and y.
    - `ax`: axes to draw in, by default those of a new figure.
    - `quantity`: "real", the default, or "frequency".
    - `at`: values of x, by default four of them.

    **Raises:** `ValueError` for a quantity that is neither "real" nor "frequency".
    """
    layers, (x, y) = _layers(result, quantity), result.points
    ax = ensure_axes(ax)
    at = np.linspace(0, x[-1], 5)[1:] if at is None else at
    rows = [int(np.abs(x - value).argmin()) for value in at]
    if quantity == "real":
        ax.axhline(0, color="k", lw=0.8)
    names = [format_value(result.scene, result.names[0], x[i]) for i in rows]
    handles = lines(ax, y, layers[rows], names)
    set_quantity_axis(ax, "x", result.scene, result.names[1], y)
    ax.set_ylabel(f"{_LABELS[quantity]} of all modes")
    legend_above(ax, handles)
    return ax


def mode_surfaces(
    result: Sweep, ax: Any = None, *, quantity: Literal["real", "frequency"] = "real"
) -> Any:
    """Real part or frequency of each mode as a surface over x and y.

    **Arguments:**

    - `result`, `quantity`: as in `mode_lines`.
    - `ax`: 3D axes to draw in, by default those of a new figure.

    **Raises:** `ValueError` for a quantity that is neither "real" nor "frequency".
    """
    from matplotlib.patches import Patch

    layers = _layers(result, quantity)
    ax = new_figure().add_subplot(projection="3d") if ax is None else ax
    x, y = np.meshgrid(*result.points)
    names = [f"mode {i + 1}" for i in range(layers.shape[-1])]
    if quantity == "real" and len(names) == 2:
        names = ["lower", "upper"]
    style: dict[str, Any] = {
        "rcount": 40,
        "ccount": 40,
        "lw": 0.3,
        "edgecolor": "0.25",
        "alpha": 0.9,
    }
    handles = []
    for i, name in enumerate(names):
        colour = _COLOURS[i % len(_COLOURS)]
        ax.plot_surface(x, y, layers[..., i].T, color=colour, **style)
        handles.append(Patch(facecolor=colour, edgecolor="0.25", label=name))
    ax.set_xlabel(label(result.scene, result.names[0]))
    ax.set_ylabel(label(result.scene, result.names[1]))
    ax.set_zlabel(_LABELS[quantity], labelpad=8)
    ax.view_init(elev=18, azim=-125)
    legend_above(ax, handles)
    return ax


def modes(result: Sweep) -> Panels:
    """Growth rate, real parts, and the frequencies of modes 1 and 2; returns their axes.

    **Arguments:**

    - `result`: a `Sweep` of `stability` over two quantities.
    """
    figure = new_figure(11.2, 9.2)
    upper, lower = figure.subplots(2, 2)
    growth_map(result, upper[0])
    mode_lines(result, upper[1])
    frequency_map(result, lower[0], mode=1)
    frequency_map(result, lower[1], mode=2)
    return Panels(figure)


def _layers(result, quantity):
    """(n, m, modes): real parts in ascending order [1/s], or frequencies [kHz]."""
    if quantity not in _LABELS:
        raise ValueError(f"quantity must be 'real' or 'frequency', got {quantity!r}")
    real, frequency = vibration_modes(result)
    # Sorted separately, each quantity has layers that cross as little as possible.
    return np.sort(real, axis=-1) if quantity == "real" else frequency / 1e3
