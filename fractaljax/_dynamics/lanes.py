"""Rows and small systems of equations of many lanes at once: components first, lanes last."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

SMALL = 6  # unknowns up to which elimination is written out, which runs faster


def together(size: int, count: int) -> int:
    """How many of `count` items of `size` bytes an inner loop takes: a 2^k that divides `count`.

    A loop with larger arrays takes twice as long, as XLA then runs its operations side by side.
    """
    most = max(1, 512 // size)  # up to so many bytes XLA on a CPU runs them in turn
    return min(1 << (most.bit_length() - 1), count & -count)


def rows(x, numbers: Sequence[int] | np.ndarray) -> Array:
    """Rows (k, ...) of x, by their static numbers; a slice where these have a constant step."""
    first, count = int(numbers[0]), len(numbers)
    step = int(numbers[1]) - first if count > 1 else 1
    if step > 0 and list(numbers) == list(range(first, first + step * count, step)):
        return x[first : first + step * (count - 1) + 1 : step]
    return jnp.stack([x[i] for i in numbers])


def row_numbers(x) -> Array:
    """The numbers (k, 1, ...) of the rows of x (k, ...)."""
    return jnp.arange(len(x)).reshape(-1, *(1,) * (x.ndim - 1))


def first_least(x) -> tuple[Array, Array]:
    """The row of x (k, ...) with the least value, and that value (...); row k where it is NaN.

    The same as `argmin`, in reductions that XLA turns into vector instructions.
    """
    least = jnp.min(x, axis=0)
    return jnp.min(jnp.where(x == least[None], row_numbers(x), len(x)), axis=0), least


def solve(W, b) -> Array:
    """The solution of W x = b for W (f, f, ...) and b (f, ...), lanes last."""
    if len(b) == 1:
        return b / W[0]
    if len(b) == 2:
        entries = W.reshape(4, *W.shape[2:])
        diagonal, off_diagonal = entries[::3], entries[1:3]
        return (diagonal[::-1] * b - off_diagonal * b[::-1]) / (
            diagonal * diagonal[::-1] - off_diagonal * off_diagonal[::-1]
        )
    if len(b) <= 16:  # from there on a library is faster
        return _by_elimination(W, b)
    W, b = jnp.moveaxis(W, (0, 1), (-2, -1)), jnp.moveaxis(b, 0, -1)
    return jnp.moveaxis(jnp.linalg.solve(W, b[..., None])[..., 0], -1, 0)


def _by_elimination(W, b) -> Array:
    """`solve` in operations that XLA fuses into one loop with others, unlike a library's."""
    lanes = jnp.broadcast_shapes(W.shape[2:], b.shape[1:])
    W, b = jnp.broadcast_to(W, (*W.shape[:2], *lanes)), jnp.broadcast_to(b, (len(b), *lanes))
    numbers = row_numbers(b)

    def step(k, A):
        # The pivot's row trades places with the first one that is left.
        column = jax.lax.dynamic_index_in_dim(A, k, 1, keepdims=False)
        pivot, _ = first_least(jnp.where(numbers < k, 1, -jnp.abs(column)))
        chosen = (numbers == pivot[None])[:, None]
        row = jnp.sum(jnp.where(chosen, A, 0), axis=0)
        A = jnp.where(chosen, jax.lax.dynamic_index_in_dim(A, k, 0), A)
        return _eliminated(k, A, row)

    def solver(W):
        return lambda _, b: jax.lax.fori_loop(
            0, len(b), step, jnp.concatenate([W, b[:, None]], axis=1)
        )[:, -1]

    def times(x):
        return jnp.sum(W * x[None], axis=1)

    return jax.lax.custom_linear_solve(times, b, solver(W), solver(jnp.swapaxes(W, 0, 1)))


def solve_positive(W, b) -> Array:
    """`solve` for a symmetric positive definite W, by elimination without pivots."""
    if len(b) < 3:
        return solve(W, b)
    if len(b) > SMALL:
        # Many right-hand sides, such as tangents, share the inverse.
        return product(_positive_inverse(W), b[:, None])[:, 0]
    lanes = jnp.broadcast_shapes(W.shape[2:], b.shape[1:])
    parts = (jnp.broadcast_to(x, (*x.shape[:2], *lanes)) for x in (W, b[:, None]))
    A = jnp.concatenate([*parts], axis=1)
    for k in range(len(b)):
        A = _eliminated(k, A, A[k])
    return A[:, -1]


def _eliminated(k, A, row) -> Array:
    """A after `row` has eliminated unknown k, and has become row k."""
    row = (row / row[k][None])[None]
    return jnp.where(row_numbers(A) == k, row, A - A[:, k, None] * row)


@jax.custom_jvp
def _positive_inverse(W) -> Array:
    eye = jnp.eye(len(W), dtype=W.dtype).reshape(len(W), len(W), *(1,) * (W.ndim - 2))
    A = jnp.concatenate([W, jnp.broadcast_to(eye, W.shape)], axis=1)
    return jax.lax.fori_loop(0, len(W), lambda k, A: _eliminated(k, A, A[k]), A)[:, len(W) :]


@_positive_inverse.defjvp
def _positive_inverse_jvp(primals, tangents):
    inverse = _positive_inverse(*primals)
    return inverse, -product(inverse, product(tangents[0], inverse))


def chosen(lanes: Bool[Array, " g"], new: Any, old: Any) -> Any:
    """The arrays of `new` in these lanes, and of `old` in the others."""

    def where(new, old):
        return jnp.where(lanes.reshape((1,) * (new.ndim - 1) + (-1,)), new, old)

    return jax.tree.map(where, new, old)


def product(A, B, *, written_out: bool = False) -> Array:
    """A @ B of each lane; a small one as a sum, which compiles into one loop with the rest.

    `written_out` is quicker where it stands alone: XLA leaves large reductions to a library.
    """
    if len(A) <= 8:
        if written_out:
            terms = (A[:, k, None] * B[k][None] for k in range(len(B)))
            return sum(terms, start=jnp.zeros((), A.dtype))
        return jnp.sum(A[:, :, None] * B[None], axis=1)
    if A[0, 0].size == B[0, 0].size == 1:
        # For one lane the library's product, which would have to move any other axes.
        lanes = jnp.broadcast_shapes(A.shape[2:], B.shape[2:])
        return (A.reshape(A.shape[:2]) @ B.reshape(B.shape[:2])).reshape(len(A), B.shape[1], *lanes)
    return jnp.einsum("ij...,jk...->ik...", A, B)


def log_spectral_radius(matrix, squarings: int) -> Array:
    """ln of the largest modulus of the eigenvalues of matrices (k, k, ...), by squaring them.

    Too large by at most the logarithm of the size of the last power over 2^squarings.
    """

    def square(_, carry):
        # The matrix to the power of 2^k, scaled to 1, and the logarithm of its scale.
        power, log = carry
        size = jnp.max(jnp.abs(power), axis=(0, 1))
        power = power / jnp.where(size > 0, size, 1)[None, None]
        return product(power, power), 2 * (log + jnp.log(size))

    carry = matrix, jnp.zeros_like(matrix[0, 0])
    return jax.lax.fori_loop(0, squarings, square, carry)[1] / 2.0**squarings
