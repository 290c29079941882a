"""Roughness parameters from filtered moments, beside simulated profiles and measured ones."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._surface.spectral_parameters import (
    gaussian_profile_parameters,
    roughness_transmission,
)
from tools import both_gradients

CUTOFF, SHORTEST, DX = 8e-4, 2e-5, 4e-6


def test_transmission():
    """Half at the nesting indices; long waves leave (lambda_c f)^2 ln 2."""
    q = 2 * math.pi / np.array([CUTOFF, SHORTEST])
    np.testing.assert_allclose(roughness_transmission(q), 1)
    np.testing.assert_allclose(roughness_transmission(q[0], CUTOFF), 0.5, rtol=1e-15)
    np.testing.assert_allclose(roughness_transmission(q[1], None, SHORTEST), 0.5, rtol=1e-15)
    both = roughness_transmission(q, CUTOFF, SHORTEST)
    np.testing.assert_allclose(both, [0.5 * 2 ** -(1 / 1600), 0.5 * (1 - 2.0**-1600)], rtol=1e-12)
    long = roughness_transmission(1e-9 * q[0], CUTOFF)
    assert float(long) == pytest.approx(1e-18 * math.log(2), rel=1e-12)


def simulated(sections=400):
    """(z, m0, m2) of a long periodic profile behind the filters, with n^-2.4 for its spectrum."""
    n = round(sections * CUTOFF / DX)
    q = 2 * np.pi * np.fft.rfftfreq(n, DX)
    share = np.asarray(roughness_transmission(q, CUTOFF, SHORTEST))
    amplitude = share * np.maximum(q, 1e3) ** -1.2
    random = np.random.default_rng(2)
    waves = amplitude * (random.standard_normal(q.size) + 1j * random.standard_normal(q.size))
    power = 2 * amplitude**2 / n**2 * 2
    return np.fft.irfft(waves, n), power.sum(), (power * q**2).sum()


def test_simulated_profile():
    """Ra, Rq, Rdq and Mr1 agree; Rz is high by 4 to 12 %, as said; RSm leaves no hill out."""
    z, m0, m2 = simulated()
    expected = gaussian_profile_parameters(m0, m2, CUTOFF)
    p = fj.profile_parameters(z, DX, sections=400)
    for name in ("Ra", "Rq", "Rdq", "Rk"):
        assert float(getattr(p, name)) == pytest.approx(float(getattr(expected, name)), rel=0.03)
    for name in ("Rpk", "Rvk", "Mr1", "Rku"):
        assert float(getattr(p, name)) == pytest.approx(float(getattr(expected, name)), rel=0.08)
    assert 1.04 < float(expected.Rz / p.Rz) < 1.12
    upward = np.sum((z[:-1] <= 0) & (z[1:] > 0))
    assert z.size * DX / upward == pytest.approx(float(expected.RSm), rel=0.03)
    assert p.RSm > expected.RSm
    totals = np.ptp(z.reshape(80, -1), axis=1).mean()
    assert 1.02 < float(expected.Rt) / totals < 1.12


def test_batches_and_derivatives():
    """Lengths scale with m0^(1/2), and Rdq with m2^(1/2)."""
    m0, m2 = np.array([1e-12, 4e-12]), np.array([0.01, 0.04])
    batch = gaussian_profile_parameters(m0, m2, CUTOFF)
    for name, value in vars(batch).items():
        assert value.shape == (2,), name
    np.testing.assert_allclose(batch.Rz[1] / batch.Rz[0], 2, rtol=1e-12)
    slopes = both_gradients(
        lambda x: gaussian_profile_parameters(x[0], x[1], CUTOFF).Rz, (1e-12, 0.01)
    )
    for forward, reverse in zip(*slopes, strict=True):
        assert float(forward) == pytest.approx(float(reverse), rel=1e-12)
    Rz = jax.jit(lambda m2: gaussian_profile_parameters(1e-12, m2, CUTOFF).Rz)
    difference = (Rz(jnp.array(0.01 + 1e-7)) - Rz(jnp.array(0.01 - 1e-7))) / 2e-7
    assert float(slopes[0][1]) == pytest.approx(float(difference), rel=1e-6)
