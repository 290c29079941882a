"""Several limit cycles beside one another, or along a quantity."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..motion.cycle import LimitCycle
from .axes import legend_above, new_axes, new_figure
from .cycle import phase_portrait, spectrum

_TANGENTS = 6
_TANGENT = 0.09  # half its length, beside the width of the axis


def cycles(results: Mapping[str, LimitCycle], *, direction: int = 1) -> Any:
    """Phase portrait and spectrum of one direction, a row for each cycle; returns the figure.

    All rows have the same axes, as the source's Figs. 11 (direction 1) and 12 (2) compare them;
    the keys name the rows.

    **Raises:** `ValueError` for none, where there is no limit cycle, for a batch, or a direction
    not 1 or 2.
    """
    if not results:
        raise ValueError("there must be at least one limit cycle to draw")
    figure = new_figure(10.4, 0.5 + 3.6 * len(results))
    parts = np.ravel(figure.subfigures(len(results), 1))
    portraits, spectra = [], []
    for part, (name, cycle) in zip(parts, results.items(), strict=True):
        part.suptitle(name, x=0.01, ha="left", fontweight="bold", fontsize="medium")
        left, right = part.subplots(1, 2)
        portraits.append(phase_portrait(cycle, left, direction=direction))
        spectra.append(spectrum(cycle, right, direction=direction))
    _share_limits(portraits)
    _share_limits(spectra)
    for ax in spectra:
        (stems,) = ax.collections
        stems.set_segments(
            [[(f, ax.get_ylim()[0]), (f, a)] for (f, _), (_, a) in stems.get_segments()]
        )
    return figure


def _share_limits(axes):
    for axis in "xy":
        low, high = np.transpose([getattr(ax, f"get_{axis}lim")() for ax in axes])
        for ax in axes:
            getattr(ax, f"set_{axis}lim")(low.min(), high.max())


def amplitudes(
    results: LimitCycle, over: Any, ax: Any = None, *, label: str, slopes: Any = None
) -> Any:
    """Peak-to-peak amplitudes [um] of a batch of cycles over a quantity, both directions.

    `over` (n,) are the values of the quantity, `label` its name with its unit, and `slopes` (n,)
    the derivative of the amplitude of direction 1 by it [m per unit], drawn as some tangents.
    Gaps are members without a cycle.

    **Raises:** `ValueError` for another batch than `over` (n,) says, or slopes of another shape.
    """
    over = np.asarray(over, float)
    if over.ndim != 1 or results.period.shape != over.shape:
        raise ValueError(
            f"over must have the shape (n,) of the batch, got {over.shape} and "
            f"{results.period.shape}"
        )
    ax = new_axes() if ax is None else ax
    amplitude = np.asarray(results.amplitude) * 1e6
    handles = []
    for i, (colour, marker) in enumerate([("tab:blue", "o"), ("tab:orange", "s")]):
        style: dict[str, Any] = {"color": colour, "marker": marker, "ms": 4, "lw": 1.3}
        handles += ax.plot(over, amplitude[:, i], label=f"direction {i + 1}", **style)
    if slopes is not None:
        slopes = np.asarray(slopes, float)
        if slopes.shape != over.shape:
            raise ValueError(f"slopes must have shape {over.shape}, got {slopes.shape}")
        reach = _TANGENT * np.ptp(over) * np.array([-1, 1])
        shown = np.unique(np.linspace(0, len(over) - 1, _TANGENTS).astype(int))
        for x, y, slope in zip(over[shown], amplitude[shown, 0], slopes[shown] * 1e6, strict=True):
            style = {"color": "k", "lw": 1.1, "zorder": 3, "label": "derivative of direction 1"}
            tangent = ax.plot(x + reach, y + slope * reach, **style)
        handles += tangent
    ax.set_xlabel(label)
    ax.set_ylabel("peak-to-peak amplitude [µm]")
    legend_above(ax, handles)
    return ax
