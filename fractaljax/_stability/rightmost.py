"""The eigenvalue of a structure that grows most, and its derivatives by its own two vectors.

A reduced structure holds a coarse space that has every mode of its band to a few digits.
Those that may grow most are refined by two-sided Rayleigh quotient iteration (B. N. Parlett, Math.
Comput. 28 (1974) 679), which takes an LU factorisation of size n in the place of all eigenvalues of
size 2n: one to the last digit, each other until it is known to grow less. Where the coarse modes do
not settle which is the largest, all are computed.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from .._base.lapack import one_by_one, solve
from .._mechanism.reduced import CoarseSpace
from . import quadratic
from .band import MOST_DAMPED, in_band

Matrices = tuple[Float[Array, "n n"], Float[Array, "n n"], Float[Array, "n n"]]


class _Mode(NamedTuple):
    """An eigenvalue with its right and left vector, y (2 s M + C) x = 1."""

    s: Complex[Array, ""]
    x: Complex[Array, " n"]
    y: Complex[Array, " n"]


def rightmost(
    matrices: Matrices, band: tuple[float, float] | None, coarse: CoarseSpace | None
) -> Complex[Array, ""]:
    """The eigenvalue with the largest real part, in a `band` if there is one."""
    if jnp.iscomplexobj(matrices[2]):  # structural damping
        s = quadratic.solve(*matrices).s
        return s[jnp.argmax(_rank(jax.lax.stop_gradient(s), band))]
    return _mode(band, coarse, *matrices).s


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _mode(band, coarse, M, C, K) -> _Mode:
    if coarse is None:
        return _rightmost_of_all(band, M, C, K)

    @one_by_one
    def solution(M, C, K):
        mode, settled = _refined(band, coarse, M, C, K)
        return jax.lax.cond(settled, lambda: mode, lambda: _rightmost_of_all(band, M, C, K))

    return solution(M, C, K)


@_mode.defjvp
def _mode_jvp(band, coarse, primals, tangents):
    M, C, _ = primals
    mode = s, x, y = _mode(band, coarse, *primals)
    dM, dC, dK = (X.astype(s.dtype) for X in tangents)
    ds = -(y @ (s**2 * (dM @ x) + s * (dC @ x) + dK @ x))
    rigid = s == 0
    ds = jnp.where(rigid, 0, ds)
    # Q dx + ds Q' x = -dQ x and its transpose. The length of x is free: y Q' dx = 0.
    Q, slope, dQ = _dynamic_stiffness(s, *primals), 2 * s * M + C, s**2 * dM + s * dC + dK
    right, left = slope @ x, y @ slope
    bordered = jnp.block([[Q, right[:, None]], [left[None], jnp.zeros((1, 1), s.dtype)]])
    bordered = jnp.where(rigid, jnp.eye(len(bordered), dtype=s.dtype), bordered)
    length = y @ ((2 * ds * M + 2 * s * dM + dC) @ x)
    dx = solve(bordered, jnp.append(-(dQ @ x), 0))[:-1]
    dy = solve(bordered.T, jnp.append(-(y @ dQ), -length))[:-1]
    return mode, _Mode(ds, dx, dy)


def _dynamic_stiffness(s, M, C, K) -> Complex[Array, "n n"]:
    """Q(s) = s^2 M + s C + K."""
    return s * (s * M + C) + K


def _rightmost_of_all(band, M, C, K) -> _Mode:
    modes = quadratic.solve(M, C, K)
    i = jnp.argmax(_rank(modes.s, band))  # sorting would double the time to compile
    return _Mode(modes.s[i], modes.x[i], modes.y[i])


def _rank(s, band):
    """Real parts, -inf outside the band."""
    return s.real if band is None else jnp.where(in_band(s, band), s.real, -jnp.inf)


# --- from the modes of a coarse space -------------------------------------------------------------


class _Search(NamedTuple):
    """The k coarse modes as refined so far, and the rightmost refined mode."""

    refined: Bool[Array, " k"]
    s: Complex[Array, " k"]  # infinite where it is not refined
    error: Float[Array, " k"]  # of s, at most
    sound: Bool[Array, ""]  # whether each was refined to a mode of its own, near the coarse one
    best: _Mode


def _refined(band, coarse: CoarseSpace, M, C, K) -> tuple[_Mode, Bool[Array, ""]]:
    """The rightmost mode, and True if that is certain.

    Every mode z of the coarse space is within `radius` of one of the structure. A refined
    mode is the rightmost if no unrefined one can have a larger real part or be the same.
    """
    V, W = (jnp.asarray(X, M.dtype) for X in (coarse.V, coarse.W))
    rough: Any = quadratic.solve(*(W.T @ X @ V for X in (M, C, K)))
    z, size = rough.s, jnp.abs(rough.s)
    radius = coarse.tol * size
    wider = (z.imag > band[0] - radius) & (z.imag <= band[1] + radius)
    eligible = wider & (jnp.abs(z.real) <= MOST_DAMPED * size + 2 * radius)

    def unsettled(now: _Search) -> Bool[Array, " k"]:
        reach = now.error[None] + radius[:, None]
        near = (jnp.abs(now.s[None] - z[:, None]) <= reach).any(axis=1)
        return eligible & ~now.refined & (near | (z.real + radius >= now.best.s.real))

    def refine(now: _Search) -> _Search:
        i = jnp.argmax(jnp.where(unsettled(now), z.real, -jnp.inf))

        def alone(s, error) -> Bool[Array, ""]:
            # Two modes that converge within 1e-9 of |s| are one, or too close to tell them apart.
            return (jnp.abs(now.s - s) > jnp.maximum(now.error + error, 1e-9 * size[i])).all()

        def beaten(s, error) -> Bool[Array, ""]:
            return (s.real + error < now.best.s.real) & alone(s, error)

        start = _Mode(z[i], V @ rough.x[i], W @ rough.y[i])
        mode, error, converged = _iterated(M, C, K, start, beaten)
        s = mode.s
        sound = now.sound & converged & alone(s, error) & (jnp.abs(s - z[i]) <= radius[i])
        better = in_band(s, band) & (s.real > now.best.s.real)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), mode, now.best)
        refined, eigenvalues = now.refined.at[i].set(True), now.s.at[i].set(s)
        return _Search(refined, eigenvalues, now.error.at[i].set(error), sound, best)

    none = _Mode(jnp.full((), -jnp.inf, z.dtype), *jnp.zeros((2, len(M)), z.dtype))
    unrefined = jnp.zeros(len(z), bool), jnp.full_like(z, jnp.inf), jnp.zeros_like(size)
    first = _Search(*unrefined, jnp.array(True), none)
    end = jax.lax.while_loop(lambda now: now.sound & unsettled(now).any(), refine, first)
    return end.best, end.sound & jnp.isfinite(end.best.s.real)


def _iterated(
    M, C, K, mode: _Mode, beaten: Callable
) -> tuple[_Mode, Float[Array, ""], Bool[Array, ""]]:
    """A mode by two-sided Rayleigh quotient iteration, its error, and True if it converged.

    The error is below the last change, since digits triple. An eigenvalue that is `beaten` within
    it needs no more of them.
    """
    rounding = 64 * jnp.finfo(M.dtype).eps  # what the solutions with Q leave

    def settled(s, error):
        return (error <= rounding * jnp.abs(s)) | beaten(s, error)

    def going(now):
        step, mode, error = now
        # Digits triple in each step: what has not converged in six does not.
        return (step < 6) & (error >= 0) & ~settled(mode.s, error)

    def improve(now):
        step, (s, x, y), _ = now
        slope = 2 * s * M + C
        lu, _, order = jax.lax.linalg.lu(_dynamic_stiffness(s, M, C, K))
        x, y = _inverse(lu, order, slope @ x, y @ slope)
        x, y = x / jnp.linalg.norm(x), y / jnp.linalg.norm(y)
        change = (y @ (_dynamic_stiffness(s, M, C, K) @ x)) / (y @ (slope @ x))
        return step + 1, _Mode(s - change, x, y), jnp.abs(change)

    first = 0, mode, jnp.full((), jnp.inf, M.dtype)
    _, (s, x, y), error = jax.lax.while_loop(going, improve, first)
    y = y / (y @ ((2 * s * M + C) @ x))
    return _Mode(s, x, y), error, settled(s, error)


def _inverse(lu, order, b, c) -> tuple[jax.Array, jax.Array]:
    """Q^-1 b and c Q^-1, from Q[order] = L U."""
    triangular = functools.partial(jax.lax.linalg.triangular_solve, lu)
    b, c = b[order][:, None], c[None]
    b = triangular(b, left_side=True, lower=True, unit_diagonal=True)
    b = triangular(b, left_side=True, lower=False)
    c = triangular(c, left_side=False, lower=False)
    c = triangular(c, left_side=False, lower=True, unit_diagonal=True)
    return b[:, 0], jnp.zeros_like(c[0]).at[order].set(c[0])
