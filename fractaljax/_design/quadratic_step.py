"""The step of a sequential quadratic method: a small quadratic program, in JAX.

    min over d:  g d + d B d/2 + rho sum_i max(0, c_i + a_i d),  low <= d <= high.

What the linearised requirements leave unmet is penalised, so that there always is a solution, and
the multipliers are at most rho. It is found by the predictor-corrector interior-point method of S.
Mehrotra ("On the implementation of a primal-dual interior point method", 1992), in a fixed number
of iterations: many programs run side by side under `jax.vmap`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._dynamics.lanes import SMALL, solve_positive


def quadratic_step(
    g: Float[Array, " v"],
    B: Float[Array, "v v"],
    c: Float[Array, " k"],
    A: Float[Array, "k v"],
    rho: Float[ArrayLike, ""],
    low: Float[Array, " v"],
    high: Float[Array, " v"],
    iterations: int = 16,
) -> tuple[Float[Array, " v"], Float[Array, " k"]]:
    """The step d (v,) and the multipliers (k,) of the residuals. B is positive definite.

    Each of the `iterations` brings complementarity down to less than a third, near the end to far
    less.
    """
    eps = jnp.finfo(g.dtype).eps
    # An inverse, as `solve_positive` takes of larger ones, is too inexact near the end.
    solve = solve_positive if len(g) <= SMALL else _solve_cholesky
    count = 2 * (len(c) + len(g))

    def body(_, carry):
        d, t, multiplier, to_low, to_high = carry
        s, w, p, q = t - c - A @ d, rho - multiplier, d - low, high - d
        gap = (multiplier @ s + w @ t + to_low @ p + to_high @ q) / count
        slope = B @ d + g + A.T @ multiplier - to_low + to_high
        share = 1 / (s + multiplier * t / w)
        W = B + A.T @ ((share * multiplier)[:, None] * A) + jnp.diag(to_low / p + to_high / q)

        def direction(centre, by_s, by_t, by_p, by_q):
            """Newton's step to products equal to `centre`, less what is of second order."""
            h_s, h_t = centre - by_s - multiplier * s, centre - by_t - w * t
            h_p, h_q = centre - by_p - to_low * p, centre - by_q - to_high * q
            base = share * (h_s - multiplier * h_t / w)
            dd = solve(W, h_p / p - h_q / q - slope - A.T @ base)
            dm = base + share * multiplier * (A @ dd)
            return dd, (h_t + t * dm) / w, dm, (h_p - to_low * dd) / p, (h_q + to_high * dd) / q

        def longest(step):
            """The share of a step nearly up to where the first variable is 0."""
            dd, dt, dm, dp, dq = step
            now = (s, w, p, q, t, multiplier, to_low, to_high)
            changes = (dt - A @ dd, -dm, dd, -dd, dt, dm, dp, dq)
            shares = [jnp.where(b < 0, -a / b, jnp.inf) for a, b in zip(now, changes, strict=True)]
            return jnp.minimum(1, 0.995 * jnp.min(jnp.concatenate(shares)))

        zero = jnp.zeros_like
        dd, dt, dm, dp, dq = affine = direction(0.0, zero(s), zero(t), zero(p), zero(q))
        ds = dt - A @ dd
        a = longest(affine)
        ahead = (multiplier + a * dm) @ (s + a * ds) + (w - a * dm) @ (t + a * dt)
        ahead += (to_low + a * dp) @ (p + a * dd) + (to_high + a * dq) @ (q - a * dd)
        centre = gap * jnp.clip(ahead / (count * gap), 1e-6, 1) ** 3
        step = direction(centre, ds * dm, -dm * dt, dp * dd, -dq * dd)
        a = longest(step)
        new = tuple(x + a * dx for x, dx in zip(carry, step, strict=True))
        # Where it has converged, rounding would only spoil it.
        going = (gap > 1e-3 * eps) & jnp.isfinite(a) & jnp.all(jnp.isfinite(new[0]))
        return tuple(jnp.where(going, x, old) for x, old in zip(new, carry, strict=True))

    d = (low + high) / 2
    at = c + A @ d
    t = jnp.maximum(at, 0) + 0.1 * (1 + jnp.abs(at))
    half = jnp.full_like(c, rho / 2)
    to_low = jnp.full_like(
        d, jnp.max(jnp.abs(g + A.T @ half)) + jnp.max(jnp.abs(B)) * jnp.max(high - low)
    )
    carry = jax.lax.fori_loop(0, iterations, body, (d, t, half, to_low, to_low))
    return jnp.clip(carry[0], low, high), carry[2]


def _solve_cholesky(W, b) -> Array:
    """The solution of W x = b by the factors of Cholesky."""
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(W), True), b)
