"""Curves over one quantity of a scene, one for each value of a second."""

from typing import Any, Literal

import numpy as np

from .._contact.contact import Regime
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
from .panels import Panels

_STIFFNESS = {"K_n": "normal stiffness K_n", "K_t": "tangential stiffness K_t"}


def curves(result: Sweep, ax: Axes | None = None, *, label: str) -> Axes:
    """A sweep of a scalar over its first quantity, one line for each value of the second.

    **Arguments:**

    - `result`: a `Sweep` with one or two axes and one scalar at every point.
    - `ax`: axes to draw in, by default those of a new figure.
    - `label`: names the scalar, with its unit.

    **Raises:** `ValueError` for another sweep.
    """
    values = np.asarray(result)
    if values.ndim != len(result.names) or values.ndim > 2:
        raise ValueError(f"curves need scalars over one or two axes, got shape {values.shape}")
    ax = ensure_axes(ax)
    handles = _draw(result, values, ax)
    ax.set_ylabel(label)
    if values.ndim == 2:
        legend_above(ax, handles)
    return ax


def stiffness_curves(
    result: Sweep, ax: Axes | None = None, *, stiffness: Literal["K_n", "K_t"] = "K_n"
) -> Axes:
    """K_n or K_t on a logarithmic axis, from a sweep of `stiffness` or of contact states.

    Contact states add circles where the joint becomes fully plastic, and crosses where gross slip
    begins or ends.

    **Arguments:**

    - `result`: a `Sweep` with one or two axes.
    - `ax`: axes to draw in, by default those of a new figure.
    - `stiffness`: "K_n", the default, or "K_t".

    **Raises:** `ValueError` for a stiffness that is neither "K_n" nor "K_t".
    """
    from matplotlib.lines import Line2D

    if stiffness not in _STIFFNESS:
        raise ValueError(f"stiffness must be 'K_n' or 'K_t', got {stiffness!r}")
    ax = ensure_axes(ax)
    measured = result.values
    if isinstance(measured, tuple):
        component = measured[list(_STIFFNESS).index(stiffness)]
    else:
        component = getattr(measured, stiffness)
    values = np.where(np.asarray(component) > 0, component, np.nan)
    handles, marks = _draw(result, values, ax), {}
    for line, place, (marker, words) in _changes(result, handles):
        style: dict[str, Any] = {"mfc": "white", "ms": 6, "ls": "none", "zorder": 3}
        x, y = line.get_data()
        ax.plot(x[place], y[place], marker, color=line.get_color(), **style)
        marks[words] = Line2D([], [], marker=marker, color="k", label=words, **style)
    ax.set_ylabel(f"{_STIFFNESS[stiffness]} [N/m]")
    if np.isfinite(values).any():
        ax.set_yscale("log")
    else:
        words = f"{stiffness} = 0 everywhere"
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center")
    if len(handles) > 1 or marks:
        legend_above(ax, [*handles, *marks.values()])
    return ax


def stiffness(result: Sweep) -> Panels:
    """K_n and K_t side by side; returns their axes.

    **Arguments:**

    - `result`: a `Sweep` as in `stiffness_curves`.
    """
    figure = new_figure(11.2, 5.2)
    for ax, which in zip(figure.subplots(1, 2), ("K_n", "K_t"), strict=True):
        stiffness_curves(result, ax, stiffness=which)
    return Panels(figure)


def _draw(result, values, ax):
    """Draw values (n,) or (n, m) over the first quantity; the lines."""
    x, *others = result.points
    names = [format_value(result.scene, result.names[1], y) for y in others[0]] if others else [""]
    set_quantity_axis(ax, "x", result.scene, result.names[0], x)
    return lines(ax, x, values.reshape(x.size, -1).T, names)


def _changes(result, drawn):
    """Yield line, place and mark of the last stiff point before a regime or the first after it."""
    regime = getattr(result.values, "regime", None)
    if regime is None:
        return
    for member, mark in (
        (Regime.fully_plastic, ("o", "fully plastic beyond")),
        (Regime.gross_slip, ("X", "gross slip begins or ends")),
    ):
        inside = np.asarray(regime == member).reshape(result.points[0].size, -1).T
        for line, within in zip(drawn, inside, strict=True):
            y = line.get_ydata()
            for k in np.flatnonzero(within[1:] != within[:-1]):
                stiff = [place for place in (k, k + 1) if np.isfinite(y[place])]
                yield from ((line, place, mark) for place in stiff if not within[place])
