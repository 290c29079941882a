"""Both modes of a scene over any two of its quantities, as the source's Figs. 7 to 10 show them."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .contact import FixedContact, Regime
from .friction import Coulomb
from .parts import Part, Record, leaf, number, quantities, require_scalar
from .scene import Scene, brake_scene
from .stability import stability

STIFFNESS_RATIO, FREQUENCY_RATIO = "K_t/K_n", "omega_1/omega_2"


class Modes(Record):
    """The two modes of a scene over a grid, as `modes_over` returns them.

    A mode is a conjugate pair of eigenvalues, or the slowest of real ones, with frequency 0. Along
    the last axis the mode of lower frequency comes first.
    """

    names: tuple[str, str] = eqx.field(static=True)  # of x and y
    units: tuple[str, str] = eqx.field(static=True)
    x: jax.Array  # (n,)
    y: jax.Array  # (m,)
    real: jax.Array  # (m, n, 2), real part [1/s]
    frequency: jax.Array  # (m, n, 2), imaginary part over 2 pi [Hz]
    regime: Regime | None  # (m, n), members of Regime; None for a joint of given stiffness

    @property
    def growth_rate(self) -> jax.Array:
        """Largest real part [1/s], (m, n); above 0 the scene squeals."""
        return self.real.max(axis=-1)


def mapped_quantities(scene: Scene) -> list[str]:
    """The names `modes_over` takes: numbers of the scene, and two ratios."""
    paths = quantities(scene)
    numbers = [name for name, path in paths.items() if not isinstance(leaf(scene, path), Part)]
    return [*numbers, STIFFNESS_RATIO, FREQUENCY_RATIO]


def modes_over(
    scene: Scene, x: tuple[str, Any], y: tuple[str, Any], friction_slope: bool = True
) -> Modes:
    """The modes of Eq. 43 over two quantities, each a name and its values (n,) and (m,).

    Names are those of `scene.replace`, and K_t/K_n at the scene's K_n, omega_1/omega_2 at its
    omega_2. `friction_slope=False` leaves out the slope of the friction law, as the source does.

    **Raises:** `ValueError` for an unknown name, two names of one quantity, values that are not
    one-dimensional or outside their domain, and for a scene that holds arrays.
    """
    require_scalar(scene)
    axes = {name: _values(scene, name, values) for name, values in (x, y)}
    names = x[0], y[0]
    if len({_target(scene, name) for name in names}) < 2:
        raise ValueError(f"x and y must be two quantities, got {names[0]} and {names[1]}")
    across, up = axes.values()
    shape = up.size, across.size
    grid = {
        names[0]: jnp.broadcast_to(across[None, :], shape),
        names[1]: jnp.broadcast_to(up[:, None], shape),
    }
    first, second, regime = _modes(scene.replace(**_changes(scene, grid)), friction_slope)
    real, frequency = (jnp.stack(pair, axis=-1) for pair in zip(first, second, strict=True))
    units = _unit(scene, names[0]), _unit(scene, names[1])
    return Modes(names, units, across, up, real, frequency, regime)


def _values(scene, name, values):
    known = mapped_quantities(scene)
    if name not in known:
        raise ValueError(f"scene has no quantity {name!r}; it has {', '.join(known)}")
    # A list as NumPy reads it; what is an array already may be traced.
    values = number(name, values if hasattr(values, "dtype") else np.array(values))
    if values.ndim != 1 or not values.size:
        raise ValueError(f"the values of {name} must be a list, got shape {values.shape}")
    return values


def _target(scene: Scene, name: str) -> str:
    """The quantity of the scene that a name changes."""
    if name == STIFFNESS_RATIO:
        return "stiffness_ratio" if scene.contact.fractal else "K_t"
    return "omega_1" if name == FREQUENCY_RATIO else name


def _unit(scene, name):
    if name in (STIFFNESS_RATIO, FREQUENCY_RATIO):
        return "-"
    *owner, field = quantities(scene)[name]
    fields = {f.name: f for f in dataclasses.fields(leaf(scene, tuple(owner)))}
    return fields[field].metadata["unit"]


def _changes(scene: Scene, grid: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """What `scene.replace` takes, ratios multiplied by what they are ratios to."""
    changes = {}
    for name, values in grid.items():
        if name == STIFFNESS_RATIO and not scene.contact.fractal:
            values = number(name, values, at_least=0) * grid.get("K_n", scene.contact.K_n)
        elif name == FREQUENCY_RATIO:
            values = number(name, values, above=0) * grid.get("omega_2", scene.oscillator.omega_2)
        changes[_target(scene, name)] = values
    return changes


@functools.partial(jax.jit, static_argnames="friction_slope")
def _modes(grid: Scene, friction_slope):
    def one(scene):
        modes = _in_pairs(stability(scene, friction_slope).eigenvalues)
        if not scene.contact.fractal:
            return *modes, None
        return *modes, scene.contact.state(scene.friction.mu_s, scene.friction.mu_m).regime

    axes = jax.tree.map(lambda x: 0 if x.ndim else None, grid)
    return jax.vmap(jax.vmap(one, (axes,)), (axes,))(grid)


def _in_pairs(s):
    """Real parts and frequencies of the modes, lower one first, from eigenvalues (4,).

    `stability` has the largest real part first and conjugates side by side.
    """
    oscillates = s.imag != 0
    # Beside an overdamped direction the other one is what oscillates, if anything does.
    slower = jnp.where(oscillates[1], s[1], jnp.where(oscillates[2], s[2], s[1]))
    other = jnp.where(oscillates[0], s[2], slower)
    frequency, other_frequency = (jnp.abs(x.imag) / (2 * jnp.pi) for x in (s[0], other))
    low = frequency <= other_frequency
    first = jnp.where(low, s[0].real, other.real), jnp.where(low, frequency, other_frequency)
    second = jnp.where(low, other.real, s[0].real), jnp.where(low, other_frequency, frequency)
    return first, second


# Figure and panel: variable, friction, K_n/(4e8 N/m). The axes are lost in the scan: these show
# the whole unstable region, but for the friction above 1.
_SOURCE = {
    "7": ("mu", None, 1.0),
    "8": ("mu", None, 8.0),
    "9a": (FREQUENCY_RATIO, 0.1, 1.0),
    "9b": (FREQUENCY_RATIO, 0.2, 1.0),
    "9c": (FREQUENCY_RATIO, 0.2, 0.4),
    "9d": (FREQUENCY_RATIO, 0.3, 1.0),
}
_SOURCE_RANGES = {"mu": ((0.0025, 1.0), (0.0025, 1.0)), FREQUENCY_RATIO: ((0.02, 6.0), (0.0, 1.6))}
SOURCE_PANELS = tuple(_SOURCE)


def source_scene(panel: str) -> Scene:
    """The scene of a panel of the source's Figs. 7 to 10, one of `SOURCE_PANELS`; 10 is as 9.

    Constant friction; the friction of Figs. 7 and 8, which they vary, is 0.4 here and the stiffness
    ratio, which all vary, 0.5.

    **Raises:** `ValueError` for another name.
    """
    if panel not in _SOURCE:
        raise ValueError(f"panel must be one of {', '.join(SOURCE_PANELS)}, got {panel!r}")
    _, mu, factor = _SOURCE[panel]
    K_n = 4e8 * factor
    friction = Coulomb(0.4 if mu is None else mu)
    return Scene(FixedContact(K_n, K_n / 2), friction, brake_scene().oscillator)


def source_modes(panel: str, points: int = 400) -> Modes:
    """The modes of a panel of the source's Figs. 7 to 10, by its Eq. 43; errors as `source_scene`.

    Stiffness ratio upwards; to the right friction (7, 8) or omega_1/omega_2 (9, 10).
    """
    scene = source_scene(panel)
    variable = _SOURCE[panel][0]
    across, up = (np.linspace(*ends, points) for ends in _SOURCE_RANGES[variable])
    return modes_over(scene, (variable, across), (STIFFNESS_RATIO, up), friction_slope=False)
