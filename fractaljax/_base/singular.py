"""Functions with a removable or a genuine singular point, safe there in value and derivative.

Each takes any shape, and is jitted so that a program that calls one many times traces it once.
NaN, which a traced value outside its domain becomes, stays NaN: hence `~(x <= 0)`.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from .parts import Numbers

# Taylor coefficients of exprel and of its derivative, highest power first
_EXPREL = [1 / math.factorial(k + 1) for k in range(12, -1, -1)]
_EXPREL_SLOPE = [(k + 1) / math.factorial(k + 2) for k in range(12, -1, -1)]


def polynomial(coefficients: Sequence[float], x: Numbers) -> Numbers:
    """The polynomial with these coefficients, highest power first."""
    value = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value


def _split(x):
    """True near 0, where a series serves, and x for the closed form and for the series."""
    near = jnp.abs(x) < 0.25  # the rest of either series is under 1e-17 there
    return near, jnp.where(near, 1, x), jnp.where(near, x, 0)


@jax.custom_jvp
@jax.jit
def exprel(x: Numbers) -> Numbers:
    """(exp(x) - 1) / x, with its limit 1 at x = 0."""
    near, far, x = _split(x)
    return jnp.where(near, polynomial(_EXPREL, x), (jnp.exp(far) - 1) / far)


@jax.jit
def _exprel_slope(x):
    # Both branches are smooth, so every further derivative is right too.
    near, far, x = _split(x)
    exp = jnp.exp(far)
    return jnp.where(near, polynomial(_EXPREL_SLOPE, x), (exp - (exp - 1) / far) / far)


exprel.defjvps(lambda dx, value, x: dx * _exprel_slope(x))


def boxcox(log_x: Numbers, r: Numbers) -> Numbers:
    """(x^r - 1) / r from ln x, with its limit ln x at r = 0."""
    return log_x * exprel(r * log_x)


@jax.custom_jvp
@jax.jit
def positive_cbrt(x: Numbers) -> Numbers:
    """Cube root of max(x, 0); value and derivative are exactly 0 for x <= 0.

    The true derivative is infinite at 0 from above: it grows without bound as x -> 0+.
    """
    inside = ~(x <= 0)
    x = jnp.where(inside, x, 1)
    root = jnp.cbrt(x)
    # Compiled as exp(log(x)/3) it loses two digits far from 1; one Newton step restores them.
    return jnp.where(inside, root - (root - x / root**2) / 3, 0)


@jax.jit
def _positive_cbrt_slope(x):
    inside = ~(x <= 0)
    x = jnp.where(inside, x, 1)
    return jnp.where(inside, positive_cbrt(x) / x / 3, 0)


positive_cbrt.defjvps(lambda dx, value, x: dx * _positive_cbrt_slope(x))


@jax.jit
def positive_sqrt(x: Numbers) -> Numbers:
    """Square root of max(x, 0); value and derivative are exactly 0 for x <= 0."""
    inside = ~(x <= 0)
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, x, 1)), 0)


@jax.jit
def safe_divide(numerator: Numbers, denominator: Numbers, otherwise: Numbers) -> Numbers:
    """numerator / denominator, and `otherwise` where the denominator is 0."""
    zero = denominator == 0
    return jnp.where(zero, otherwise, numerator / jnp.where(zero, 1, denominator))


@jax.jit
def exp_or_inf(x: Numbers) -> Numbers:
    """exp(x), and infinity with derivative exactly 0 where that overflows.

    An infinite derivative would turn the zero cotangents of reverse mode into NaN.
    """
    overflows = jnp.exp(x) == jnp.inf
    return jnp.where(overflows, jnp.inf, jnp.exp(jnp.where(overflows, 0, x)))
