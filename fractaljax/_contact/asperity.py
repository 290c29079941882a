"""The revised asperity law: each asperity begins elastic and ends plastic, on a base of its own.

In the source's law (Majumdar and Bhushan's) a contact is as flat as its base allows, so that it
turns from plastic to elastic as it grows. Here the base differs from the part of it that is
pressed (Morag and Etsion, Wear 262, 624, 2007, doi:10.1016/j.wear.2006.07.007). A base whose
contact would be `a` if flattened elastically has the height delta(a) of Eq. 16 and the tip radius
R(a) = a/(pi delta) of Eq. 17. The bases that touch have the size distribution n(a) (Eq. 25), from
the shortest wavelength up, and their interferences omega are uniform from 0 to delta(a). With
omega_1 at first yield (Eq. 20) and y = omega/omega_1, an asperity carries the mean pressure p on
the area A

    y < 1         A = pi R omega        p = 1.1 k_mu sigma_y y^(1/2)
    1 < y < 54    A = pi R omega f(y)   p from 1.1 k_mu sigma_y to H as ln y
    54 < y        A = 2 pi R omega      p = H

f = 1 + 3 s^2 - 2 s^3, s = (y - 1)/53 (Zhao, Maietta and Chang, J. Tribol. 122, 86, 2000,
doi:10.1115/1.555332), and has the stiffness 2 E (A/pi)^(1/2) of a contact that unloads elastically.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Numbers, flag, number, quantity, require_kind
from .._base.singular import boxcox
from .._surface.surface import Surface
from .contact import Contact
from .fractal import critical_pressure_ratio, friction_correction, log_critical_area
from .material import Material, mindlin_ratio

_LOG_PLASTIC = math.log(54)  # ln y from which all is plastic


class Sums(eqx.Module):
    """Totals over all spots of a joint."""

    area: Numbers  # [m^2]
    load: Numbers  # [N]
    stiffness: Numbers  # [N/m]


@final
class AsperityContact(Contact, law="asperity"):
    """The revised asperity law: elastic, then elastic-plastic, then plastic asperities.

    The bases of the asperities follow the island law of the source down to the shortest wavelength
    L_s [m]; see the module. K_n > 0 at every load; it grows about as P at small loads and as
    P^((D-1)/(4-D)) above, D < 2.5; K_t = (2 - 2 nu)/(2 - nu) K_n (Mindlin), or `stiffness_ratio`
    K_n if that is given. With `domain_extension` the island law has Wang and Komvopoulos' factor
    psi(D) (J. Tribol. 116, 812, 1994); the source has psi = 1.

    Asperities do not interact and the law has no nominal area: it is 1.2 to 4 times as stiff as
    boundary elements where less than a third of the area touches, and has no limit of full
    contact. It has no load curve: K_n ~ P as the load vanishes, so that the joint would not
    open at a finite gap.

    **Raises:** `ValueError` unless P > 0, L_s > 0 and stiffness_ratio >= 0.
    """

    surface: Surface  # surface that is machined
    material: Material  # the pair as one material
    P: Numbers = quantity("N", "normal load", log=True)
    L_s: Numbers = quantity("m", "shortest wavelength of the surface", log=True)
    stiffness_ratio: Numbers | None = quantity("-", "K_t/K_n, if not Mindlin's")
    domain_extension: bool = eqx.field(
        default=False, static=True, metadata={"note": "psi(D), not 1"}
    )

    has_surface: ClassVar[bool] = True
    yields: ClassVar[bool] = True

    def __init__(
        self,
        surface: Surface,
        material: Material,
        P: ArrayLike,
        L_s: ArrayLike,
        stiffness_ratio: ArrayLike | None = None,
        domain_extension: bool = False,
    ):
        require_kind("surface", surface, Surface)
        require_kind("material", material, Material)
        self.surface, self.material = surface, material
        self.P, self.L_s = number("P", P, above=0), number("L_s", L_s, above=0)
        if stiffness_ratio is not None:
            stiffness_ratio = number("stiffness_ratio", stiffness_ratio, at_least=0)
        self.stiffness_ratio = stiffness_ratio
        self.domain_extension = flag("domain_extension", domain_extension)

    def stiffness(self, mu_s, mu_m):
        ratio = self.stiffness_ratio
        if ratio is None:
            ratio = mindlin_ratio(self.material.nu)
        K_n = self._solve(mu_m).stiffness
        return K_n, ratio * K_n

    def real_area(self, mu_m):
        return self._solve(mu_m).area

    def _solve(self, mu_m) -> Sums:
        """The sums over all spots under the load P."""
        D, E, H = self.surface.D, self.material.E, self.material.H
        k_mu = friction_correction(mu_m)
        log_a_s = math.log(math.pi / 8) + 2 * jnp.log(self.L_s)  # Eq. 16's base of L_s, flattened
        log_a_e = log_critical_area(self.surface, self.material, k_mu) - log_a_s
        beta = critical_pressure_ratio(self.material, k_mu)
        count = jnp.exp((3 - D) / 2 * log_domain_extension(D)) if self.domain_extension else 1.0
        # All in units of the smallest base, and of its load at the pressure H.
        a_s = jnp.exp(log_a_s)
        borders = [log_a_e - _LOG_PLASTIC / (D - 2), log_a_e]

        def spot(log_a):
            return mean_spot((D - 2) * (log_a_e - log_a), beta)

        def log_load(x):
            """ln load over x = ln(a_l - 1): nearly linear, with slopes from 1/2 to 1."""
            log_a_l = jnp.logaddexp(x, 0)
            sums = base_sums(log_a_l, D, borders, spot)
            return jnp.log(sums.load) + (D - 1) / 2 * log_a_l, (sums, log_a_l)

        target = jnp.log(self.P / (H * a_s * count))
        x = _root(lambda x: log_load(x)[0] - target, jnp.zeros_like(self.P))
        sums, log_a_l = log_load(x)[1]
        count *= jnp.exp((D - 1) / 2 * log_a_l)
        return Sums(
            area=count * a_s * sums.area,
            load=count * H * a_s * sums.load,
            stiffness=count * 2 * E * jnp.sqrt(a_s / math.pi) * sums.stiffness,
        )


def base_sums(
    log_a_l: Numbers,
    D: Numbers,
    borders: list[Numbers],
    spot: Callable[[Float[Array, " k"]], Sums],
) -> Sums:
    """The sums over all bases, areas in units of the smallest: integral of spot(ln a) n(a) da.

    It runs from a = 1 to the largest a_l, with n(a) of Eq. 25 over a_l^((D-1)/2). `spot` gives
    area, load and stiffness of a base over a, a and a^(1/2), smooth between the `borders` in ln a.
    """
    zero = jnp.zeros_like(log_a_l)
    ends = jnp.stack([zero, *(jnp.clip(x, zero, log_a_l) for x in borders), log_a_l])
    # 32 nodes in each piece give 12 digits (tested), as 24 do in `mean_spot`.
    node, weight = jnp.asarray(np.polynomial.legendre.leggauss(32), log_a_l.dtype)
    half = jnp.diff(ends) / 2
    log_a = (ends[:-1, None] + jnp.outer(half, node + 1)).ravel()
    steps, one = (D - 1) / 2 * jnp.outer(half, weight).ravel(), spot(log_a)
    # n(a) a da = n(a) a^2 dln a
    area, root = (steps * jnp.exp((p + (1 - D) / 2) * log_a) for p in (1, 0.5))
    return Sums(
        area=jnp.sum(area * one.area),
        load=jnp.sum(area * one.load),
        stiffness=jnp.sum(root * one.stiffness),
    )


def mean_spot(log_Y: Float[Array, " k"], beta: Numbers) -> Sums:
    """The mean spot of a base over its interferences: y from 0 to Y, at full flattening.

    Area, load and stiffness are over the base's a, H a and 2 E (a/pi)^(1/2); `beta` is the mean
    pressure at first yield over H.
    """
    node, weight = jnp.asarray(np.polynomial.legendre.leggauss(24), log_Y.dtype)
    half = jnp.clip(log_Y, 0, _LOG_PLASTIC) / 2
    t = jnp.outer(half, node + 1)  # ln y
    share = jnp.exp(t - jnp.maximum(log_Y, 0)[:, None])  # of the height of the base
    s = jnp.expm1(t) / math.expm1(_LOG_PLASTIC)
    growth = 1 + s**2 * (3 - 2 * s)
    pressure = 1 - (1 - beta) * (1 - t / _LOG_PLASTIC)
    steps = share * jnp.outer(half, weight)

    # Integrals of A, A p and A^(1/2) over the share: elastic, elastic-plastic, plastic.
    before, after = jnp.minimum(log_Y, 0), jnp.minimum(_LOG_PLASTIC - log_Y, 0)
    beyond = -jnp.expm1(2 * after)
    return Sums(
        area=jnp.exp(2 * (before - log_Y)) / 2 + jnp.sum(share * growth * steps, 1) + beyond,
        load=beta * jnp.exp(2.5 * before - 2 * log_Y) / 2.5
        + jnp.sum(share * growth * pressure * steps, 1)
        + beyond,
        stiffness=jnp.exp(1.5 * (before - log_Y)) / 1.5
        + jnp.sum(jnp.sqrt(share * growth) * steps, 1)
        - math.sqrt(2) * jnp.expm1(1.5 * after) / 1.5,
    )


def log_domain_extension(D: Numbers) -> Numbers:
    """ln psi from psi^((3-D)/2) - (1 + psi^(-(D-1)/2))^(-(3-D)/(D-1)) = (3-D)/(D-1).

    psi falls from (3 + 5^(1/2))/2 at D = 2 to e - 1 at D = 3.
    """

    def residual(x):
        rest = jnp.log1p(jnp.exp(-(D - 1) / 2 * x))
        return (D - 1) / 2 * boxcox(x, (3 - D) / 2) + boxcox(rest, -(3 - D) / (D - 1)) - 1

    return _root(residual, jnp.full_like(D, 0.75))


def _root(f: Callable[[Numbers], Numbers], start: Numbers) -> Numbers:
    """The root of an increasing function, with its implicit derivatives of every order."""

    def newton(f, start):
        def step(_, x):
            value, slope = jax.jvp(f, (x,), (jnp.ones_like(x),))
            return x - value / slope

        # Six steps reach the last digit over the whole domain (tested).
        return jax.lax.fori_loop(0, 6, step, start)

    solve: Any = jax.lax.custom_root
    return solve(f, start, newton, lambda g, y: y / g(jnp.ones_like(y)))
