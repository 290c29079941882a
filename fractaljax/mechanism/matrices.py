"""The matrices of a structure: read, checked, and in coordinates of unit mass."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import concrete, number


def array_of(name: str, value) -> jax.Array:
    """A nested list, array or sparse matrix of SciPy's as an array of finite real numbers.

    **Raises:** `TypeError` for what is none; `ValueError` for NaN and infinity.
    """
    value = value.toarray() if hasattr(value, "toarray") else value  # a sparse matrix
    kind = f"{value.dtype} numbers" if hasattr(value, "dtype") else type(value).__name__
    unfit = TypeError(f"{name} must be an array of real numbers, got {kind}")
    if isinstance(value, (list, tuple)):
        if any(isinstance(entry, (str, bool, np.bool_)) for entry in jax.tree.leaves(value)):
            raise unfit
        try:
            value = jnp.asarray(value)
        except (ValueError, TypeError, OverflowError):  # ragged, or too large
            raise unfit from None
    try:
        return number(name, value)
    except TypeError:
        raise unfit from None


def square(name: str, value) -> jax.Array:
    """Like `array_of`, and a `ValueError` for what is no square matrix."""
    array = array_of(name, value)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not array.size:
        raise ValueError(f"{name} must be a square matrix, got shape {array.shape}")
    return array


def fitting(name: str, value, shape: tuple[int, ...]) -> jax.Array:
    """Like `array_of`, and a `ValueError` for another shape than that of the mass matrix."""
    array = array_of(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape} as M demands, got {array.shape}")
    return array


def mass_matrix(M: jax.Array) -> jax.Array:
    """M (n, n) made exactly symmetric.

    **Raises:** `ValueError` unless M is symmetric to 1e-6 and positive definite.
    """
    values, half = concrete(M), (M + M.T) / 2
    if values is None:
        bad = ~jnp.isfinite(jnp.linalg.cholesky(half)).all()
        return eqx.error_if(half, bad, "M must be positive definite")
    diagonal = np.diagonal(values)
    if diagonal.min() <= 0:
        i = int(diagonal.argmin())
        raise ValueError(
            f"M must be positive definite, got {diagonal[i].item()} on its diagonal at {i}"
        )
    unit = values / np.sqrt(diagonal)[:, None] / np.sqrt(diagonal)[None]
    uneven = np.abs(unit - unit.T)
    if uneven.max() > 1e-6:
        i, j = np.unravel_index(uneven.argmax(), uneven.shape)
        raise ValueError(
            f"M must be symmetric, got {values[i, j].item()} at ({i}, {j}) "
            f"and {values[j, i].item()} at ({j}, {i})"
        )
    try:
        pivot = np.diagonal(np.linalg.cholesky((unit + unit.T) / 2)).min() ** 2
    except np.linalg.LinAlgError:
        pivot = 0.0
    if pivot <= len(unit) * np.finfo(unit.dtype).eps:
        raise ValueError("M must be positive definite: some motion would have no kinetic energy")
    return half


def mass_normalised(L: jax.Array, X: jax.Array) -> jax.Array:
    """L^-1 X L^-T (n, n): the matrix X in coordinates in which M = L L^T is the identity."""
    half = jax.scipy.linalg.solve_triangular(L, X, lower=True)
    return jax.scipy.linalg.solve_triangular(L, half.T, lower=True).T
