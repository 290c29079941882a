"""Curves of contact stiffness and of its slope, as the source's Figs. 2 to 4 show them."""

from typing import Any

import numpy as np

from ..base.ranges import is_logarithmic
from ..mechanism.contact import Regime
from ..sweeping.stiffness_curves import StiffnessCurves
from .axes import legend_above, new_axes, new_figure

_WORDS = {"K_n": "normal stiffness K_n", "K_t": "tangential stiffness K_t"}
_STYLES = ("solid", "dashed", "dashdot", "dotted")
_CLIPPED = 0.05  # of the slopes at each end: they are infinite where stiffness vanishes


def stiffness_curves(
    result: StiffnessCurves, ax: Any = None, *, stiffness: str = "K_n", slope: bool = False
) -> Any:
    """K_n or K_t over x on a logarithmic axis, a colour for each y; or its relative slope.

    The slope is d ln K/dx, d ln K/d ln x where x is on a logarithmic axis. Circles: where a joint
    becomes fully plastic; crosses: where gross slip begins or ends.

    **Raises:** `ValueError` for a stiffness that is neither "K_n" nor "K_t".
    """
    import matplotlib as mpl
    from matplotlib.lines import Line2D

    if stiffness not in _WORDS:
        raise ValueError(f"stiffness must be 'K_n' or 'K_t', got {stiffness!r}")
    ax = new_axes() if ax is None else ax
    x, logarithmic = np.asarray(result.x), is_logarithmic(float(result.x[0]), float(result.x[-1]))
    values = _slopes(result, stiffness, x, logarithmic) if slope else _values(result, stiffness)
    colours = mpl.colormaps["viridis"](np.linspace(0, 0.85, len(values)))
    handles, marks = [], {}
    for i, (row, colour) in enumerate(zip(values, colours, strict=True)):
        line = ax.plot(x, row, color=colour, ls=_STYLES[i % 4], lw=1.7)[0]
        line.set_label(f"{result.names[1]} = {float(result.y[i]):.3g}{_suffix(result.units[1])}")
        handles.append(line)
        for marker, label, at in _changes(result, i, row):
            style: dict[str, Any] = {"mfc": "white", "ms": 6, "ls": "none", "zorder": 3}
            ax.plot(x[at], row[at], marker, color=colour, **style)
            marks[label] = Line2D([], [], marker=marker, color="k", label=label, **style)
    ax.set_xscale("log" if logarithmic else "linear")
    ax.set_xlim(x[0], x[-1])
    ax.set_xlabel(f"{result.names[0]} [{result.units[0]}]")
    star, unit = ("", "N/m") if result.A_a is None else ("*", "-")
    if slope:
        ax.set_ylabel(f"d ln {stiffness}/d {'ln ' if logarithmic else ''}{result.names[0]} [-]")
    else:
        ax.set_ylabel(f"{_WORDS[stiffness]}{star} [{unit}]")
    if not np.isfinite(values).any():
        words = f"{stiffness} = 0 everywhere"
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center")
    elif slope:
        ax.axhline(0, color="k", lw=0.8)
        ax.set_ylim(*_limits(values))
    else:
        ax.set_yscale("log")
    legend_above(ax, [*handles, *marks.values()])
    return ax


def stiffness(result: StiffnessCurves, *, slope: bool = False) -> Any:
    """K_n and K_t side by side, or their slopes; returns the figure."""
    figure = new_figure(11.2, 5.2)
    for ax, which in zip(figure.subplots(1, 2), _WORDS, strict=True):
        stiffness_curves(result, ax, stiffness=which, slope=slope)
    return figure


def _values(result, stiffness):
    """(m, n): the stiffness where there is any."""
    values = np.asarray(getattr(result, stiffness))
    return np.where(values > 0, values, np.nan)


def _slopes(result, stiffness, x, logarithmic):
    slopes = np.asarray(getattr(result, f"{stiffness}_slope"))
    return slopes * x if logarithmic else slopes


def _limits(slopes):
    """Limits that show what is between the infinite ends of the curves."""
    low, high = np.nanquantile(slopes, [_CLIPPED, 1 - _CLIPPED])
    margin = 0.1 * (high - low)
    return min(low - margin, -margin), max(high + margin, margin)


def _changes(result, i, row):
    """Marker, label and place of every change of regime on curve i that has a stiffness there."""
    for regime, marker, label in (
        (Regime.fully_plastic, "o", "fully plastic beyond"),
        (Regime.gross_slip, "X", "gross slip begins or ends"),
    ):
        inside = np.asarray(result.regime == regime)[i]
        for k in np.flatnonzero(inside[1:] != inside[:-1]):
            drawn = [at for at in (k, k + 1) if np.isfinite(row[at]) and not inside[at]]
            yield from ((marker, label, at) for at in drawn)


def _suffix(unit):
    return "" if unit == "-" else f" {unit}"
