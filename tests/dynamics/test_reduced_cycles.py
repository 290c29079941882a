"""Limit cycles of reduced structures beside those of the full ones they stand for."""

import functools

import jax
import numpy as np
import pytest

import fractaljax as fj
import hybrid_truth
from structures import beam_on_pad, monodromy_of, truth_of

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


def with_slope(x, name, value, **options):
    """The limit cycle, and the derivative of its period by a quantity with that value."""

    def period(value):
        cycle = fj.limit_cycle(x.replace(**{name: value}), **options)
        return cycle.period, cycle

    _, slope, cycle = jax.jvp(period, (value,), (1.0,), has_aux=True)
    return cycle, float(slope)


@functools.cache
def full_cycle():
    return with_slope(rods(), "middle.P", 0.5)


# Amplitudes are of 4000 points of the orbit.
@pytest.mark.slow
@pytest.mark.parametrize(("top", "n", "close"), [(3.0, 11, 2e-4), (12.0, 16, 2e-7)])
def test_cycle_of_a_reduction_is_that_of_the_structure(top, n, close):
    """The better the wider the band: to rounding where it holds all modes, slopes as well."""
    full, wanted = full_cycle()
    over = {"middle.P": (0.4, 0.6)} if n == full._system.n else {}
    reduced = fj.reduce(rods(), over, (0, top), tol=1e-9, progress=False)
    assert reduced.n == n
    if over:
        cycle, slope = with_slope(reduced, "middle.P", 0.5)
        assert abs(wanted) > 1e-2 and slope == pytest.approx(wanted, rel=1e-7)
    else:
        cycle = fj.limit_cycle(reduced)
    assert 0.1 < full.stick_fraction[0] < 0.5
    np.testing.assert_allclose(cycle.period, full.period, rtol=close / 10)
    np.testing.assert_allclose(cycle.stick_fraction, full.stick_fraction, atol=close)
    np.testing.assert_allclose(cycle.normal_force, full.normal_force, rtol=close)
    moved = np.asarray(reduced.full(cycle.orbit(4000)[1]))
    assert moved.shape == (4000, 4 * N)
    for dof in TIPS:
        assert np.ptp(moved[:, dof]) == pytest.approx(float(full.amplitude[dof]), rel=close)


@functools.cache
def brake():
    """Nine rough joints under a beam, 45 of 150 degrees of freedom; one unstable mode, 12.7 kHz."""
    surface, lining = fj.Surface(2.4, 1e-8, 1.5), fj.Material(2e9, 0.25, 5e7, 1.5e8)
    structure = beam_on_pad(
        lambda share: fj.FractalContact(surface, lining, P=4000 * share),
        0.35,
        lambda M, K: fj.rayleigh_damping(M, K, 20.0, 1e-6),
        V=1.0,
        preload=True,
    )
    return fj.reduce(structure, {}, (0, 2 * np.pi * 15000), tol=1e-6, progress=False)


@pytest.mark.slow
@pytest.mark.optimised
def test_squeal_of_nine_joints():
    """From the default start, through 600 periods of growth; two of the joints lift off."""
    reduced = brake()
    cycle, slope = with_slope(reduced, "pair_3.mu", 0.35, rtol=1e-12)

    def closed(mu):
        mechanism = truth_of(reduced.replace(**{"pair_3.mu": mu}))
        z, T = np.asarray(cycle.state) / mechanism.units, float(cycle.period) * mechanism.omega
        near = mechanism.map_in_units(monodromy_of(cycle))
        return mechanism, *hybrid_truth.closed(mechanism.scaled, z, T, 1e-12, near)

    mechanism, z, T, trip = closed(0.35)
    assert T / mechanism.omega == pytest.approx(float(cycle.period), rel=1e-11)
    state = z * mechanism.units
    np.testing.assert_allclose(cycle.state, state, rtol=0, atol=1e-10 * abs(state).max())
    stick, _, opened = hybrid_truth.shares(mechanism.scaled, trip) / T
    np.testing.assert_allclose(cycle.stick_fraction, stick, rtol=0, atol=1e-10)
    np.testing.assert_allclose(cycle.open_fraction, opened, rtol=0, atol=1e-10)
    assert np.flatnonzero(opened).tolist() == [0, 2] and stick[0] > 0.05
    sizes = np.sort(abs(np.linalg.eigvals(hybrid_truth.monodromy(mechanism.scaled, trip))))
    np.testing.assert_allclose(np.sort(abs(cycle.multipliers))[-6:], sizes[-6:], rtol=1e-7)

    h = 1e-4
    ends = [T / own.omega for own, _, T, _ in map(closed, (0.35 - h, 0.35 + h))]
    assert slope == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-6)
