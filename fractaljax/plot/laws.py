"""Contact laws side by side."""

from typing import Any

import numpy as np

from .._contact.compare import BOUNDARY_ELEMENTS, LawComparison
from .._surface.surface import Surface
from .axes import Axes, ensure_axes, line_colours, new_figure
from .panels import Panels

_PANELS = {
    "K_n": "normal stiffness K_n [N/m]",
    "alpha": "d ln K_n/d ln P [-]",
    "ratio": "stiffness ratio K_t/K_n [-]",
    "share": "real over nominal area A_r/A [-]",
}


def law_curves(result: LawComparison, ax: Axes | None = None, *, show: str = "K_n") -> Axes:
    """One quantity of every law over the load; boundary elements as points with their scatter.

    **Arguments:**

    - `result`: as `compare_laws` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    - `show`: "K_n", the default, "alpha" (d ln K_n/d ln P, with published values), "ratio"
      (K_t/K_n) or "share" (real over nominal area).

    **Raises:** `ValueError` for any other `show`.
    """
    if show not in _PANELS:
        raise ValueError(f"show must be one of {', '.join(_PANELS)}, got {show!r}")
    ax, loads = ensure_axes(ax), np.asarray(result.loads)
    colours = line_colours(len(result.curves))
    for i, (law, curve) in enumerate(result.curves.items()):
        values = _values(result, curve, show)
        if values is None:
            continue
        style: dict[str, Any] = {"label": law, "color": colours[i]}
        if law != BOUNDARY_ELEMENTS:
            ax.plot(loads, values, ls=("solid", "dashed", "dashdot", "dotted")[i % 4], **style)
            continue
        style |= {"color": "k", "marker": "o", "ms": 5, "mfc": "white", "ls": "none", "zorder": 3}
        if show == "K_n" and curve.scatter is not None:
            factor = np.exp(np.asarray(curve.scatter))
            errors = np.stack([values - values / factor, values * factor - values])
            ax.errorbar(loads, values, errors, capsize=3, **style)
        else:
            ax.plot(loads, values, **style)
    if show == "alpha":
        surface = result.surface
        H = 3 - float(surface.D) if isinstance(surface, Surface) else float(surface.roll_off()[1])
        grey: dict[str, Any] = {"color": "0.55", "lw": 1, "zorder": 1}
        ax.axhspan(0.5, 0.77, color="0.92", zorder=0, label="Pohrt and Popov 2012, D = 2 to 3")
        ax.axhline(1 / (1 + H), ls="dotted", label="1/(1+H): Pastewka et al. 2013", **grey)
        ax.axhline(1, ls="dashed", label="1: Campañá et al. 2011", **grey)
        ax.set_ylim(0, 3)
    ax.set(xscale="log", xlabel="normal load P [N]", ylabel=_PANELS[show])
    if show in ("K_n", "share"):
        ax.set_yscale("log")
    if show == "ratio":
        ax.set_ylim(0, None)
    ax.legend(fontsize="small", frameon=False)
    return ax


def laws(result: LawComparison) -> Panels:
    """K_n, its exponent, K_t/K_n and the real area by every law; returns their axes.

    **Arguments:**

    - `result`: as `compare_laws` returns it.
    """
    figure = new_figure(11.2, 8.4)
    for ax, show in zip(figure.subplots(2, 2).ravel(), _PANELS, strict=True):
        law_curves(result, ax, show=show)
    return Panels(figure)


def _values(result, curve, show):
    """The values (k,) of one curve, NaN where one is undefined; None if the law has none."""
    if show == "ratio":
        if curve.K_t is None:
            return None
        K_n = np.where(np.asarray(curve.K_n) > 0, curve.K_n, np.nan)
        return np.asarray(curve.K_t) / K_n
    if show == "share":
        return None if curve.real_area is None else np.asarray(curve.real_area / result.area)
    values = np.asarray(getattr(curve, show))
    return np.where(np.isfinite(values) & (values != 0), values, np.nan)
