"""Matrices as they are read, mass matrices, coordinates of unit mass, and damping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import fractaljax as fj
from fractaljax._mechanism.matrices import as_array, fitting, mass_matrix, mass_normalised, square
from structures import beam, matrices, state_matrix
from tools import refusals

M, C, K = matrices(5)
UNEVEN = jnp.array([[1.0, 0.5], [0.0, 1.0]])
RATIOS = np.array([0.03, 0.01, 0.02, 0.0, 0.05])


@pytest.mark.parametrize(
    "convert", [np.ndarray.tolist, scipy.sparse.csr_matrix, jnp.asarray, np.float32]
)
def test_arrays_of_every_kind(convert):
    found = as_array("K", convert(np.eye(3)))
    np.testing.assert_array_equal(found, np.eye(3))
    assert found.dtype == (np.float32 if convert is np.float32 else np.float64)
    traced = jax.jit(lambda x: as_array("F", [x, 2 * x]))(3)
    np.testing.assert_array_equal(traced, [3.0, 6.0])


@pytest.mark.parametrize(
    "value", ["K", None, [[1.0, "2"]], [[1.0], [2.0, 3.0]], [[True, 1]], 1j * K, [10**400]]
)
def test_what_is_no_as_array_real_numbers(value):
    with pytest.raises(TypeError, match="K must be an array of real numbers, got"):
        as_array("K", value)


test_refusals = refusals(
    [
        (lambda: fitting("K", np.eye(3), (2, 2)), r"K must have shape \(2, 2\) as M demands, got"),
        (lambda: fitting("K", [[np.nan]], (1, 1)), "K must be finite, got nan"),
        (lambda: square("M", M[:2]), r"M must be a square matrix, got shape \(2, 5\)"),
        (lambda: square("M", 3.0), r"M must be a square matrix, got shape \(\)"),
        (lambda: mass_matrix(jnp.diag(jnp.array([1.0, 1, 0]))), "definite, got 0.0 on its .* at 2"),
        (lambda: mass_matrix(UNEVEN), r"symmetric, got 0.5 at \(0, 1\) and 0.0 at \(1, 0\)"),
        (lambda: mass_matrix(jnp.ones((3, 3))), "definite: some motion would have no kinetic"),
        (lambda: mass_matrix(jnp.ones((3, 3)) - 0.1 * jnp.eye(3)), "no kinetic energy"),
        (lambda: fj.rayleigh_damping(M, K, -1.0, 0.0), r"alpha must be at least 0, got -1\.0"),
        (lambda: fj.rayleigh_damping(M, K, 1.0, RATIOS), "beta must be a single number"),
        (lambda: fj.rayleigh_damping(M, np.eye(4), 1.0, 0), r"K must have shape \(5, 5\)"),
        (lambda: fj.modal_damping(M, np.eye(4), 0.01), r"K must have shape \(5, 5\)"),
        (lambda: fj.modal_damping(-M, K, 0.01), "M must be positive definite"),
        (lambda: fj.modal_damping(M, np.triu(K), 0.01), "damping_ratio needs a symmetric K"),
        (lambda: fj.modal_damping(M, K, RATIOS[:2]), r"scalar or have shape \(5,\), got"),
        (lambda: fj.modal_damping(M, K, -0.1), r"damping_ratio must be at least 0, got -0\.1"),
    ]
)


def test_under_jit_it_is_nan():
    """By the same tests as where it is known."""
    checked = jax.jit(mass_matrix)
    wrong = [-jnp.eye(2), jnp.diag(jnp.array([1.0, 0])), UNEVEN]
    wrong += [jnp.ones((2, 2)), jnp.array([[1.0, 2.0], [2.0, 1.0]]), jnp.full((2, 2), jnp.nan)]
    for matrix in wrong:
        assert np.isnan(checked(matrix)).all()
    uneven = jnp.array([[4.0, 1 + 1e-9], [1.0, 1e-8 + 0.25]])
    np.testing.assert_array_equal(checked(uneven), mass_matrix(uneven))
    damping = jax.jit(lambda K: fj.modal_damping(jnp.eye(2), K, 0.01))
    assert np.isnan(damping(wrong[2])).all() and np.isfinite(damping(2 * jnp.eye(2))).all()


def test_a_mass_matrix_is_symmetric_and_one_in_its_coordinates():
    uneven = M.copy()
    uneven[0, 1] *= 1 + 1e-9
    found = np.asarray(mass_matrix(jnp.asarray(uneven)))
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(found, M, rtol=1e-9)
    weights = np.random.default_rng(0).standard_normal(M.shape)
    slope = jax.grad(lambda M: (mass_matrix(M) * weights).sum())(jnp.asarray(M))
    np.testing.assert_allclose(slope, (weights + weights.T) / 2, rtol=1e-14)
    # Frequencies are those of M and K, and M itself is the identity.
    L = jnp.linalg.cholesky(M)
    np.testing.assert_allclose(mass_normalised(L, jnp.asarray(M)), np.eye(5), atol=1e-12)
    squares = np.linalg.eigvalsh(mass_normalised(L, jnp.asarray(K)))
    np.testing.assert_allclose(squares, scipy.linalg.eigh(K, M, eigvals_only=True), rtol=1e-10)


def damping_ratios(C):
    """Those of the modes in the order of rising frequency, by SciPy, and the frequencies."""
    s = np.linalg.eigvals(state_matrix(M, C, K))
    s = s[np.imag(s) > 0]
    s = s[np.argsort(abs(s))]
    return -np.real(s) / abs(s), abs(s)


def test_rayleigh_damping_and_rigid_body_modes():
    C = fj.rayleigh_damping(M, scipy.sparse.csr_matrix(K), 2.0, 3e-6)
    np.testing.assert_allclose(C, 2.0 * M + 3e-6 * K)
    ratios, omega = damping_ratios(C)
    np.testing.assert_allclose(ratios, (2.0 / omega + 3e-6 * omega) / 2, rtol=1e-10)
    # Of a size whose dense matrix would take gigabytes.
    n = 30_000
    X = scipy.sparse.diags_array(2.0 + np.arange(n)) - scipy.sparse.eye_array(n, k=1)
    eye = scipy.sparse.eye_array(n)
    C = fj.rayleigh_damping(eye, X, 3.0, 1e-3)
    assert scipy.sparse.issparse(C)
    assert abs((C - (3.0 * eye + 1e-3 * X)).tocsr()).max() == 0
    few = scipy.sparse.eye_array(2500)
    mixed = fj.rayleigh_damping(few, 2 * np.eye(2500), 3.0, 0.5)
    np.testing.assert_array_equal(mixed, 4.0 * np.eye(2500))
    C = np.asarray(fj.modal_damping(*beam(5, free=True), 0.02))
    np.testing.assert_allclose(C @ np.tile([1.0, 0.0], 6), 0, rtol=0, atol=1e-6 * np.abs(C).max())


@pytest.mark.parametrize("ratio", [0.01, RATIOS])
def test_modal_damping(ratio):
    """Every mode has the ratio that was asked for."""
    C = fj.modal_damping(M, K, ratio)
    np.testing.assert_allclose(C, C.T, rtol=0, atol=1e-12 * np.abs(C).max())
    ratios, omega = damping_ratios(C)
    np.testing.assert_allclose(ratios, np.broadcast_to(ratio, 5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(omega**2, scipy.linalg.eigh(K, M, eigvals_only=True), rtol=1e-10)
