"""Machined surfaces, described by their fractal parameters."""

import math
from typing import final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._base.parts import Numbers, concrete, number, quantity
from .spectrum import Pieces, Spectrum


@final
class Surface(Spectrum, law="fractal"):
    """A fractal surface in the Yan-Komvopoulos form of the Weierstrass-Mandelbrot function.

    As a spectrum it is m = G^(2D-4) f^(2D-6)/2 at the frequency f = q/(2 pi), self-affine with
    H = 3 - D, without an end: where lengths matter, the longest and the shortest wavelength are
    stated beside it.

    **Raises:** `ValueError` unless 2 < D < 3, G > 0 and gamma > 1.
    """

    D: Numbers = quantity("-", "fractal dimension, above 2 and below 3; larger is finer")
    G: Numbers = quantity("m", "fractal roughness; larger is rougher", log=True)
    gamma: Numbers = quantity("-", "ratio of successive spatial frequencies, above 1")

    def __init__(self, D: ArrayLike, G: ArrayLike, gamma: ArrayLike = 1.5):
        self.D = _dimension(D, G)
        self.G = number("G", G, above=0)
        # A tenth of a millimetre: that of machined surfaces is a nanometre or less.
        self.gamma = number("gamma", gamma, above=1)

    def m(self, q):
        # G^(2D-4) alone may underflow.
        wavelength = 2 * math.pi / jnp.asarray(q)
        return (wavelength * (self.G / wavelength) ** (self.D - 2)) ** 2 / 2

    def times(self, factor):
        return eqx.tree_at(lambda x: x.G, self, self.G * factor ** (1 / (self.D - 2)))

    def between(self, L, L_s) -> Pieces:
        """The waves of Eq. 13 from L to L_s, with half a step of gamma beyond first and last."""
        log_gamma = jnp.log(self.gamma)
        q = 2 * math.pi / (L * jnp.exp(log_gamma / 2))
        width = frequency_count(self.gamma, L / L_s) * log_gamma
        edges = jnp.stack([q, q * jnp.exp(width)])
        return Pieces(edges, self.m(q)[None], 2 * (self.D - 2)[None])


def _dimension(D, G) -> Numbers:
    """A checked D; errors say what to type for the D of a profile, and for D and G in turn."""
    try:
        return number("D", D, above=2, below=3)
    except ValueError as error:
        values = [concrete(jnp.asarray(x)) for x in (D, G)]
        plain = [float(x) for x in values if x is not None and x.ndim == 0]
        if len(plain) == 2:
            first, second = plain
            if 1 < first < 2:
                hint = f"this is a profile's D, which is one less: type D = {first + 1:.10g}"
                raise ValueError(f"{error}: {hint}") from None
            if 2 < second < 3:
                raise ValueError(f"{error}: the order is Surface(D, G)") from None
        raise


def frequency_count(gamma, ratio, xp=jnp):
    """n_max + 1 of Eq. 13, n_max = int(ln(L/L_s)/ln gamma), `ratio` being L/L_s; any shape."""
    # A ratio that is a power of gamma up to rounding counts as one.
    rounding = float(jnp.finfo(gamma.dtype).eps) ** 0.6
    return 1 + xp.floor(xp.log(ratio) / xp.log(gamma) + rounding)
