"""Damping matrices: every mode has the ratio that was asked for."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import fractaljax as fj
from structures import beam, matrices


def damping_ratios(M, C, K):
    modes = fj.stability(fj.Structure(M, C, K, []))
    s = [s for s in modes.eigenvalues.tolist() if s.imag > 0]
    s.sort(key=abs)
    return np.array([-x.real / abs(x) for x in s]), np.abs(s)


def test_rayleigh_damping():
    M, _, K = matrices(5)
    C = fj.rayleigh_damping(M, K, 2.0, 3e-6)
    np.testing.assert_allclose(C, 2.0 * M + 3e-6 * K)
    ratios, omega = damping_ratios(M, C, K)
    np.testing.assert_allclose(ratios, (2.0 / omega + 3e-6 * omega) / 2, rtol=1e-10)
    with pytest.raises(ValueError, match=r"alpha must be at least 0, got -1\.0"):
        fj.rayleigh_damping(M, K, -1.0, 0.0)


@pytest.mark.parametrize("ratio", [0.01, np.array([0.03, 0.01, 0.02, 0.0, 0.05])])
def test_modal_damping(ratio):
    M, _, K = matrices(5)
    C = fj.modal_damping(M, K, ratio)
    np.testing.assert_allclose(C, C.T, rtol=0, atol=1e-12 * np.abs(C).max())
    ratios, omega = damping_ratios(M, C, K)
    np.testing.assert_allclose(ratios, np.broadcast_to(ratio, 5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(omega**2, scipy.linalg.eigh(K, M, eigvals_only=True), rtol=1e-10)


def test_modal_damping_leaves_rigid_body_modes_free():
    M, K = beam(5, free=True)
    C = fj.modal_damping(M, K, 0.02)
    rigid = np.tile([1.0, 0.0], 6)
    scale = np.abs(C).max()
    np.testing.assert_allclose(C @ rigid, 0, rtol=0, atol=1e-6 * scale)


def test_modal_damping_refuses():
    M, _, K = matrices(3)
    with pytest.raises(ValueError, match="damping_ratio needs a symmetric K"):
        fj.modal_damping(M, np.triu(K), 0.01)
    with pytest.raises(ValueError, match=r"scalar or have shape \(3,\), got shape \(2,\)"):
        fj.modal_damping(M, K, np.array([0.1, 0.2]))
    with pytest.raises(ValueError, match=r"damping_ratio must be at least 0, got -0\.1"):
        fj.modal_damping(M, K, -0.1)


def test_what_has_another_shape_is_refused():
    M, _, K = matrices(3)
    for damping in (fj.rayleigh_damping, lambda M, K, *_: fj.modal_damping(M, K, 0.01)):
        with pytest.raises(ValueError, match=r"M must be a square matrix, got shape \(3,\)"):
            damping(np.diag(M), K, 1.0, 1e-6)
        with pytest.raises(
            ValueError, match=r"K must have shape \(3, 3\) as M demands, got \(3,\)"
        ):
            damping(M, np.diag(K), 1.0, 1e-6)
        with pytest.raises(ValueError, match=r"K must have shape \(3, 3\) as M demands"):
            damping(M, np.eye(4), 1.0, 1e-6)
        sparse = damping(scipy.sparse.csr_matrix(M), scipy.sparse.csr_matrix(K), 1.0, 1e-6)
        np.testing.assert_array_equal(sparse, damping(M, K, 1.0, 1e-6))
    with pytest.raises(ValueError, match=r"beta must be a scalar, got shape \(3,\)"):
        fj.rayleigh_damping(M, K, 1.0, np.ones(3))
    with pytest.raises(ValueError, match="M must be positive definite"):
        fj.modal_damping(-M, K, 0.01)
