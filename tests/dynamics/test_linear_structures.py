"""Structures without joints: nothing rubs, and every motion has a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import fractaljax as fj
from tools import both_modes

M, C, K = np.diag([1.0, 2.0]), np.diag([0.1, 0.3]), np.array([[2.0, -1.0], [-1.0, 3.0]])
F, FORCE, FREQUENCY = np.array([1.0, 0.0]), np.array([0.7, -0.2]), 0.2


def structure(factor=1.0, scale=1.0) -> fj.Structure:
    return fj.Structure(M, C, factor * K, joints=[], F=scale * F)


def response(factor=1.0):
    """The complex displacement under the harmonic force."""
    Omega = 2 * np.pi * FREQUENCY
    return np.linalg.solve(factor * K - Omega**2 * M + 1j * Omega * C, FORCE)


def test_free_motion():
    """The matrix exponential, from starts of the sizes of machines and of atoms."""
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, np.hstack([K, C]))]])
    for scale in (1.0, 1e-9):
        start, rest = scale * np.array([1.0, 0.5, 0.0, -1.0]), scale * np.linalg.solve(K, F)
        rest = np.r_[rest, 0, 0]
        found = fj.simulate(structure(scale=scale), start, 7.0)
        truth = rest + expm(7.0 * A) @ (start - rest)
        np.testing.assert_allclose(found.end, truth, rtol=0, atol=1e-8 * scale)
        assert found.switches() == []
    cycle = fj.limit_cycle(structure(), throw=False)
    assert cycle.result == fj.CycleResult.equilibrium


def test_forced_motion():
    """Amplitudes, multipliers and the state at the time 0 of the steady response."""
    force = fj.Excitation(FORCE, FREQUENCY)
    cycle = fj.limit_cycle(structure(), excitation=force)
    x = response()
    assert float(cycle.period) == pytest.approx(1 / FREQUENCY, rel=1e-14)
    np.testing.assert_allclose(cycle.amplitude, 2 * abs(x), rtol=1e-9)
    wanted = np.r_[np.linalg.solve(K, F) + x.real, -(2 * np.pi * FREQUENCY) * x.imag]
    np.testing.assert_allclose(cycle.state, wanted, rtol=1e-8)
    assert cycle.normal_force.shape == (0, 2) and cycle.stick_fraction.shape == (0,)
    assert cycle.open_fraction.shape == cycle.tension_fraction.shape == (0,)
    s = np.asarray(fj.stability(structure()).eigenvalues)
    moduli = np.sort(abs(np.exp(s / FREQUENCY)))
    np.testing.assert_allclose(np.sort(abs(np.asarray(cycle.multipliers))), moduli, rtol=1e-8)


@pytest.mark.slow
def test_starts_of_a_forced_motion():
    """All end in the one response."""
    force = fj.Excitation(FORCE, FREQUENCY)
    shares = fj.basin(structure(), radius=1.0, starts=8, excitation=force, progress=False).shares
    assert shares["cycle 1"] == 1


@pytest.mark.slow
def test_gradient_of_the_response():
    """By a factor of the stiffness, in both modes."""

    def amplitude(factor):
        force = fj.Excitation(FORCE, FREQUENCY)
        return fj.limit_cycle(structure(factor[0]), excitation=force, throw=False).amplitude

    value, *slopes = jax.jit(lambda x: both_modes(amplitude, x))(jnp.ones(1))
    np.testing.assert_allclose(value, 2 * abs(response()), rtol=1e-9)
    wanted = (abs(response(1 + 1e-5)) - abs(response(1 - 1e-5))) / 1e-5
    for slope in slopes:
        np.testing.assert_allclose(np.asarray(slope)[:, 0], wanted, rtol=1e-7)
