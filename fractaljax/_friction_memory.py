"""Friction laws with memory: internal states z beside the sliding velocity w.

A face of a joint under the normal load N has the friction force `force(z, w, N)` [N] while
dz/dt = `rate(z, w, N)`. Both take velocities of either sign; `mu` is what remains in steady
sliding.
"""

from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike

from ._base.parts import Numbers, number, ordered, quantity, whole
from ._base.singular import safe_divide
from ._friction import ExponentialStribeck, Friction


@final
class LuGre(Friction, law="lugre"):
    """Bristles of stiffness sigma_0 and damping sigma_1, per normal load, that slip gradually.

    dz/dt = w - sigma_0 abs(w) z/g(w), g(w) = mu_d + (mu_s - mu_d) exp(-(abs(w)/v_0)^exponent), and
    the force is N (sigma_0 z + sigma_1 dz/dt + viscous w): in steady sliding g + viscous abs(w) of
    N, which is `ExponentialStribeck` for an exponent of 1. With sigma_0 towards infinity, so does
    the motion become that of dry friction. The contact's K_t stays in parallel, as in Eq. 39.

    Source: Canudas de Wit et al. (1995), doi 10.1109/9.376053, there with the exponent 2.

    **Raises:** `ValueError` unless mu_s > 0, 0 <= mu_d <= mu_s, v_0 > 0, sigma_0 > 0, sigma_1 >= 0,
    viscous >= 0 and the exponent is a whole number of at least 1.
    """

    mu_s: Numbers = quantity("-", "static friction coefficient")
    mu_d: Numbers = quantity("-", "dynamic friction coefficient, without the viscous part")
    v_0: Numbers = quantity("m/s", "sliding velocity over which friction falls by a factor e")
    sigma_0: Numbers = quantity("1/m", "stiffness of the bristles per normal load", log=True)
    sigma_1: Numbers = quantity("s/m", "damping of the bristles per normal load")
    viscous: Numbers = quantity("s/m", "viscous part of the friction coefficient")
    exponent: int = eqx.field(static=True, default=1)

    state_size: ClassVar[int] = 1
    amplitudes: ClassVar[tuple[str, ...]] = ("mu_s", "mu_d", "viscous", "sigma_0", "sigma_1")

    def __init__(
        self,
        mu_s: ArrayLike,
        mu_d: ArrayLike,
        v_0: ArrayLike,
        sigma_0: ArrayLike,
        sigma_1: ArrayLike,
        viscous: ArrayLike = 0.0,
        exponent: int = 1,
    ):
        self.mu_d = number("mu_d", mu_d, at_least=0)
        self.mu_s = ordered("mu_s", number("mu_s", mu_s, above=0), "mu_d", self.mu_d)
        self.v_0 = number("v_0", v_0, above=0)
        self.sigma_0 = number("sigma_0", sigma_0, above=0)
        self.sigma_1 = number("sigma_1", sigma_1, at_least=0)
        self.viscous = number("viscous", viscous, at_least=0)
        self.exponent = whole("exponent", exponent, 1)

    def _without_viscous(self, speed) -> Numbers:
        """g, the friction coefficient without the viscous part; mu_s exactly at rest."""
        fall = jnp.expm1(-((speed / self.v_0) ** self.exponent))
        return self.mu_s + (self.mu_s - self.mu_d) * fall

    @property
    def mu_m(self):
        """The least friction coefficient over all speeds, or up to 100 m/s beside an exponent."""
        if self.exponent > 1:
            return super().mu_m
        law = ExponentialStribeck(self.mu_s, self.mu_d, self.v_0, self.viscous)
        return law.mu_m

    def mu(self, speed):
        return self._without_viscous(speed) + self.viscous * speed

    def rate(self, z, w, N):
        speed = jnp.abs(w)
        return w - self.sigma_0 * speed / self._without_viscous(speed) * z

    def force(self, z, w, N):
        by_bristles = self.sigma_0 * z + self.sigma_1 * self.rate(z, w, N)
        return N * (by_bristles + self.viscous * w)

    def steady(self, w, N):
        return (jnp.sign(w) * self._without_viscous(jnp.abs(w)) / self.sigma_0)[None]

    def state_unit(self, length):
        return self.mu_s / self.sigma_0


@final
class Dahl(Friction, law="dahl"):
    """Bristles without damping under constant friction: dz/dt = w - sigma_0 abs(w) z/mu.

    The force is N sigma_0 z. The contact's K_t stays in parallel, as in Eq. 39.

    Source: Dahl (1968), A Solid Friction Model, with his exponent 1.

    **Arguments:**

    - `mu`: friction coefficient [-] of steady sliding, above 0.
    - `sigma_0`: stiffness of the bristles per normal load [1/m], above 0.

    **Raises:** `ValueError` for others.
    """

    mu_s: Numbers = quantity("-", "friction coefficient of steady sliding", name="mu")
    sigma_0: Numbers = quantity("1/m", "stiffness of the bristles per normal load", log=True)

    state_size: ClassVar[int] = 1
    velocity_dependent: ClassVar[bool] = False
    lowest: ClassVar[str] = "mu"
    amplitudes: ClassVar[tuple[str, ...]] = ("mu_s", "sigma_0")

    def __init__(self, mu: ArrayLike, sigma_0: ArrayLike):
        self.mu_s = number("mu", mu, above=0)
        self.sigma_0 = number("sigma_0", sigma_0, above=0)

    @property
    def mu_m(self):
        """The friction coefficient of steady sliding, at every speed."""
        return self.mu_s

    def mu(self, speed):
        return self.mu_s * jnp.ones_like(speed)

    def rate(self, z, w, N):
        return w - self.sigma_0 * jnp.abs(w) / self.mu_s * z

    def force(self, z, w, N):
        return N * self.sigma_0 * z

    def steady(self, w, N):
        return (jnp.sign(w) * self.mu_s / self.sigma_0)[None]

    def state_unit(self, length):
        return self.mu_s / self.sigma_0


@final
class RateAndState(Friction, law="rate_and_state"):
    """Friction that ages at rest: mu_0 + a ln(w/v_ref) + b z, z = ln(v_ref theta/D_c).

    theta [s] is the age of the contacts: dtheta/dt = 1 - abs(w) theta/D_c (Dieterich), which is
    dz/dt = (v_ref exp(-z) - abs(w))/D_c. Near w = 0 the logarithm is regularised, with the sign of
    w: a asinh(w/(2 v_ref) exp((mu_0 + b z)/a)), so that a contact at rest creeps. In steady sliding
    z = -ln(w/v_ref), and friction falls with the velocity where b > a. mu_s and mu_m, which contact
    laws take, are both mu_0. The contact's K_t stays in parallel, as in Eq. 39.

    Source: Rice, Lapusta and Ranjith (2001), doi 10.1016/S0022-5096(01)00042-4.

    **Raises:** `ValueError` unless mu_0, a, D_c, v_ref > 0 and b >= 0.
    """

    mu_0: Numbers = quantity("-", "friction coefficient of steady sliding at v_ref")
    a: Numbers = quantity("-", "direct effect of the velocity")
    b: Numbers = quantity("-", "effect of the age of the contacts")
    D_c: Numbers = quantity("m", "sliding distance that renews the contacts", log=True)
    v_ref: Numbers = quantity("m/s", "reference velocity", log=True)

    state_size: ClassVar[int] = 1
    lowest: ClassVar[str] = "mu_0"
    amplitudes: ClassVar[tuple[str, ...]] = ("mu_0", "a", "b")

    def __init__(
        self, mu_0: ArrayLike, a: ArrayLike, b: ArrayLike, D_c: ArrayLike, v_ref: ArrayLike
    ):
        self.mu_0 = number("mu_0", mu_0, above=0)
        self.a = number("a", a, above=0)
        self.b = number("b", b, at_least=0)
        self.D_c = number("D_c", D_c, above=0)
        self.v_ref = number("v_ref", v_ref, above=0)

    @property
    def mu_s(self):
        """The friction coefficient at v_ref, as there is none at rest."""
        return self.mu_0

    @property
    def mu_m(self):
        """The friction coefficient at v_ref."""
        return self.mu_0

    def mu(self, speed):
        speed = jnp.asarray(speed)
        return self.force(self.steady(speed, 1.0)[0], speed, jnp.ones_like(speed))

    def rate(self, z, w, N):
        return (self.v_ref * jnp.exp(-jnp.asarray(z)) - jnp.abs(w)) / self.D_c

    def force(self, z, w, N):
        r, p = w / (2 * self.v_ref), (self.mu_0 + self.b * z) / self.a
        return N * self.a * _asinh_scaled(r, p)

    def steady(self, w, N):
        # Contacts do not grow older than rounding can tell from v_ref.
        least = jnp.finfo(jnp.result_type(float, w)).eps
        return -jnp.log(jnp.maximum(jnp.abs(w) / self.v_ref, least))[None]

    def state_unit(self, length):
        return jnp.ones_like(self.mu_0)


def _asinh_scaled(r, p) -> Numbers:
    """asinh(r e^p), where e^p may leave the range of numbers."""
    p, above = jnp.minimum(p, 0), jnp.maximum(p, 0)
    small = jnp.maximum(jnp.exp(-above), jnp.finfo(above.dtype).tiny)
    r = r * jnp.exp(p)  # the argument is r/small
    near = jnp.abs(r) < small
    size = jnp.where(near, 1, jnp.abs(r))
    log = above + jnp.log(size + jnp.sqrt(size**2 + small**2))
    return jnp.where(near, jnp.arcsinh(jnp.where(near, r / small, 0)), jnp.sign(r) * log)


class _Sliders(Friction):
    """n springs in series with sliders, side by side, in all as stiff as K_t, as strong as mu N.

    Slider i slips where its spring has the force (2 i - 1)/n^2 mu N.
    """

    mu_s: Numbers = quantity("-", "friction coefficient of all sliders", name="mu")
    stiffness: Numbers | None = quantity(
        "N/m", "tangential stiffness in series; by default K_t of the contact", log=True
    )
    relaxation: Numbers | None = quantity(
        "s", "time in which a slider yields; by default a thousandth of 1/omega", log=True
    )

    velocity_dependent: ClassVar[bool] = False
    in_series: ClassVar[bool] = True
    lowest: ClassVar[str] = "mu"
    amplitudes: ClassVar[tuple[str, ...]] = ("mu_s",)

    @property
    def mu_m(self):
        """The friction coefficient, at every speed."""
        return self.mu_s

    def mu(self, speed):
        return self.mu_s * jnp.ones_like(speed)

    def at_joint(self, K_t, time):
        law: Any = self
        if self.stiffness is None:
            law = eqx.tree_at(lambda x: x.stiffness, law, K_t, is_leaf=lambda x: x is None)
        if self.relaxation is None:
            time = time / 1000  # its square, the error that is left, is a millionth
            law = eqx.tree_at(lambda x: x.relaxation, law, time, is_leaf=lambda x: x is None)
        return law

    def _springs(self, N) -> tuple[Numbers, Numbers, Numbers]:
        """Stiffness of one spring, the most each holds (n,), and the relaxation time."""
        for name in ("stiffness", "relaxation"):
            if getattr(self, name) is None:
                raise ValueError(f"{name} must be given where the law stands outside of a joint")
        n = self.state_size
        shares = (2 * jnp.arange(n, dtype=jnp.result_type(float, N)) + 1) / n**2
        # A slider that nothing presses holds nothing.
        most = jnp.asarray(self.mu_s * jnp.maximum(N, 0))[..., None] * shares
        return jnp.asarray(self.stiffness) / n, most, jnp.asarray(self.relaxation)

    def rate(self, z, w, N):
        spring, most, relaxation = self._springs(N)
        excess = spring * z - jnp.clip(spring * z, -most, most)
        return w - safe_divide(excess, spring, z) / relaxation

    def force(self, z, w, N):
        spring, most, _ = self._springs(N)
        return jnp.sum(jnp.clip(spring * z, -most, most), axis=-1)

    def steady(self, w, N):
        spring, most, relaxation = self._springs(N)
        return jnp.sign(w) * safe_divide(most, spring, jnp.zeros_like(most)) + w * relaxation


@final
class Jenkins(_Sliders, law="jenkins"):
    """The tangential spring in series with a slider: it holds up to mu N, and then slips.

    z is the elongation of the spring; dz/dt = w while K_t abs(z) < mu N, and beyond
    w - (z - z_limit)/relaxation, while the force stays mu N: the error of a reversal is of the
    order of relaxation^2. K_t of the contact, or `stiffness`, acts here alone: the matrices and the
    second face of Eq. 39 have none. Where N <= 0 there is no friction.

    Source: Jenkins (1962), J. Appl. Phys. 33, 3; the relaxation: Duvaut and Lions (1972).

    **Arguments:**

    - `mu`: friction coefficient [-], above 0.
    - `stiffness`: tangential stiffness in series [N/m], above 0; by default K_t of the contact.
    - `relaxation`: time in which the slider yields [s], above 0; by default a thousandth of
      1/omega, the unit of time of the motion.

    **Raises:** `ValueError` for others.
    """

    state_size: ClassVar[int] = 1

    def __init__(
        self,
        mu: ArrayLike,
        stiffness: ArrayLike | None = None,
        relaxation: ArrayLike | None = None,
    ):
        self.mu_s = number("mu", mu, above=0)
        self.stiffness = None if stiffness is None else number("stiffness", stiffness, above=0)
        self.relaxation = None if relaxation is None else number("relaxation", relaxation, above=0)


@final
class Iwan(_Sliders, law="iwan"):
    """Several `Jenkins` elements side by side, of equal springs and evenly spread limits.

    Together they have the stiffness K_t and the limit mu N; slider i of n slips at the elongation
    (2 i - 1)/n mu N/K_t. So slip begins early, and sets in gradually.

    Source: Iwan (1966), doi 10.1115/1.3625199.

    **Arguments:**

    - `mu`: friction coefficient [-], above 0.
    - `elements`: their number n, 8 by default.
    - `stiffness`, `relaxation`: as in `Jenkins`.

    **Raises:** `ValueError` for others.
    """

    elements: int = eqx.field(static=True, default=8)

    def __init__(
        self,
        mu: ArrayLike,
        elements: int = 8,
        stiffness: ArrayLike | None = None,
        relaxation: ArrayLike | None = None,
    ):
        self.mu_s = number("mu", mu, above=0)
        self.elements = whole("elements", elements, 1)
        self.stiffness = None if stiffness is None else number("stiffness", stiffness, above=0)
        self.relaxation = None if relaxation is None else number("relaxation", relaxation, above=0)

    @property
    def state_size(self):
        """One elongation an element."""
        return self.elements
