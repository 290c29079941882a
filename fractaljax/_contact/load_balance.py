"""The load balance of a fractal joint, which determines the largest contact area a_l.

Eq. 26 (Eq. 27 at D = 2.5) over the load of an all-plastic joint with a_l = a_e depends only on
t = ln(a_l/a_e), D and beta = P_e(a_e)/(H a_e):

    s = (D-1)/2 t + ln(1 + q(t)),   q(t) = beta (3-D)/2 (e^(rt) - 1)/r,   r = (5-2D)/2

Its root t(s) takes a fixed number of Halley steps, and has the implicit derivative. Every function
takes any shape.
"""

import functools
import math

import jax
import jax.numpy as jnp

from .._base.parts import Numbers
from .._base.singular import boxcox


def _bounded(t, D):
    """t up to where the square of e^(rt) would overflow.

    Beyond that the load on plastic contacts is negligible, and s is linear in t.
    """
    r, largest = (5 - 2 * D) / 2, 0.35 * math.log(jnp.finfo(D.dtype).max)
    return jnp.minimum(t, largest / jnp.maximum(r, 1e-6))


def elastic_to_plastic_load(t: Numbers, D: Numbers, beta: Numbers) -> Numbers:
    """q(t), the ratio of the two terms of Eq. 26, for t >= 0."""
    return beta * (3 - D) / 2 * boxcox(_bounded(t, D), (5 - 2 * D) / 2)


def log_load(t: Numbers, D: Numbers, beta: Numbers) -> Numbers:
    """s(t) = ln P - ln P(all plastic, a_l = a_e), for t >= 0."""
    linear = (D - 1) / 2 * t + (5 - 2 * D) / 2 * (t - _bounded(t, D))
    return linear + jnp.log1p(elastic_to_plastic_load(t, D, beta))


def _excess_slope(t, D, beta):
    """w = ds/dt - (D-1)/2, for which dw/dt = w (r - w)."""
    r = (5 - 2 * D) / 2
    # e^(rt) as 1 + r (e^(rt) - 1)/r shares the exponential of q.
    growth = beta * (3 - D) / 2 * (1 + r * boxcox(_bounded(t, D), r))
    return growth / (1 + elastic_to_plastic_load(t, D, beta))


@jax.jit
def _halley_step(t, s, D, beta):
    w = _excess_slope(t, D, beta)
    error, slope = log_load(t, D, beta) - s, (D - 1) / 2 + w
    return t - error * slope / (slope**2 - error * w * ((5 - 2 * D) / 2 - w) / 2)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _elastic_log_area_ratio(s, D, beta, steps):
    t = s / ((D - 1) / 2 + beta * (3 - D) / 2)  # the tangent at t = 0
    for _ in range(steps):
        t = _halley_step(t, s, D, beta)
    return t


@_elastic_log_area_ratio.defjvp
def _elastic_log_area_ratio_jvp(steps, primals, tangents):
    # Made of differentiable pieces, so that every order of derivative is right.
    s, D, beta = primals
    ds, dD, dbeta = tangents
    t = _elastic_log_area_ratio(s, D, beta, steps)
    _, dload = jax.jvp(lambda D, beta: log_load(t, D, beta), (D, beta), (dD, dbeta))
    return t, (ds - dload) / ((D - 1) / 2 + _excess_slope(t, D, beta))


def log_area_ratio(s: Numbers, D: Numbers, beta: Numbers, steps: int = 3) -> Numbers:
    """t(s) = ln(a_l/a_e); t = s where the joint is fully plastic, s <= 0.

    Three Halley steps reach the last digit over the whole domain (tested).
    """
    elastic = s > 0
    root = _elastic_log_area_ratio(jnp.where(elastic, s, 1), D, beta, steps)
    return jnp.where(elastic, root, s)
