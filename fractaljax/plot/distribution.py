"""How a quantity is distributed over samples."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import ArrayLike

from .axes import Axes, ensure_axes, legend_above


def distribution(
    samples: Mapping[str, ArrayLike],
    ax: Axes | None = None,
    *,
    label: str,
    limit: float | None = None,
) -> Axes:
    """The share [-] of each set of samples that lies below every value, a line for each.

    **Arguments:**

    - `samples`: {name: samples (n,)}, sets of any sizes.
    - `ax`: axes to draw in, by default those of a new figure.
    - `label`: names the quantity with its unit.
    - `limit`: a value to mark, by default none: for growth rates at 0, one minus the share is the
      probability of squeal.

    **Raises:** `ValueError` if there are no sets, for a set that is empty or not of shape (n,), and
    for values that are not finite.
    """
    if not samples:
        raise ValueError("there must be at least one set of samples to draw")
    checked = {name: np.asarray(values, float) for name, values in samples.items()}
    for name, values in checked.items():
        if values.ndim != 1 or not values.size or not np.isfinite(values).all():
            raise ValueError(f"samples {name!r} must be finite numbers (n,)")
    ax = ensure_axes(ax)
    handles = []
    for i, (name, values) in enumerate(checked.items()):
        style = ("solid", "dashed", "dashdot", "dotted")[i % 4]
        handles.append(ax.ecdf(values, label=name, color=f"C{i}", ls=style, lw=1.8))
    if limit is not None:
        handles.append(ax.axvline(limit, color="0.35", lw=1, label=f"limit {limit:g}"))
    ax.set_ylim(-0.02, 1.02)
    ax.set_xlabel(label)
    ax.set_ylabel("share below [-]")
    legend_above(ax, handles)
    return ax
