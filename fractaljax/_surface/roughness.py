"""The roughness parameters that Eq. 13 implies, without sampling a surface."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Numbers, Record, number, ordered
from .surface import Surface, frequency_count


class Roughness(Record):
    """Roughness parameters over a band of wavelengths, as `roughness` returns them."""

    Sq: Float[Array, "..."]  # root mean square height [m]
    Sa: Float[Array, "..."]  # mean absolute height [m]
    Sdq: Float[Array, "..."]  # root mean square gradient, rise over run [-]


def roughness(surface: Surface, L: ArrayLike, L_s: ArrayLike) -> Roughness:
    """Sq, Sa and Sdq of Eq. 13, over wavelengths from L down to L_s [m]; any shape.

    They are expectations over an area much larger than L. On an area of L x L, Sq scatters from
    place to place; in the mean square it is up to 0.4 percent lower with the mean removed, and up
    to 7 percent (5 at D = 2.4) with the mean plane removed, as instruments do. Sa takes heights as
    Gaussian, which is up to 0.64 percent too low. Sdq grows with L/L_s without bound.

    **Raises:** `ValueError` unless 0 < L_s <= L.
    """
    L_s = number("L_s", L_s, above=0)
    L = ordered("L", number("L", L, above=0), "L_s", L_s)
    return _roughness(surface, L, L_s)


@jax.jit
def _roughness(surface, L, L_s):
    Sq = root_mean_square_height(surface, L, L_s)
    return Roughness(Sq, math.sqrt(2 / math.pi) * Sq, root_mean_square_gradient(surface, L, L_s))


def root_mean_square_height(surface: Surface, L, L_s) -> Numbers:
    """Sq [m] from Sq^2 = L^2 (G/L)^(2D-4) ln(gamma)/2 sum_{n=0..n_max} gamma^(2(D-3)n).

    The mean square of Eq. 13 about its mean: independent phases add up, and each of the M waves of
    one frequency has 1/(2M).
    """
    D, log_gamma = surface.D, jnp.log(surface.gamma)
    waves = _geometric_sum(2 * (D - 3) * log_gamma, frequency_count(surface.gamma, L / L_s))
    return L * (surface.G / L) ** (D - 2) * jnp.sqrt(log_gamma / 2 * waves)


def root_mean_square_gradient(surface: Surface, L, L_s) -> Numbers:
    """Sdq from Sdq^2 = 2 pi^2 (G/L)^(2D-4) ln(gamma) sum_{n=0..n_max} gamma^(2(D-2)n).

    As `root_mean_square_height`, each wave times its wavenumber 2 pi gamma^n/L.
    """
    D, log_gamma = surface.D, jnp.log(surface.gamma)
    waves = _geometric_sum(2 * (D - 2) * log_gamma, frequency_count(surface.gamma, L / L_s))
    return math.sqrt(2) * math.pi * (surface.G / L) ** (D - 2) * jnp.sqrt(log_gamma * waves)


def _geometric_sum(exponent, count):
    """The sum of e^(exponent n) over n from 0 to count - 1."""
    return jnp.expm1(count * exponent) / jnp.expm1(exponent)
