"""The quadratic eigenvalue problem (s^2 M + s C + K) x = 0 for M symmetric positive definite.

LAPACK solves it as a linear problem of size 2n, in coordinates in which M is the identity
(Cholesky). The left and right vectors y and x then correct each eigenvalue by
-y (s^2 M + s C + K) x, where y (2 s M + C) x = 1, and bound what rounding of the matrices can do
to it, entry by entry: stiff parts take no digits from soft ones that hardly move them. Derivatives
are ds = -y (s^2 dM + s dC + dK) x for distinct eigenvalues, and those of the vectors, which makes
derivatives of every order right.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from .._base.lapack import one_by_one
from .._base.rounding import rounding_error
from .._mechanism.matrices import mass_normalised
from .band import in_band
from .hysteretic import physical_modes


class Modes(NamedTuple):
    """Every solution (s, x), in no particular order."""

    s: Complex[Array, " k"]  # exactly 0 for a rigid-body mode
    x: Complex[Array, "k n"]  # of any length
    error: Float[Array, " k"]  # how far rounding of the matrices can move s
    y: Complex[Array, "k n"]  # left vectors, y (2 s M + C) x = 1


class Leading(NamedTuple):
    """The modes that grow most, each with the mode nearest to it."""

    s: Complex[Array, " count"]
    neighbour: Complex[Array, " count"]  # equal to s of a mode that is alone
    first: Bool[Array, " count"]  # whether it grows at least as fast as its neighbour


def solve(
    M: Float[Array, "n n"],
    C: Float[Array, "n n"],
    K: Float[Array, "n n"],
    C_error: Float[Array, "n n"] | None = None,
) -> Modes:
    """All 2n modes. `C_error` bounds the error of C beyond rounding.

    A rigid-body mode has K x = 0 and s = 0 within rounding. A complex K is K + i K_loss, with
    structural damping: `hysteretic.py` says which solutions are modes then.
    """
    if jnp.iscomplexobj(K):
        return physical_modes(_solutions(M, C, K, C_error), _solutions(M, C, K.real, C_error))
    return _solutions(M, C, K, C_error)


def _solutions(M, C, K, C_error) -> Modes:
    """All 2n solutions (s, x) of the problem as it is."""
    # Units of every degree of freedom and of time that make matrices of order one. They are
    # powers of two, so that scaling rounds nothing.
    units = _power_of_two(-_half_exponent(jnp.diagonal(M)), M.dtype)
    M, C, K, C_error = jax.tree.map(lambda X: X * units[:, None] * units[None], (M, C, K, C_error))
    stiffness, damping = _row_sum(K), _row_sum(C)
    no_exponent = -2000  # below that of any number
    exponent = jnp.maximum(
        jnp.where(stiffness > 0, _half_exponent(stiffness), no_exponent),
        jnp.where(damping > 0, jnp.frexp(damping)[1], no_exponent),
    )
    omega = _power_of_two(jnp.where(exponent > no_exponent, exponent, 0), M.dtype)
    C_error = None if C_error is None else C_error / omega
    scaled = _modes(M, C / omega, K / omega / omega, C_error)
    s = omega * jnp.where(scaled.rigid, 0, scaled.z)
    return Modes(s, scaled.X.T * units[None], omega * scaled.error, scaled.Y / omega * units[None])


def leading(
    M: Float[Array, "n n"],
    C: Float[Array, "n n"],
    K: Float[Array, "n n"],
    count: int,
    band: tuple[float, float] | None = None,
) -> Leading:
    """The `count` eigenvalues with the largest real parts, one of each conjugate pair.

    With first derivatives only: a few take far less work than all of those that `solve` gives. In
    a `band` if there is one; if it has fewer, -band[1], critically damped, fills up.
    """
    fixed = jax.tree.map(jax.lax.stop_gradient, (M, C, K))
    modes = jax.tree.map(jax.lax.stop_gradient, solve(*fixed))
    dM, dC, dK = (X - at for X, at in zip((M, C, K), fixed, strict=True))  # 0, with derivatives

    def eigenvalues(places):
        s, x, y = modes.s[places], modes.x[places], modes.y[places]
        moved = s - s**2 * _between(y, dM, x) - s * _between(y, dC, x) - _between(y, dK, x)
        if not jnp.iscomplexobj(K):
            return moved
        return jnp.where(s.imag == 0, moved.real, moved)  # K_loss keeps what is real so

    return leading_among(modes.s, eigenvalues, count, band)


def leading_among(
    fixed: Complex[Array, " k"],
    eigenvalues: Callable[[Array], Array],
    count: int,
    band: tuple[float, float] | None,
) -> Leading:
    """As `leading`, of eigenvalues without derivatives, and a function of places that has them."""
    sought = (fixed.imag >= 0) & in_band(fixed, band)
    order = jnp.argsort(jnp.where(sought, -fixed.real, jnp.inf))
    places, rank = order[:count], jnp.argsort(order)
    others = (sought & (fixed.imag > 0))[None] & (rank[None] != rank[places][:, None])
    distance = jnp.where(others, jnp.abs(fixed[places][:, None] - fixed[None]), jnp.inf)
    nearest = jnp.argmin(distance, axis=1)
    paired = (distance.min(axis=1) < jnp.inf) & (fixed[places].imag > 0)
    s = jnp.where(sought[places], eigenvalues(places), -1 if band is None else -band[1])
    neighbour = jnp.where(paired & sought[places], eigenvalues(nearest), s)
    return Leading(s, neighbour, jnp.where(paired, rank[nearest] > rank[places], True))


def _between(y, X, x) -> jax.Array:
    """y_i X x_i for every i."""
    return (y * (x @ X.T.astype(x.dtype))).sum(axis=1)


def _row_sum(X) -> jax.Array:
    return jax.lax.stop_gradient(jnp.abs(X).sum(axis=1).max())


def _half_exponent(x) -> jax.Array:
    """The binary exponent of sqrt(x)."""
    return jnp.frexp(jax.lax.stop_gradient(x))[1] // 2


def _power_of_two(exponent, dtype) -> jax.Array:
    return jnp.ldexp(jnp.ones_like(exponent, dtype), exponent)


class _Vectors(NamedTuple):
    """Eigenvalues z_i, right vectors x_i and left vectors y_i, y_i (2 z_i M + C) x_i = 1."""

    z: jax.Array  # (2n,)
    X: jax.Array  # (n, 2n), right vectors in columns
    Y: jax.Array  # (2n, n), left vectors in rows
    error: jax.Array  # (2n,) of z
    rigid: jax.Array  # (2n,) whether K x = 0 and z = 0 within rounding


@jax.custom_jvp
def _modes(M, C, K, C_error) -> _Vectors:
    z, X, Y = _lapack(M, C, K)
    eps, rounding = jnp.finfo(M.dtype).eps, rounding_error(M.dtype)
    row, size = z[None], _size(z)[None]
    MX, CX, KX = (A @ X for A in (M, C, K))
    M_size, C_size, K_size = (jnp.abs(A) @ _size(X) for A in (M, C, K))
    slope = (Y.T * (2 * MX * row + CX)).sum(axis=0)
    most = (_size(Y.T) * (2 * M_size * size + C_size)).sum(axis=0)
    # A slope of 0 is a defective eigenvalue: take what rounding would make of it.
    slope = jnp.where(_size(slope) > eps * most, slope, jnp.sqrt(eps) * most)
    Y = Y / jnp.where(slope == 0, 1, slope)[:, None]
    # The residual between all pairs of modes, and a bound on its rounding error.
    left = -Y @ ((MX * row + CX) * row + KX)
    off = _size(left) + rounding * (_size(Y) @ ((M_size * size + C_size) * size + K_size))
    if C_error is not None:
        off = off + _size(Y) @ (C_error @ _size(X) * size)
    z, error = _pairwise(z, jnp.diagonal(left), _shift(z, off))
    inertia = _size((Y.T * MX).sum(axis=0))
    stiffness = rounding * (_size(Y.T) * K_size).sum(axis=0)
    force = (_size(Y.T) * _size(KX)).sum(axis=0)
    rigid = (size[0] ** 2 * inertia <= stiffness) & (force <= stiffness)
    double = jnp.minimum(jnp.sqrt(stiffness / jnp.where(inertia > 0, inertia, 1)), error)
    # Far below every elastic mode; otherwise it is an elastic mode lost in rounding.
    rigid &= double < 0.01 * jnp.where(rigid | (size[0] < error), jnp.inf, size[0]).min()
    error = jnp.where(rigid, double, error)
    return _Vectors(z, X, Y, error + jnp.sqrt(jnp.finfo(M.dtype).tiny), rigid)


def _size(x) -> jax.Array:
    """A modulus of complex x, 1 to 1.5 times the usual one, which compiles slowly."""
    return jnp.abs(x.real) + jnp.abs(x.imag)


@one_by_one
def _lapack(M, C, K):
    """Eigenvalues (2n,), right vectors (n, 2n) and left vectors (2n, n), uncorrected.

    Where degrees of freedom differ by orders of magnitude, LAPACK's eigenvalues are accurate for
    the slow ones only if the fast ones come first, and Cholesky's factors only if they come last.
    """
    n = len(M)
    unit = jnp.diagonal(M)
    rate = jnp.maximum(jnp.sqrt(jnp.abs(jnp.diagonal(K)) / unit), jnp.abs(jnp.diagonal(C)) / unit)
    # Sorted by counting, which compiles in a fraction of the time.
    place = jnp.arange(n)
    earlier = (rate[None] < rate[:, None]) | (
        (rate[None] == rate[:, None]) & (place[None] < place[:, None])
    )
    undo = earlier.sum(axis=1)
    slow_first = jnp.argmax(undo[None] == place[:, None], axis=1)
    L = jnp.linalg.cholesky(M[slow_first][:, slow_first])
    C, K = (mass_normalised(L, A[slow_first][:, slow_first]) for A in (C, K))
    A = jnp.block([[jnp.zeros_like(K), jnp.eye(n, dtype=K.dtype)], [-K, -C]])
    fast_first = np.arange(2 * n).reshape(2, n).T[::-1].ravel()
    z, left, right = jax.lax.linalg.eig(
        A[fast_first][:, fast_first],
        compute_left_eigenvectors=True,
        compute_right_eigenvectors=True,
    )
    back = np.argsort(fast_first)
    # The upper half of the right vector of a state (x, z x), the lower half of the left one.
    halves = jnp.concatenate([right[back][:n], left[back][n:].conj()], axis=1)
    halves = jax.scipy.linalg.solve_triangular(L.astype(z.dtype), halves, lower=True, trans="T")
    halves = halves[undo]
    return z, halves[:, : 2 * n], halves[:, 2 * n :].T


def _shift(z, off):
    """(k,): how far errors `off` (k, k) between all pairs can move each eigenvalue."""
    both = jnp.sqrt(off) * jnp.sqrt(off.T)
    distance = _size(z[None] - z[:, None]) / 1.5
    # The eigenvalues of [[0, e], [f, g]] move by e f/g, and by sqrt(e f) where they coincide. The
    # factor 4 is for more than two.
    shifts = 4 * both * jnp.where(both < distance, both / jnp.where(distance > 0, distance, 1), 1)
    return shifts.sum(axis=1) - jnp.diagonal(shifts) + jnp.diagonal(off)


def _pairwise(z, correction, error):
    """Corrected eigenvalues and their errors, conjugate to the last bit where they were."""
    second = (z.imag < 0) & (z == jnp.roll(z, 1).conj())
    correction = jnp.where(second, jnp.roll(correction, 1).conj(), correction)
    return z + correction, jnp.where(second, jnp.roll(error, 1), error)


@_modes.defjvp
def _modes_jvp(primals, tangents):
    at = _modes(*primals)
    z, X, Y = at.z, at.X, at.Y
    dM, dC, dK = (dA.astype(X.dtype) for dA in tangents[:3])
    mass_change = Y @ (dM @ X)
    P = -(mass_change * z[None] ** 2 + Y @ (dC @ X) * z[None] + Y @ (dK @ X))
    # The length of the vectors is free. Of all choices this is the one with w.dv = 0 for the
    # vectors w and v of the states; eigenvalues and normalised shapes do not depend on it.
    same = jnp.eye(len(z), dtype=z.dtype)
    difference = z[None] - z[:, None]
    least = jnp.finfo(z.dtype).eps * (_size(z)[None] + _size(z)[:, None])
    mixing = P * _inverse(difference + same, least) * (1 - same)
    none: Any = jnp.zeros_like(at.error), np.zeros(at.rigid.shape, jax.dtypes.float0)
    return at, _Vectors(jnp.diagonal(P), X @ mixing, -(mixing + mass_change * z[None]) @ Y, *none)


def _inverse(x, least) -> jax.Array:
    """1/x for complex x, bounded by about 1/least."""
    size = jnp.maximum(x.real**2 + x.imag**2, jnp.maximum(least**2, jnp.finfo(x.dtype).tiny))
    return x.conj() / size
