"""The sliders of `plot.explore` in a notebook, where Python computes."""

import html
import io
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .._contact.contact import Regime
from .._dynamics.cycle import CycleResult
from .._dynamics.limit_cycle import limit_cycle
from .._mechanism.quantities import replaced
from .._mechanism.scene import Scene, stiffness
from .._stability.stability import stability
from .._surface.roughness import roughness
from .._surface.topography import topography
from .axes import new_figure
from .cycle import cycle as draw_cycle
from .design import stability_map
from .explore import WAVELENGTHS, Axis, slider_axes
from .maps import contact_regime
from .shapes import complex_mode
from .topography import topography as draw_topography


def explore(scene: Scene, **windows: tuple[float, float]) -> Any:
    """Sliders over the quantities of a scene, for a notebook: a widget to end a cell with.

    A number may be typed under each slider. Beside them are the numbers of `stability` and
    `stiffness`, the map of the first two quantities with the point on it, the surface and the mode.
    A button finds the limit cycle.

    **Arguments:**

    - `scene`: a scene of scalars.
    - `windows`: as for `plot.explore`, which writes a page for those without Python.

    **Raises:** `ImportError` unless ipywidgets is installed; else as `plot.explore`, except that
    any contact law is accepted.
    """
    try:
        import ipywidgets
    except ImportError:
        raise ImportError("explore needs ipywidgets: python -m pip install ipywidgets") from None
    axes, scene = slider_axes(scene, windows)
    sliders = {axis.name: _slider(ipywidgets, axis) for axis in axes}
    typed = {axis.name: _entry(ipywidgets, axis) for axis in axes}
    numbers, words = ipywidgets.HTML(), ipywidgets.HTML()
    pictures = {name: ipywidgets.Image(format="png") for name in ("map", "surface", "mode")}
    motion = ipywidgets.Image(format="png")
    button, on_map = ipywidgets.Button(description="Limit cycle"), _Map(axes)
    if not scene.contact.has_surface:
        del pictures["surface"]

    def values() -> dict[str, float]:
        return {name: entry.value for name, entry in typed.items()}

    def update(_: Any = None) -> None:
        here = replaced(scene, values())
        numbers.value, words.value = _table(here), ""
        pictures["map"].value = on_map.at(here, values())
        pictures["mode"].value = _mode(here)
        if "surface" in pictures:
            pictures["surface"].value = _surface(here)
        motion.layout.display = "none"  # it belongs to the last position

    def find(_: Any) -> None:
        words.value = "searching"
        cycle = limit_cycle(replaced(scene, values()), throw=False)
        words.value = html.escape(CycleResult[cycle.result])
        if np.isfinite(cycle.period):
            size = ", ".join(f"{x:.5g}" for x in cycle.amplitude)
            words.value += f": peak to peak {size} m, {cycle.frequency:.5g} Hz"
            motion.value, motion.layout.display = _png(draw_cycle(cycle)), "block"

    for name, entry in typed.items():
        ipywidgets.dlink((sliders[name], "value"), (entry, "value"))
        entry.observe(update, names="value")
    button.on_click(find)
    update()
    pairs = itertools.chain.from_iterable(zip(sliders.values(), typed.values(), strict=True))
    left = ipywidgets.VBox([*pairs, numbers, button, words])
    row = ipywidgets.Layout(flex_flow="row wrap")
    return ipywidgets.VBox([ipywidgets.Box([left, *pictures.values()], layout=row), motion])


def _slider(ipywidgets: Any, axis: Axis) -> Any:
    unit = "" if axis.unit == "-" else f" [{axis.unit}]"
    return ipywidgets.SelectionSlider(
        options=[(f"{stop:.5g}", float(stop)) for stop in axis.stops],
        index=axis.start * axis.refine,
        description=f"{axis.name}{unit}",
        continuous_update=False,  # a drag computes where it ends
    )


def _entry(ipywidgets: Any, axis: Axis) -> Any:
    low, high = float(axis.stops[0]), float(axis.stops[-1])
    value = float(axis.stops[axis.start * axis.refine])
    return ipywidgets.BoundedFloatText(value, min=low, max=high, step=None, description=axis.name)


def _table(scene: Scene) -> str:
    """The numbers of a scene as rows of a table."""
    modes, (K_n, K_t) = stability(scene), stiffness(scene)
    rows = {
        "growth rate": f"{modes.growth_rate:+.5g} 1/s",
        "frequency": f"{modes.frequency:.5g} Hz",
        "normal stiffness K_n": f"{K_n:.5g} N/m",
        "tangential stiffness K_t": f"{K_t:.5g} N/m",
    }
    if scene.contact.has_surface:
        rows["Sq"] = f"{roughness(scene.contact.surface, *WAVELENGTHS).Sq:.5g} m"
    if scene.contact.fractal:
        rows["regime"] = Regime[contact_regime(scene)]
    cells = (f"<tr><td>{name}</td><td>{html.escape(text)}</td></tr>" for name, text in rows.items())
    return f"<table>{''.join(cells)}</table>"


class _Map:
    """The map of the first two quantities, drawn again when another quantity changes."""

    def __init__(self, axes: list[Axis]):
        self.names = [axis.name for axis in axes[:2]]
        self.bounds = {axis.name: (axis.nodes[0], axis.nodes[-1]) for axis in axes[:2]}
        self.key: Any = None
        self.ax: Any = None

    def at(self, scene: Scene, values: Mapping[str, float]) -> bytes:
        key = [value for name, value in values.items() if name not in self.names]
        if self.ax is None or key != self.key:
            self.key, self.ax = key, stability_map(scene, self.bounds)
        style: dict[str, Any] = {"mfc": "tab:cyan", "mec": "k", "ms": 9}
        (point,) = self.ax.plot(*([values[name]] for name in self.names), "o", **style)
        picture = _png(self.ax.figure)
        point.remove()
        return picture


def _surface(scene: Scene) -> bytes:
    L, n = WAVELENGTHS[0], 128  # points on a side: a surface is drawn in a moment
    z = topography(scene.contact.surface, L, n, key=jax.random.key(0))
    return _png(draw_topography(z, L / n, new_figure(5.6, 4.8).add_subplot()).figure)


def _mode(scene: Scene) -> bytes:
    modes = stability(scene)
    if not np.isfinite(modes.growth_rate):
        return b""
    return _png(complex_mode(modes, 0, new_figure(5.6, 4.8).add_subplot()).figure)


def _png(figure: Any) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=80)
    return content.getvalue()
