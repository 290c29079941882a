"""Friction laws: the coefficient as a function of sliding velocity."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.parts import Part, number, ordered, quantity


class Friction(Part):
    """A friction law mu(v); `mu_s` is its static value, `mu_m` its minimum."""

    velocity_dependent: ClassVar[bool]
    lowest: ClassVar[str]  # which quantity holds mu_m

    mu_s: eqx.AbstractVar[jax.Array]
    mu_m: eqx.AbstractVar[jax.Array]

    def coefficient(self, v) -> jax.Array:
        """mu at sliding velocity v [m/s], with the sign of v; any shape."""
        return self.branch(v, jnp.sign(v))

    @abc.abstractmethod
    def branch(self, v, sign) -> jax.Array:
        """mu with `sign` (+1 or -1, or any number between) in place of sgn v, smooth in v.

        branch(0, +-1) = +-mu_s: the law of one sliding direction, continued through v = 0.
        """

    @abc.abstractmethod
    def slope(self, v) -> jax.Array:
        """dmu/dv [s/m] at sliding velocity v != 0; any shape."""


class Coulomb(Friction):
    """Constant friction, mu(v) = mu sgn(v).

    **Raises:** `ValueError` unless mu > 0.
    """

    mu: jax.Array = quantity("-", "friction coefficient")

    velocity_dependent: ClassVar[bool] = False
    lowest: ClassVar[str] = "mu"

    def __init__(self, mu):
        self.mu = number("mu", mu, above=0)

    @property
    def mu_s(self):
        return self.mu

    @property
    def mu_m(self):
        return self.mu

    def branch(self, v, sign):
        return self.mu * sign

    def slope(self, v):
        return jnp.zeros_like(v)


class Stribeck(Friction):
    """Friction that falls from mu_s at rest to its minimum mu_m at v_m and rises beyond (Eq. 38).

    mu(v) = mu_s sgn(v) - 3 (mu_s - mu_m)/(2 v_m) v + (mu_s - mu_m)/(2 v_m^3) v^3. Beyond
    sqrt(3) v_m it exceeds mu_s, and grows without bound: a law for speeds up to about v_m.

    **Raises:** `ValueError` unless mu_s > 0, 0 <= mu_m <= mu_s and v_m > 0.
    """

    mu_s: jax.Array = quantity("-", "static friction coefficient")
    mu_m: jax.Array = quantity("-", "smallest friction coefficient, reached at v_m")
    v_m: jax.Array = quantity("m/s", "sliding velocity of the smallest friction")

    velocity_dependent: ClassVar[bool] = True
    lowest: ClassVar[str] = "mu_m"

    def __init__(self, mu_s, mu_m, v_m):
        self.mu_s = number("mu_s", mu_s, above=0)
        self.mu_m = number("mu_m", mu_m, at_least=0)
        self.mu_s = ordered("mu_s", self.mu_s, "mu_m", self.mu_m)
        self.v_m = number("v_m", v_m, above=0)

    def branch(self, v, sign):
        drop, u = self.mu_s - self.mu_m, v / self.v_m
        return self.mu_s * sign + drop * u * (u**2 - 3) / 2

    def slope(self, v):
        drop, u = self.mu_s - self.mu_m, v / self.v_m
        return 1.5 * drop / self.v_m * (u**2 - 1)
