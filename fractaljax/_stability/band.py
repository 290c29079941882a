"""Which eigenvalues count: all, or those in the band of a reduction."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex

MOST_DAMPED = 0.3  # damping ratio of the modes that a reduction looks for


def in_band(s: Complex[Array, " k"], band: tuple[float, float] | None) -> Bool[Array, " k"]:
    """True for eigenvalues that a reduction to the band (low, high) gives: low < |Im s| <= high.

    In rad/s. False for |Re s| > 0.3 |s|, which it does not look for.
    """
    if band is None:
        return jnp.ones(s.shape, bool)
    frequency = abs(s.imag)  # in NumPy for its arrays: one program per shape is slow to compile
    sought = abs(s.real) <= MOST_DAMPED * (s.real**2 + frequency**2) ** 0.5
    return (frequency > band[0]) & (frequency <= band[1]) & sought


def leading(s: Complex[Array, " k"], band: tuple[float, float] | None) -> Array:
    """The order (k,) of the eigenvalues: those in the band first, the largest real part first."""
    rank = s.real if band is None else jnp.where(in_band(s, band), s.real, -jnp.inf)
    return jnp.lexsort((-s.imag, -rank))


def among(s: Complex[Array, " k"], band: tuple[float, float] | None) -> Complex[Array, " k"]:
    """The eigenvalues in the band, and -1, critically damped, in the place of the others."""
    return s if band is None else jnp.where(in_band(s, band) | jnp.isnan(s), s, -1)
