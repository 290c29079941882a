"""Both modes of a scene over any two of its quantities, as the source's Figs. 7 to 10 show them."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import Record, brief, require_scalar
from ..mechanism.contact import FixedContact, Regime
from ..mechanism.friction import Coulomb
from ..mechanism.quantities import (
    FREQUENCY_RATIO,
    FRICTION,
    STIFFNESS_RATIO,
    axis_values,
    replaced,
    require_independent,
    unit,
)
from ..mechanism.scene import Scene, brake_scene, require_kind
from .stability import stability


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


def modes_over(
    scene: Scene, x: tuple[str, Any], y: tuple[str, Any], friction_slope: bool = True
) -> Modes:
    """The modes of Eq. 43 over two quantities, each a name and its values (n,) and (m,).

    Names are those of `scene.replace`, and K_t/K_n, omega_1/omega_2 and mu (`quantities.py`).
    `friction_slope=False` leaves out the slope of the friction law, as the source does.

    **Raises:** `ValueError` for an unknown name, two names of one quantity, values that are not
    one-dimensional or outside their domain, and for a scene that holds arrays.
    """
    across, up, grid = grid_over(scene, x, y)
    first, second, regime = _modes(grid, friction_slope)
    real, frequency = (jnp.stack(pair, axis=-1) for pair in zip(first, second, strict=True))
    units = unit(scene, x[0]), unit(scene, y[0])
    return Modes((x[0], y[0]), units, across, up, real, frequency, regime)


def grid_over(
    scene: Scene, x: tuple[str, Any], y: tuple[str, Any]
) -> tuple[jax.Array, jax.Array, Scene]:
    """The values (n,) and (m,) of two quantities, and the scene with both on the grid (m, n).

    **Raises:** `ValueError` as `modes_over`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    for axis, given in (("x", x), ("y", y)):
        if not (isinstance(given, (tuple, list)) and len(given) == 2 and isinstance(given[0], str)):
            raise TypeError(f"{axis} must be a name and its values, got {brief(given)}")
    names = x[0], y[0]
    across, up = (axis_values(scene, name, values) for name, values in (x, y))
    require_independent(scene, names)
    shape = up.size, across.size
    grid = jnp.broadcast_to(across[None, :], shape), jnp.broadcast_to(up[:, None], shape)
    return across, up, replaced(scene, dict(zip(names, grid, strict=True)))


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
    "7": (FRICTION, None, 1.0),
    "8": (FRICTION, None, 8.0),
    "9a": (FREQUENCY_RATIO, 0.1, 1.0),
    "9b": (FREQUENCY_RATIO, 0.2, 1.0),
    "9c": (FREQUENCY_RATIO, 0.2, 0.4),
    "9d": (FREQUENCY_RATIO, 0.3, 1.0),
}
_SOURCE_RANGES = {
    FRICTION: ((0.0025, 1.0), (0.0025, 1.0)),
    FREQUENCY_RATIO: ((0.02, 6.0), (0.0, 1.6)),
}
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
