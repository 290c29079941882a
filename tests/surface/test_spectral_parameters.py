"""Roughness parameters from filtered moments, beside simulated profiles and measured ones."""

import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import fractaljax as fj
from fractaljax._surface.spectral_parameters import (
    gaussian_profile_parameters,
    roughness_transmission,
)
from tools import both_gradients, both_modes, refusals

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


GROUND = fj.SelfAffine(1e-6, 0.8, 6e-5, 2e-6)
FILTERS: Any = dict(cutoff=2.5e-4, shortest=2e-5)


class Turned(fj.Spectrum):
    """Waves about the feed."""

    feed: Any
    longest: Any
    shortest: Any

    def m(self, q):
        return 1e-12 * jnp.exp(-2 * jnp.log(q * self.feed / (2 * jnp.pi)) ** 2)


@pytest.mark.parametrize(
    ("surface", "rtol"),
    [
        (GROUND, 1e-12),
        (fj.SelfAffine(1e-6, 0.8, 6e-5, 2e-6, lay=4.0), 1e-4),
        (Turned(1e-4, 1e-3, 1e-5), 1e-6),
    ],
    ids=["self-affine", "lay", "own"],
)
def test_without_filters(surface, rtol):
    """Rq = Sq and Rdq = Sdq/sqrt(2), and no extremes without a section."""
    p, s, rough = (
        fj.profile_parameters(surface),
        fj.areal_parameters(surface),
        fj.roughness(surface),
    )
    np.testing.assert_allclose([p.Rq, s.Sq, s.Sa], [rough.Sq, rough.Sq, rough.Sa], rtol=rtol)
    slopes = [p.Rdq * math.sqrt(2), s.Sdq, math.sqrt(s.Sdr / 50)]
    np.testing.assert_allclose(slopes, [rough.Sdq] * 3, rtol=1e-12)
    assert all(math.isnan(x) for x in (p.Rz, p.Rp, p.Rv, p.Rt, s.Sz, s.Sp, s.Sv, s.Sal, s.Str))


def test_fractal_surface():
    """The wavelengths of a `Surface` stand beside it; its Sq is that of the sum to a percent."""
    surface = fj.Surface(2.4, 1e-10)
    band: Any = dict(L=1e-3, L_s=1e-6)
    p, rough = fj.profile_parameters(surface, **band), fj.roughness(surface, **band)
    assert float(p.Rq) == pytest.approx(float(rough.Sq), rel=0.01)
    moments = surface.between(jnp.array(1e-3), jnp.array(1e-6))
    s = fj.areal_parameters(surface, **band)
    np.testing.assert_allclose([s.Sq**2, s.Sdq**2], [moments.moment(0), moments.moment(2)])


@pytest.mark.parametrize("wavelength", [2e-6, 3e-5, 1e-4, 1e-3, 3e-2])
def test_one_wavelength(wavelength):
    """Against adaptive quadrature over the direction of waves of almost one wavelength."""
    q = 2 * math.pi / wavelength * np.array([1, 1 + 1e-10])
    surface = fj.MeasuredSpectrum(q, [1e-20, 1e-20])
    Sq = float(fj.roughness(surface).Sq)

    def share(sine):
        x = sine / wavelength
        return -math.expm1(-math.log(2) * (2.5e-4 * x) ** 2) * 2 ** -((2e-5 * x) ** 2)

    def mean(k):
        """Over the angle between the profile and the crests."""
        edges = np.array([0, 1 / 30, 1 / 3, 1]) * min(1.0, wavelength / 2e-5)
        parts = [
            quad(lambda a: (q[0] * math.sin(a)) ** (2 * k) * share(math.sin(a)) ** 2, *ends)[0]
            for ends in itertools.pairwise([*edges, math.pi / 2])
        ]
        return sum(parts) * 2 / math.pi

    p, s = fj.profile_parameters(surface, **FILTERS), fj.areal_parameters(surface, **FILTERS)
    expected = [Sq * math.sqrt(mean(k)) for k in (0, 1)]
    np.testing.assert_allclose([p.Rq, p.Rdq], expected, rtol=1e-6)
    expected = [Sq * share(1), Sq * share(1) * q[0]]
    np.testing.assert_allclose([s.Sq, s.Sdq], expected, rtol=1e-8)


def test_broad_spectra():
    """A table that follows a self-affine surface, and a surface far finer than the filters."""
    q = 2 * np.pi / np.geomspace(1e-2, 2e-6, 400)
    # The roll-off is one of the points.
    q = np.sort(np.append(q, 2 * np.pi / 6e-5))
    long = fj.SelfAffine(1e-6, 0.8, 6e-5, 2e-6, longest=1e-2)
    table = fj.MeasuredSpectrum(q, np.asarray(long.C(q)))
    for measure in (fj.profile_parameters, fj.areal_parameters):
        p, same = measure(long, **FILTERS), measure(table, **FILTERS)
        for name, value in vars(p).items():
            np.testing.assert_allclose(getattr(same, name), value, rtol=1e-8, err_msg=name)
    fine = fj.SelfAffine(1e-6, 0.5, 6e-5, 1e-8)
    q = np.exp(np.linspace(math.log(1e2), math.log(2 * np.pi / 1e-8), 8001))
    # Waves along the profile: by the trapezoidal rule over both, the angle as its logarithm.
    u = np.linspace(-18, math.log(math.pi / 2), 2001)
    along = q[:, None] * np.sin(np.exp(u))[None]
    share = np.asarray(roughness_transmission(along, **FILTERS)) ** 2
    means = 2 / np.pi * np.trapezoid(share * np.exp(u)[None], u, axis=1)
    square = np.trapezoid(np.asarray(fine.m(q)) * means, np.log(q))
    p = fj.profile_parameters(fine, **FILTERS)
    assert float(p.Rq) == pytest.approx(math.sqrt(square), rel=1e-5)


def test_simulated_heights():
    """Lines of a map with this spectrum, and the map: ISO 21920-2 and ISO 25178-2 beside these."""
    n, dx = 1024, 2e-6
    z = fj.topography(GROUND, n * dx, n, key=jax.random.key(1), periodic=True)
    lines = jnp.concatenate([z[::16], z.T[::16]])
    measured = jax.vmap(lambda z: fj.profile_parameters(z, dx, sections=7, **FILTERS))(lines)
    p = fj.profile_parameters(GROUND, sections=7, **FILTERS)
    Rq = math.sqrt(np.mean(measured.Rq**2))
    assert float(p.Rq) == pytest.approx(Rq, rel=0.02)
    assert float(p.Rdq) == pytest.approx(math.sqrt(np.mean(measured.Rdq**2)), rel=0.02)
    for name, rel in {"Ra": 0.03, "Rk": 0.03, "Mr1": 0.08, "Mr2": 0.03}.items():
        value = float(np.mean(getattr(measured, name)))
        assert float(getattr(p, name)) == pytest.approx(value, rel=rel), name
    for name in ("Rz", "Rp", "Rv", "Rt"):
        assert 0.98 < float(getattr(p, name) / np.mean(getattr(measured, name))) < 1.12, name
    area, s = fj.areal_parameters(z, dx, **FILTERS), fj.areal_parameters(GROUND, **FILTERS)
    for name in ("Sq", "Sa", "Sdq", "Sdr", "Sk"):
        expected = float(getattr(area, name))
        assert float(getattr(s, name)) == pytest.approx(expected, rel=0.03), name


def measures(x):
    """Some parameters, of x = Sq, H, roll-off, shortest wave, cutoff and shortest of the filter."""
    surface = fj.SelfAffine(1e-6 * x[0], x[1], 6e-5 * x[2], 2e-6 * x[3], lay=2 * x[0])
    filters = dict(cutoff=2.5e-4 * x[4], shortest=2e-5 * x[5])
    p, s = fj.profile_parameters(surface, **filters), fj.areal_parameters(surface, **filters)
    return jnp.log(jnp.stack([p.Ra, p.Rz, p.Rdq, p.RSm, p.Rpk, s.Sa, s.Sdr, s.Svk]))


def test_derivatives_of_spectra():
    """Both modes, compiled, against differences; a batch is as its members."""
    x = jnp.array([1.1, 0.7, 1.0, 1.2, 0.9, 1.0])
    _, *slopes = jax.jit(lambda x: both_modes(measures, x))(x)
    values = jax.jit(jax.vmap(measures))
    steps = 1e-5 * jnp.eye(6)
    differences = (values(x[None] + steps) - values(x[None] - steps)).T / 2e-5
    for slope in slopes:
        np.testing.assert_allclose(slope, differences, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(values(x[None])[0], measures(x), rtol=1e-12)


test_refusals = refusals(
    [
        (lambda: fj.profile_parameters(GROUND, 1e-6), "dx is for heights"),
        (lambda: fj.areal_parameters(GROUND, dy=1e-6), "dx is for heights"),
        (lambda: fj.profile_parameters(np.ones(9), 1.0, L=1.0), "L and L_s are for a Surface"),
        (lambda: fj.areal_parameters(GROUND, L_s=1.0), "L and L_s are for a Surface"),
        (lambda: fj.profile_parameters(fj.Surface(2.4, 1e-10)), "a Surface needs L and L_s"),
        (
            lambda: fj.profile_parameters(GROUND, cutoff=1e-6, shortest=1e-5),
            "cutoff must be at least shortest",
        ),
        (lambda: fj.areal_parameters(GROUND, cutoff=-1.0), "cutoff must be above 0"),
        (lambda: fj.profile_parameters(GROUND, sections=0), "sections must be a whole number"),
        (
            lambda: fj.profile_parameters(fj.Surface(np.array([2.4, 2.5]), 1.0), L=1.0, L_s=1.0),
            "D must be a scalar",
        ),
    ]
)


def test_heights_need_their_step():
    with pytest.raises(TypeError, match="heights need dx"):
        fj.areal_parameters(np.ones((9, 9)))
