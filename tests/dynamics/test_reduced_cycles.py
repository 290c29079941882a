"""Limit cycles of reduced structures beside those of the full ones they stand for."""

import functools

import jax
import numpy as np
import pytest

import fractaljax as fj

N = 8  # masses of each of two rods at right angles
TIPS = [N - 1, 2 * N - 1]


@functools.cache
def rods():
    """Two joints, at the ends and the middles; friction that falls with speed. It squeals."""
    stiffness = np.diag([2.0] * (N - 1) + [1.0]) - np.eye(N, k=1) - np.eye(N, k=-1)
    M, K = np.eye(2 * N) / N, np.kron(np.eye(2), N * stiffness)
    law = fj.ExponentialStribeck(0.6, 0.45, 0.5)
    tip = fj.Joint(fj.FixedContact(1.0, 0.5, P=1.0), law, N - 1, 2 * N - 1, V=0.5, preload=True)
    middle = fj.FixedContact(1.0, 0.3, P=0.5), law, N // 2 - 1, N + N // 2 - 1
    joints = {"tip": tip, "middle": fj.Joint(*middle, V=0.5, preload=True)}
    return fj.Structure(M, 0.02 * M + 0.1 * K, K, joints)


@functools.cache
def full_cycle():
    return fj.limit_cycle(rods())


# Amplitudes are of 4000 points of the orbit.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("top", "n", "close"), [(3.0, 11, 2e-4), (6.0, 12, 1e-5), (12.0, 16, 2e-7)]
)
def test_cycle_of_a_reduction_is_that_of_the_structure(top, n, close):
    """The better the wider the band: to rounding where it holds all modes."""
    full = full_cycle()
    reduced = fj.reduce(rods(), {}, (0, top), tol=1e-9, progress=False)
    assert reduced.n == n
    cycle = fj.limit_cycle(reduced)
    assert 0.1 < full.stick_fraction[0] < 0.5
    np.testing.assert_allclose(cycle.period, full.period, rtol=close / 10)
    np.testing.assert_allclose(cycle.stick_fraction, full.stick_fraction, atol=close)
    np.testing.assert_allclose(cycle.normal_force, full.normal_force, rtol=close)
    moved = np.asarray(reduced.full(cycle.orbit(4000)[1]))
    assert moved.shape == (4000, 4 * N)
    for dof in TIPS:
        assert np.ptp(moved[:, dof]) == pytest.approx(float(full.amplitude[dof]), rel=close)


@pytest.mark.slow
def test_derivative_of_the_period_of_a_reduction():
    reduced = fj.reduce(rods(), {"middle.P": (0.4, 0.6)}, (0, 12.0), tol=1e-9, progress=False)

    def period(x):
        return lambda P: fj.limit_cycle(x.replace(**{"middle.P": P})).period

    slope, wanted = (float(jax.jacfwd(period(x))(0.5)) for x in (reduced, rods()))
    assert abs(wanted) > 1e-2 and slope == pytest.approx(wanted, rel=1e-7)
