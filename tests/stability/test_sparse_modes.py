"""Modes of a large sparse chain in a band, against their closed form."""

import numpy as np
import pytest
import scipy.sparse

from fractaljax._stability.sparse_modes import band_modes

N, BETA = 150, 1e-3  # masses of 1 kg, springs of 1 N/m between two walls, C = BETA K


def chain():
    K = scipy.sparse.csr_array(2 * np.eye(N) - np.eye(N, k=1) - np.eye(N, k=-1))
    return scipy.sparse.csr_array(np.eye(N)), BETA * K, K


@pytest.mark.parametrize("band", [(0.0, 2.0), (0.3, 1.1)])
def test_a_crowded_band_is_halved_until_all_its_modes_are_found(band):
    """A shift finds the 40 nearest; in these bands there are 150 and 63."""
    omega = 2 * np.sin(np.arange(1, N + 1) * np.pi / (2 * (N + 1)))
    closed = -BETA * omega**2 / 2 + 1j * omega * np.sqrt(1 - (BETA * omega / 2) ** 2)
    closed = closed[(closed.imag > band[0]) & (closed.imag <= band[1])]
    found = band_modes(chain(), band)
    assert len(closed) > 40
    np.testing.assert_allclose(found.s, closed, atol=1e-11)
    M, C, K = chain()
    for s, right, left in zip(found.s, found.right.T, found.left.T, strict=True):
        dynamic = s**2 * M + s * C + K
        assert np.linalg.norm(dynamic @ right) < 1e-9 * np.linalg.norm(right)
        assert np.linalg.norm(dynamic.T @ left) < 1e-9 * np.linalg.norm(left)


def test_more_equal_modes_than_can_be_told_apart_are_refused():
    one = scipy.sparse.csr_array(np.eye(N))
    with pytest.raises(ValueError, match=r"too many eigenvalues near .*: choose a narrower band"):
        band_modes((one, 0 * one, one), (0.5, 1.5))
