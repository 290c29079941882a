"""Requirements on a scene, for `design(constraints=...)`: at most 0 where they are met.

Each is called with a scene and returns its residual: a scalar of order one, continuous, with a
nonzero slope on both sides of every regime boundary. A residual that requires elastic contacts
keeps growing with ln(a_e/a_l) below the critical area, where the quantity itself is constant.
"""

import abc
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Record, flag, is_traced, ordered, scalar, whole
from .._contact.contact import ContactState
from .._dynamics.cycle import VELOCITY_REFERENCE, CycleResult
from .._dynamics.limit_cycle import limit_cycle
from .._mechanism.mechanism import Mechanism
from .._mechanism.scene import stiffness
from .._stability.margin import least_damping_ratio
from .._stability.stability import stability
from .._surface.areal_parameters import areal_parameters
from .._surface.profile_parameters import profile_parameters
from .._surface.roughness import root_mean_square
from .._surface.surface import Surface
from .joints import joint_with_surface

Limit = Any  # a scalar, or None where there is none


class Constraint(Record):
    """A quantity of a scene that must lie within limits; a pytree, its limits are its leaves.

    **Raises:** `ValueError` without a limit, for one outside its domain, or in the wrong order.
    """

    at_least: Limit  # the least value allowed, in the unit of the quantity, or None
    at_most: Limit  # the largest value allowed, in the unit of the quantity, or None

    symbol: ClassVar[str]
    unit: ClassVar[str] = ""
    domain: ClassVar[dict[str, float]] = {"above": 0}
    # True if the quantity is constant in a fully plastic joint, which lacks elastic contacts.
    flat_if_plastic: ClassVar[bool] = False

    def __init__(self, at_least: ArrayLike | None = None, at_most: ArrayLike | None = None):
        if at_least is None and at_most is None:
            raise ValueError(f"{self.symbol} needs at_least or at_most")
        self.at_least, self.at_most = (
            None if limit is None else scalar(f"{self.symbol} {which}", limit, **self.domain)
            for which, limit in [("at_least", at_least), ("at_most", at_most)]
        )
        low, high = self.at_least, self.at_most
        if low is not None and high is not None and not low < high:
            raise ValueError(
                f"{self.symbol} at_least must be below at_most, got {at_least!r}, {at_most!r}"
            )

    @abc.abstractmethod
    def measure(self, scene: Any) -> Array:
        """The quantity itself of a `scene`, in SI units."""

    def below(self, value: Array) -> Array:
        """The residual of `at_least` at a `value` of the quantity."""
        return 1 - value / self.at_least

    def above(self, value: Array) -> Array:
        """The residual of `at_most` at a `value` of the quantity."""
        return value / self.at_most - 1

    def __call__(self, scene: Any) -> Float[Array, ""]:
        value, sides = self.measure(scene), []
        if self.at_least is not None:
            lacking: Any = 0.0
            if self.flat_if_plastic and scene.contact.fractal:
                lacking = jnp.maximum(-_state(scene, self.symbol).log_area_ratio, 0)
            sides.append(self.below(value) + lacking)
        if self.at_most is not None:
            sides.append(self.above(value))
        return sides[0] if len(sides) == 1 else jnp.maximum(*sides)

    @property
    def name(self) -> str:
        """What is required, as results show it: `K_n >= 4e+08 N/m`."""
        unit = f" {self.unit}" if self.unit else ""
        low, high = (
            "its limit" if is_traced(limit) else limit if limit is None else f"{limit:.6g}"
            for limit in (self.at_least, self.at_most)
        )
        if low is None:
            return f"{self.symbol} <= {high}{unit}"
        if high is None:
            return f"{self.symbol} >= {low}{unit}"
        return f"{low} <= {self.symbol} <= {high}{unit}"


class Plain(Constraint):
    """A user's function that is itself a residual."""

    function: Callable[[Any], Any] = eqx.field(static=True)  # gives the residual of a scene

    def __init__(self, function: Callable[[Any], Any]):
        self.at_least, self.at_most, self.function = None, None, function

    def measure(self, scene):
        return self.function(scene)

    def __call__(self, scene):
        return self.function(scene)

    @property
    def name(self):
        """The name of the function."""
        return getattr(self.function, "__name__", repr(self.function))


def _surface(scene: Mechanism, symbol: str) -> Surface:
    joint = scene.sole_joint
    if joint is None or not joint.contact.has_surface:
        raise ValueError(f"{symbol} needs a scene whose contact has a surface")
    return joint.contact.surface


def _state(scene: Mechanism, symbol: str) -> ContactState:
    joint = scene.sole_joint
    if joint is None or not joint.contact.fractal:
        raise ValueError(f"{symbol} needs a FractalContact")
    return joint.contact.state(joint.friction.mu_s, joint.friction.mu_m)


class _LogConstraint(Constraint):
    """A quantity on a logarithmic scale: its residuals are logarithms."""

    def below(self, value):
        return jnp.log(self.at_least / value)

    def above(self, value):
        return jnp.log(value / self.at_most)


class NormalStiffness(Constraint):
    """K_n [N/m], at least a limit > 0."""

    symbol: ClassVar[str] = "K_n"
    unit: ClassVar[str] = "N/m"
    flat_if_plastic: ClassVar[bool] = True

    def __init__(self, at_least: ArrayLike):
        super().__init__(at_least)

    def measure(self, scene):
        return stiffness(scene)[0]


class ElasticShare(Constraint):
    """Share of the load on elastic contacts, 1 - `plastic_share`, at least a limit."""

    symbol: ClassVar[str] = "elastic share"
    domain: ClassVar[dict[str, float]] = {"above": 0, "below": 1}
    flat_if_plastic: ClassVar[bool] = True

    def __init__(self, at_least: ArrayLike):
        super().__init__(at_least)

    def measure(self, scene):
        return 1 - _state(scene, self.symbol).plastic_share


class RealContactArea(_LogConstraint):
    """Real contact area A_r [m^2] within limits, by the contact law (Eq. 28 of the fractal one).

    In a fully plastic joint Eq. 28 gives P/H for every surface, the least possible area.
    """

    symbol: ClassVar[str] = "A_r"
    unit: ClassVar[str] = "m^2"
    flat_if_plastic: ClassVar[bool] = True

    def measure(self, scene):
        joint = scene.sole_joint
        area = None if joint is None else joint.contact.real_area(joint.friction.mu_m)
        if area is None:
            raise ValueError(f"{self.symbol} needs a scene whose contact law has a real area")
        return area


class Roughness(_LogConstraint):
    """Sq [m] of the surface within limits, over wavelengths from L to L_s < L [m].

    See `root_mean_square`.
    """

    L: Float[Array, ""]  # longest wavelength [m]
    L_s: Float[Array, ""]  # shortest wavelength [m]

    symbol: ClassVar[str] = "Sq"
    unit: ClassVar[str] = "m"

    def __init__(
        self,
        at_least: ArrayLike | None = None,
        at_most: ArrayLike | None = None,
        *,
        L: ArrayLike,
        L_s: ArrayLike,
    ):
        super().__init__(at_least, at_most)
        self.L = scalar("L", L, above=0)
        self.L_s = scalar("L_s", L_s, above=0)
        if not self.L_s < self.L:
            raise ValueError(f"L_s must be below L, got {L_s!r} and {L!r}")

    def measure(self, scene):
        return root_mean_square(_surface(scene, self.symbol), self.L, self.L_s)


class _DrawingLimit(_LogConstraint):
    """A roughness parameter to expect of the surface of a contact, a `Spectrum`, within limits.

    Gaussian filters leave the waves from `shortest` to `cutoff` [m], as in `profile_parameters`.
    `below` is another name of `at_most`, and `joint` the name of a joint of a structure, which may
    be left out where only one has a surface.
    """

    cutoff: Limit  # longest wavelength that the filter leaves [m], or None
    shortest: Limit  # shortest wavelength that the filter leaves [m], or None
    L: Float[Array, ""]  # longest wavelength of a `Surface` [m]
    L_s: Float[Array, ""]  # shortest wavelength of a `Surface` [m]
    joint: str | None = eqx.field(static=True)  # of a structure

    unit: ClassVar[str] = "m"

    def __init__(
        self,
        at_least: ArrayLike | None,
        at_most: ArrayLike | None,
        cutoff: ArrayLike | None,
        shortest: ArrayLike | None,
        L: ArrayLike,
        L_s: ArrayLike,
        below: ArrayLike | None,
        joint: str | None,
    ):
        self.joint = joint
        if below is not None and at_most is not None:
            raise ValueError(f"{self.symbol} takes below or at_most, which are one limit")
        super().__init__(at_least, at_most if below is None else below)
        self.shortest = None if shortest is None else scalar("shortest", shortest, above=0)
        self.cutoff = None if cutoff is None else scalar("cutoff", cutoff, above=0)
        if self.cutoff is not None and self.shortest is not None:
            ordered("cutoff", self.cutoff, "shortest", self.shortest)
        self.L_s = scalar("L_s", L_s, above=0)
        self.L = ordered("L", scalar("L", L, above=0), "L_s", self.L_s)

    def expected(self, scene: Mechanism, parameters: Callable[..., Any]) -> Any:
        """The `profile_parameters` or `areal_parameters` of the surface behind the filters."""
        _, surface = joint_with_surface(scene, self.joint, self.symbol)
        band = dict(L=self.L, L_s=self.L_s) if isinstance(surface, Surface) else {}
        return parameters(surface, cutoff=self.cutoff, shortest=self.shortest, **band)


class Ra(_DrawingLimit):
    """Arithmetic mean height Ra [m] of the profile within limits; see `profile_parameters`.

    `cutoff` and `shortest` are the lengths of its filters [m]; L and L_s count for a `Surface`;
    `joint` names one of a structure.
    """

    symbol: ClassVar[str] = "Ra"

    def __init__(
        self,
        at_least: ArrayLike | None = None,
        at_most: ArrayLike | None = None,
        *,
        cutoff: ArrayLike,
        shortest: ArrayLike | None = None,
        L: ArrayLike = 1e-3,
        L_s: ArrayLike = 1e-6,
        below: ArrayLike | None = None,
        joint: str | None = None,
    ):
        super().__init__(at_least, at_most, cutoff, shortest, L, L_s, below, joint)

    def measure(self, scene):
        return self.expected(scene, profile_parameters).Ra


class Rz(_DrawingLimit):
    """Maximum height Rz [m] of the profile within limits; see `profile_parameters`.

    `cutoff`, the length of a section, and `shortest` are the lengths of its filters [m]; L and L_s
    count for a `Surface`; `joint` names one of a structure. The limit is on an Rz up to 12 % above
    the mean of measured ones.
    """

    symbol: ClassVar[str] = "Rz"

    def __init__(
        self,
        at_least: ArrayLike | None = None,
        at_most: ArrayLike | None = None,
        *,
        cutoff: ArrayLike,
        shortest: ArrayLike | None = None,
        L: ArrayLike = 1e-3,
        L_s: ArrayLike = 1e-6,
        below: ArrayLike | None = None,
        joint: str | None = None,
    ):
        super().__init__(at_least, at_most, cutoff, shortest, L, L_s, below, joint)

    def measure(self, scene):
        return self.expected(scene, profile_parameters).Rz


class Sq(_DrawingLimit):
    """Root mean square height Sq [m] of the map within limits; see `areal_parameters`.

    `cutoff` and `shortest` are the lengths of its filters [m], None for none; L and L_s count for a
    `Surface`; `joint` names one of a structure.
    """

    symbol: ClassVar[str] = "Sq"

    def __init__(
        self,
        at_least: ArrayLike | None = None,
        at_most: ArrayLike | None = None,
        *,
        cutoff: ArrayLike | None = None,
        shortest: ArrayLike | None = None,
        L: ArrayLike = 1e-3,
        L_s: ArrayLike = 1e-6,
        below: ArrayLike | None = None,
        joint: str | None = None,
    ):
        super().__init__(at_least, at_most, cutoff, shortest, L, L_s, below, joint)

    def measure(self, scene):
        return self.expected(scene, areal_parameters).Sq


class DampingRatio(Constraint):
    """Least damping ratio -Re/|lambda| of all eigenvalues, at least a limit.

    For a structure, rigid-body modes do not count.
    """

    friction_slope: bool = eqx.field(static=True)  # True if the slope of friction counts

    symbol: ClassVar[str] = "damping ratio"
    domain: ClassVar[dict[str, float]] = {"above": -1, "below": 1}

    def __init__(self, at_least: ArrayLike, *, friction_slope: bool = True):
        super().__init__(at_least)
        self.friction_slope = flag("friction_slope", friction_slope)

    def measure(self, scene):
        modes = stability(scene, self.friction_slope)
        s = modes.eigenvalues
        return least_damping_ratio(jnp.where(modes.counted | jnp.isnan(s), s, -1))

    def below(self, value):
        return jnp.arcsinh((self.at_least - value) / 1e-3)  # their magnitude at squeal


class Frequency(Constraint):
    """Frequencies [Hz] of all modes within limits: the lowest at least, the highest at most.

    All modes count, since the critical one jumps where modes cross.
    """

    friction_slope: bool = eqx.field(static=True)  # True if the slope of friction counts

    symbol: ClassVar[str] = "frequencies"
    unit: ClassVar[str] = "Hz"

    def __init__(
        self,
        at_least: ArrayLike | None = None,
        at_most: ArrayLike | None = None,
        *,
        friction_slope: bool = True,
    ):
        super().__init__(at_least, at_most)
        self.friction_slope = flag("friction_slope", friction_slope)

    def measure(self, scene):
        """The lowest and highest frequency (2,) [Hz] of a `scene`; 0 for an overdamped mode."""
        modes = stability(scene, self.friction_slope)
        frequencies = jnp.abs(modes.eigenvalues.imag) / (2 * math.pi)
        lowest = jnp.where(modes.counted, frequencies, jnp.inf).min()
        return jnp.stack([lowest, jnp.where(modes.counted, frequencies, 0).max()])

    def below(self, value):
        return super().below(value[0])

    def above(self, value):
        return super().above(value[1])


class CycleConstraint(Constraint):
    """A measure of the limit cycle in one degree of freedom: at most a limit, or an objective.

    Without a limit it is an objective only. `design` follows the cycle from one design to the next.
    Called directly, it measures the cycle that `limit_cycle` finds. At rest the measure is 0.
    """

    dof: int = eqx.field(static=True)  # from 0

    def __init__(self, at_most: ArrayLike | None = None, *, dof: int = 0):
        if at_most is None:
            self.at_least = self.at_most = None
        else:
            super().__init__(at_most=at_most)
        self.dof = whole("dof", dof, 0)

    @abc.abstractmethod
    def of(self, amplitude: Array, velocity: Array) -> Array:
        """The measure of an `amplitude` peak to peak [m] and a `velocity`, rms [m/s]."""

    def __call__(self, scene):
        return self.measure(scene) if self.at_most is None else super().__call__(scene)

    def measure(self, scene):
        cycle = limit_cycle(scene, throw=False)
        at_rest = cycle.result == CycleResult.equilibrium
        measures = cycle.amplitude[self.dof], cycle.velocity_rms[self.dof]
        return self.of(*(jnp.where(at_rest, 0, measure) for measure in measures))


class CycleAmplitude(CycleConstraint):
    """Peak-to-peak amplitude [m] of the limit cycle in a degree of freedom, at most a limit."""

    symbol: ClassVar[str] = "cycle amplitude"
    unit: ClassVar[str] = "m"

    def __init__(self, at_most: ArrayLike | None = None, *, dof: int = 0):
        super().__init__(at_most, dof=dof)

    def of(self, amplitude, velocity):
        return amplitude


class VelocityLevel(CycleConstraint):
    """20 lg(v/1 nm/s) [dB] of the root mean square v of a velocity of the limit cycle.

    At most a limit. The sound level of a single radiator changes by the same amount. It is 0 at
    rest.
    """

    symbol: ClassVar[str] = "velocity level"
    unit: ClassVar[str] = "dB"

    def __init__(self, at_most: ArrayLike | None = None, *, dof: int = 0):
        super().__init__(at_most, dof=dof)

    def of(self, amplitude, velocity):
        return 20 * jnp.log10(jnp.maximum(velocity, VELOCITY_REFERENCE) / VELOCITY_REFERENCE)

    def above(self, value):
        return (value - self.at_most) / 10
