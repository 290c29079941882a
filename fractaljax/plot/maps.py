"""Maps of growth rate and frequency of both modes, and the views of the source's Figs. 7 to 10."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..mechanism.contact import Regime
from ..modes.maps import Modes, source_modes
from .axes import legend_above, new_axes, new_figure

_QUANTITIES = {"real": "real part [1/s]", "frequency": "frequency [kHz]"}


def growth_map(modes: Modes, ax: Any = None) -> Any:
    """Growth rate [1/s] as labelled contours: filled where the scene squeals, dashed where not.

    Hatched where a fractal joint is not elastic-plastic, and the growth rate another mechanism's.

    **Raises:** `ValueError` unless x and y have two values or more.
    """
    from matplotlib.ticker import MaxNLocator

    ax = _map_axes(modes, ax)
    growth = _growth(modes)
    grid = np.asarray(modes.x), np.asarray(modes.y), growth
    low, high = growth.min(), growth.max()
    if high > 0:
        levels = MaxNLocator(8).tick_values(0, high)
        ax.contourf(*grid, levels, colors=_pale("YlOrBr", len(levels) - 1))
        _labelled(ax, grid, levels[1:], linestyles="solid")
    if low < 0:
        levels = np.asarray(MaxNLocator(4).tick_values(low, min(high, 0)))
        _labelled(ax, grid, levels[levels < 0], linestyles="dashed")
    return _finish(modes, ax, "growth rate [1/s]")


def frequency_map(modes: Modes, ax: Any = None, *, mode: int = 1) -> Any:
    """Frequency [kHz] of the lower (1) or the higher (2) mode, and the stability boundary.

    **Raises:** `ValueError` for another mode, and as `growth_map`.
    """
    from matplotlib.ticker import MaxNLocator

    if mode not in (1, 2):
        raise ValueError(f"mode must be 1 or 2, got {mode!r}")
    ax = _map_axes(modes, ax)
    frequency = np.asarray(modes.frequency[..., mode - 1]) / 1e3
    grid = np.asarray(modes.x), np.asarray(modes.y), frequency
    levels = MaxNLocator(10).tick_values(frequency.min(), frequency.max())
    if frequency.min() < frequency.max():
        ax.contourf(*grid, levels, colors=_pale("YlGnBu", len(levels) - 1))
        _labelled(ax, grid, levels, linestyles="solid")
    return _finish(modes, ax, f"frequency of mode {mode} [kHz]")


def mode_lines(
    modes: Modes, ax: Any = None, *, quantity: str = "real", at: Sequence[float] | None = None
) -> Any:
    """Real part or frequency of both modes over y, a colour for each of the values `at` of x.

    Without `at` four of them. They are the nearest there are: nothing is interpolated.

    **Raises:** `ValueError` for a quantity that is neither "real" nor "frequency".
    """
    import matplotlib as mpl

    ax = new_axes() if ax is None else ax
    values, y, x = _layers(modes, quantity), np.asarray(modes.y), np.asarray(modes.x)
    at = np.linspace(0, x[-1], 5)[1:] if at is None else at
    columns = [int(np.abs(x - value).argmin()) for value in at]
    colours = mpl.colormaps["viridis"](np.linspace(0, 0.85, len(columns)))
    styles = ["solid", "dashed", "dashdot", "dotted"]
    if quantity == "real":
        ax.axhline(0, color="k", lw=0.8)
    handles = []
    for i, (column, colour) in enumerate(zip(columns, colours, strict=True)):
        drawn = ax.plot(y, values[:, column], color=colour, ls=styles[i % 4], lw=1.5)
        drawn[0].set_label(f"{modes.names[0]} = {x[column]:.3g}{_suffix(modes.units[0])}")
        handles.append(drawn[0])
    ax.set_xlim(y[0], y[-1])
    ax.set_xlabel(_label(modes, 1))
    ax.set_ylabel(f"{_QUANTITIES[quantity]} of both modes")
    legend_above(ax, handles)
    return ax


def mode_surfaces(modes: Modes, ax: Any = None, *, quantity: str = "real") -> Any:
    """Real part or frequency of both modes as two surfaces over x and y; `ax` has to be 3D.

    **Raises:** `ValueError` for a quantity that is neither "real" nor "frequency".
    """
    from matplotlib.patches import Patch

    values = _layers(modes, quantity)
    if ax is None:
        ax = new_figure().add_subplot(projection="3d")
    x, y = np.meshgrid(np.asarray(modes.x), np.asarray(modes.y))
    handles = []
    words = ("lower", "upper") if quantity == "real" else ("mode 1", "mode 2")
    for layer, colour, word in zip((0, 1), ("#9ecae1", "#d95f0e"), words, strict=True):
        z = values[..., layer]
        ax.plot_surface(
            x, y, z, color=colour, rcount=40, ccount=40, lw=0.3, edgecolor="0.25", alpha=0.9
        )
        handles.append(Patch(facecolor=colour, edgecolor="0.25", label=word))
    ax.set_xlabel(_label(modes, 0))
    ax.set_ylabel(_label(modes, 1))
    ax.set_zlabel(_QUANTITIES[quantity])
    ax.view_init(elev=18, azim=-125)
    legend_above(ax, handles)
    return ax


def modes(result: Modes) -> Any:
    """Growth rate, real parts, and the frequency of each mode; returns the figure."""
    figure = new_figure(11.2, 9.2)
    upper, lower = figure.subplots(2, 2)
    growth_map(result, upper[0])
    mode_lines(result, upper[1])
    frequency_map(result, lower[0], mode=1)
    frequency_map(result, lower[1], mode=2)
    return figure


def source_figure(number: int) -> Any:
    """The source's Fig. 7, 8, 9 or 10, as maps; returns the figure.

    **Raises:** `ValueError` for another number.
    """
    if number in (7, 8):
        return modes(source_modes(str(number)))
    if number not in (9, 10):
        raise ValueError(f"number must be 7, 8, 9 or 10, got {number!r}")
    figure = new_figure(11.2, 9.2 if number == 9 else 17)
    rows = figure.subplots(2, 2).reshape(4, 1) if number == 9 else figure.subplots(4, 2)
    for letter, row in zip("abcd", rows, strict=True):
        panel = source_modes(f"9{letter}")
        for mode, ax in enumerate(row, start=1):
            _ = growth_map(panel, ax) if number == 9 else frequency_map(panel, ax, mode=mode)
            ax.set_title(f"({letter}) {ax.get_title(loc='left')}", fontsize="medium", loc="left")
    return figure


# ---------------------------------------------------------------------------------------------
# What they share
# ---------------------------------------------------------------------------------------------


def _map_axes(modes, ax):
    """Axes with the scales, limits and labels of a grid that contours can be drawn on."""
    if min(modes.x.size, modes.y.size) < 2:
        shape = modes.y.size, modes.x.size
        raise ValueError(f"a map needs two values a side at least, got a grid of shape {shape}")
    ax = new_axes() if ax is None else ax
    for i, (values, axis) in enumerate([(modes.x, "x"), (modes.y, "y")]):
        values = np.asarray(values)
        ax.set(**{f"{axis}label": _label(modes, i), f"{axis}lim": (values[0], values[-1])})
        if _geometric(values):
            ax.set(**{f"{axis}scale": "log"})
    return ax


def _geometric(values):
    """Whether values are even in the logarithm, and not as they are."""
    if values.size < 3 or values.min() <= 0 or _even(values):
        return False
    return _even(np.log(values))


def _even(values):
    steps = np.diff(values)
    return bool(np.allclose(steps, steps[0], rtol=1e-3, atol=0))


def _label(modes, i):
    return f"{modes.names[i]} [{modes.units[i]}]"


def _suffix(unit):
    return "" if unit == "-" else f" {unit}"


def _layers(modes, quantity):
    """(m, n, 2): what a name stands for, in the units of its label."""
    if quantity not in _QUANTITIES:
        raise ValueError(f"quantity must be 'real' or 'frequency', got {quantity!r}")
    values = np.asarray(getattr(modes, quantity))
    # Layers of real parts cross no more than those of frequencies do: each has its own order.
    return values / 1e3 if quantity == "frequency" else np.sort(values, axis=-1)


def _pale(name, count):
    """Colours of a map that gets darker, so pale that black lines and words are read on them."""
    import matplotlib as mpl

    return mpl.colormaps[name](np.linspace(0.05, 0.6, count))


def _labelled(ax, grid, levels, linestyles):
    lines = ax.contour(*grid, levels, colors="0.25", linewidths=0.7, linestyles=linestyles)
    ax.clabel(lines, fontsize="x-small", fmt=lambda level: f"{level:g}")


def _growth(modes):
    """The growth rate where the joint is elastic: elsewhere it is that of another mechanism."""
    growth = np.asarray(modes.growth_rate)
    if modes.regime is None:
        return growth
    inelastic = np.asarray(modes.regime != Regime.elastic_plastic)
    return growth if inelastic.all() else np.ma.masked_where(inelastic, growth)


def _finish(modes, ax, title):
    """Boundary, regimes, and above the axes what is shown at the left and a legend at the right."""
    ax.set_title(title, fontsize="medium", loc="left")
    handles = [*_boundary(modes, ax), *_regimes(modes, ax)]
    if handles:
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.99)}
        ax.legend(handles=handles, ncols=3, fontsize="small", frameon=False, **place)
    return ax


def _boundary(modes, ax):
    from matplotlib.lines import Line2D

    growth = _growth(modes)
    if not growth.min() < 0 < growth.max():
        return []
    ax.contour(modes.x, modes.y, growth, [0.0], colors="k", linewidths=2)
    return [Line2D([], [], color="k", lw=2, label="stability boundary")]


def _regimes(modes, ax):
    from matplotlib.patches import Patch

    handles = []
    for regime, grey, hatch, label in [
        (Regime.fully_plastic, "0.80", "//", "fully plastic"),
        (Regime.gross_slip, "0.92", "..", "gross slip"),
    ]:
        inside = None if modes.regime is None else np.asarray(modes.regime == regime)
        if inside is not None and inside.any():
            style: dict[str, Any] = {"hatches": [hatch], "colors": [grey]}
            ax.contourf(modes.x, modes.y, inside.astype(float), levels=[0.5, 1.5], **style)
            handles.append(Patch(facecolor=grey, hatch=hatch, edgecolor="0.3", label=label))
    return handles
