"""The motion that each start of a two-dimensional section ends in."""

from typing import Any

import numpy as np

from .._dynamics.basin import Basin
from .axes import Axes, ensure_axes, legend_above

_COLOURS = {"equilibrium": "#c6dbef", "diverges": "0.25", "undecided": "#d62728"}


def basin(result: Basin, ax: Axes | None = None) -> Axes:
    """The outcomes of a section as areas: each point has the outcome of the nearest start.

    Displacements are in um, or in m if one is above 1 cm; velocities are in m/s.

    **Arguments:**

    - `result`: as `basin` returns it, of starts that differ in two coordinates only, as in a box
      with all others fixed.
    - `ax`: axes to draw in, by default those of a new figure.

    **Raises:** `ValueError` unless exactly two coordinates differ.
    """
    import matplotlib as mpl
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch
    from scipy.spatial import KDTree

    starts = result.starts
    coordinates = np.flatnonzero(np.ptp(starts, axis=0) > 0)
    if len(coordinates) != 2:
        raise ValueError(
            f"a picture needs starts that differ in 2 coordinates, got {len(coordinates)}"
        )
    ax, n = ensure_axes(ax), starts.shape[1] // 2
    small = np.abs(starts[:, :n]).max() < 1e-2  # m
    unit = np.where((coordinates < n) & small, 1e6, 1)
    points = starts[:, coordinates] * unit
    low, high = points.min(axis=0), points.max(axis=0)
    pixels = 400  # along each axis: about as many as a figure shows
    x, y = (low + (high - low) * ((np.arange(pixels) + 0.5) / pixels)[:, None]).T
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    nearest = KDTree(points / (high - low)).query(grid / (high - low))[1]
    shown = result.labels[nearest].reshape(pixels, pixels)
    names = result.outcomes
    cycles = iter(mpl.colormaps["viridis"](np.linspace(0.15, 0.95, max(1, len(names) - 3))))
    colours = [_COLOURS[name] if name in _COLOURS else next(cycles) for name in names]
    picture: dict[str, Any] = {"origin": "lower", "aspect": "auto", "interpolation": "nearest"}
    picture |= {"cmap": ListedColormap(colours), "vmin": -0.5, "vmax": len(names) - 0.5}
    ax.imshow(shown, extent=(low[0], high[0], low[1], high[1]), **picture)
    shares = result.shares
    handles = [
        Patch(facecolor=colour, label=f"{name}, {shares[name]:.1%}")
        for name, colour in zip(names, colours, strict=True)
        if shares[name]
    ]
    for which, i in zip("xy", coordinates.tolist(), strict=True):
        name = f"x{i + 1} [{'µm' if small else 'm'}]" if i < n else f"dx{i - n + 1}/dt [m/s]"
        ax.set(**{f"{which}label": name})
    legend_above(ax, handles)
    return ax
