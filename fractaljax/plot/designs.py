"""The designs of a family of mechanisms over the quantities that differ between its members."""

from typing import Any

import numpy as np

from .._design.many import DesignMany
from .._mechanism.quantities import label, require_quantity
from .axes import Axes, ensure_axes, legend_above


def design_map(
    designs: DesignMany,
    x: str,
    y: str | None = None,
    ax: Axes | None = None,
    *,
    quantity: str | None = None,
) -> Axes:
    """A designed quantity over one or two quantities that differ between the members of a family.

    Over two quantities it is a map of a grid of members, or points; over one a line. Members
    without a design are crosses.

    **Arguments:**

    - `designs`: as `design_many` returns them.
    - `x`, `y`: names of quantities of the mechanisms; by default there is no `y`.
    - `ax`: axes to draw in, by default those of a new figure.
    - `quantity`: a designed one, by default the first.

    **Raises:** `ValueError` for an unknown name.
    """
    quantity = next(iter(designs.quantities)) if quantity is None else quantity
    if quantity not in designs.quantities:
        raise ValueError(f"quantity must be one of {', '.join(designs.quantities)}, got {quantity}")
    for name in (x,) if y is None else (x, y):
        require_quantity(designs.member, name)
    ax, met = ensure_axes(ax), np.asarray(designs.met)
    values = np.where(met, designs[quantity], np.nan)
    words, quantities = label(designs.member, quantity), designs.member.stored_quantities()
    scale = quantity in quantities and quantities[quantity].log
    axes: list[np.ndarray] = [
        designs.mechanism_quantity(name) for name in ((x,) if y is None else (x, y))
    ]
    if y is None:
        order = np.argsort(axes[0], axis=None)
        ax.plot(axes[0].ravel()[order], values.ravel()[order], "o-", ms=3, lw=1.4)
        ax.set(ylabel=words, yscale="log" if scale else "linear")
        failed = [axes[0][~met], np.full((~met).sum(), np.nanmin(values) if met.any() else 0.0)]
    else:
        how: dict[str, Any] = {"cmap": "viridis"}
        if scale:
            how["norm"] = "log"
        if values.ndim == 2 and min(values.shape) > 1:
            drawn = ax.pcolormesh(*axes, values, shading="nearest", **how)
            drawn.set_rasterized(True)
        else:
            at, over = (axis[met] for axis in axes)
            drawn = ax.scatter(
                at, over, s=14, c=values[met], edgecolors="0.3", linewidths=0.4, **how
            )
        ax.figure.colorbar(drawn, ax=ax, pad=0.02).set_label(words)
        ax.set_ylabel(label(designs.member, y))
        failed = [axis[~met] for axis in axes]
    ax.set_xlabel(label(designs.member, x))
    if not met.all():
        style = {"color": "tab:red", "ls": "none", "ms": 4, "clip_on": False}
        legend_above(ax, ax.plot(*failed, "x", label="no design meets all requirements", **style))
    return ax
