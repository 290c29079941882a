"""LAPACK under `vmap`: one problem after the other.

Two concurrent calls of LAPACK on batches deadlock on two cores (jaxlib 0.10). Sequential calls are
about as fast.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float


def one_by_one(function: Callable) -> Callable:
    """A LAPACK function, without derivatives, that `vmap` calls for one member at a time."""
    sequential: Any = sequential_vmap(function)
    return sequential


_lapack_solve = one_by_one(jnp.linalg.solve)


def solve(A: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """x with A x = b, for b (n,) or (n, k), with derivatives in both modes."""
    fixed = jax.lax.stop_gradient(A)
    return jax.lax.custom_linear_solve(
        lambda x: A @ x,
        b,
        solve=lambda _, b: _lapack_solve(fixed, b),
        transpose_solve=lambda _, b: _lapack_solve(fixed.T, b),
    )
