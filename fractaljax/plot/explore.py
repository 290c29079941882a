"""A page with sliders over the quantities of a scene, in one file that needs no network.

Growth rate, frequency, mode and stiffness are computed in the browser, by the program of the
package translated to JavaScript. Limit cycles are computed here, on a grid.
"""

import base64
import functools
import html
import itertools
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._base.files import write_whole
from .._base.parts import require_kind, require_scalar, whole
from .._base.programs import exported_jit
from .._base.toml import part_table, write_toml
from .._contact.contact import Regime
from .._dynamics.cycle import CycleResult
from .._dynamics.limit_cycle import limit_cycle
from .._mechanism.quantities import (
    axis_values,
    label,
    quantity_names,
    require_independent,
    require_inside,
    require_quantity,
    substituted,
    unit,
    value_of,
    with_optional,
)
from .._mechanism.scene import Scene, stiffness
from .._stability.two_directions import two_directions
from .._surface.roughness import roughness
from .._surface.surface import frequency_count
from .._surface.topography import random_phases
from .._version import __version__
from .javascript import javascript
from .maps import contact_regime

WAVELENGTHS = 1e-3, 1e-6  # [m], of Sq; the surface is drawn over the longest
_SHADES = ["growth_rate", "plastic", "slip"]  # what the map shows, in the order of the leaves
_CYCLE = ("period", "amplitude_1", "amplitude_2", "stick")


class Axis(NamedTuple):
    """A quantity that a slider moves."""

    name: str
    label: str  # meaning and symbol
    unit: str
    log: bool
    nodes: np.ndarray  # where limit cycles are computed; the scene's value is among them
    start: int  # index of the scene's value
    refine: int  # stops of the slider in each interval between nodes

    @property
    def stops(self) -> np.ndarray:
        """The values of the slider: every `refine`-th is a node, to the last bit."""
        share = np.arange(self.refine) / self.refine
        low, high = self.nodes[:-1, None], self.nodes[1:, None]
        inner = low ** (1 - share) * high**share if self.log else low * (1 - share) + high * share
        inner[:, 0] = self.nodes[:-1]
        return np.append(inner.ravel(), self.nodes[-1])


def explore(
    scene: Scene,
    path: str | os.PathLike,
    *,
    cycles: bool | Mapping[str, int] = True,
    progress: bool = True,
    **windows: tuple[float, float],
) -> None:
    """Write a page with a slider for each of `windows`, in one .html file that needs no network.

    The page shows what `stability` and `stiffness` give at every position of the sliders, to
    rounding: it runs the same program, translated. Numbers may be typed, and the scene with them
    saved as a TOML file. It also shows the mode in motion, a surface with its D and G, and limit
    cycles from a small disturbance. Where the mechanism squeals between those that are computed,
    the page shows the nearest and says so.

    **Arguments:**

    - `scene`: a scene of scalars.
    - `path`: the .html file.
    - `cycles`: True, the default, computes limit cycles where sliding squeals, on a grid of 13
      values of the first quantity, 5 of the second and 3 of the others, and the value of the scene;
      {name: number of values} chooses the grid; False leaves them out: seconds, not minutes.
    - `progress`: shows a bar.
    - `windows`: (low, high) of two or more quantities by name, as the axes of `sweep`:
      `D=(2.35, 2.45)`. By default those of D, G, P and mu that the scene has, or K_n, K_t/K_n and
      mu. The first two span the map of growth rates.

    **Raises:** `TypeError` for what is not a `Scene`; `ValueError` for a scene that holds arrays,
    one whose program has loops or looks numbers up (as of `AsperityContact`, `TabulatedFriction` or
    on a load curve), which `fj.explore` shows in a notebook, an unknown quantity, two that are not
    independent, less than two, a window outside its domain, that is no (low, high) or that leaves
    out the value of the scene, and a path that does not end in .html; `OSError` if the file cannot
    be written.
    """
    if not os.fspath(path).endswith(".html"):
        raise ValueError(f"path must end in .html, got {os.fspath(path)!r}")
    write_whole(path, page(scene, windows, cycles, progress).encode())


def page(
    scene: Scene,
    windows: Mapping[str, tuple[float, float]],
    cycles: bool | Mapping[str, int] = True,
    progress: bool = True,
) -> str:
    """The text of the page that `explore` writes."""
    axes, scene = slider_axes(scene, windows, cycles)
    names = [axis.name for axis in axes]

    def numbers(*q):
        return point(substituted(scene, dict(zip(names, q, strict=True))))

    def shade(*q):
        values = numbers(*q)
        return {name: values[name] for name in _SHADES}

    # Before the search for cycles, since it may refuse the law.
    try:
        program = javascript(shade, len(axes), "shade")
    except ValueError as error:
        laws = f"{type(scene.contact).__name__} and {type(scene.friction).__name__}"
        raise ValueError(
            f"a page of {laws} cannot be written, {error}: fj.explore shows it in a notebook"
        ) from None
    long = program.count("\n") > 1000  # lines: the map has fewer points to stay quick
    programs = javascript(numbers, len(axes), "point") + program
    shown: Any = jax.eval_shape(numbers, *[0.0] * len(axes))
    data = {
        "axes": [
            {
                **{key: getattr(axis, key) for key in ("name", "label", "unit", "log", "refine")},
                "stops": axis.stops.tolist(),
                "start": axis.start * axis.refine,
            }
            for axis in axes
        ],
        "numbers": sorted(shown),  # as the leaves of a dictionary are
        "shades": _SHADES,
        "map": 75 if long else 150,
        "colours": {"growth": _colours("YlOrBr", 0.05), "heights": _colours("cividis", 0.0)},
        "surface": _waves(scene) if scene.contact.has_surface else None,
        "cycles": None if cycles is False else _cycles(scene, axes, progress),
    }
    data["file"], written = _scene_file(scene, names)
    programs += javascript(written, len(axes), "written")
    text = {
        "title": html.escape(f"fractaljax: a scene over {', '.join(names)}"),
        "version": html.escape(__version__),
        "programs": programs,
        "data": json.dumps(data).replace("</", "<\\/"),
    }
    template = (
        resources.files("fractaljax.plot").joinpath("explore.html").read_text(encoding="utf-8")
    )
    return re.sub(r"@(\w+)@", lambda placeholder: text[placeholder[1]], template)


def slider_axes(
    scene: Scene, windows: Mapping[str, Any], cycles: bool | Mapping[str, int] = False
) -> tuple[list[Axis], Any]:
    """The axes of `windows`, and the scene with a number for each quantity among them.

    **Raises:** as `explore`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    windows = dict(windows) or _default(scene)
    if len(windows) < 2:
        raise ValueError(f"explore needs two quantities or more, got {', '.join(windows)}")
    for name in windows:
        require_quantity(scene, name)
    require_independent(scene, tuple(windows))
    counts = dict(zip(windows, [13, 5, *[3] * len(windows)], strict=False))
    counts |= cycles if isinstance(cycles, Mapping) else {}
    if unknown := counts.keys() - windows.keys():
        raise ValueError(f"cycles must name quantities of the sliders, got {', '.join(unknown)}")
    axes = [_axis(scene, name, windows[name], whole("cycles", counts[name], 2)) for name in windows]
    require_inside(scene, {axis.name: axis.nodes for axis in axes})
    return axes, with_optional(scene, tuple(windows))


def point(scene: Scene) -> dict[str, Any]:
    """The numbers that a page shows for a scene, by name, each a scalar.

    "coupling" and "first" are the factors of (s^2 + c_1 s + a) x1 = mu K_n/m x2, for the mode.
    """
    system, (K_n, K_t) = two_directions(scene, True), stiffness(scene)
    lin, s = system.polynomial, system.rightmost()
    re, im = s.real, s.imag
    numbers = {
        "growth_rate": re,
        "frequency": im / (2 * math.pi),
        "K_n": K_n,
        "K_t": K_t,
        "V": scene.oscillator.V,
        "coupling": scene.coefficient() * system.K_n / scene.oscillator.m,
        "first_real": re**2 - im**2 + lin.c_1 * re + lin.a,
        "first_imag": (2 * re + lin.c_1) * im,
        "plastic": False,
        "slip": False,
    }
    if scene.contact.fractal:
        regime = contact_regime(scene)
        numbers["plastic"] = regime == Regime.fully_plastic
        numbers["slip"] = regime == Regime.gross_slip
    if scene.contact.has_surface:
        surface = scene.contact.surface
        numbers |= {"D": surface.D, "G": surface.G, "gamma": surface.gamma}
        numbers["Sq"] = roughness(surface, *WAVELENGTHS).Sq
    return numbers


@functools.partial(jax.jit, static_argnums=1)
def points_at(scene: Any, names: tuple[str, ...], values: Any) -> dict[str, Any]:
    """The numbers of `point` where these quantities have the values (k, names), each (k,)."""
    return jax.vmap(lambda q: point(substituted(scene, dict(zip(names, q, strict=True)))))(values)


def _default(scene: Scene) -> dict[str, tuple[float, float]]:
    quantities = quantity_names(scene)
    names = [name for name in ("D", "G", "P", "mu") if name in quantities]
    if "D" not in names:
        names = [name for name in ("K_n", "K_t/K_n", "mu") if name in quantities]
    windows = {}
    for name in names:
        value = float(value_of(scene, name))
        if name == "D":
            windows[name] = max(2.001, value - 0.05), min(2.999, value + 0.05)
        else:
            windows[name] = value / 2, value * (1.5 if name in ("mu", "K_t/K_n") else 2.0)
    return windows


def _axis(scene: Scene, name: str, window: Any, count: int) -> Axis:
    ends = np.asarray(axis_values(scene, name, window))
    value = float(value_of(scene, name))
    if ends.shape != (2,) or not ends[0] < ends[1]:
        raise ValueError(f"{name} must be (low, high), got {window!r}")
    if not ends[0] <= value <= ends[1]:
        raise ValueError(f"the window of {name} must hold its value, {value:g}, got {window!r}")
    quantity = scene.stored_quantities().get(name)
    log = quantity is not None and quantity.log
    space: Any = np.geomspace if log else np.linspace
    nodes = space(*ends, count)
    nodes[[0, -1]] = ends
    k = int(np.abs(nodes - value).argmin())
    if abs(nodes[k] - value) <= 1e-9 * (ends[1] - ends[0]):  # a node, up to rounding
        nodes[k] = value
    else:
        nodes = np.sort(np.append(nodes, value))
    place = int(np.searchsorted(nodes, value))
    refine = math.ceil(120 / (len(nodes) - 1))  # a slider has 120 positions, or a few more
    words = label(scene, name).rsplit(" [", 1)[0]
    return Axis(name, words, unit(scene, name), log, nodes, place, refine)


def _scene_file(scene: Scene, names: Sequence[str]) -> tuple[list[Any], Any]:
    """The text of the scene's TOML file with indices for its numbers, and a program for these.

    There is no text for a law that no file holds.
    """

    def changed(*q):
        return substituted(scene, dict(zip(names, q, strict=True)))

    def written(*q):
        return [each for leaf in jax.tree.leaves(changed(*q)) for each in jnp.ravel(leaf)]

    # A friction law may have become a scaled one.
    leaves, tree = jax.tree.flatten(jax.eval_shape(changed, *[0.0] * len(names)))
    sizes = [math.prod(leaf.shape) for leaf in leaves]
    places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])

    def marks(leaf, place):  # texts, which the file has in quotation marks
        texts = [f"number {k}" for k in place]
        return np.array(texts, object).reshape(leaf.shape).tolist()

    marked = jax.tree.unflatten(tree, map(marks, leaves, places))
    try:
        text = write_toml("A fractaljax scene, in SI units.", part_table(marked))
    except ValueError:
        return [], written
    parts: list[Any] = re.split(r'"number (\d+)"', text)
    parts[1::2] = map(int, parts[1::2])
    return parts, written


def _colours(name: str, start: float) -> list[str]:
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    return [to_hex(colour) for colour in mpl.colormaps[name](np.linspace(start, 1, 64))]


def _base64(values: Any, kind: type) -> str:
    """An array as the text from which a page reads it: its bytes, the lowest first."""
    return base64.b64encode(np.asarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()


# --- the surface ----------------------------------------------------------------------------


def _waves(scene: Scene) -> dict[str, Any]:
    """The sum of Eq. 13 over directions for each frequency; D and G only weight these sums."""
    surface, (L, L_s) = scene.contact.surface, WAVELENGTHS
    n, directions = 96, 10  # enough for a picture; the page holds their sums
    waves = surface_waves(float(surface.gamma), n, directions)
    return {
        "n": n,
        "L": L,
        "M": directions,
        "count": len(waves),
        "band": f"wavelengths {1e6 * L_s:g} to {1e6 * L:g} µm",
        "waves": _base64(waves, np.float32),
    }


def surface_waves(gamma: float, n: int, directions: int = 10) -> np.ndarray:
    """(frequencies, n, n): cos(phi) - cos(k.x + phi) summed over directions, with fixed phases."""
    count = int(frequency_count(np.float64(gamma), n / 2, np))
    phases = 2 * np.pi * np.asarray(random_phases(jax.random.key(0), count, directions))
    angles = np.pi * np.arange(1, directions + 1) / directions
    i = np.arange(n) / n
    waves = np.empty((count, n, n))
    for k in range(count):
        x, y = 2 * np.pi * gamma**k * i[:, None, None], 2 * np.pi * gamma**k * i[None, :, None]
        turned = x * np.cos(angles) + y * np.sin(angles) + phases[k]
        waves[k] = (np.cos(phases[k]) - np.cos(turned)).sum(axis=-1)
    return waves


# --- limit cycles ---------------------------------------------------------------------------


def _cycles(
    scene, axes: Sequence[Axis], progress: bool, batch: int = 32, samples: int = 96
) -> dict[str, Any]:
    """Limit cycles at the nodes where sliding squeals, and the outcomes at the others in words.

    They are computed `batch` at once, and their orbits have `samples` points.
    """
    from tqdm import tqdm

    names = tuple(axis.name for axis in axes)
    nodes = np.array(list(itertools.product(*(axis.nodes for axis in axes))))
    steady = points_at(scene, names, nodes)
    words = [
        "quiet: small disturbances die out",
        "fully plastic: the joint has no stiffness",
        "gross slip: the joint has no tangential stiffness",
        "no steady sliding",
    ]
    growth = np.asarray(steady["growth_rate"])
    kinds = [np.asarray(steady["plastic"]), np.asarray(steady["slip"]), np.isnan(growth)]
    state = np.select(kinds, [1, 2, 3], 0).astype(np.int32)
    row = np.full(len(nodes), -1, np.int32)
    numbers: list[Any] = []
    orbits: list[Any] = []
    squeals = np.flatnonzero((state == 0) & (growth > 0))
    with tqdm(total=len(squeals), desc="limit cycles", disable=not progress) as bar:
        for begin in range(0, len(squeals), batch):
            some = squeals[begin : begin + batch]
            # A short batch repeats its nodes: one shape compiles once.
            result, *arrays = _find_cycles(scene, names, nodes[np.resize(some, batch)], samples)
            arrays = [np.asarray(array) for array in arrays]
            for i, node in enumerate(some):
                outcome = CycleResult[jax.tree.map(lambda x, i=i: x[i], result)]
                if outcome not in words:
                    words.append(outcome)
                state[node] = words.index(outcome)
                if np.isfinite(arrays[0][i, 0]):
                    row[node] = len(numbers)
                    numbers.append(arrays[0][i])
                    orbits.append(arrays[1][i])
            bar.update(len(some))
    return {
        "nodes": [axis.nodes.tolist() for axis in axes],
        "samples": samples,
        "names": _CYCLE,
        "words": words,
        "state": _base64(state, np.int32),
        "row": _base64(row, np.int32),
        "numbers": _base64(numbers, np.float64),
        "orbits": _base64(orbits, np.float32),
    }


@functools.partial(exported_jit, static_argnames=("names", "samples"))
def _find_cycles(scene, names, nodes, samples):
    """Results, the numbers of `_CYCLE` and orbits (samples, [x1, v1]) for a batch of nodes."""

    def one(q):
        varied = substituted(scene, dict(zip(names, q, strict=True)))
        # Most settle long before; the page says which have not.
        cycle = limit_cycle(varied, max_returns=500, throw=False)
        _, states = cycle.orbit(samples)
        numbers = cycle.period, *cycle.amplitude, cycle.stick_fraction[0]
        return cycle.result, jnp.stack(numbers), states[:, jnp.array([0, 2])]

    return jax.vmap(one)(nodes)
