"""Published curves, and ours over them."""

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from .axes import new_figure
from .panels import Panels

if TYPE_CHECKING:
    from .._validate.validate import ValidatedCase
else:
    ValidatedCase = Any

_MARKS = "osD^v<"
_STYLES = "solid", "dashed", "dashdot", "dotted"


def validation(case: ValidatedCase) -> Panels:
    """The curves of a published case: theirs as marks or dashed, ours as lines; the figure.

    **Arguments:**

    - `case`: a member of `Validation.cases`.

    **Raises:** `ValueError` for a case that did not run.
    """
    import matplotlib as mpl

    if not case.panels:
        raise ValueError(f"{case.name} has no curves: {case.reason}")
    width = max(6.4, 5.4 * len(case.panels))
    figure = new_figure(width, 4.9)
    source = case.citation + ("" if case.doi is None else f", doi:{case.doi}")
    figure.suptitle(f"{case.title}\n{textwrap.fill(source, round(14 * width))}", fontsize="small")
    axes = figure.subplots(1, len(case.panels), squeeze=False)[0]
    for ax, panel in zip(axes, case.panels, strict=True):
        ours = [curve for curve in panel.curves if curve.ours and curve.label]
        colours = mpl.colormaps["viridis"](np.linspace(0, 0.8, len(ours)))
        mine = marks = dashes = -1
        for curve in panel.curves:
            fresh = bool(curve.label)
            style: dict[str, Any] = {"label": curve.label or None}
            if curve.ours:
                mine += fresh
                style |= {"color": colours[mine], "ls": _STYLES[mine % 4], "lw": 1.6, "zorder": 3}
            elif curve.dashed:
                dashes += fresh
                style |= {"color": "0.45", "ls": ("dashed", "dotted")[dashes % 2], "lw": 1.2}
            else:
                marks += fresh
                style |= {"color": "0.35", "marker": _MARKS[marks % 6], "ms": 5, "mfc": "none"}
                style |= {"ls": "none", "zorder": 2}
            ax.plot(curve.x, curve.y, **style)
        ax.set(xlabel=panel.xlabel, ylabel=panel.ylabel, **panel.options)
        ax.legend(fontsize="x-small", frameon=False)
    return Panels(figure)
