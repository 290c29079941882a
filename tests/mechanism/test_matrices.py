"""Matrices as they are read, what is no mass matrix, and coordinates of unit mass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

from fractaljax.mechanism.matrices import array_of, fitting, mass_matrix, mass_normalised
from structures import matrices


@pytest.mark.parametrize("convert", [np.ndarray.tolist, scipy.sparse.csr_matrix, np.float32])
def test_arrays_of_every_kind(convert):
    found = array_of("K", convert(np.eye(3)))
    np.testing.assert_array_equal(found, np.eye(3))
    assert found.dtype == (np.float32 if convert is np.float32 else np.float64)


@pytest.mark.parametrize("value", ["K", None, [[1.0, "2"]], [[1.0], [2.0, 3.0]], [[True]], 1j])
def test_what_is_no_array_of_real_numbers(value):
    with pytest.raises(TypeError, match="K must be an array of real numbers, got") as caught:
        array_of("K", value)
    assert "\n" not in str(caught.value)


def test_shapes_and_values_are_checked():
    with pytest.raises(ValueError, match=r"K must have shape \(2, 2\) as M demands, got \(3, 3\)"):
        fitting("K", np.eye(3), (2, 2))
    with pytest.raises(ValueError, match="K must be finite, got nan"):
        fitting("K", [[np.nan]], (1, 1))


def test_a_mass_matrix_is_made_exactly_symmetric():
    M = matrices(4)[0]
    uneven = M.copy()
    uneven[0, 1] *= 1 + 1e-9
    found = np.asarray(mass_matrix(array_of("M", uneven)))
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(found, M, rtol=1e-9)


@pytest.mark.parametrize(
    ("M", "message"),
    [
        ([[1.0, 0.0], [0.0, -2.0]], "positive definite, got -2.0 on its diagonal at 1"),
        ([[1.0, 0.5], [0.0, 1.0]], r"symmetric, got 0.5 at \(0, 1\) and 0.0 at \(1, 0\)"),
        ([[1.0, 1.0], [1.0, 1.0]], "positive definite: some motion would have no kinetic energy"),
    ],
)
def test_what_is_no_mass_matrix(M, message):
    with pytest.raises(ValueError, match=f"M must be {message}"):
        mass_matrix(array_of("M", M))


def test_what_is_no_mass_matrix_when_compiled():
    place = jax.jit(mass_matrix)
    np.testing.assert_array_equal(place(np.eye(2)), np.eye(2))
    with pytest.raises(Exception, match="M must be positive definite"):
        place(-np.eye(2))


def test_coordinates_of_unit_mass():
    """Frequencies are those of M and K, and M itself is the identity."""
    M, _, K = matrices(4)
    L = jnp.linalg.cholesky(M)
    np.testing.assert_allclose(mass_normalised(L, jnp.asarray(M)), np.eye(4), atol=1e-12)
    squares = np.linalg.eigvalsh(mass_normalised(L, jnp.asarray(K)))
    np.testing.assert_allclose(squares, scipy.linalg.eigh(K, M, eigvals_only=True), rtol=1e-10)
