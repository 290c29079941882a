"""Roughness parameters of Gaussian heights, from their spectrum behind the filters.

With m(q) the mean square height per ln q and T the transmission of both filters, the filtered
moments of a profile in a random direction are

    m_2k = int m(q) <(q cos a)^2k T(q cos a)^2> dln q,

the mean over the angle a between the profile and a wave; those of a map are
int m(q) q^2k T(q)^2 dln q.
"""

import functools
import math
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from .._base.parts import Numbers, ordered, require_scalar, scalar, whole
from .drawing_parameters import ArealParameters, ProfileParameters
from .gaussian_filter import low_pass_transmission
from .roughness import wavelengths_of
from .spectrum import Pieces, Spectrum
from .surface import Surface


def spectral_profile_parameters(
    surface: Spectrum, cutoff, shortest, L, L_s, sections: int | None
) -> ProfileParameters:
    """Expected `profile_parameters` of a surface; without a cutoff its extremes are NaN.

    **Raises:** `ValueError` unless 0 < shortest <= cutoff, and as `wavelengths_of`.
    """
    sections = 5 if sections is None else whole("sections", sections, 1)
    return _profile(*_check_spectrum(surface, cutoff, shortest, L, L_s), sections=sections)


def spectral_areal_parameters(surface: Spectrum, cutoff, shortest, L, L_s) -> ArealParameters:
    """Expected `areal_parameters` of a surface; extremes and correlation lengths are NaN.

    **Raises:** `ValueError` unless 0 < shortest <= cutoff, and as `wavelengths_of`.
    """
    return _areal(*_check_spectrum(surface, cutoff, shortest, L, L_s))


def refuse_grid(*steps: ArrayLike | None) -> None:
    """Refuse grid steps beside a spectrum."""
    if any(step is not None for step in steps):
        raise ValueError("dx is for heights; a spectrum has no grid")


def require_step(dx: ArrayLike | None, L: ArrayLike | None, L_s: ArrayLike | None) -> ArrayLike:
    """The grid step dx of heights, which have no wavelengths L and L_s of a surface."""
    if L is not None or L_s is not None:
        raise ValueError("L and L_s are for a Surface; heights have wavelengths of their own")
    if dx is None:
        raise TypeError("heights need dx, the distance of their points in m")
    return dx


def _check_spectrum(surface, cutoff, shortest, L, L_s):
    L, L_s = wavelengths_of(surface, L, L_s)
    require_scalar(surface)
    if L is not None and L_s is not None:
        L, L_s = scalar("L", L), scalar("L_s", L_s)
    if shortest is not None:
        shortest = scalar("shortest", shortest, above=0)
    if cutoff is not None:
        cutoff = scalar("cutoff", cutoff, above=0)
        if shortest is not None:
            cutoff = ordered("cutoff", cutoff, "shortest", shortest)
    return surface, cutoff, shortest, L, L_s


@functools.partial(jax.jit, static_argnames="sections")
def _profile(surface, cutoff, shortest, L, L_s, sections):
    q, heights = _waves(surface, L, L_s)
    cosines, weights = _directions()
    along = q[:, None] * jnp.asarray(cosines)[None]
    share = heights[:, None] * jnp.asarray(weights)[None]
    share = share * roughness_transmission(along, cutoff, shortest) ** 2
    section = jnp.nan if cutoff is None else cutoff
    m0, m2 = jnp.sum(share), jnp.sum(share * along**2)
    return gaussian_profile_parameters(m0, m2, section, sections)


@jax.jit
def _areal(surface, cutoff, shortest, L, L_s):
    q, heights = _waves(surface, L, L_s)
    heights = heights * roughness_transmission(q, cutoff, shortest) ** 2
    Sq, gradients = jnp.sqrt(jnp.sum(heights)), jnp.sum(heights * q**2)
    core, peaks, first = _gaussian_material_ratio()
    same = jnp.ones_like(Sq)
    # Not NaN by a product with Sq, whose derivatives would be NaN too.
    unknown = jnp.full_like(Sq, jnp.nan)
    return ArealParameters(
        Sa=math.sqrt(2 / math.pi) * Sq,
        Sq=Sq,
        Sz=unknown,
        Sp=unknown,
        Sv=unknown,
        Ssk=0 * same,
        Sku=3 * same,
        Sdq=jnp.sqrt(gradients),
        Sdr=50 * gradients,
        Sal=unknown,
        Str=unknown,
        Sk=core * Sq,
        Spk=peaks * Sq,
        Svk=peaks * Sq,
        Smr1=100 * first * same,
        Smr2=100 * (1 - first) * same,
    )


def _waves(surface: Spectrum, L, L_s) -> tuple[Numbers, Numbers]:
    """Wavenumbers (n,) [rad/m] of a quadrature over ln q, and the mean square height of each."""
    if isinstance(surface, Surface):
        pieces: Pieces = surface.between(L, L_s)
    else:
        pieces = surface.pieces(count=128)
    # The filters are smooth over less than a unit of ln q, and one piece may be 20 wide.
    node, weight = np.polynomial.legendre.leggauss(max(6, 256 // len(pieces.m)))
    x = pieces.widths[:, None] * jnp.asarray((node + 1) / 2)[None]
    q = pieces.q[:-1, None] * jnp.exp(x)
    heights = pieces.m[:, None] * jnp.exp((pieces.r - 2)[:, None] * x)
    heights = heights * pieces.widths[:, None] * jnp.asarray(weight / 2)[None]
    return q.ravel(), heights.ravel()


def _directions() -> tuple[np.ndarray, np.ndarray]:
    """Cosines of angles of a quarter turn, and their weights in a mean.

    Dense near right angles, where the short waves are long along the profile: the distance from
    the right angle is u^4 pi/2 at the Gauss nodes u of 0 to 1.
    """
    node, weight = np.polynomial.legendre.leggauss(48)
    u = (node + 1) / 2
    return np.sin(math.pi / 2 * u**4), 2 * u**3 * weight


def roughness_transmission(
    q: ArrayLike, cutoff: ArrayLike | None = None, shortest: ArrayLike | None = None
) -> Numbers:
    """Share of the amplitude of a wave of wavenumber q [rad/m] that the Gaussian filters leave.

    [1 - 2^-(lambda_c f)^2] 2^-(lambda_s f)^2 with f = q/(2 pi), of the shape of q; a filter that is
    None passes all.
    """
    frequency = jnp.asarray(q, float) / (2 * jnp.pi)
    share = jnp.ones_like(frequency)
    if shortest is not None:
        share = low_pass_transmission(frequency, shortest)
    if cutoff is not None:
        # 1 - 2^-x, exact for long waves too.
        share = -jnp.expm1(-math.log(2) * (jnp.asarray(cutoff) * frequency) ** 2) * share
    return share


def gaussian_profile_parameters(
    m0: ArrayLike, m2: ArrayLike, cutoff: ArrayLike, sections: int = 5
) -> ProfileParameters:
    """Expected roughness parameters of a profile with Gaussian heights; any shape.

    m0 [m^2] and m2 are the filtered mean squares of heights and slopes, and `cutoff` [m] is the
    length of a section. Extremes are those of independent maxima, as many as upward crossings of
    the mean line, N = cutoff (m2/m0)^(1/2)/(2 pi) in a section: Rz = 2 Rq (c + 0.5772/c) with
    c = (2 ln N)^(1/2). Simulated profiles have an Rz lower by up to 12 %. RSm is the mean distance
    of the upward crossings, with no hill or valley left out. N must be above 1.
    """
    m0, m2, cutoff = jnp.asarray(m0, float), jnp.asarray(m2, float), jnp.asarray(cutoff, float)
    Rq = jnp.sqrt(m0)
    RSm = 2 * jnp.pi * jnp.sqrt(m0 / m2)

    def expected_range(length):
        c = jnp.sqrt(2 * jnp.log(length / RSm))
        return 2 * Rq * (c + np.euler_gamma / c)

    Rz = expected_range(cutoff)
    core, peaks, first = _gaussian_material_ratio()
    same = jnp.ones_like(Rz)
    return ProfileParameters(
        Ra=math.sqrt(2 / math.pi) * Rq,
        Rq=Rq,
        Rz=Rz,
        Rp=Rz / 2,
        Rv=Rz / 2,
        Rt=expected_range(sections * cutoff),
        Rsk=0 * same,
        Rku=3 * same,
        Rdq=jnp.sqrt(m2),
        RSm=RSm,
        Rk=core * Rq,
        Rpk=peaks * Rq,
        Rvk=peaks * Rq,
        Mr1=100 * first * same,
        Mr2=100 * (1 - first) * same,
    )


def _gaussian_material_ratio() -> tuple[float, float, float]:
    """(Rk/Rq, Rpk/Rq, Mr1) of Gaussian heights.

    The steepness of the least-squares line over the middle 40 %, 12/0.4^3 times the integral of
    (Phi(u) - 1/2) u phi(u) du, by parts.
    """
    normal = NormalDist()
    end = normal.inv_cdf(0.7)
    integral = math.erf(end) / (2 * math.sqrt(math.pi)) - 0.4 * normal.pdf(end)
    core = 12 / 0.4**3 * integral
    upper = core / 2
    first = normal.cdf(-upper)
    return core, 2 * (normal.pdf(upper) / first - upper), first
