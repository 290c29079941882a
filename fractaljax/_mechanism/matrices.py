"""The matrices of a structure: read, checked, and in coordinates of unit mass."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from .._base.parts import Numbers, concrete, number

MatrixLike = Any  # an array, a nested list, or a sparse matrix of SciPy's


def array_of(name: str, value: MatrixLike) -> Numbers:
    """A nested list, an array or a sparse matrix of SciPy's as an array of finite real numbers.

    **Raises:** `TypeError` for anything else; `ValueError` for NaN and infinity.
    """
    value = value.toarray() if hasattr(value, "toarray") else value
    kind = f"{value.dtype} numbers" if hasattr(value, "dtype") else type(value).__name__
    wrong = TypeError(f"{name} must be an array of real numbers, got {kind}")
    if isinstance(value, (list, tuple)):
        if any(isinstance(entry, (str, bool, np.bool_)) for entry in jax.tree.leaves(value)):
            raise wrong
        try:
            value = jnp.asarray(value)
        except (ValueError, TypeError, OverflowError):  # ragged, no numbers, too large
            raise wrong from None
    try:
        return number(name, value)
    except TypeError:
        raise wrong from None


def square(name: str, value: MatrixLike) -> Float[Array, "n n"]:
    """Like `array_of`, and a `ValueError` unless it is a square matrix."""
    array = array_of(name, value)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not array.size:
        raise ValueError(f"{name} must be a square matrix, got shape {array.shape}")
    return array


def fitting(name: str, value: MatrixLike, shape: tuple[int, ...]) -> Numbers:
    """Like `array_of`, and a `ValueError` for another shape than the mass matrix demands."""
    array = array_of(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape} as M demands, got {array.shape}")
    return array


def mass_matrix(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """M (n, n) made exactly symmetric.

    **Raises:** `ValueError` unless M is symmetric to 1e-6 and positive definite.
    """
    values, half = concrete(M), (M + M.T) / 2
    if values is None:
        bad = ~jnp.isfinite(jnp.linalg.cholesky(half)).all()
        return eqx.error_if(half, bad, "M must be positive definite")
    diagonal = np.diagonal(values)
    i = int(diagonal.argmin())
    if diagonal[i] <= 0:
        got = f"{diagonal[i].item()} on its diagonal at {i}"
        raise ValueError(f"M must be positive definite, got {got}")
    unit = values / np.sqrt(diagonal)[:, None] / np.sqrt(diagonal)[None]
    uneven = np.abs(unit - unit.T)
    if uneven.max() > 1e-6:
        i, j = np.unravel_index(uneven.argmax(), uneven.shape)
        got = f"{values[i, j].item()} at ({i}, {j}) and {values[j, i].item()} at ({j}, {i})"
        raise ValueError(f"M must be symmetric, got {got}")
    try:
        pivot = np.diagonal(np.linalg.cholesky((unit + unit.T) / 2)).min() ** 2
    except np.linalg.LinAlgError:
        pivot = 0.0
    if pivot <= len(unit) * np.finfo(unit.dtype).eps:
        raise ValueError("M must be positive definite: some motion would have no kinetic energy")
    return half


def mass_normalised(L: Float[Array, "n n"], X: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L^-1 X L^-T: the matrix X in coordinates in which M = L L^T is the identity."""
    half = solve_triangular(L, X, lower=True)
    return solve_triangular(L, half.T, lower=True).T
