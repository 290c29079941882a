"""Scatter from one surface to the next, of a prescribed size, out of that and errors together."""

import math
from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._identify.pool import random_effects
from fractaljax._surface.surface_scatter import log_height
from synthetic import gaussian_profile
from tools import refusals

T = np.array([[0.04, 0.03], [0.03, 0.09]])


def test_random_effects_recover_their_scatter():
    """T on average over many processes, of measurements with unlike errors; the mean too."""
    rng = np.random.default_rng(0)
    between, standardised = [], []
    for _ in range(60):
        roots = rng.uniform(0.05, 0.4, (12, 2))
        V = np.array([np.diag(root**2) for root in roots])
        y = rng.multivariate_normal([1.0, -2.0], T, 12) + roots * rng.standard_normal((12, 2))
        mean, found, of_mean = random_effects(y, V)
        between.append(found)
        standardised.append((mean - [1.0, -2.0]) / np.sqrt(np.diagonal(of_mean)))
    np.testing.assert_allclose(np.mean(between, axis=0), T, atol=0.012)
    assert 0.8 < np.std(standardised) < 1.25


def test_no_scatter_and_equal_errors():
    """The mean and its error are those of a mean; an error that explains all leaves no scatter."""
    y = np.array([[1.0], [1.1], [0.9], [1.0]])
    mean, between, of_mean = random_effects(y, np.full((4, 1, 1), 0.04))
    assert mean[0] == pytest.approx(1.0) and between[0, 0] < 1e-6
    assert of_mean[0, 0] == pytest.approx(0.01, rel=1e-3)
    # Without errors it is the sample covariance.
    _, between, of_mean = random_effects(y, np.zeros((4, 1, 1)))
    assert between[0, 0] == pytest.approx(np.var(y, ddof=1), rel=1e-3)
    assert of_mean[0, 0] == pytest.approx(np.var(y, ddof=1) / 4, rel=1e-3)


def test_profiles_of_one_process():
    """D scatters by 0.08 from one to the next, ln m at 1e5 rad/m by 0.5."""
    rng = np.random.default_rng(1)
    q, found = 1e5, []
    level = log_height(2.5, math.log(1e-9), q)
    f = q / (2 * math.pi)
    for _ in range(10):
        D, log_m = 2.5 + 0.08 * rng.standard_normal(), level + 0.5 * rng.standard_normal()
        log_G = (log_m + math.log(2) + (6 - 2 * D) * math.log(f)) / (2 * D - 4)
        found.append(fj.identify(gaussian_profile(rng, D, 2048, math.exp(log_G)), 1e-6))
    pooled = fj.pool_surfaces(found)
    assert isinstance(pooled.surface, fj.Surface)
    sigma = pooled.standard_deviations
    assert 0.05 < sigma["D"] < 0.13 and 0.3 < sigma["ln m(q)"] < 0.8
    assert abs(float(pooled.surface.D) - 2.5) < 0.08
    assert fj.squeal_probability(fj.brake_scene(), pooled, samples=1000).value > 0
    # The same surface ten times has only the error of the mean left.
    alone = fj.pool_surfaces([found[0]] * 10).standard_deviations
    assert alone["D"] == pytest.approx(found[0].D_standard_error / math.sqrt(10), rel=0.02)


def test_self_affine_profiles():
    """Where one has a roll-off all are pooled as that."""
    rng = np.random.default_rng(2)
    found = []
    for _ in range(2):
        z = gaussian_profile(rng, 2.3, 4096)
        waves = np.fft.rfft(z - np.linspace(z[0], z[-1], z.size))
        f = np.fft.rfftfreq(z.size, 1e-6)
        found.append(fj.identify(np.fft.irfft(waves * (1 + (2e4 / (f + 1)) ** 2) ** -0.6), 1e-6))
    assert all(isinstance(each.surface, fj.SelfAffine) for each in found)
    pooled = fj.pool_surfaces(found)
    assert isinstance(pooled.surface, fj.SelfAffine)
    assert pooled.names == ("ln Sq", "hurst", "ln rolloff")
    ends = sorted(float(each.self_affine.rolloff) for each in found)
    assert ends[0] <= float(pooled.surface.rolloff) <= ends[1]


def smooth_maps(factors, n=128, side=1e-3):
    """Maps without waves below four steps, which no law describes, and their step."""
    surface = fj.SelfAffine(1e-6, 0.8, side / 8, side / 32)
    z = [np.asarray(fj.topography(surface, side, n, seed=k)) for k in range(len(factors))]
    return [factor * each for factor, each in zip(factors, z, strict=True)], side / n


def test_measured_spectra_scatter_by_their_heights():
    factors = np.exp([0.0, 0.4, -0.4, 0.2, -0.2])
    maps, dx = smooth_maps(factors)
    found = [fj.identify(z, dx) for z in maps]
    assert any(isinstance(each.surface, fj.MeasuredSpectrum) for each in found)
    pooled: Any = fj.pool_surfaces(found)
    first: Any = found[0].measured_spectrum
    assert isinstance(pooled.surface, fj.MeasuredSpectrum)
    assert pooled.names == ("ln height_factor",)
    logs = np.log([z.std() for z in maps])
    assert pooled.standard_deviations["ln height_factor"] == pytest.approx(
        np.std(logs, ddof=1) * math.sqrt(1 + 1 / 5), rel=0.2
    )
    Sq = float(fj.roughness(pooled.surface).Sq)
    assert math.log(Sq) == pytest.approx(np.mean(logs), abs=0.05)
    # The errors of the mean of five are below those of each.
    surface: Any = pooled.surface
    assert np.max(surface.ln_C_error) < 0.6 * np.max(first.ln_C_error)


def test_maps_and_profiles_without_a_law_are_not_pooled():
    maps, dx = smooth_maps([1.0])
    found = fj.identify(maps[0], dx)
    profile = fj.identify(gaussian_profile(np.random.default_rng(0)), 1e-6)
    with pytest.raises(ValueError, match=r"^identifications\[1\] is of a profile.*height_factor"):
        fj.pool_surfaces([found, profile])
    small = fj.identify(1e-6 * maps[0], 1e-6 * dx)
    with pytest.raises(ValueError, match=r"^identifications must have wavelengths in common"):
        fj.pool_surfaces([found, small])


def test_the_height_of_a_table_is_its_factor():
    """Bounds on Sq name what a `MeasuredSpectrum` has in place of it."""
    scene, table = fj.brake_scene(), fj.MeasuredSpectrum([1e4, 1e5], [1e-21, 1e-24])
    contact = fj.PerssonContact(table, scene.contact.material, 400.0, 1e-5)
    scene = fj.Scene(contact, scene.friction, scene.oscillator).replace(height_factor=1.0)
    with pytest.raises(ValueError, match=r"bounds on 'Sq'.*did you mean height_factor"):
        fj.design(scene, {"Sq": (1e-7, 1e-5)}, progress=False)


test_refused = refusals(
    [
        (lambda: fj.pool_surfaces([]), r"^identifications must be two or more, got 0"),
    ]
)
