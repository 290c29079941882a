"""Modes followed over a quantity."""

import numpy as np

from .._stability.tracks import ModeTracks
from .axes import frequency_unit, legend_above, lines, new_figure, set_quantity_axis
from .panels import Panels


def mode_tracks(tracks: ModeTracks, *, most: int = 9) -> Panels:
    """Growth rate [1/s] and frequency of all modes over the quantity; returns their axes.

    A mode is drawn thick where it is unstable. If there are more than `most`, only modes that are
    unstable somewhere have a colour, and the axes show their range; the others are grey.

    **Arguments:**

    - `tracks`: as `track_modes` returns them.
    - `most`: modes that have a colour and a name in the legend, 9 by default.
    """
    x, growth = tracks.values, tracks.growth_rates
    # The growth rate of an undamped mode is a rounding error of |s|.
    unstable = growth > 1e-9 * np.abs(tracks.eigenvalues)
    chosen = np.flatnonzero(unstable.any(axis=0) | (len(growth.T) <= most))
    factor, hertz = frequency_unit(tracks.frequencies)
    figure = new_figure(8.4, 8.0)
    panels = figure.subplots(2, 1, sharex=True)
    layers = {"growth rate [1/s]": growth, f"frequency [{hertz}]": tracks.frequencies * factor}
    handles = []
    for ax, (words, values) in zip(panels, layers.items(), strict=True):
        set_quantity_axis(ax, "x", tracks.x, tracks.name, x)
        ax.plot(x, np.delete(values, chosen, axis=1), color="0.75", lw=0.8)
        mine = values[:, chosen].T
        handles = lines(ax, x, mine, [f"mode {i + 1}" for i in chosen])
        for line, row, where in zip(handles, mine, unstable[:, chosen].T, strict=True):
            ax.plot(x, np.where(where, row, np.nan), color=line.get_color(), lw=4, alpha=0.6)
        if mine.size:
            low, high = np.nanmin(mine), np.nanmax(mine)
            aside = 0.15 * ((high - low) or abs(high) or 1.0)
            ax.set_ylim(low - aside, high + aside)
        ax.set_ylabel(words)
    panels[0].axhline(0, color="k", lw=0.8)
    panels[0].set_xlabel("")
    if handles:
        legend_above(panels[0], handles[:most])
    figure.align_ylabels()
    return Panels(figure)
