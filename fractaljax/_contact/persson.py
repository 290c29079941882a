"""Persson's contact law: a rough surface on an elastic half-space, over a nominal area.

With p the nominal pressure, m(q) the mean square height per ln q and g(q) the root mean square
gradient of all waves up to the wavenumber q, the mean gap u falls with the pressure as

    -du/dln p = 1/sqrt(2 pi) integral of m q/g [gamma_P + 3 (1 - gamma_P) erf^2(s)] e^(-s^2) dln q,
    s(q) = sqrt(2) p/(E g(q))

(Yang and Persson, J. Phys. Condens. Matter 20, 215214, 2008, doi:10.1088/0953-8984/20/21/215214,
with the integral over the pressure done; here times 1 + (A_r/A)^4/2, by which it falls short of
boundary elements towards full contact), and K_n = A dp/d(-u). A finite surface touches first at
its highest hills, which gives K_n ~ P^(1/(1+H)), H = 3 - D, at small loads (Pastewka et al., Phys.
Rev. E 87, 062809, 2013, doi:10.1103/PhysRevE.87.062809).
"""

import math
from typing import ClassVar, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Numbers, number, ordered, quantity, require_kind
from .._base.singular import boxcox
from .._surface.roughness import root_mean_square_height
from .._surface.surface import Surface, frequency_count
from .contact import Contact, partial_slip
from .material import Material

# Factors of the elastic energy in the middle range and of the finite-size law, the exponent that
# joins the two, and the correction towards full contact: fitted to boundary elements, D = 2.1 to
# 2.9 (tested).
_GAMMA_P = 0.45
_FINITE_SIZE, _FINITE_SIZE_D = 1.05, 1.24
_JOIN = 2.4
_CLOSING = 0.5

_LAYER = 3e-10  # m: no joint is stiffer than one layer of atoms of its own bulk
_NODES = np.polynomial.legendre.leggauss(64)
_NEGLIGIBLE = 40.0  # e^-40 is below rounding


def mindlin_ratio(nu: Numbers) -> Numbers:
    """K_t/K_n = (2 - 2 nu)/(2 - nu) of a contact without slip."""
    return (2 - 2 * nu) / (2 - nu)


class _Band(NamedTuple):
    """The surface's waves as a power law of ln q over a band x = ln(q/q_low), 0 to `width`."""

    L: Numbers  # longest wavelength that the nominal area has room for [m]
    q: Numbers  # the smallest wavenumber [rad/m]
    m: Numbers  # mean square height per ln q there [m^2]; it falls as e^((r - 2) x)
    width: Numbers
    r: Numbers  # the mean square gradient up to x is q^2 m (e^(r x) - 1)/r


@final
class PerssonContact(Contact):
    """A rough surface on an elastic half-space: K_n by Persson's theory, K_t by Mindlin's ratio.

    `area` is the nominal area of the joint [m^2]; wavelengths run from L down to L_s [m], as in
    `topography`, and none is longer than the side of the area. K_n follows P^(1/(1+H)) at
    small loads, then P, then rises to full contact. K_t = (2 - 2 nu)/(2 - nu) K_n (Mindlin, J.
    Appl. Mech. 16, 259, 1949; for rough surfaces Campana, Persson and Mueser, J. Phys. Condens.
    Matter 23, 085001, 2011), or `stiffness_ratio` K_n if that is given. Under a tangential load Q
    the rim of each contact slips, and K_t is that of the load P - Q/mu_s (Ciavarella, J. Appl.
    Mech. 65, 998, 1998); 0 in gross slip, Q >= mu_s P. Nothing yields: sigma_y and H play no role.

    Within 35 % of boundary elements wherever less than half of the area touches, and within a
    factor of two up to nearly full contact. Too soft where the whole contact is smaller than
    2 L_s^2, and a single smooth summit carries the load. Differentiable in everything but L_s,
    since Eq. 13 has a whole number of waves.

    **Raises:** `ValueError` unless P > 0, area > 0, 0 < L_s <= L, stiffness_ratio >= 0, Q >= 0.
    """

    surface: Surface
    material: Material
    P: Numbers = quantity("N", "normal load", log=True)
    area: Numbers = quantity("m^2", "nominal area of the joint", log=True)
    L: Numbers = quantity("m", "longest wavelength of the surface", log=True)
    L_s: Numbers = quantity("m", "shortest wavelength of the surface", log=True)
    stiffness_ratio: Numbers | None = quantity("-", "K_t/K_n, if not Mindlin's")
    Q: Numbers | None = quantity("N", "tangential load, if some contacts slip at their rims")

    has_surface: ClassVar[bool] = True

    def __init__(
        self,
        surface: Surface,
        material: Material,
        P: ArrayLike,
        area: ArrayLike,
        L: ArrayLike,
        L_s: ArrayLike,
        stiffness_ratio: ArrayLike | None = None,
        Q: ArrayLike | None = None,
    ):
        require_kind("surface", surface, Surface)
        require_kind("material", material, Material)
        self.surface, self.material = surface, material
        self.P, self.area = number("P", P, above=0), number("area", area, above=0)
        self.L_s = number("L_s", L_s, above=0)
        self.L = ordered("L", number("L", L, above=0), "L_s", self.L_s)
        if stiffness_ratio is not None:
            stiffness_ratio = number("stiffness_ratio", stiffness_ratio, at_least=0)
        self.stiffness_ratio = stiffness_ratio
        self.Q = None if Q is None else number("Q", Q, at_least=0)

    @property
    def depends_on_friction(self) -> bool:
        return self.Q is not None

    @property
    def opening_exponent(self):
        """1/(1 + H), H = 3 - D: the finite-size law."""
        return 1 / (4 - self.surface.D)

    def stiffness(self, mu_s, mu_m):
        ratio, K_n = self.stiffness_ratio, self._stiffness(self.P)
        if ratio is None:
            ratio = mindlin_ratio(self.material.nu)
        if self.Q is None:
            return K_n, ratio * K_n
        return K_n, ratio * partial_slip(self._stiffness, self.P, self.Q, mu_s)

    def real_area(self, mu_m):
        """erf(sqrt(2) p/(E Sdq)) of the nominal area (Persson, J. Chem. Phys. 115, 3840, 2001)."""
        band = self._band()
        s = self._strain(self.P, band) / jnp.sqrt(boxcox(band.width, band.r))
        return self.area * erf(s)

    def mean_gap(self) -> Float[Array, ""]:
        """Mean distance of the two surfaces [m]: the integral of dP/K_n up to full contact."""
        band = self._band()
        s = self._strain(self.P, band) / jnp.sqrt(boxcox(band.width, band.r))
        # Up to full contact; beyond it an e-fold, which adds nothing.
        end = jnp.maximum(math.sqrt(_NEGLIGIBLE) / s, math.e)
        node, weight = jnp.asarray(_NODES, self.P.dtype)
        loads = self.P * end ** ((node + 1) / 2)
        compliance = jax.vmap(lambda P: self._compliance(P, band))(loads)
        return jnp.sum(loads * compliance * weight) / 2 * jnp.log(end)

    def _band(self) -> _Band:
        """The band of Eq. 13's waves, with half a step of gamma beyond the first and the last."""
        D, G, log_gamma = self.surface.D, self.surface.G, jnp.log(self.surface.gamma)
        L = jnp.maximum(jnp.minimum(self.L, jnp.sqrt(self.area)), self.L_s)
        half_step = jnp.exp(log_gamma / 2)
        m = (L * (G / L) ** (D - 2)) ** 2 / 2 * half_step ** (2 * (3 - D))
        width = frequency_count(self.surface.gamma, L / self.L_s) * log_gamma
        return _Band(L, 2 * math.pi / (L * half_step), m, width, 2 * (D - 2))

    def _strain(self, P, band):
        """sqrt(2) p/E over the gradient of the longest waves: s at (e^(r x) - 1)/r = 1."""
        strain = math.sqrt(2) * P / (self.area * self.material.E * band.q * jnp.sqrt(band.m))
        return jnp.maximum(strain, jnp.finfo(strain.dtype).tiny ** 0.25)

    def _stiffness(self, P):
        """K_n [N/m] under the load P, no stiffer than one layer of atoms of the bulk."""
        return 1 / (self._compliance(P, self._band()) + _LAYER / (self.material.E * self.area))

    def _compliance(self, P, band: _Band):
        """1/K_n [m/N] under the load P."""
        E, A, D, r = self.material.E, self.area, self.surface.D, band.r
        strain = self._strain(P, band) ** 2
        # In ln x, from where the exponential is negligible against its value at the end.
        last = strain / boxcox(band.width, r)
        first = strain / (_NEGLIGIBLE + last)
        low = jnp.log(jnp.log1p(r * first) / r)
        span = jnp.log(band.width) - low
        node, weight = jnp.asarray(_NODES, D.dtype)
        x = jnp.exp(low + (node + 1) / 2 * span)
        gradient = boxcox(x, r)
        s = jnp.sqrt(strain / gradient)
        kernel = (_GAMMA_P + 3 * (1 - _GAMMA_P) * erf(s) ** 2) * jnp.exp(-(s**2))
        waves = jnp.exp((r - 1) * x) / jnp.sqrt(gradient) * x * weight * span / 2
        middle = jnp.sqrt(band.m / (2 * math.pi)) * jnp.sum(waves * kernel) / P
        middle *= 1 + _CLOSING * erf(jnp.sqrt(last)) ** 4
        middle += jnp.finfo(D.dtype).tiny  # at full contact its powers have derivatives too
        # As many surfaces of side L as the area holds, each with its own highest hill.
        cells, Sq = A / band.L**2, root_mean_square_height(self.surface, band.L, self.L_s)
        share = (P / (cells * E * Sq * band.L)) ** (1 / (4 - D))
        finite = _FINITE_SIZE * jnp.exp(_FINITE_SIZE_D * (D - 2.5)) * cells * E * band.L * share
        return middle / (1 + (middle * finite) ** _JOIN) ** (1 / _JOIN)
