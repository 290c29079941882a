"""Friction laws: the coefficient as a function of the sliding speed."""

import abc
from typing import ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from ._base.parts import Numbers, Part, number, ordered, quantity


class Friction(Part):
    """A friction law mu(speed), at speeds of at least 0 [m/s].

    A law has `coefficient`, differentiable at 0 from above; slope and sign follow from it. It has
    mu_s = mu(0) and mu_m, its smallest value, as fields or properties.
    """

    velocity_dependent: ClassVar[bool] = True  # if False, neither slope nor speed is traced
    lowest: ClassVar[str] = "mu_m"  # the field that holds mu_m

    mu_s: eqx.AbstractVar[Numbers]
    mu_m: eqx.AbstractVar[Numbers]

    @abc.abstractmethod
    def coefficient(self, speed: ArrayLike) -> Numbers:
        """mu at sliding speeds >= 0 [m/s]; any shape."""

    def slope(self, v: ArrayLike) -> Numbers:
        """dmu/d|v| [s/m] at sliding velocities v [m/s]; any shape."""
        speed = jnp.abs(v)
        return jax.jvp(self.coefficient, (speed,), (jnp.ones_like(speed),))[1]

    def branch(self, v: ArrayLike, sign: ArrayLike) -> Numbers:
        """mu of one sliding direction, `sign` = +1 or -1, continued smoothly through v = 0.

        branch(0, +-1) = +-mu_s. A sign between them smooths this jump, and nothing else.
        """
        if not self.velocity_dependent:
            return self.mu_s * sign
        side = jnp.sign(sign)
        return self.mu_s * sign + side * (self.coefficient(side * v) - self.mu_s)


@final
class Coulomb(Friction):
    """Constant friction.

    **Raises:** `ValueError` unless mu > 0.
    """

    mu: Numbers = quantity("-", "friction coefficient")

    velocity_dependent: ClassVar[bool] = False
    lowest: ClassVar[str] = "mu"

    def __init__(self, mu: ArrayLike):
        self.mu = number("mu", mu, above=0)

    @property
    def mu_s(self):
        return self.mu

    @property
    def mu_m(self):
        return self.mu

    def coefficient(self, speed):
        return self.mu * jnp.ones_like(speed)


@final
class Stribeck(Friction):
    """Friction that falls from mu_s at rest to its minimum mu_m at v_m and rises beyond (Eq. 38).

    mu(v) = mu_s - 3 (mu_s - mu_m)/(2 v_m) v + (mu_s - mu_m)/(2 v_m^3) v^3. Beyond sqrt(3) v_m it
    exceeds mu_s, and grows without bound: a law for speeds up to about v_m.

    **Raises:** `ValueError` unless mu_s > 0, 0 <= mu_m <= mu_s and v_m > 0.
    """

    mu_s: Numbers = quantity("-", "static friction coefficient")
    mu_m: Numbers = quantity("-", "smallest friction coefficient, reached at v_m")
    v_m: Numbers = quantity("m/s", "sliding velocity of the smallest friction")

    def __init__(self, mu_s: ArrayLike, mu_m: ArrayLike, v_m: ArrayLike):
        self.mu_m = number("mu_m", mu_m, at_least=0)
        self.mu_s = ordered("mu_s", number("mu_s", mu_s, above=0), "mu_m", self.mu_m)
        self.v_m = number("v_m", v_m, above=0)

    def coefficient(self, speed):
        u = speed / self.v_m
        return self.mu_s + (self.mu_s - self.mu_m) * u * (u**2 - 3) / 2
