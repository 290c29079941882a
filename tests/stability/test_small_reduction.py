"""The smallest reduction of a short beam that meets its tolerance."""

import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from structures import beam, state_matrix

BAND = (0.0, 4000.0)


def in_band(M, C, K):
    s = scipy.linalg.eigvals(state_matrix(*map(np.asarray, (M, C, K))))
    return np.sort_complex(s[(s.imag > 0) & (s.imag <= BAND[1])])


@pytest.mark.parametrize("joints", [(), "one"])
def test_a_reduction_is_as_small_as_its_tolerance_lets_it_be(joints):
    M, K = beam(8)
    C = 3.0 * M + 2e-7 * K
    if joints:
        contact = fj.FixedContact(4e5, 2e5, P=300.0)
        joints = [fj.Joint(contact, fj.Coulomb(0.4), 14, 10, preload=True)]
    full = fj.Structure(M, C, K, joints)
    wanted = in_band(*fj.assemble(full))
    sizes = []
    for tol in (1e-3, 1e-8):
        reduced = fj.reduce(full, {}, BAND, tol)
        found = in_band(*fj.assemble(reduced))
        assert len(found) == len(wanted) >= 3
        assert (abs(found - wanted) <= tol * abs(wanted)).all() and reduced.reduction.error <= tol
        sizes.append(reduced.n)
    # Of these modes each has a vector, and joints couple some more of them.
    assert sizes == ([7, 9] if joints else [5, 5])
