"""Roughness parameters and moments of a surface, without sampling it."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Numbers, Record, number, ordered, require_kind, require_scalar
from .spectrum import Spectrum
from .surface import Surface, frequency_count


class Roughness(Record):
    """Roughness parameters over a band of wavelengths, as `roughness` returns them."""

    Sq: Float[Array, "..."]  # root mean square height [m]
    Sa: Float[Array, "..."]  # mean absolute height [m]
    Sdq: Float[Array, "..."]  # root mean square gradient, rise over run [-]


class SpectralMoments(Record):
    """Moments of a surface's profiles, as `spectral_moments` returns them.

    m_2k is the mean square of the k-th derivative of a profile, on average over its directions.
    """

    m0: Float[Array, "..."]  # mean square height [m^2]
    m2: Float[Array, "..."]  # mean square slope, half the mean square gradient [-]
    m4: Float[Array, "..."]  # mean square second derivative [1/m^2]
    alpha: Float[Array, "..."]  # Nayak's parameter m0 m4/m2^2: 1.5 for one wavelength, or larger


def roughness(
    surface: Spectrum, L: ArrayLike | None = None, L_s: ArrayLike | None = None
) -> Roughness:
    """Sq, Sa and Sdq of a surface, without sampling it.

    They are expectations over an area much larger than the longest wavelength. On an area of
    L x L, Sq scatters from place to place; of Eq. 13 it is in the mean square up to 0.4 percent
    lower with the mean removed, and up to 7 percent (5 at D = 2.4) with the mean plane removed, as
    instruments do. Sa takes heights as Gaussian, which for Eq. 13 is up to 0.64 percent too low.
    Sdq of Eq. 13 grows with L/L_s without bound.

    **Arguments:**

    - `surface`: a `Surface`, `SelfAffine`, `MeasuredSpectrum` or a spectrum of one's own.
    - `L`, `L_s`: longest and shortest wavelength [m] of a `Surface`, any shape; the other spectra
      have their own.

    **Raises:** `ValueError` unless 0 < L_s <= L, for a `Surface` without them, and for another
    spectrum with them.
    """
    return _roughness(surface, *_band_of_one(surface, L, L_s))


@jax.jit
def _roughness(surface, L, L_s):
    if isinstance(surface, Surface):
        Sq, Sdq = (root_mean_square(surface, L, L_s, k) for k in (0, 1))
    else:
        Sq, Sdq = map(jnp.sqrt, surface.moments()[:2])
    return Roughness(Sq, math.sqrt(2 / math.pi) * Sq, Sdq)


def spectral_moments(
    surface: Spectrum, L: ArrayLike | None = None, L_s: ArrayLike | None = None
) -> SpectralMoments:
    """The moments of a surface's spectrum, and Nayak's parameter.

    m0 = int m dln q, m2 = 1/2 int m q^2 dln q, m4 = 3/8 int m q^4 dln q (Nayak, J. Lubr. Technol.
    93, 398, 1971, doi:10.1115/1.3451608), with the mean over directions m of the spectrum.

    **Arguments:**

    - `surface`, `L`, `L_s`: as in `roughness`.

    **Returns:** `SpectralMoments`.

    **Raises:** as `roughness`.
    """
    return _moments(surface, *_band_of_one(surface, L, L_s))


@jax.jit
def _moments(surface, L, L_s):
    if isinstance(surface, Surface):
        roots = (root_mean_square(surface, L, L_s, k) for k in (0, 1, 2))
        heights, gradients, curvatures = (root**2 for root in roots)
    else:
        heights, gradients, curvatures = surface.moments()
    m0, m2, m4 = heights, gradients / 2, 3 * curvatures / 8
    return SpectralMoments(m0, m2, m4, m0 * (m4 / m2**2))


def _band_of_one(surface, L, L_s) -> tuple[Numbers | None, Numbers | None]:
    """As `wavelengths_of`, for one spectrum, or surfaces of any shape.

    **Raises:** `ValueError` for an array of other spectra: use `jax.vmap`.
    """
    band = wavelengths_of(surface, L, L_s)
    if not isinstance(surface, Surface):
        require_scalar(surface)
    return band


def wavelengths_of(
    surface: Spectrum, L: ArrayLike | None, L_s: ArrayLike | None
) -> tuple[Numbers | None, Numbers | None]:
    """L and L_s, checked: a `Surface` needs them, any other spectrum has its own.

    **Raises:** `TypeError` for what is no spectrum; `ValueError` unless 0 < L_s <= L, or both are
    None.
    """
    require_kind("surface", surface, Spectrum)
    if not isinstance(surface, Surface):
        if L is not None or L_s is not None:
            kind = type(surface).__name__
            raise ValueError(f"L and L_s are for a Surface; a {kind} has wavelengths of its own")
        return None, None
    if L is None or L_s is None:
        raise ValueError("a Surface needs L and L_s, its longest and its shortest wavelength in m")
    L_s = number("L_s", L_s, above=0)
    return ordered("L", number("L", L, above=0), "L_s", L_s), L_s


def root_mean_square(surface: Surface, L, L_s, order: int = 0) -> Numbers:
    """Root mean square of Eq. 13 (Sq), of its gradient (Sdq) or of |q|^k times each wave, order k.

    Its square is L^2 (G/L)^(2D-4) ln(gamma)/2 (2 pi/L)^(2k) sum_{n=0..n_max} gamma^(2(D-3+k)n):
    independent phases add up, and each of the M waves of one frequency has 1/(2M).
    """
    D, log_gamma = surface.D, jnp.log(surface.gamma)
    exponent = 2 * (D - 3 + order) * log_gamma
    waves = jnp.expm1(frequency_count(surface.gamma, L / L_s) * exponent) / jnp.expm1(exponent)
    amplitude = (surface.G / L) ** (D - 2) * jnp.sqrt(log_gamma / 2 * waves)
    return L * amplitude * (2 * math.pi / L) ** order
