"""Heights of a surface, and of the surfaces before and after a design."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

from .._design.design import Design
from .._surface.roughness import roughness
from .._surface.surface import Surface
from .._surface.topography import Topographies
from .axes import Axes, ensure_axes, new_figure
from .panels import Panels


def topography(
    z: Float[ArrayLike, "n m"], dx: float, ax: Axes | None = None, *, dy: float | None = None
) -> Axes:
    """Heights [um] of a map about their mean; x [um] along its first axis.

    **Arguments:**

    - `z`: heights (n, m) [m]; NaN is left white.
    - `dx`: distance of points along the first axis [m].
    - `ax`: axes to draw in, by default those of a new figure.
    - `dy`: distance of points along the second axis [m], by default dx.

    **Raises:** `ValueError` for a z that is no map or holds no height, and unless dx, dy > 0.
    """
    z = np.asarray(z, float)
    if z.ndim != 2 or not np.isfinite(z).any():
        raise ValueError(f"z must be a map (n, m) of heights, got shape {z.shape}")
    steps = dx, dx if dy is None else dy
    if not all(np.isfinite(step) and step > 0 for step in steps):
        raise ValueError(f"dx and dy must be above 0, got {steps[0]!r} and {steps[1]!r}")
    ax, heights = ensure_axes(ax), _subtract_mean(z)
    image = _draw(ax, heights, steps, np.nanmin(heights), np.nanmax(heights))
    ax.figure.colorbar(image, ax=ax, pad=0.02).set_label("height about the mean [µm]")
    return ax


def topographies(design: Design, **options: Any) -> Panels:
    """The given and the designed surface side by side, at one colour scale; returns their axes.

    **Arguments:**

    - `design`: as `design` returns it.
    - `options`: those of `Design.topographies`.
    """
    return drawn_topographies(design, design.topographies(**options))


def drawn_topographies(design: Design, surfaces: Topographies) -> Panels:
    """As `topographies`, of surfaces that are computed already."""
    heights = [_subtract_mean(z) for z in (surfaces.before, surfaces.after)]
    low, high = min(z.min() for z in heights), max(z.max() for z in heights)
    figure = new_figure(11.2, 5.4)
    figure.set_layout_engine("constrained", wspace=0.06)
    axes = figure.subplots(1, 2, sharey=True)
    names = "given surface", "best found" if design.violated else "designed surface"
    scenes = design.initial, design.scene
    for ax, z, name, scene in zip(axes, heights, names, scenes, strict=True):
        image = _draw(ax, z, (surfaces.dx, surfaces.dx), low, high)
        surface = scene.contact.surface
        if isinstance(surface, Surface):
            about = f"D = {surface.D:.5g}, G = {surface.G:.4g} m"
        else:
            about = f"Sq = {roughness(surface).Sq:.4g} m"
        ax.set_title(f"{name}: {about}", fontsize="medium")
        ax.label_outer()
    figure.colorbar(image, ax=axes, pad=0.02).set_label("height about the mean [µm]")
    return Panels(figure)


def _subtract_mean(z):
    return (z - np.nanmean(z)) * 1e6


def _draw(ax, heights, steps, low, high):
    extent = [0, heights.shape[0] * steps[0] * 1e6, 0, heights.shape[1] * steps[1] * 1e6]
    style: dict[str, Any] = {"cmap": "cividis", "origin": "lower", "extent": extent}
    image = ax.imshow(heights.T, vmin=low, vmax=high, **style)
    ax.set_xlabel("x [µm]")
    ax.set_ylabel("y [µm]")
    return image
