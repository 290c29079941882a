"""Maps of growth rate and frequency over two quantities, from a sweep of `stability`."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._contact.contact import Regime
from .._mechanism.scene import Scene
from .._sweep.result import Sweep
from .._sweep.sweep import sweep
from .axes import Artist, Axes, ensure_axes, set_quantity_axis

_PLASTIC, _SLIP = ("fully plastic", "0.80", "//"), ("gross slip", "0.92", "..")


class RegimeLevels(NamedTuple):
    """Continuous functions of a fractal contact; both are above 0 where it is elastic-plastic."""

    plastic: Any  # ln(a_l/a_e), at most 0 where it is fully plastic
    slip: Any  # 1 - Q_e/(mu_s P), at most 0 in gross slip; 1 with a given stiffness ratio

    @property
    def inelastic(self) -> np.ndarray:
        """True where the contact is not elastic-plastic."""
        return (np.asarray(self.plastic) <= 0) | (np.asarray(self.slip) <= 0)


def regime_levels(scene: Scene) -> RegimeLevels:
    """How far a fractal contact is from being fully plastic and from gross slip."""
    state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
    ratio = 0.0 if state.slip_ratio is None else state.slip_ratio
    return RegimeLevels(state.log_area_ratio, jnp.ones_like(state.log_area_ratio) - ratio)


def growth_map(result: Sweep, ax: Axes | None = None) -> Axes:
    """Growth rate [1/s] as labelled contours: filled where it squeals, dashed where it does not.

    Hatched where a fractal contact is not elastic-plastic: there the growth rate belongs to another
    mechanism; and, with another hatch, where it is NaN, for example where a preloaded joint has no
    closed equilibrium.

    **Arguments:**

    - `result`: a `Sweep` of `stability` or of `growth_rate` over two quantities.
    - `ax`: axes to draw in, by default those of a new figure.

    **Raises:** `ValueError` unless the sweep has two axes, each with two values or more.
    """
    from matplotlib.ticker import MaxNLocator

    ax, growth, handles = _start(result, ax)
    if (high := growth.max()) > 0:
        _fill(result, ax, growth, MaxNLocator(8).tick_values(0, high), "YlOrBr", skip=1)
    if (low := growth.min()) < 0:
        levels = np.asarray(MaxNLocator(4).tick_values(low, min(high, 0)))
        _label(result, ax, growth, levels[levels < 0], linestyles="dashed")
    return _finish(result, ax, growth, handles, "growth rate [1/s]")


def frequency_map(result: Sweep, ax: Axes | None = None, *, mode: int = 1) -> Axes:
    """Frequency [kHz] of a mode over two quantities, and the stability boundary.

    Hatches are as in `growth_map`.

    **Arguments:**

    - `result`: a `Sweep` of `stability` over two quantities.
    - `ax`: axes to draw in, by default those of a new figure.
    - `mode`: number of the mode, from 1, the default, which has the lowest frequency.

    **Raises:** `ValueError` for an unknown mode, and as `growth_map`.
    """
    from matplotlib.ticker import MaxNLocator

    ax, growth, handles = _start(result, ax)
    _, frequencies = vibration_modes(result)
    if mode not in range(1, frequencies.shape[-1] + 1):
        raise ValueError(f"mode must be from 1 to {frequencies.shape[-1]}, got {mode!r}")
    frequency = np.ma.masked_where(_no_number(result), frequencies[..., mode - 1] / 1e3)
    low, high = frequency.min(), frequency.max()
    if low < high:
        _fill(result, ax, frequency, MaxNLocator(10).tick_values(low, high), "YlGnBu")
    return _finish(result, ax, growth, handles, f"frequency of mode {mode} [kHz]")


def stability_chart(result: Sweep, ax: Axes | None = None) -> Axes:
    """The number of unstable modes over one or two quantities.

    Over two, it has labelled contours of the growth rate [1/s] and the stability boundary, as in
    `growth_map`; over one, the growth rate and its zero. A real part within rounding of 0 is not
    unstable.

    **Arguments:**

    - `result`: a `Sweep` of `stability`, or of a measure that returns any object with the
      `growth_rate`, `eigenvalues`, `resolutions` and `counted` of a `Stability`.
    - `ax`: axes to draw in, by default those of a new figure.

    **Raises:** `ValueError` for a sweep of anything else, and unless it has one or two axes, each
    with two values or more.
    """
    from matplotlib.ticker import MaxNLocator

    count = unstable_modes(result)
    if count.ndim == 1:
        ax, ((name, x),) = ensure_axes(ax), result.axes.items()
        if len(x) < 2:
            raise ValueError("a chart needs two values or more, got one")
        growth = np.asarray(result.values.growth_rate)
        _count(ax, x, np.array([0.0, 1.0]), np.stack([count, count]), ax.get_xaxis_transform())
        ax.axhline(0, color="k", lw=0.8)
        ax.plot(x, growth, color="k", lw=2)
        set_quantity_axis(ax, "x", result.scene, name, x)
        ax.set_ylabel("growth rate [1/s]")
        return ax
    ax, growth, handles = _start(result, ax)
    x, y = result.points
    _count(ax, x, y, count.T, ax.transData)
    levels = MaxNLocator(8).tick_values(growth.min(), growth.max())
    _label(result, ax, growth, levels[levels != 0], linestyles=None)
    return _finish(result, ax, growth, handles, "growth rate [1/s]")


def unstable_modes(result: Sweep) -> np.ma.MaskedArray:
    """The number of modes that grow, (*grid), masked where there is no steady sliding."""
    needed = "growth_rate", "eigenvalues", "resolutions", "counted"
    if not all(hasattr(result.values, name) for name in needed):
        raise ValueError("a chart needs a sweep of stability")
    arrays: Any = [np.asarray(getattr(result.values, name)) for name in needed]
    growth, s, error, counted = arrays
    grows = counted & (s.imag >= 0) & (s.real > error)
    return np.ma.masked_where(np.isnan(growth), grows.sum(axis=-1))


def vibration_modes(result: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """Real part [1/s] and frequency [Hz] of the n modes, (*grid, n), the lowest frequency first.

    A mode is a conjugate pair of the 2n eigenvalues, or the slowest of the real ones.
    """
    s: Any = np.asarray(result.values.eigenvalues)
    kind = np.sign(-s.imag)  # upper half plane first, then the real axis
    order = np.lexsort((-s.real, kind))[..., : s.shape[-1] // 2]
    s = np.take_along_axis(s, order, axis=-1)
    s = np.take_along_axis(s, np.argsort(s.imag, axis=-1, kind="stable"), axis=-1)
    return s.real, s.imag / (2 * np.pi)


def shade_regimes(ax: Axes, x: np.ndarray, y: np.ndarray, levels: RegimeLevels) -> list[Artist]:
    """Hatch where a joint (n, m) is fully plastic or slips as a whole; the legend's handles.

    The edges are contours of continuous functions, and have no stairs.
    """
    pairs = zip(levels, (_PLASTIC, _SLIP), strict=True)
    return [h for level, style in pairs for h in _shade(ax, x, y, -np.asarray(level), *style)]


def shade_unsteady(ax: Axes, x: np.ndarray, y: np.ndarray, none: np.ndarray) -> list[Artist]:
    """Hatch where there is no growth rate (n, m): neither stable nor squealing."""
    # From each point half way to its neighbours.
    return _shade(ax, x, y, none - 0.5, "no steady sliding", "1.0", "xx")


def _shade(ax, x, y, level, words: str, grey: str, hatch: str) -> list[Artist]:
    """Hatch where `level` (n, m) is above 0."""
    from matplotlib.patches import Patch

    if not (level > 0).any():
        return []
    style: dict[str, Any] = {"hatches": [hatch], "colors": [grey]}
    ax.contourf(x, y, level.T, levels=[0, np.nanmax(level) + 1], **style)
    return [Patch(facecolor=grey, hatch=hatch, edgecolor="0.3", label=words)]


def contact_regime(scene: Scene) -> Regime:
    """The regime of a fractal contact."""
    return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m).regime


def _start(result, ax):
    """The axes, the growth rate (n, m) masked where inelastic or NaN, and handles of hatches."""
    shape = tuple(map(len, result.points))
    if len(shape) != 2 or min(shape) < 2:
        raise ValueError(f"a map needs two axes of two values or more, got a grid of {shape}")
    ax = ensure_axes(ax)
    x, y = result.points
    set_quantity_axis(ax, "x", result.scene, result.names[0], x)
    set_quantity_axis(ax, "y", result.scene, result.names[1], y)
    none = _no_number(result)
    growth = np.ma.masked_where(none, getattr(result.values, "growth_rate", result.values))

    joint = result.scene.sole_joint
    if joint is None or not joint.contact.fractal:
        return ax, growth, shade_unsteady(ax, x, y, none)
    axes: Any = result.axes
    levels = sweep(regime_levels, result.scene, progress=False, **axes).values
    if not levels.inelastic.all():
        growth = np.ma.masked_where(levels.inelastic, growth)
    return ax, growth, shade_regimes(ax, x, y, levels) + shade_unsteady(ax, x, y, none)


def _no_number(result) -> np.ndarray:
    """True where the growth rate of a sweep is NaN."""
    return np.isnan(np.asarray(getattr(result.values, "growth_rate", result.values)))


def _fill(result, ax, values, levels, name, skip=0):
    import matplotlib as mpl

    # Pale enough that black lines and labels stay readable.
    colours = mpl.colormaps[name](np.linspace(0.05, 0.6, len(levels) - 1))
    ax.contourf(*result.points, values.T, levels, colors=colours)
    _label(result, ax, values, levels[skip:], linestyles="solid")


def _count(ax, x, y, count, transform):
    """Draw a number of modes (y, x) in colours, with their scale."""
    import matplotlib as mpl
    from matplotlib.colors import BoundaryNorm, ListedColormap

    top = max(1, int(count.max()))
    colours = mpl.colormaps["YlOrBr"](np.linspace(0.12, 0.6, top))
    # White where it is stable.
    cmap = ListedColormap([(1.0, 1.0, 1.0, 1.0), *colours]).with_extremes(bad="0.8")
    norm = BoundaryNorm(np.arange(top + 2) - 0.5, top + 1)
    mesh = ax.pcolormesh(
        x, y, count, norm=norm, cmap=cmap, shading="nearest", transform=transform, zorder=0
    )
    mesh.set_rasterized(True)
    ticks = range(0, top + 1, 1 + top // 10)
    ax.figure.colorbar(mesh, ax=ax, ticks=ticks, pad=0.02).set_label("unstable modes")


def _label(result, ax, values, levels, linestyles):
    style: dict[str, Any] = {"colors": "0.25", "linewidths": 0.7, "linestyles": linestyles}
    contours = ax.contour(*result.points, values.T, levels, **style)
    ax.clabel(contours, fontsize="x-small", fmt=lambda level: f"{level:g}")


def _finish(result, ax, growth, handles, title):
    """Draw the stability boundary, and above the axes the title (left) and legend (right)."""
    from matplotlib.lines import Line2D

    if growth.min() < 0 < growth.max():
        ax.contour(*result.points, growth.T, [0.0], colors="k", linewidths=2)
        handles = [Line2D([], [], color="k", lw=2, label="stability boundary"), *handles]
    rows = -(-len(handles) // 3)
    ax.set_title(title, fontsize="medium", loc="left", pad=6 if rows < 2 else 6 + 14 * rows)
    if handles:
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.99)}
        ax.legend(handles=handles, ncols=3, fontsize="small", frameon=False, **place)
    return ax
