"""Persson's contact law: a rough surface on an elastic half-space, over a nominal area.

With p the nominal pressure, m(q) the mean square height per ln q and g(q) the root mean square
gradient of all waves up to the wavenumber q, the mean gap u falls with the pressure as

    -du/dln p = 1/sqrt(2 pi) integral of m q/g [gamma_P + 3 (1 - gamma_P) erf^2(s)] e^(-s^2) dln q,
    s(q) = sqrt(2) p/(E g(q))

(Yang and Persson, J. Phys. Condens. Matter 20, 215214, 2008, doi:10.1088/0953-8984/20/21/215214,
with the integral over the pressure done; here times 1 + (A_r/A)^4/2, by which it falls short of
boundary elements towards full contact), and K_n = A dp/d(-u). A finite surface touches first at
its highest hills, which gives K_n ~ P^(1/(1+H)) at small loads, with the Hurst exponent H (Pastewka
et al., Phys. Rev. E 87, 062809, 2013, doi:10.1103/PhysRevE.87.062809). Its N cells of the roll-off
length have hills of unequal height: boundary elements show the stiffness of sqrt(N) equal cells.
"""

import math
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Numbers, number, quantity, require_kind
from .._base.singular import boxcox
from .._surface.roughness import root_mean_square, wavelengths_of
from .._surface.spectrum import Pieces, Spectrum
from .._surface.surface import Surface
from .contact import Contact, partial_slip
from .material import Material, mindlin_ratio

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


@final
class PerssonContact(Contact, law="persson"):
    """A rough surface on an elastic half-space: K_n by Persson's theory, K_t by Mindlin's ratio.

    K_n follows P^(1/(1+H)) at small loads, then P, then rises to full contact. K_t = (2 - 2 nu)/
    (2 - nu) K_n (Mindlin, J. Appl. Mech. 16, 259, 1949; for rough surfaces Campana, Persson and
    Mueser, J. Phys. Condens. Matter 23, 085001, 2011), or `stiffness_ratio` K_n if that is given.
    Under a tangential load Q the rim of each contact slips, and K_t is that of the load P - Q/mu_s
    (Ciavarella, J. Appl. Mech. 65, 998, 1998); 0 in gross slip, Q >= mu_s P. Nothing yields:
    sigma_y and H of the material play no role.

    Heights are taken as Gaussian. Within 35 % of boundary elements wherever less than half of the
    area touches, and within a factor of two up to nearly full contact. Too soft where the whole
    contact is smaller than the square of two shortest wavelengths, and a single smooth summit
    carries the load. Differentiable in all but L_s, since Eq. 13 has a whole number of waves.

    **Arguments:**

    - `surface`: a `Surface`, a `SelfAffine`, a `MeasuredSpectrum`, or a spectrum of one's own.
    - `material`: of the pair.
    - `P`: normal load [N].
    - `area`: nominal area of the joint [m^2]. Waves longer than its side are left out.
    - `L`, `L_s`: longest and shortest wavelength [m] of a `Surface`, as in `topography`; the other
      spectra have their own.
    - `stiffness_ratio`: K_t/K_n, by default Mindlin's.
    - `Q`: tangential load [N], if some contacts slip at their rims.

    **Raises:** `ValueError` unless P > 0, area > 0, 0 < L_s <= L, stiffness_ratio >= 0, Q >= 0, for
    a `Surface` without L and L_s, and for another spectrum with them.
    """

    surface: Spectrum = eqx.field(metadata={"law": "fractal"})  # the usual one in files
    material: Material
    P: Numbers = quantity("N", "normal load", log=True)
    area: Numbers = quantity("m^2", "nominal area of the joint", log=True)
    L: Numbers | None = quantity("m", "longest wavelength of a fractal surface", log=True)
    L_s: Numbers | None = quantity("m", "shortest wavelength of a fractal surface", log=True)
    stiffness_ratio: Numbers | None = quantity("-", "K_t/K_n, if not Mindlin's")
    Q: Numbers | None = quantity("N", "tangential load, if some contacts slip at their rims")

    def __init__(
        self,
        surface: Spectrum,
        material: Material,
        P: ArrayLike,
        area: ArrayLike,
        L: ArrayLike | None = None,
        L_s: ArrayLike | None = None,
        stiffness_ratio: ArrayLike | None = None,
        Q: ArrayLike | None = None,
    ):
        require_kind("surface", surface, Spectrum)
        require_kind("material", material, Material)
        self.surface, self.material = surface, material
        self.P, self.area = number("P", P, above=0), number("area", area, above=0)
        self.L, self.L_s = wavelengths_of(surface, L, L_s)
        if stiffness_ratio is not None:
            stiffness_ratio = number("stiffness_ratio", stiffness_ratio, at_least=0)
        self.stiffness_ratio = stiffness_ratio
        self.Q = None if Q is None else number("Q", Q, at_least=0)

    @property
    def has_surface(self) -> bool:
        return isinstance(self.surface, Surface)

    @property
    def depends_on_friction(self) -> bool:
        return self.Q is not None

    @property
    def opening_exponent(self):
        """1/(1 + H): the finite-size law."""
        return 1 / (1 + self._cells()[1])

    def stiffness(self, mu_s, mu_m):
        ratio, K_n = self.stiffness_ratio, self._stiffness(self.P)
        if ratio is None:
            ratio = mindlin_ratio(self.material.nu)
        if self.Q is None:
            return K_n, ratio * K_n
        return K_n, ratio * partial_slip(self._stiffness, self.P, self.Q, mu_s)

    def real_area(self, mu_m):
        """erf(sqrt(2) p/(E Sdq)) of the nominal area (Persson, J. Chem. Phys. 115, 3840, 2001)."""
        return self.area * erf(self._strain(self.P, self._pieces()))

    def mean_gap(self) -> Float[Array, ""]:
        """Mean distance of the two surfaces [m]: the integral of dP/K_n up to full contact."""
        pieces = self._pieces()
        # Up to full contact; beyond it an e-fold, which adds nothing.
        end = jnp.maximum(math.sqrt(_NEGLIGIBLE) / self._strain(self.P, pieces), math.e)
        node, weight = jnp.asarray(_NODES, self.P.dtype)
        loads = self.P * end ** ((node + 1) / 2)
        compliance = jax.vmap(lambda P: self._compliance(P, pieces))(loads)
        return jnp.sum(loads * compliance * weight) / 2 * jnp.log(end)

    def _longest(self):
        """The longest wavelength that the nominal area has room for [m]."""
        side = jnp.sqrt(self.area)
        if self.L is None or self.L_s is None:
            return side
        return jnp.maximum(jnp.minimum(self.L, side), self.L_s)

    def _pieces(self) -> Pieces:
        if isinstance(self.surface, Surface):
            return self.surface.between(self._longest(), self.L_s)
        return self.surface.pieces(self._longest())

    def _cells(self):
        """The side [m] of the cells whose hills touch first, their H, and the surface's Sq [m]."""
        longest = self._longest()
        if isinstance(self.surface, Surface):
            Sq = root_mean_square(self.surface, longest, self.L_s)
            return longest, 3 - self.surface.D, Sq
        side, H = self.surface.roll_off()
        return jnp.minimum(side, longest), H, jnp.sqrt(self.surface.moments()[0])

    def _strain(self, P, pieces: Pieces):
        """sqrt(2) p/(E Sdq)."""
        gradient = jnp.sqrt(pieces.moment(2))
        strain = math.sqrt(2) * P / (self.area * self.material.E * gradient)
        return jnp.maximum(strain, jnp.finfo(strain.dtype).tiny ** 0.25)

    def _stiffness(self, P):
        """K_n [N/m] under the load P, no stiffer than one layer of atoms of the bulk."""
        return 1 / (self._compliance(P, self._pieces()) + _LAYER / (self.material.E * self.area))

    def _compliance(self, P, pieces: Pieces):
        """1/K_n [m/N] under the load P."""
        E, A = self.material.E, self.area
        strain = self._strain(P, pieces)
        middle = self._waves(strain, pieces) / (math.sqrt(2 * math.pi) * P)
        middle *= 1 + _CLOSING * erf(strain) ** 4
        middle += jnp.finfo(middle.dtype).tiny  # at full contact its powers have derivatives too
        side, H, Sq = self._cells()
        cells = jnp.sqrt(A) / side  # the square root of as many as the area holds
        share = (P / (cells * E * Sq * side)) ** (1 / (1 + H))
        finite = _FINITE_SIZE * jnp.exp(_FINITE_SIZE_D * (0.5 - H)) * cells * E * side * share
        return middle / (1 + (middle * finite) ** _JOIN) ** (1 / _JOIN)

    def _waves(self, strain, pieces: Pieces):
        """The integral of m q/g [...] e^(-s^2) over ln q [m]; `strain` is s at the last wave.

        In ln x, x = ln(q/q_low), from where the exponential is negligible against that at the end.
        """
        density = pieces.m * pieces.q[:-1] ** 2  # mean square gradient per ln q at the lower edges
        gradients = density * boxcox(pieces.widths, pieces.r)
        total = jnp.sum(gradients)
        earlier = np.tri(len(pieces.m), k=-1, dtype=bool)
        below = jnp.sum(jnp.where(earlier, gradients[None], 0), axis=1)
        # Where e^-s^2 is so small: x - x_i = ln(1 + r y)/r, at least that with a small r > 0.
        first = strain**2 / (_NEGLIGIBLE + strain**2) * total
        y, r = jnp.clip(first - below, 0, gradients) / density, jnp.maximum(pieces.r, 1e-3)
        edges = jnp.log(pieces.q / pieces.q[0])
        tiny = jnp.finfo(total.dtype).tiny
        low = jnp.log(jnp.maximum(edges[:-1] + jnp.log1p(r * y) / r, tiny))
        spans = jnp.log(jnp.maximum(edges[1:], tiny)) - low

        def integral(some: slice, count: int):
            node, weight = (
                jnp.asarray(x, total.dtype)[None] for x in np.polynomial.legendre.leggauss(count)
            )
            span, start, r = (x[some, None] for x in (spans, edges[:-1], pieces.r))
            at = jnp.exp(low[some, None] + (node + 1) / 2 * span)
            x = jnp.maximum(at - start, 0)
            g2 = below[some, None] + density[some, None] * boxcox(x, r)
            g2 = jnp.maximum(g2, first / 2)  # at the left of pieces without a width
            s = strain * jnp.sqrt(total / g2)
            kernel = (_GAMMA_P + 3 * (1 - _GAMMA_P) * erf(s) ** 2) * jnp.exp(-(s**2))
            mq = (pieces.m * pieces.q[:-1])[some, None] * jnp.exp((r - 1) * x)
            return jnp.sum(mq / jnp.sqrt(g2) * kernel * at * weight * span) / 2

        count = len(pieces.m)
        waves = integral(slice(0, 1), 64)
        return waves if count == 1 else waves + integral(slice(1, None), 64 if count == 2 else 16)
