"""The fractal contact law: from a surface under load to the stiffness of the joint.

Equation numbers are those of the source paper. Areas are kept as logarithms, since a_e spans
hundreds of decades as D -> 2. Every integral over the elastic contacts is one function,
`area_moment`. The equations take any shape.
"""

from typing import ClassVar, NamedTuple, final

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import Numbers, number, ordered, quantity, require_kind, require_scalar, scalar
from .._base.singular import boxcox, exp_or_inf, positive_cbrt
from .._surface.surface import Surface
from .contact import MU_M_MAX, Contact, ContactState, Regime
from .load_balance import elastic_to_plastic_load, log_area_ratio, log_load
from .material import Material


def friction_correction(mu_m: Numbers) -> Numbers:
    """Eq. 19: k_mu, by which friction lowers the pressure at yield, for 0 <= mu_m <= 0.9.

    As printed, with its step of 4e-4 at mu_m = 0.3.
    """
    return jnp.where(mu_m <= 0.3, 1 - 0.228 * mu_m, 0.932 * jnp.exp(-1.58 * (mu_m - 0.3)))


def log_critical_area(surface: Surface, material: Material, k_mu: Numbers) -> Numbers:
    """Eq. 21: ln a_e [a_e in m^2], the contact area above which an asperity is elastic."""
    D, phi = surface.D, material.sigma_y / material.E
    return (
        2 * jnp.log(33 * k_mu * phi / 40)
        + (3 * D - 11) * jnp.log(2.0)
        + (4 - D) * jnp.log(jnp.pi)
        - jnp.log(jnp.log(surface.gamma))
    ) / (2 - D) + 2 * jnp.log(surface.G)


def critical_pressure_ratio(material: Material, k_mu: Numbers) -> Numbers:
    """Eqs. 18 and 24 at a = a_e: P_e(a_e)/(H a_e) = 1.1 k_mu sigma_y/H, for every D and G."""
    return 1.1 * k_mu * material.sigma_y / material.H


def area_moment(p: float, D: Numbers, log_a_e: Numbers, t: Numbers) -> Numbers:
    """J(p) = integral of a^p n(a) da over the elastic contacts [a_e, a_l] (Eq. 25) [m^(2p)].

    (D-1)/2 a_l^((D-1)/2) (a_l^r - a_e^r)/r with r = p + (1-D)/2. With t = ln(a_l/a_e) this is
    (D-1)/2 a_l^p (1 - e^(-rt))/r, in which no power of a_e alone can overflow. Exactly 0 for
    t <= 0, where nothing is elastic.
    """
    elastic = ~(t <= 0)  # NaN stays NaN
    # Deep in the plastic regime a_e overflows: the unused branch must not see it.
    log_a_e, t = jnp.where(elastic, log_a_e, 0), jnp.where(elastic, t, 1)
    r = p + (1 - D) / 2
    moment = (D - 1) / 2 * jnp.exp(p * (log_a_e + t)) * boxcox(t, -r)
    return jnp.where(elastic, moment, 0)


def normal_stiffness(D: Numbers, E: Numbers | float, J_half: Numbers) -> Numbers:
    """Eq. 30: K_n = 4 E (4-D)/(3 pi^(1/2) (3-D)) J(1/2) [N/m]."""
    return 4 * E * (4 - D) / (3 * jnp.sqrt(jnp.pi) * (3 - D)) * J_half


def tangential_load(J_1: Numbers, elastic_load: Numbers, material: Material) -> Numbers:
    """Eq. 33: Q_e = 8/(pi (6-3 nu)) [sigma_y J(1) + (2 nu - 1) P_elastic] [N] (34 at D = 2.5)."""
    nu, sigma_y = material.nu, material.sigma_y
    return 8 / (jnp.pi * (6 - 3 * nu)) * (sigma_y * J_1 + (2 * nu - 1) * elastic_load)


def tangential_stiffness(E, nu, slip_ratio: Numbers, J_half: Numbers) -> Numbers:
    """Eq. 36: K_t = 8 Gbar/((2-nu) pi^(1/2)) (1 - Q_e/(mu P))^(1/3) J(1/2), Gbar = E/(2(1+nu))."""
    shear_modulus = E / (2 * (1 + nu))
    factor = 8 * shear_modulus / ((2 - nu) * jnp.sqrt(jnp.pi))
    return factor * positive_cbrt(1 - slip_ratio) * J_half


class _LoadBalance(NamedTuple):
    """The solution of the load balance, and the stiffness that follows from it."""

    log_a_l: Numbers
    log_a_e: Numbers
    log_area_ratio: Numbers
    plastic_share: Numbers
    K_n: Numbers
    K_t: Numbers
    Q_e: Numbers | None
    slip_ratio: Numbers | None


@final
class FractalContact(Contact, law="fractal"):
    """Stiffness from the surface: Eqs. 21, 26, 30, 33 and 36 under the normal load P.

    If `stiffness_ratio` is given, K_t = stiffness_ratio K_n and no tangential law is evaluated.

    **Raises:** `ValueError` unless P > 0 and stiffness_ratio >= 0.
    """

    surface: Surface  # surface that is machined
    material: Material  # the pair as one material
    P: Numbers = quantity("N", "normal load", log=True)
    stiffness_ratio: Numbers | None = quantity("-", "K_t/K_n, if not by the tangential law")

    has_surface: ClassVar[bool] = True
    fractal: ClassVar[bool] = True
    yields: ClassVar[bool] = True

    def __init__(
        self,
        surface: Surface,
        material: Material,
        P: ArrayLike,
        stiffness_ratio: ArrayLike | None = None,
    ):
        require_kind("surface", surface, Surface)
        require_kind("material", material, Material)
        self.surface = surface
        self.material = material
        self.P = number("P", P, above=0)
        if stiffness_ratio is not None:
            stiffness_ratio = number("stiffness_ratio", stiffness_ratio, at_least=0)
        self.stiffness_ratio = stiffness_ratio

    def stiffness(self, mu_s, mu_m):
        balance = self._solve(mu_s, mu_m)
        return balance.K_n, balance.K_t

    def real_area(self, mu_m):
        """Real contact area A_r [m^2] of Eq. 28 at the smallest friction coefficient `mu_m`."""
        # The static friction bounds the tangential load only.
        return self.state(jnp.ones_like(self.P), mu_m).A_r

    @jax.jit
    def state(self, mu_s: ScalarLike, mu_m: ScalarLike) -> ContactState:
        """The whole state of the joint; Q_e and slip_ratio are None if `stiffness_ratio` is given.

        **Arguments:**

        - `mu_s`, `mu_m`: static and smallest friction coefficient, scalars.
        """
        balance, D = self._solve(mu_s, mu_m), self.surface.D
        a_l, slip_ratio = jnp.exp(balance.log_a_l), balance.slip_ratio
        regime = Regime.elastic_plastic
        if slip_ratio is not None:
            regime = Regime.where(slip_ratio >= 1, Regime.gross_slip, regime)
        return ContactState(
            K_n=balance.K_n,
            K_t=balance.K_t,
            a_l=a_l,
            a_e=exp_or_inf(balance.log_a_e),
            A_r=(D - 1) / (3 - D) * a_l,
            Q_e=balance.Q_e,
            plastic_share=balance.plastic_share,
            log_area_ratio=balance.log_area_ratio,
            slip_ratio=slip_ratio,
            regime=Regime.where(balance.log_area_ratio <= 0, Regime.fully_plastic, regime),
        )

    def _solve(self, mu_s, mu_m) -> _LoadBalance:
        D, P, material = self.surface.D, self.P, self.material
        k_mu = friction_correction(mu_m)
        beta = critical_pressure_ratio(material, k_mu)
        log_a_e = log_critical_area(self.surface, material, k_mu)
        # Eqs. 23 and 25: the a_l that carries the load if every contact is plastic.
        log_a_plastic = jnp.log(P) - jnp.log(material.H) + jnp.log((3 - D) / (D - 1))
        s = log_a_plastic - log_a_e
        t = log_area_ratio(s, D, beta)
        ratio = elastic_to_plastic_load(jnp.maximum(t, 0), D, beta)
        plastic_share = 1 / (1 + ratio)
        J_half = area_moment(0.5, D, log_a_e, t)
        K_n = normal_stiffness(D, material.E, J_half)
        Q_e = slip_ratio = None
        if self.stiffness_ratio is None:
            J_1 = area_moment(1.0, D, log_a_e, t)
            Q_e = tangential_load(J_1, ratio * plastic_share * P, material)
            slip_ratio = Q_e / (mu_s * P)
            K_t = tangential_stiffness(material.E, material.nu, slip_ratio, J_half)
        else:
            K_t = self.stiffness_ratio * K_n
        log_a_l = log_a_plastic + (t - s)
        return _LoadBalance(log_a_l, log_a_e, t, plastic_share, K_n, K_t, Q_e, slip_ratio)


def contact_state(
    surface: Surface, material: Material, P: ScalarLike, *, mu_s: ScalarLike, mu_m: ScalarLike
) -> ContactState:
    """The joint of `surface` and `material` under a normal load: Eqs. 21, 26, 28, 30, 33 and 36.

    **Arguments:**

    - `surface`, `material`: those of the joint; scalars, `jax.vmap` takes many.
    - `P`: normal load [N].
    - `mu_s`: static friction coefficient, which bounds the tangential load (Eq. 35).
    - `mu_m`: smallest friction coefficient, which lowers the pressure at yield (Eq. 19).

    **Returns:** a `ContactState`.

    **Raises:** `ValueError` unless P > 0, mu_s > 0, 0 <= mu_m <= 0.9 and mu_m <= mu_s, and for
    arrays: use `jax.vmap`.
    """
    mu_m = scalar("mu_m", mu_m, at_least=0, at_most=MU_M_MAX)
    mu_s = ordered("mu_s", scalar("mu_s", mu_s, above=0), "mu_m", mu_m)
    contact = FractalContact(surface, material, P)
    require_scalar(contact)
    return contact.state(mu_s, mu_m)


def contact_load(
    surface: Surface, material: Material, A_r: ArrayLike, *, mu_m: ArrayLike
) -> Float[Array, "..."]:
    """Eqs. 26 to 28: the normal load P [N] at a real contact area.

    The inverse of `contact_state`, whose A_r under this load is the given one.

    **Arguments**, of any shapes that broadcast:

    - `surface`, `material`: those of the joint.
    - `A_r`: real contact area [m^2].
    - `mu_m`: smallest friction coefficient, which lowers the pressure at yield (Eq. 19).

    **Raises:** `ValueError` unless A_r > 0 and 0 <= mu_m <= 0.9.
    """
    require_kind("surface", surface, Surface)
    require_kind("material", material, Material)
    A_r = number("A_r", A_r, above=0)
    D, k_mu = surface.D, friction_correction(number("mu_m", mu_m, at_least=0, at_most=MU_M_MAX))
    log_a_e = log_critical_area(surface, material, k_mu)
    t = jnp.log((3 - D) / (D - 1) * A_r) - log_a_e
    elastic = ~(t <= 0)  # NaN stays NaN
    t = jnp.where(elastic, t, 1)
    # Over the load H A_r of an all-plastic joint with the same area.
    log_share = log_load(t, D, critical_pressure_ratio(material, k_mu)) - t
    return material.H * A_r * jnp.exp(jnp.where(elastic, log_share, 0))
