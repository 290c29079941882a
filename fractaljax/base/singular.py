"""Functions with a removable or a genuine singular point, safe there in value and derivative.

Each is jitted, so that a program that calls one many times traces it once.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp

# Powers of x in exprel and in its derivative, highest first; the rest is below 1e-17 at |x| = 1/4.
_SERIES_RADIUS = 0.25
_EXPREL = [1 / math.factorial(k + 1) for k in range(12, -1, -1)]
_EXPREL_SLOPE = [(k + 1) / math.factorial(k + 2) for k in range(12, -1, -1)]


def polynomial(coefficients: Sequence[float], x: jax.Array) -> jax.Array:
    """The polynomial with these coefficients, highest power first; any shape."""
    value = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value


@jax.custom_jvp
@jax.jit
def exprel(x: jax.Array) -> jax.Array:
    """(exp(x) - 1) / x, with its limit 1 at x = 0; any shape."""
    near = jnp.abs(x) < _SERIES_RADIUS
    far, x = jnp.where(near, 1, x), jnp.where(near, x, 0)
    return jnp.where(near, polynomial(_EXPREL, x), (jnp.exp(far) - 1) / far)


@jax.jit
def _exprel_slope(x):
    # Both branches are smooth: every further derivative is right at 0 and beside it.
    near = jnp.abs(x) < _SERIES_RADIUS
    far, x = jnp.where(near, 1, x), jnp.where(near, x, 0)
    exp = jnp.exp(far)
    return jnp.where(near, polynomial(_EXPREL_SLOPE, x), (exp - (exp - 1) / far) / far)


exprel.defjvps(lambda dx, value, x: dx * _exprel_slope(x))


def boxcox(log_x: jax.Array, r: jax.Array) -> jax.Array:
    """(x^r - 1) / r from ln x, with its limit ln x at r = 0; any shape.

    ln x exprel(r ln x), which loses nothing as r -> 0 or x -> 1.
    """
    return log_x * exprel(r * log_x)


@jax.custom_jvp
@jax.jit
def positive_cbrt(x: jax.Array) -> jax.Array:
    """Cube root of max(x, 0); value and derivative are exactly 0 for x <= 0; any shape.

    The true derivative is infinite at 0 from above: it grows without bound as x -> 0+.
    """
    inside = x > 0
    x = jnp.where(inside, x, 1)
    # Some compilers make cbrt of exp and log, which loses two digits far from 1; Newton's step
    # brings them back.
    root = jnp.cbrt(x)
    return jnp.where(inside, root - (root - x / root**2) / 3, 0)


@jax.jit
def _positive_cbrt_slope(x):
    inside = x > 0
    x = jnp.where(inside, x, 1)
    return jnp.where(inside, positive_cbrt(x) / x / 3, 0)


positive_cbrt.defjvps(lambda dx, value, x: dx * _positive_cbrt_slope(x))


@jax.jit
def positive_sqrt(x: jax.Array) -> jax.Array:
    """Square root of max(x, 0); value and derivative are exactly 0 for x <= 0; any shape."""
    inside = x > 0
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, x, 1)), 0)


@jax.jit
def safe_divide(numerator: jax.Array, denominator: jax.Array, otherwise: jax.Array) -> jax.Array:
    """numerator / denominator, and `otherwise` where the denominator is 0; any shape."""
    zero = denominator == 0
    return jnp.where(zero, otherwise, numerator / jnp.where(zero, 1, denominator))


@jax.jit
def exp_or_inf(x: jax.Array) -> jax.Array:
    """exp(x), and infinity with derivative exactly 0 where that overflows; any shape.

    An infinite derivative would turn the zero cotangents of reverse mode into NaN.
    """
    overflows = jnp.exp(x) == jnp.inf
    return jnp.where(overflows, jnp.inf, jnp.exp(jnp.where(overflows, 0, x)))
