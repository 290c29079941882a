"""Friction laws: the coefficient as a function of the sliding speed."""

import abc
import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from ._base.laws import Law, refuse
from ._base.parts import Numbers, concrete, number, ordered, quantity, require_kind
from ._base.singular import safe_divide

# Speeds [m/s] among which the least value of a law is sought.
SPEEDS = np.concatenate([[0.0], np.geomspace(1e-6, 100.0, 161)])


class _FromLaw:
    """A number that follows from mu, unless a subclass has a field or a property of this name.

    A property would not do: it cannot be overridden by a field.
    """

    def __init__(self, function: Callable[[Any], Numbers]):
        self.function = function

    def __get__(self, law: Any, kind: type | None = None) -> Any:
        if law is None:
            raise AttributeError("of a law, not of its class")  # not the default of a field
        return self.function(law)


class Friction(Law):
    """A friction law mu(speed), at speeds of at least 0 [m/s].

    A custom law declares its numbers as fields and defines `mu`, differentiable at 0 from above:

        class Falling(fj.Friction, law="falling"):
            mu_s: jax.Array = fj.quantity("-", "static friction coefficient")
            c: jax.Array = fj.quantity("s/m", "fall of the friction coefficient with speed")

            def mu(self, speed):
                return self.mu_s / (1 + self.c * speed)

    Slope, sign and the scaling of `critical_friction` follow from it. `law` is its name in TOML
    files, without which it cannot be written to one; `fj.quantity` adds unit and meaning there and
    makes a number available to sweeps and designs.

    A law with memory has `state_size` internal states z, of its own units, on each face of a joint
    on which it acts, and defines `rate` and `force` as well; `mu` is then its steady sliding:

        class Bristles(fj.Friction):
            state_size = 1
            mu_s: jax.Array = fj.quantity("-", "friction coefficient")
            sigma: jax.Array = fj.quantity("1/m", "stiffness of the bristles per normal load")

            def mu(self, speed):
                return self.mu_s + 0 * speed

            def rate(self, z, w, N):
                return w - self.sigma * abs(w) / self.mu_s * z

            def force(self, z, w, N):
                return self.sigma * z * N

    mu_s is mu(0). mu_m, which Eq. 19 takes as dynamic friction, is the least value of mu up to
    100 m/s, and at least 0; the source means the minimum of its Eq. 38. A field or a property of
    either name replaces it.

    Motions and cycles reach their `rtol` where mu is smooth. A law that is continuous, but not
    smooth at some speeds, states them [m/s] as `knots`, a property or a constant of the class;
    their number may not depend on the numbers of the law. Steps then end there:

        class Bent(fj.Friction):
            mu_0: jax.Array = fj.quantity("-", "friction coefficient up to a speed")
            v_1: jax.Array = fj.quantity("m/s", "speed from which on it falls")

            @property
            def knots(self):
                return jnp.stack([self.v_1])

            def mu(self, speed):
                return self.mu_0 / (1 + jnp.maximum(speed / self.v_1 - 1, 0))

    A field mu_s may lie above mu(0), the limit of mu at vanishing speed. The law then has a jump:
    in stick the friction force is at most mu_s times the normal force, and where it reaches that
    limit it falls to mu(0) times the normal force as sliding begins.

    **Raises:** `ValueError` unless mu(0) > 0 and a field mu_s is at least mu(0), and for a name
    that another law has. For a traced law every number is NaN instead.
    """

    velocity_dependent: ClassVar[bool] = True  # if False, neither slope nor speed is traced
    lowest: ClassVar[str] = "mu_m"  # the quantity that holds mu_m
    # Internal states of one face: where there are any, `rate` and `force` say how it rubs.
    state_size: ClassVar[int] = 0
    in_series: ClassVar[bool] = False  # whether the contact's K_t acts in it alone, in series
    # Speeds (k,) [m/s] at which mu is continuous, but not smooth.
    knots: ClassVar[Any] = ()
    # Fields that scale the law as a whole; a law without them is wrapped in `Scaled`.
    amplitudes: ClassVar[tuple[str, ...]] = ()

    mu_s = _FromLaw(lambda law: law.mu(jnp.zeros((), _dtype(law))))
    mu_m = _FromLaw(lambda law: _least_coefficient(law))

    def check_as_defined(self):
        kinetic = concrete(number("mu(0)", self.mu(jnp.zeros((), _dtype(self))), above=0))
        static = concrete(jnp.asarray(self.mu_s))
        if kinetic is None or static is None:
            kinetic, static = self.mu(jnp.zeros((), _dtype(self))), jnp.asarray(self.mu_s)
            refuse(self, ~(kinetic > 0) | ~_at_least(static, kinetic))
        elif not np.all(_at_least(static, kinetic)):
            raise ValueError(f"mu_s must be at least mu(0) = {kinetic}, got {static}")

    @property
    def has_jump(self) -> bool:
        """True if mu_s may lie above mu(0), which is decided when a program is traced."""
        if self.built_in:
            return False
        # As a field, or as a property.
        field = any(field.name == "mu_s" for field in dataclasses.fields(self))
        return field or inspect.getattr_static(type(self), "mu_s") is not Friction.__dict__["mu_s"]

    def kinetic_limit(self) -> Numbers:
        """mu(0), the limit of the coefficient at vanishing speed: mu_s for a law without a jump."""
        return self.mu(jnp.zeros((), _dtype(self))) if self.has_jump else self.mu_s

    @abc.abstractmethod
    def mu(self, speed: ArrayLike) -> Numbers:
        """The friction coefficient [-] at sliding speeds `speed` >= 0 [m/s], of any shape."""

    def slope(self, v: ArrayLike) -> Numbers:
        """dmu/d|v| [s/m] at sliding velocities `v` [m/s], of any shape."""
        speed = jnp.abs(v)
        return jax.jvp(self.mu, (speed,), (jnp.ones_like(speed),))[1]

    def branch(self, v: ArrayLike, sign: ArrayLike) -> Numbers:
        """mu of one sliding direction, continued smoothly through v = 0.

        branch(0, +-1) = +-mu(0).

        **Arguments:**

        - `v`: sliding velocities [m/s], of any shape.
        - `sign`: the direction, +1 or -1. A sign between them smooths the jump at v = 0, and
          nothing else.
        """
        kinetic = self.kinetic_limit()
        if not self.velocity_dependent:
            return kinetic * sign
        side = jnp.sign(sign)
        return kinetic * sign + side * (self.mu(side * v) - kinetic)

    def in_motion(self) -> "Friction":
        """The law in the form that is evaluated at every step of a motion, by default itself."""
        return self

    def rate(self, z: ArrayLike, w: ArrayLike, N: ArrayLike) -> Numbers:
        """dz/dt (state_size,) of a law with memory.

        **Arguments:**

        - `z`: internal states (state_size,).
        - `w`: sliding velocity [m/s], of either sign.
        - `N`: normal load [N] of the face.
        """
        raise NotImplementedError(f"{type(self).__name__} has no internal states")

    def force(self, z: ArrayLike, w: ArrayLike, N: ArrayLike) -> Numbers:
        """Friction force [N] of a law with memory, along w; arguments as `rate`."""
        raise NotImplementedError(f"{type(self).__name__} has no internal states")

    def steady(self, w: ArrayLike, N: ArrayLike) -> Numbers:
        """States (state_size,) with rate 0; arguments as `rate`. By default by Newton's method."""

        def step(_, z):
            slope = jax.jacfwd(rate)(z)
            change = jnp.linalg.solve(slope, rate(z))
            return z - jnp.where(jnp.isfinite(change), change, 0)

        def rate(z):
            return jnp.reshape(self.rate(z, w, N), (self.state_size,))

        start = jnp.zeros(self.state_size, jnp.result_type(float, w))
        return jax.lax.fori_loop(0, 16, step, start)

    def state_unit(self, length: ArrayLike) -> ArrayLike:
        """The size of the states, in which motions carry them; by default the unit of `length`."""
        return length

    def at_joint(self, K_t: ArrayLike, time: ArrayLike) -> "Friction":
        """The law in a joint of tangential stiffness K_t [N/m], in motion with a unit of `time`."""
        return self

    def times(self, factor: ArrayLike) -> "Friction":
        """The law as a whole times `factor`, a number above 0; not checked."""
        law, names = (self, self.amplitudes) if self.amplitudes else (Scaled(self), ("factor",))
        scaled = [factor * getattr(law, name) for name in names]
        return eqx.tree_at(lambda law: [getattr(law, name) for name in names], law, scaled)


def _dtype(law: Friction) -> Any:
    return jnp.result_type(float, *jax.tree.leaves(law))


def _at_least(static: Any, kinetic: Any) -> Any:
    """True where a static coefficient is at least the kinetic one, to rounding."""
    return static >= kinetic * (1 - 8 * float(jnp.finfo(static.dtype).eps))


def _least_coefficient(law: Friction) -> Numbers:
    """The least value of mu up to 100 m/s, at least 0; differentiable with its place."""
    fixed = jax.tree.map(jax.lax.stop_gradient, law)
    speeds = jnp.asarray(SPEEDS, _dtype(law))
    place = jnp.argmin(jax.vmap(fixed.mu)(speeds), axis=0)
    ends = speeds[jnp.maximum(place - 1, 0)], speeds[jnp.minimum(place + 1, len(speeds) - 1)]

    def bisect(_, ends):
        low, high = ends
        middle = (low + high) / 2
        falls = fixed.slope(middle) < 0
        return jnp.where(falls, middle, low), jnp.where(falls, high, middle)

    _, at = jax.lax.fori_loop(0, 60, bisect, ends)  # more halvings than a double has bits
    # The place of a minimum moves with the law: a Newton step of 0 length has that derivative.
    slope, bend = jax.jvp(law.slope, (at,), (jnp.ones_like(at),))
    step = safe_divide(slope, bend, jnp.zeros_like(bend))
    return jnp.maximum(law.mu(at - jnp.where(jnp.abs(step) < 1e-6 * at, step, 0)), 0)


class WithStatic(Friction):
    """A law that stores its static coefficient apart, None where it is mu(0)."""

    static: eqx.AbstractVar[Numbers | None]

    @property
    def has_jump(self):
        return self.static is not None

    @property
    def mu_s(self):
        """The largest friction coefficient in stick."""
        return self.kinetic_limit() if self.static is None else self.static

    def kinetic_limit(self):
        return self.mu(jnp.zeros((), _dtype(self)))


@final
class Coulomb(WithStatic, law="coulomb"):
    """Constant friction, perhaps with a higher static coefficient.

    **Arguments:**

    - `mu`: friction coefficient [-], of sliding at every speed.
    - `mu_s`: static friction coefficient [-], at least `mu`; by default there is none but `mu`.

    **Raises:** `ValueError` unless mu > 0 and mu_s >= mu.
    """

    kinetic: Numbers = quantity("-", "friction coefficient", name="mu")
    static: Numbers | None = quantity(
        "-", "static friction coefficient, by default mu", name="mu_s", absent=True
    )

    velocity_dependent: ClassVar[bool] = False
    lowest: ClassVar[str] = "mu"

    def __init__(self, mu: ArrayLike, mu_s: ArrayLike | None = None):
        self.kinetic = number("mu", mu, above=0)
        self.static = (
            None if mu_s is None else ordered("mu_s", number("mu_s", mu_s), "mu", self.kinetic)
        )

    @property
    def amplitudes(self):
        return ("kinetic", "static") if self.has_jump else ("kinetic",)

    @property
    def mu_m(self):
        """The friction coefficient, at every speed."""
        return self.kinetic

    def kinetic_limit(self):
        return self.kinetic

    def mu(self, speed):
        return self.kinetic * jnp.ones_like(speed)


@final
class Stribeck(Friction, law="stribeck"):
    """Friction that falls from mu_s at rest to its minimum mu_m at v_m and rises beyond (Eq. 38).

    mu(v) = mu_s - 3 (mu_s - mu_m)/(2 v_m) v + (mu_s - mu_m)/(2 v_m^3) v^3. Beyond sqrt(3) v_m it
    exceeds mu_s, and grows without bound: a law for speeds up to about v_m.

    **Raises:** `ValueError` unless mu_s > 0, 0 <= mu_m <= mu_s and v_m > 0.
    """

    mu_s: Numbers = quantity("-", "static friction coefficient")
    mu_m: Numbers = quantity("-", "smallest friction coefficient, reached at v_m")
    v_m: Numbers = quantity("m/s", "sliding velocity of the smallest friction")

    amplitudes: ClassVar[tuple[str, ...]] = ("mu_s", "mu_m")

    def __init__(self, mu_s: ArrayLike, mu_m: ArrayLike, v_m: ArrayLike):
        self.mu_m = number("mu_m", mu_m, at_least=0)
        self.mu_s = ordered("mu_s", number("mu_s", mu_s, above=0), "mu_m", self.mu_m)
        self.v_m = number("v_m", v_m, above=0)

    def mu(self, speed):
        u = speed / self.v_m
        return self.mu_s + (self.mu_s - self.mu_m) * u * (u**2 - 3) / 2


@final
class ExponentialStribeck(Friction, law="exponential"):
    """Friction that decays from mu_s towards mu_d, with a viscous part.

    mu(v) = mu_d + (mu_s - mu_d) exp(-v/v_0) + viscous v. Its mu_m is mu_d without a viscous part,
    else the minimum, at v = v_0 ln((mu_s - mu_d)/(viscous v_0)) or at 0. Used in belt models:
    Papangelo, Ciavarella and Hoffmann (2017).

    **Raises:** `ValueError` unless mu_s > 0, 0 <= mu_d <= mu_s, v_0 > 0 and viscous >= 0.
    """

    mu_s: Numbers = quantity("-", "static friction coefficient")
    mu_d: Numbers = quantity("-", "dynamic friction coefficient, without the viscous part")
    v_0: Numbers = quantity("m/s", "sliding velocity over which friction falls by a factor e")
    viscous: Numbers = quantity("s/m", "viscous part of the friction coefficient")

    amplitudes: ClassVar[tuple[str, ...]] = ("mu_s", "mu_d", "viscous")

    def __init__(self, mu_s: ArrayLike, mu_d: ArrayLike, v_0: ArrayLike, viscous: ArrayLike = 0.0):
        self.mu_d = number("mu_d", mu_d, at_least=0)
        self.mu_s = ordered("mu_s", number("mu_s", mu_s, above=0), "mu_d", self.mu_d)
        self.v_0 = number("v_0", v_0, above=0)
        self.viscous = number("viscous", viscous, at_least=0)

    @property
    def mu_m(self):
        """The least friction coefficient over all speeds."""
        rise, drop = self.viscous * self.v_0, self.mu_s - self.mu_d
        falls, ratio = rise < drop, safe_divide(rise, drop, jnp.ones_like(rise * drop))
        ratio = jnp.where(falls & (ratio > 0), ratio, 1)
        return jnp.where(falls, self.mu_d + rise * (1 - jnp.log(ratio)), self.mu_s)

    def mu(self, speed):
        # expm1, so that mu(0) is mu_s to the last digit.
        fall = (self.mu_s - self.mu_d) * jnp.expm1(-(speed / self.v_0))
        return self.mu_s + fall + self.viscous * speed


@final
class HyperbolicStribeck(Friction, law="hyperbolic"):
    """Friction that falls as mu(v) = mu_s/(1 + delta v), towards 0 at high speed: mu_m = 0.

    Source: Leine et al. (1998), doi 10.1023/A:1008289604683.

    **Raises:** `ValueError` unless mu_s > 0 and delta >= 0.
    """

    mu_s: Numbers = quantity("-", "static friction coefficient")
    delta: Numbers = quantity("s/m", "rate at which friction falls with the sliding velocity")

    amplitudes: ClassVar[tuple[str, ...]] = ("mu_s",)

    def __init__(self, mu_s: ArrayLike, delta: ArrayLike):
        self.mu_s = number("mu_s", mu_s, above=0)
        self.delta = number("delta", delta, at_least=0)

    @property
    def mu_m(self):
        """The limit of the friction coefficient at high speed, 0."""
        return jnp.zeros_like(self.mu_s)

    def mu(self, speed):
        return self.mu_s / (1 + self.delta * speed)


@final
class Scaled(Friction, law="scaled"):
    """A friction law times a factor: the scaled form of a law that names no `amplitudes`.

    **Raises:** `TypeError` unless `of` is a `Friction`; `ValueError` unless factor > 0.
    """

    of: Friction
    factor: Numbers = quantity("-", "factor of the friction law")

    amplitudes: ClassVar[tuple[str, ...]] = ("factor",)

    def __init__(self, of: Friction, factor: ArrayLike = 1.0):
        require_kind("of", of, Friction)
        self.of = of
        self.factor = number("factor", factor, above=0)

    @property
    def velocity_dependent(self):
        return self.of.velocity_dependent

    @property
    def has_jump(self):
        return self.of.has_jump

    @property
    def mu_s(self):
        # Without a jump as of any other law.
        return self.factor * self.of.mu_s if self.has_jump else self.mu(jnp.zeros((), _dtype(self)))

    @property
    def mu_m(self):
        return self.factor * self.of.mu_m

    @property
    def state_size(self):
        return self.of.state_size

    @property
    def in_series(self):
        return self.of.in_series

    @property
    def knots(self):
        return self.of.knots

    def mu(self, speed):
        return self.factor * self.of.mu(speed)

    def in_motion(self):
        return Scaled(self.of.in_motion(), self.factor)

    def rate(self, z, w, N):
        return self.of.rate(z, w, N)

    def force(self, z, w, N):
        return self.factor * self.of.force(z, w, N)

    def steady(self, w, N):
        return self.of.steady(w, N)

    def state_unit(self, length):
        return self.of.state_unit(length)

    def at_joint(self, K_t, time):
        return Scaled(self.of.at_joint(K_t, time), self.factor)
