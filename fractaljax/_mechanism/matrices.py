"""The matrices of a structure: checked, summed, and transformed to unit mass."""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from .._base.parts import Numbers, concrete, nan_where, number
from .coefficient import Parameters, check_coefficient, evaluated

MatrixLike = Any  # an array, a nested list, or a sparse matrix of SciPy's


class Sparse:
    """A large sparse matrix of SciPy's, outside of JAX; compared by identity."""

    def __init__(self, matrix: Any):
        self.matrix = matrix.tocsr()


class MatrixSum(eqx.Module):
    """A matrix as a sum of matrices (n, n), each times a coefficient: sum_i c_i(p) X_i.

    Large sparse matrices are not leaves of the pytree: only a reduction can use them.
    """

    arrays: tuple[Numbers, ...]
    sparse: tuple[Sparse, ...] = eqx.field(static=True)  # in place of all arrays, or empty
    coefficients: tuple[Callable | None, ...] = eqx.field(static=True)  # None for 1

    @property
    def matrices(self) -> list[Any]:
        """The matrix of each term, an array or sparse, without its coefficient."""
        return [each.matrix for each in self.sparse] or list(self.arrays)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the sum, with batch axes before the two of the matrix."""
        return self.matrices[0].shape

    def at(self, p: Parameters) -> Any:
        """The sum at parameters p: an array, or a sparse matrix."""
        total = None
        for coefficient, X in zip(self.coefficients, self.matrices, strict=True):
            value = evaluated(coefficient, p)
            if value is not None:
                X = X * (float(value) if self.sparse else value)
            total = X if total is None else total + X
        return total

    def projected(self, left: np.ndarray, right: np.ndarray) -> "MatrixSum":
        """The sum with each X replaced by left^T X right, where left and right are (n, r)."""
        held = self.matrices if self.sparse else map(np.asarray, self.arrays)
        arrays = tuple(jnp.asarray(left.T @ (X @ right)) for X in held)
        return MatrixSum(arrays, (), self.coefficients)


def matrix_sum(
    name: str, matrix: Any, p: Parameters, fit: Callable[[str, MatrixLike], Any]
) -> MatrixSum:
    """The sum from a matrix or a sequence of (coefficient, matrix), each matrix checked by `fit`.

    A numeric coefficient is multiplied into its matrix.

    **Raises:** as `fit` and `check_coefficient`, naming the term.
    """
    terms = matrix if is_sum(matrix) else [(None, matrix)]
    arrays, coefficients = [], []
    for i, (coefficient, X) in enumerate(terms, start=1):
        term = f"{name}, term {i}" if terms is matrix else name
        X = fit(term, X)
        if coefficient is not None:
            coefficient = check_coefficient(f"the coefficient of {term}", coefficient, p)
        if coefficient is not None and not callable(coefficient):
            X, coefficient = (
                X * (np.asarray(coefficient).item() if is_sparse(X) else coefficient),
                None,
            )
        arrays.append(X)
        coefficients.append(coefficient)
    if any(map(is_sparse, arrays)):
        from scipy.sparse import csr_array

        kept = [Sparse(X if is_sparse(X) else csr_array(np.asarray(X))) for X in arrays]
        return MatrixSum((), tuple(kept), tuple(coefficients))
    return MatrixSum(tuple(arrays), (), tuple(coefficients))


def placed(small: Numbers, places: Sequence[int], n: int, sparse: bool) -> Any:
    """A matrix (n, n) with `small` (k, k) in the rows and columns `places`, and 0 elsewhere."""
    index = np.array(places, int)
    if not sparse:
        return jnp.zeros((n, n), small.dtype).at[index[:, None], index[None]].set(small)
    from scipy.sparse import coo_array

    i, j = np.meshgrid(index, index, indexing="ij")
    return coo_array((np.asarray(small).ravel(), (i.ravel(), j.ravel())), shape=(n, n)).tocsr()


def merged(matrix: Any) -> Any:
    """A matrix or sum with all terms that have no coefficient as one, the first."""
    if not is_sum(matrix):
        return matrix
    plain = [X for coefficient, X in matrix if coefficient is None]
    rest = [(coefficient, X) for coefficient, X in matrix if coefficient is not None]
    if not plain:
        return rest
    whole = functools.reduce(operator.add, plain)
    return [(None, whole), *rest] if rest else whole


def separated(K: Any, K_loss: Any) -> tuple[Any, Any]:
    """K and K_loss, both real, from a K that may be complex: K + i K_loss, structural damping.

    Both are matrices or sequences of (coefficient, matrix), each of which may be complex. Imaginary
    parts are added to K_loss.
    """
    terms = K if is_sum(K) else [(None, K)]
    if not any(_is_complex(each) for term in terms for each in term):
        return K, K_loss
    loss = [] if K_loss is None else list(K_loss if is_sum(K_loss) else [(None, K_loss)])
    real = []
    for coefficient, X in terms:
        if not (_is_complex(coefficient) or _is_complex(X)):
            real.append((coefficient, X))
            continue
        X = X if hasattr(X, "dtype") else np.asarray(X)
        if _is_complex(coefficient):
            X, coefficient = coefficient * X, None
        real.append((coefficient, X.real))
        loss.append((coefficient, X.imag))
    one = is_sum(K) or len(loss) > 1
    return (real, loss) if one else (real[0][1], loss[0][1])


def _is_complex(value: Any) -> bool:
    """True for a complex number, array, sparse matrix, or nested list with a complex number."""
    if hasattr(value, "dtype"):
        return jnp.issubdtype(value.dtype, jnp.complexfloating)
    return any(isinstance(entry, complex) for entry in jax.tree.leaves(value))


def is_sum(value: Any) -> bool:
    """True for a sequence of (coefficient, matrix), False for a nested list of numbers."""

    def is_matrix(x):
        if isinstance(x, (list, tuple)):
            return bool(x) and isinstance(x[0], (list, tuple))
        return len(getattr(x, "shape", ())) == 2

    pairs = isinstance(value, Sequence) and not isinstance(value, str) and len(value) > 0
    return pairs and all(
        isinstance(each, (list, tuple)) and len(each) == 2 and is_matrix(each[1]) for each in value
    )


def is_sparse(X: Any) -> bool:
    """True if X is a sparse matrix of SciPy's."""
    return hasattr(X, "toarray")


def as_array(name: str, value: MatrixLike) -> Numbers:
    """An array of finite real numbers from a nested list, an array or a SciPy sparse matrix.

    **Raises:** `TypeError` for anything else; `ValueError` for NaN and infinity.
    """
    value = value.toarray() if is_sparse(value) else value
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
    """As `as_array`, with a `ValueError` unless it is a square matrix."""
    array = as_array(name, value)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not array.size:
        raise ValueError(f"{name} must be a square matrix, got shape {array.shape}")
    return array


def fitting(name: str, value: MatrixLike, shape: tuple[int, ...]) -> Numbers:
    """As `as_array`, with a `ValueError` for any shape but the one that M demands."""
    array = as_array(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape} as M demands, got {array.shape}")
    return array


def square_or_sparse(name: str, value: MatrixLike, largest_dense: int = 2000) -> Any:
    """As `square`, but a sparse matrix of more than `largest_dense` rows stays sparse."""
    if not is_sparse(value) or value.ndim != 2 or max(value.shape) <= largest_dense:
        return square(name, value)
    if value.shape[0] != value.shape[1]:
        raise ValueError(f"{name} must be a square matrix, got shape {value.shape}")
    if value.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be an array of real numbers, got {value.dtype} numbers")
    if not np.isfinite(value.data).all():
        raise ValueError(f"{name} must be finite")
    return value.astype(float)


def fitting_or_sparse(name: str, value: MatrixLike, shape: tuple[int, ...]) -> Any:
    """As `fitting`, but a large sparse matrix stays sparse."""
    value = square_or_sparse(name, value) if is_sparse(value) else value
    if not is_sparse(value):
        return fitting(name, value, shape)
    if value.shape != shape:
        raise ValueError(f"{name} must have shape {shape} as M demands, got {value.shape}")
    return value


def require_mass_matrix(M: Any) -> None:
    """Refuse a sparse M that is not symmetric to 1e-6, or with a diagonal that is not positive."""
    diagonal = M.diagonal()
    if diagonal.min() <= 0:
        got = f"{diagonal.min()} on its diagonal at {diagonal.argmin()}"
        raise ValueError(f"M must be positive definite, got {got}")
    if abs(M - M.T).max() > 1e-6 * abs(M).max():
        raise ValueError("M must be symmetric")


def mass_matrix(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """M (n, n) made exactly symmetric.

    **Raises:** `ValueError` unless M is symmetric to 1e-6 and positive definite; a traced M
    becomes NaN instead.
    """
    values = concrete(M)
    # NumPy unless M is traced: JAX would compile a program for each shape.
    X = M if isinstance(M, Tracer) else np.asarray(M)
    half = jnp.asarray((X + X.T) / 2)
    if values is None:
        units = jnp.sqrt(jnp.diagonal(half))
        unit = jax.lax.stop_gradient(M / units[:, None] / units[None])
        pivot = jnp.diagonal(jnp.linalg.cholesky((unit + unit.T) / 2)).min() ** 2
        good = (jnp.abs(unit - unit.T).max() <= 1e-6) & (pivot > _least_pivot(unit))
        return nan_where(~good, half)
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
    if pivot <= _least_pivot(unit):
        raise ValueError("M must be positive definite: some motion would have no kinetic energy")
    return half


def _least_pivot(unit) -> float:
    """The pivot of a unit-diagonal mass matrix at which all digits of the matrix are lost."""
    return len(unit) * float(np.finfo(unit.dtype).eps)


def mass_normalised(L: Float[Array, "n n"], X: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L^-1 X L^-T: the matrix X in coordinates in which M = L L^T is the identity."""
    half = solve_triangular(L, X, lower=True)
    return solve_triangular(L, half.T, lower=True).T
