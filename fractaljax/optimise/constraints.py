"""Requirements on a scene, for `design(constraints=...)`: at most 0 where they are met.

Each is called with a scene and gives a scalar of order one, continuous and with a slope on both
sides of every regime boundary: one that asks for elastic contacts keeps growing with
ln(a_e/a_l) below the critical area, where the quantity itself no longer changes.
"""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.parts import Record, flag, scalar
from ..mechanism.contact import ContactState
from ..mechanism.scene import Scene, stiffness
from ..modes.stability import stability
from ..surface.roughness import root_mean_square_height


class Constraint(Record):
    """A quantity of a scene that must lie within limits; a pytree, its limits are its leaves."""

    at_least: eqx.AbstractVar[jax.Array | None]
    at_most: eqx.AbstractVar[jax.Array | None]

    symbol: ClassVar[str]
    unit: ClassVar[str]

    @abc.abstractmethod
    def measure(self, scene: Scene) -> jax.Array:
        """The quantity itself, in SI units."""

    def shortfall(self, value) -> jax.Array:
        """By how much a value is below `at_least`, of order one."""
        return jnp.log(self.at_least / value)

    def surplus(self, value) -> jax.Array:
        """By how much a value is above `at_most`, of order one."""
        return jnp.log(value / self.at_most)

    def depth(self, scene: Scene) -> jax.Array | float:
        """Added to a shortfall: ln(a_e/a_l) where the quantity is constant below yield, or 0."""
        return 0.0

    def __call__(self, scene: Scene) -> jax.Array:
        value, sides = self.measure(scene), []
        if self.at_least is not None:
            sides.append(self.shortfall(value) + self.depth(scene))
        if self.at_most is not None:
            sides.append(self.surplus(value))
        return sides[0] if len(sides) == 1 else jnp.maximum(*sides)

    @property
    def name(self) -> str:
        """What is required, as results show it: `K_n >= 4e+08 N/m`."""
        unit = f" {self.unit}" if self.unit else ""
        if self.at_least is None:
            return f"{self.symbol} <= {self.at_most:.6g}{unit}"
        if self.at_most is None:
            return f"{self.symbol} >= {self.at_least:.6g}{unit}"
        return f"{self.at_least:.6g} <= {self.symbol} <= {self.at_most:.6g}{unit}"


def _limits(symbol, at_least, at_most=None, *, above=-math.inf, below=math.inf) -> tuple[Any, Any]:
    """Both limits as numbers, or None; at least one of them, in order and inside the domain."""
    if at_least is None and at_most is None:
        raise ValueError(f"{symbol} needs at_least or at_most")
    low, high = (
        None if limit is None else scalar(f"{symbol} {which}", limit, above=above, below=below)
        for which, limit in [("at_least", at_least), ("at_most", at_most)]
    )
    if low is not None and high is not None and not low < high:
        raise ValueError(f"{symbol} at_least must be below at_most, got {at_least!r}, {at_most!r}")
    return low, high


def _state(scene: Scene, symbol: str) -> ContactState:
    if not scene.contact.fractal:
        raise ValueError(f"{symbol} needs a FractalContact: a FixedContact has no surface")
    return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)


def _plastic_depth(scene: Scene) -> jax.Array | float:
    if not scene.contact.fractal:
        return 0.0
    return jnp.maximum(-_state(scene, "").log_area_ratio, 0)


class NormalStiffness(Constraint):
    """K_n [N/m] of at least some value.

    **Raises:** `ValueError` unless at_least > 0.
    """

    at_least: jax.Array
    at_most: None

    symbol: ClassVar[str] = "K_n"
    unit: ClassVar[str] = "N/m"

    def __init__(self, at_least):
        self.at_least, self.at_most = _limits("K_n", at_least, above=0)

    def measure(self, scene):
        return stiffness(scene)[0]

    def shortfall(self, value):
        return 1 - value / self.at_least  # a joint without stiffness has no logarithm

    def depth(self, scene):
        return _plastic_depth(scene)


class ElasticShare(Constraint):
    """Share of the load on elastic contacts, 1 - `plastic_share`, of at least some value.

    **Raises:** `ValueError` unless 0 < at_least < 1.
    """

    at_least: jax.Array
    at_most: None

    symbol: ClassVar[str] = "elastic share"
    unit: ClassVar[str] = ""

    def __init__(self, at_least):
        self.at_least, self.at_most = _limits("elastic share", at_least, above=0, below=1)

    def measure(self, scene):
        return 1 - _state(scene, self.symbol).plastic_share

    def shortfall(self, value):
        return 1 - value / self.at_least

    def depth(self, scene):
        return _plastic_depth(scene)


class RealContactArea(Constraint):
    """Real contact area A_r [m^2] within limits (Eq. 28).

    Fully plastic, A_r is P/H for every surface, the least there is.
    **Raises:** `ValueError` without a limit, for one that is not above 0, or a wrong order.
    """

    at_least: jax.Array | None
    at_most: jax.Array | None

    symbol: ClassVar[str] = "A_r"
    unit: ClassVar[str] = "m^2"

    def __init__(self, at_least=None, at_most=None):
        self.at_least, self.at_most = _limits("A_r", at_least, at_most, above=0)

    def measure(self, scene):
        return _state(scene, self.symbol).A_r

    def depth(self, scene):
        return _plastic_depth(scene)


class Roughness(Constraint):
    """Sq [m] of the surface within limits, over wavelengths from L to L_s [m].

    See `root_mean_square_height`. **Raises:** `ValueError` without a limit, for one that is not
    above 0, a wrong order, or unless 0 < L_s < L.
    """

    at_least: jax.Array | None
    at_most: jax.Array | None
    L: jax.Array
    L_s: jax.Array

    symbol: ClassVar[str] = "Sq"
    unit: ClassVar[str] = "m"

    def __init__(self, at_least=None, at_most=None, *, L, L_s):
        self.at_least, self.at_most = _limits("Sq", at_least, at_most, above=0)
        self.L = scalar("L", L, above=0)
        self.L_s = scalar("L_s", L_s, above=0)
        if not self.L_s < self.L:
            raise ValueError(f"L_s must be below L, got {L_s!r} and {L!r}")

    def measure(self, scene):
        if not scene.contact.fractal:
            raise ValueError("Sq needs a FractalContact: a FixedContact has no surface")
        return root_mean_square_height(scene.contact.surface, self.L, self.L_s)


class DampingRatio(Constraint):
    """Least damping ratio -Re/|lambda| of all eigenvalues, of at least some value.

    **Raises:** `ValueError` unless -1 < at_least < 1.
    """

    at_least: jax.Array
    at_most: None
    friction_slope: bool = eqx.field(static=True)

    symbol: ClassVar[str] = "damping ratio"
    unit: ClassVar[str] = ""

    def __init__(self, at_least, *, friction_slope=True):
        self.at_least, self.at_most = _limits("damping ratio", at_least, above=-1, below=1)
        self.friction_slope = flag("friction_slope", friction_slope)

    def measure(self, scene):
        eigenvalues = stability(scene, self.friction_slope).eigenvalues
        return jnp.min(-eigenvalues.real / jnp.abs(eigenvalues))

    def shortfall(self, value):
        return jnp.arcsinh((self.at_least - value) / 1e-3)  # the size that they have at squeal


class Frequency(Constraint):
    """Frequencies [Hz] of both modes within limits: the lower one at least, the higher at most.

    Both, since the critical one of them jumps where they cross. **Raises:** `ValueError` without a
    limit, for one that is not above 0, or a wrong order.
    """

    at_least: jax.Array | None
    at_most: jax.Array | None
    friction_slope: bool = eqx.field(static=True)

    symbol: ClassVar[str] = "frequencies"
    unit: ClassVar[str] = "Hz"

    def __init__(self, at_least=None, at_most=None, *, friction_slope=True):
        self.at_least, self.at_most = _limits("frequency", at_least, at_most, above=0)
        self.friction_slope = flag("friction_slope", friction_slope)

    def measure(self, scene):
        """The lower and the higher frequency (2,) [Hz]; 0 for an overdamped mode."""
        modes = stability(scene, self.friction_slope).eigenvalues
        ordered = jnp.sort(jnp.abs(modes.imag)) / (2 * jnp.pi)
        return jnp.stack([ordered[0], ordered[-1]])

    def shortfall(self, value):
        return 1 - value[0] / self.at_least

    def surplus(self, value):
        return value[1] / self.at_most - 1
