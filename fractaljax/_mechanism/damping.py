"""Damping matrices of a structure from Rayleigh coefficients or modal damping ratios."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import ArrayLike, Float

from .._base.parts import concrete, nan_where, number, scalar
from .matrices import (
    MatrixLike,
    as_array,
    fitting,
    fitting_or_sparse,
    is_sparse,
    mass_matrix,
    mass_normalised,
    square,
    square_or_sparse,
)


def rayleigh_damping(M: MatrixLike, K: MatrixLike, alpha: ArrayLike, beta: ArrayLike) -> MatrixLike:
    """C = alpha M + beta K (n, n) [N s/m], the damping matrix of Rayleigh.

    C is sparse if M and K are sparse matrices with more than 2000 rows.

    **Arguments:**

    - `M`: mass matrix (n, n) [kg], an array or a sparse matrix of SciPy.
    - `K`: stiffness matrix (n, n) [N/m], likewise.
    - `alpha`: factor of M [1/s], a scalar.
    - `beta`: factor of K [s], a scalar.

    **Raises:** `ValueError` unless alpha >= 0 and beta >= 0 are scalars and M and K are square
    matrices of the same size; `TypeError` for anything but real numbers.
    """
    M = square_or_sparse("M", M)
    K = fitting_or_sparse("K", K, M.shape)
    a, b = (scalar(name, x, at_least=0) for name, x in (("alpha", alpha), ("beta", beta)))
    if is_sparse(M) != is_sparse(K):
        M, K = (as_array(name, X) for name, X in (("M", M), ("K", K)))
    return float(a) * M + float(b) * K if is_sparse(M) else a * M + b * K


def modal_damping(M: MatrixLike, K: MatrixLike, ratio: ArrayLike) -> Float[Array, "n n"]:
    """C (n, n) [N s/m] that gives the modes of M and K their damping ratios.

    C = L X diag(2 ratio omega) X^T L^T with M = L L^T and X the eigenvectors of L^-1 K L^-T:
    differentiable where the frequencies are distinct.

    **Arguments:**

    - `M`: mass matrix (n, n) [kg].
    - `K`: stiffness matrix (n, n) [N/m], symmetric.
    - `ratio`: damping ratio [-], a scalar for every mode, or (n,) in the order of rising frequency.

    **Raises:** `ValueError` unless ratio >= 0, M is symmetric and positive definite, and K is
    symmetric and has the size of M; `TypeError` for anything but real numbers.
    """
    M = mass_matrix(square("M", M))
    K, ratio = fitting("K", K, M.shape), number("damping_ratio", ratio, at_least=0)
    if ratio.shape not in ((), K.shape[:1]):
        raise ValueError(
            f"damping_ratio must be a scalar or have shape {K.shape[:1]}, got shape {ratio.shape}"
        )
    values = concrete(K)
    if values is None:
        K = nan_where(jnp.abs(K - K.T).max() > 1e-6 * jnp.abs(K).max(), K)
    elif np.abs(values - values.T).max() > 1e-6 * np.abs(values).max():
        raise ValueError("damping_ratio needs a symmetric K: others have no real modes")
    L = jnp.linalg.cholesky(M)
    squares, X = jnp.linalg.eigh(mass_normalised(L, K))
    omega = jnp.sqrt(jnp.where(squares > 0, squares, 0))
    LX = L @ X
    return (LX * (2 * ratio * omega)[None]) @ LX.T
