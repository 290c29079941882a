"""Machined surfaces, described by their fractal parameters."""

import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._base.parts import Numbers, Part, number, quantity


class Surface(Part):
    """A fractal surface in the Yan-Komvopoulos form of the Weierstrass-Mandelbrot function.

    **Raises:** `ValueError` unless 2 < D < 3, G > 0 and gamma > 1.
    """

    D: Numbers = quantity("-", "fractal dimension, above 2 and below 3; larger is finer")
    G: Numbers = quantity("m", "fractal roughness; larger is rougher", log=True)
    gamma: Numbers = quantity("-", "ratio of successive spatial frequencies, above 1")

    def __init__(self, D: ArrayLike, G: ArrayLike, gamma: ArrayLike = 1.5):
        self.D = number("D", D, above=2, below=3)
        self.G = number("G", G, above=0)
        self.gamma = number("gamma", gamma, above=1)


def frequency_count(gamma, ratio, xp=jnp):
    """n_max + 1 of Eq. 13, n_max = int(ln(L/L_s)/ln gamma), `ratio` being L/L_s; any shape."""
    # A ratio that is a power of gamma up to rounding counts as one.
    rounding = float(jnp.finfo(gamma.dtype).eps) ** 0.6
    return 1 + xp.floor(xp.log(ratio) / xp.log(gamma) + rounding)
