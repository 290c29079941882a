"""From a surface under load to the stiffness of the joint.

Areas are carried as logarithms: a_e spans hundreds of decades as D -> 2. Equation numbers are
those of the source paper; every integral over the elastic contacts is one function,
`area_moment`. The load is given and the largest contact area a_l is not: with t = ln(a_l/a_e),
the load balance divided by that of an all-plastic joint depends on t, D and one material number
only, and its root is a fixed handful of Newton steps of third order (Halley's) with the implicit
derivative.
"""

import abc
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.parts import Part, Record, brief, number, ordered, quantity, require_scalar, scalar
from ..base.singular import boxcox, exp_or_inf, positive_cbrt
from ..surface.surfaces import Surface
from .materials import Material

# From the tangent at t = 0, three reach the last digit over the whole domain; tests hold that.
_HALLEY_STEPS = 3

MU_M_MAX = 0.9  # Eq. 19 ends there


class Regime(eqx.Enumeration):
    """The state of a joint; an outcome, never an error."""

    fully_plastic = "fully plastic: every contact is below the critical area, K_n = K_t = 0"
    elastic_plastic = "elastic-plastic"
    gross_slip = "gross slip: the tangential load reaches mu_s P, K_t = 0"


class ContactState(Record):
    """What a joint does under its load, as `contact_state` returns it; SI units."""

    K_n: jax.Array  # normal stiffness [N/m], 0 when fully plastic
    K_t: jax.Array  # tangential stiffness [N/m], 0 when fully plastic or in gross slip
    a_l: jax.Array  # largest contact area [m^2]
    a_e: jax.Array  # critical area: elastic above, plastic below [m^2]
    A_r: jax.Array  # real contact area [m^2]
    Q_e: jax.Array | None  # tangential load carried by the elastic contacts [N]
    plastic_share: jax.Array  # share of the load on plastic contacts, 1 when fully plastic
    log_area_ratio: jax.Array  # ln(a_l/a_e): how far from fully plastic, also below zero
    slip_ratio: jax.Array | None  # Q_e/(mu_s P): gross slip from 1 upwards
    regime: Regime  # a member of Regime


def friction_correction(mu_m: jax.Array) -> jax.Array:
    """Eq. 19: k_mu, by which friction lowers the pressure at yield; 0 <= mu_m <= 0.9, any shape.

    As printed, with its step of 4e-4 at mu_m = 0.3.
    """
    return jnp.where(mu_m <= 0.3, 1 - 0.228 * mu_m, 0.932 * jnp.exp(-1.58 * (mu_m - 0.3)))


def log_critical_area(surface: Surface, material: Material, k_mu: jax.Array) -> jax.Array:
    """Eq. 21: ln a_e [a_e in m^2], the contact area above which an asperity is elastic."""
    D = surface.D
    phi = material.sigma_y / material.E
    return (
        2 * jnp.log(33 * k_mu * phi / 40)
        + (3 * D - 11) * jnp.log(2.0)
        + (4 - D) * jnp.log(jnp.pi)
        - jnp.log(jnp.log(surface.gamma))
    ) / (2 - D) + 2 * jnp.log(surface.G)


def critical_pressure_ratio(material: Material, k_mu: jax.Array) -> jax.Array:
    """P_e(a_e)/(H a_e) = 1.1 k_mu sigma_y/H (Eqs. 18 and 24 at a = a_e, for every D and G)."""
    return 1.1 * k_mu * material.sigma_y / material.H


def _bounded(t, D):
    """The smaller of t and that at which the square of e^(rt), r = (5-2D)/2, would overflow.

    From there on plastic contacts carry nothing that counts, and ln P is a straight line in t.
    """
    r, largest = (5 - 2 * D) / 2, 0.35 * math.log(jnp.finfo(D.dtype).max)
    return jnp.minimum(t, largest / jnp.maximum(r, 1e-6))


def elastic_to_plastic_load(t: jax.Array, D: jax.Array, beta: jax.Array) -> jax.Array:
    """Ratio of the two terms of Eq. 26 (Eq. 27 at D = 2.5), with t = ln(a_l/a_e) >= 0.

    beta (3-D)/2 (e^(rt) - 1)/r, r = (5-2D)/2, beta as `critical_pressure_ratio`; constant where
    its square would overflow.
    """
    r = (5 - 2 * D) / 2
    return beta * (3 - D) / 2 * boxcox(_bounded(t, D), r)


def log_load(t: jax.Array, D: jax.Array, beta: jax.Array) -> jax.Array:
    """Eq. 26: ln P minus the ln P of an all-plastic joint with a_l = a_e; t = ln(a_l/a_e) >= 0."""
    beyond = t - _bounded(t, D)
    curved = (D - 1) / 2 * t + jnp.log1p(elastic_to_plastic_load(t, D, beta))
    return curved + (5 - 2 * D) / 2 * beyond


def _bending(t, D, beta):
    """w = d log_load/dt - (D-1)/2, whose own slope is w (r - w)."""
    r = (5 - 2 * D) / 2
    # e^(rt) as 1 + r (e^(rt) - 1)/r: the exponential is there already.
    growth = beta * (3 - D) / 2 * (1 + r * boxcox(_bounded(t, D), r))
    return growth / (1 + elastic_to_plastic_load(t, D, beta))


@jax.jit
def _halley_step(t, s, D, beta):
    w = _bending(t, D, beta)
    error, slope = log_load(t, D, beta) - s, (D - 1) / 2 + w
    return t - error * slope / (slope**2 - error * w * ((5 - 2 * D) / 2 - w) / 2)


@jax.custom_jvp
def _elastic_log_area_ratio(s, D, beta):
    t = s / ((D - 1) / 2 + beta * (3 - D) / 2)
    for _ in range(_HALLEY_STEPS):
        t = _halley_step(t, s, D, beta)
    return t


@_elastic_log_area_ratio.defjvp
def _elastic_log_area_ratio_jvp(primals, tangents):
    # Implicit differentiation; built from differentiable pieces, so that every order is right.
    s, D, beta = primals
    ds, dD, dbeta = tangents
    t = _elastic_log_area_ratio(s, D, beta)
    _, dload = jax.jvp(lambda D, beta: log_load(t, D, beta), (D, beta), (dD, dbeta))
    return t, (ds - dload) / ((D - 1) / 2 + _bending(t, D, beta))


def solve_log_area_ratio(s: jax.Array, D: jax.Array, beta: jax.Array) -> jax.Array:
    """t = ln(a_l/a_e) under the load s = ln P - ln P(all plastic, a_l = a_e); any shape.

    Below zero, where the joint is fully plastic, t = s.
    """
    elastic = s > 0
    return jnp.where(elastic, _elastic_log_area_ratio(jnp.where(elastic, s, 1), D, beta), s)


def area_moment(p, D: jax.Array, log_a_e: jax.Array, t: jax.Array) -> jax.Array:
    """J(p) = integral of a^p n(a) da over the elastic contacts [a_e, a_l] (Eq. 25) [m^(2p)].

    (D-1)/2 a_l^((D-1)/2) (a_l^r - a_e^r)/r with r = p + (1-D)/2, written with t = ln(a_l/a_e) as
    (D-1)/2 a_l^p (1 - e^(-rt))/r: as D -> 2, a_e alone overflows or underflows. Exactly 0 for
    t <= 0, where nothing is elastic.
    """
    elastic = t > 0
    # Far in the plastic regime a_e overflows: the unused branch must not see it.
    log_a_e, t = jnp.where(elastic, log_a_e, 0), jnp.where(elastic, t, 1)
    r = p + (1 - D) / 2
    moment = (D - 1) / 2 * jnp.exp(p * (log_a_e + t)) * boxcox(t, -r)
    return jnp.where(elastic, moment, 0)


def normal_stiffness(D: jax.Array, E, root_area_moment: jax.Array) -> jax.Array:
    """Eq. 30: K_n = 4 E (4-D)/(3 pi^(1/2) (3-D)) J(1/2) [N/m]."""
    return 4 * E * (4 - D) / (3 * jnp.sqrt(jnp.pi) * (3 - D)) * root_area_moment


def tangential_load(area_moment_1, elastic_load, material: Material) -> jax.Array:
    """Eq. 33: Q_e = 8/(pi (6-3 nu)) [sigma_y J(1) + (2 nu - 1) P_elastic] [N] (34 at D = 2.5)."""
    nu = material.nu
    return (
        8
        / (jnp.pi * (6 - 3 * nu))
        * (material.sigma_y * area_moment_1 + (2 * nu - 1) * elastic_load)
    )


def tangential_stiffness(E, nu, slip_ratio: jax.Array, root_area_moment: jax.Array) -> jax.Array:
    """Eq. 36: K_t = 8 Gbar/((2-nu) pi^(1/2)) (1 - Q_e/(mu P))^(1/3) J(1/2), Gbar = E/(2(1+nu))."""
    shear_modulus = E / (2 * (1 + nu))
    return (
        8
        * shear_modulus
        / ((2 - nu) * jnp.sqrt(jnp.pi))
        * positive_cbrt(1 - slip_ratio)
        * root_area_moment
    )


def dimensionless_normal_stiffness(D, A_r, a_e) -> jax.Array:
    """Eq. 31: K_n* = K_n/(E sqrt(A_a)) from A_r* = A_r/A_a and a_e* = a_e/A_a; any shape.

    **Raises:** `ValueError` unless 2 < D < 3, A_r > 0 and a_e > 0, which may be infinite.
    """
    D, moment = _root_area_moment_of_real_area(D, A_r, a_e)
    return normal_stiffness(D, 1.0, moment)


def dimensionless_tangential_stiffness(D, nu, A_r, a_e, slip_ratio) -> jax.Array:
    """Eq. 37: K_t* = K_t/(E sqrt(A_a)), `slip_ratio` being Q_e*/(mu P*); any shape.

    The source's text normalises by the shear modulus; its equation, followed here, by E.

    **Raises:** `ValueError` unless 2 < D < 3, 0 <= nu <= 0.5, A_r > 0, a_e > 0 and `slip_ratio` is
    finite.
    """
    nu = number("nu", nu, at_least=0, at_most=0.5)
    slip_ratio = number("slip_ratio", slip_ratio)
    _, moment = _root_area_moment_of_real_area(D, A_r, a_e)
    return tangential_stiffness(1.0, nu, slip_ratio, moment)


def _root_area_moment_of_real_area(D, A_r, a_e):
    D, A_r = number("D", D, above=2, below=3), number("A_r", A_r, above=0)
    if jnp.issubdtype(getattr(a_e, "dtype", type(a_e)), jnp.floating):
        # Towards D = 2 it overflows, and `contact_state` has infinity: nothing is elastic.
        a_e = jnp.minimum(a_e, jnp.finfo(getattr(a_e, "dtype", float)).max)
    a_e = number("a_e", a_e, above=0)
    log_a_l, log_a_e = jnp.log((3 - D) / (D - 1) * A_r), jnp.log(a_e)  # Eq. 28
    return D, area_moment(0.5, D, log_a_e, log_a_l - log_a_e)


class _Joint(eqx.Module):
    """The solved load balance and the stiffness that follows; no more than those need."""

    log_a_l: jax.Array
    log_a_e: jax.Array
    log_area_ratio: jax.Array
    plastic_share: jax.Array
    K_n: jax.Array
    K_t: jax.Array
    Q_e: jax.Array | None
    slip_ratio: jax.Array | None


def _solve(surface: Surface, material: Material, P, mu_s, mu_m, stiffness_ratio=None) -> _Joint:
    D, E, nu = surface.D, material.E, material.nu
    k_mu = friction_correction(mu_m)
    beta = critical_pressure_ratio(material, k_mu)
    log_a_e = log_critical_area(surface, material, k_mu)
    # Eqs. 23 and 25: the a_l that carries the load if every contact is plastic.
    log_a_plastic = jnp.log(P) - jnp.log(material.H) + jnp.log((3 - D) / (D - 1))
    s = log_a_plastic - log_a_e
    t = solve_log_area_ratio(s, D, beta)
    ratio = elastic_to_plastic_load(jnp.maximum(t, 0), D, beta)
    plastic_share = 1 / (1 + ratio)
    moment = area_moment(0.5, D, log_a_e, t)
    K_n = normal_stiffness(D, E, moment)
    if stiffness_ratio is None:
        Q_e = tangential_load(area_moment(1.0, D, log_a_e, t), ratio * plastic_share * P, material)
        slip_ratio = Q_e / (mu_s * P)
        K_t = tangential_stiffness(E, nu, slip_ratio, moment)
    else:
        Q_e, slip_ratio, K_t = None, None, stiffness_ratio * K_n
    return _Joint(log_a_plastic + (t - s), log_a_e, t, plastic_share, K_n, K_t, Q_e, slip_ratio)


def contact_state(surface: Surface, material: Material, P, *, mu_s, mu_m) -> ContactState:
    """The joint of `surface` and `material` under the normal load P [N]; scalars only.

    `mu_m` lowers the pressure at yield (Eq. 19), `mu_s` bounds the tangential load (Eq. 35).

    **Raises:** `ValueError` unless P > 0, mu_s > 0, 0 <= mu_m <= 0.9 and mu_m <= mu_s, and for
    arrays: use `jax.vmap`.
    """
    mu_m = scalar("mu_m", mu_m, at_least=0, at_most=MU_M_MAX)
    mu_s = ordered("mu_s", scalar("mu_s", mu_s, above=0), "mu_m", mu_m)
    contact = FractalContact(surface, material, P)
    require_scalar(contact)
    return contact.state(mu_s, mu_m)


def _require_kinds(surface, material):
    for name, part, kind in (("surface", surface, Surface), ("material", material, Material)):
        if not isinstance(part, kind):
            raise TypeError(f"{name} must be a {kind.__name__}, got {brief(part)}")


def load_of_area(surface: Surface, material: Material, A_r, mu_m) -> jax.Array:
    """As `contact_load`, without checks."""
    D, k_mu = surface.D, friction_correction(mu_m)
    t = jnp.log((3 - D) / (D - 1) * A_r) - log_critical_area(surface, material, k_mu)
    elastic = t > 0
    t = jnp.where(elastic, t, 1)
    # Elastic contacts carry less than the H a of plastic ones.
    log_share = log_load(t, D, critical_pressure_ratio(material, k_mu)) - t
    return material.H * A_r * jnp.exp(jnp.where(elastic, log_share, 0))


def contact_load(surface: Surface, material: Material, A_r, *, mu_m) -> jax.Array:
    """Eqs. 26 to 28: the normal load P [N] at the real contact area A_r [m^2]; any one shape.

    The other way round than `contact_state`, whose A_r under this load is the one given.

    **Raises:** `ValueError` unless A_r > 0 and 0 <= mu_m <= 0.9.
    """
    _require_kinds(surface, material)
    A_r = number("A_r", A_r, above=0)
    return load_of_area(surface, material, A_r, number("mu_m", mu_m, at_least=0, at_most=MU_M_MAX))


class Contact(Part):
    """What gives a scene its contact stiffness."""

    fractal: ClassVar[bool]

    @abc.abstractmethod
    def stiffness(self, mu_s, mu_m) -> tuple[jax.Array, jax.Array]:
        """(K_n, K_t) [N/m] at the given static and smallest friction."""


class FractalContact(Contact):
    """Stiffness from the surface: Eqs. 21, 26, 30, 33 and 36 under the normal load P.

    With `stiffness_ratio` given, K_t = stiffness_ratio K_n and no tangential law is evaluated.

    **Raises:** `ValueError` unless P > 0 and stiffness_ratio >= 0.
    """

    surface: Surface
    material: Material
    P: jax.Array = quantity("N", "normal load")
    stiffness_ratio: jax.Array | None = quantity("-", "K_t/K_n, if not by the tangential law")

    fractal: ClassVar[bool] = True

    def __init__(self, surface, material, P, stiffness_ratio=None):
        _require_kinds(surface, material)
        self.surface = surface
        self.material = material
        self.P = number("P", P, above=0)
        self.stiffness_ratio = (
            None
            if stiffness_ratio is None
            else number("stiffness_ratio", stiffness_ratio, at_least=0)
        )

    def stiffness(self, mu_s, mu_m):
        joint = self._solve(mu_s, mu_m)
        return joint.K_n, joint.K_t

    def _solve(self, mu_s, mu_m):
        return _solve(self.surface, self.material, self.P, mu_s, mu_m, self.stiffness_ratio)

    @jax.jit
    def state(self, mu_s, mu_m) -> ContactState:
        """Everything about the joint; no Q_e and no slip where `stiffness_ratio` is given."""
        joint, D = self._solve(mu_s, mu_m), self.surface.D
        slips = False if joint.slip_ratio is None else joint.slip_ratio >= 1
        a_l = jnp.exp(joint.log_a_l)
        return ContactState(
            K_n=joint.K_n,
            K_t=joint.K_t,
            a_l=a_l,
            a_e=exp_or_inf(joint.log_a_e),
            A_r=(D - 1) / (3 - D) * a_l,
            Q_e=joint.Q_e,
            plastic_share=joint.plastic_share,
            log_area_ratio=joint.log_area_ratio,
            slip_ratio=joint.slip_ratio,
            regime=Regime.where(
                joint.log_area_ratio <= 0,
                Regime.fully_plastic,
                Regime.where(slips, Regime.gross_slip, Regime.elastic_plastic),
            ),
        )


class FixedContact(Contact):
    """A joint of known stiffness: no contact law is evaluated.

    **Raises:** `ValueError` unless K_n >= 0 and K_t >= 0.
    """

    K_n: jax.Array = quantity("N/m", "normal contact stiffness")
    K_t: jax.Array = quantity("N/m", "tangential contact stiffness")

    fractal: ClassVar[bool] = False

    def __init__(self, K_n, K_t):
        self.K_n = number("K_n", K_n, at_least=0)
        self.K_t = number("K_t", K_t, at_least=0)

    def stiffness(self, mu_s, mu_m):
        return self.K_n, self.K_t
