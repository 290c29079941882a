"""Errors of maps that differ from place to place: what one part says of another."""

import itertools
import math

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._identify import identify as module
from fractaljax._identify.fit import Bins, bin_edges, fit
from fractaljax._identify.patches import patch_covariance
from fractaljax._identify.spectrum import map_spectra
from synthetic import DX, gaussian_map, surface

BAND, RATIO = (5e4, 3e5), 1.5


def test_one_patch_at_many_heights_and_its_influence():
    """Only ln A differs between patches, by the variance of their squares beyond 1.3 chance."""
    rng = np.random.default_rng(3)
    patch, height = gaussian_map(rng, shape=(48, 48)), rng.uniform(0.5, 2, (4, 4))
    z = np.pad(np.kron(height, patch), ((0, 3), (0, 1)))  # a few rows too many
    spectrum = map_spectra(gaussian_map(rng, shape=(192, 192)), DX, DX)[0]
    law = fit(spectrum, BAND, RATIO)
    bins = Bins(map_spectra(patch, DX, DX)[0], BAND, RATIO)
    chance = np.linalg.inv(law.influence[:2] * bins.variance @ law.influence[:2].T)
    found = patch_covariance(z, DX, DX, spectrum, law, BAND, RATIO)
    expected = np.var(height**2, ddof=1) / np.mean(height**2) ** 2 - 1.3 / chance[0, 0]
    np.testing.assert_allclose(found, [[expected, 0], [0, 0]], rtol=1e-9, atol=1e-12 * expected)
    alike = patch_covariance(np.tile(patch, (4, 4)), DX, DX, spectrum, law, BAND, RATIO)
    np.testing.assert_array_equal(alike, np.zeros((2, 2)))
    # ln A, p and the flat share against differences by the power of one bin.
    spectrum = map_spectra(gaussian_map(np.random.default_rng(1)), DX, DX)[0]
    law = fit(spectrum, BAND, RATIO, scatter=0.0)
    # A law through the means of the bins: influence holds where the fit does.
    through = fit(_replaced(spectrum, law(spectrum.f)), BAND, RATIO, scatter=0.0)
    f, h = spectrum.f, 1e-4
    edges = bin_edges(BAND, RATIO)
    for b in range(through.f.size):
        inside = (f > edges[b] * (1 - 1e-9)) & (f <= edges[b + 1] * (1 + 1e-9))
        up, down = (
            fit(_replaced(spectrum, law(f) * np.exp(s * inside)), BAND, RATIO, scatter=0.0)
            for s in (h, -h)
        )
        slope = [(getattr(up, k) - getattr(down, k)) / (2 * h) for k in ("log_A", "p", "flat")]
        np.testing.assert_allclose(through.influence[:, b], slope, rtol=2e-2, atol=2e-3)


def _replaced(spectrum, power):
    return type(spectrum)(**{**vars(spectrum), "power": power})


def _places(rng, n):
    """What differs from place to place (n, n): waves of 1/2 to 8 in the map, of variance 1."""
    total, x = 0, 2 * np.pi * np.arange(n) / n
    for waves in (0.5, 1, 2, 4, 8):
        a, phi = rng.uniform(0, 2 * np.pi, 2)
        total = total + np.cos(waves * np.add.outer(x * np.cos(a), x * np.sin(a)) + phi)
    return total * math.sqrt(2 / 5)


def rougher_here(rng, D, n):
    """The height differs from place to place."""
    return gaussian_map(rng, D, (n, n)) * np.exp(_places(rng, n))


def finer_here(rng, D, n):
    """The dimension does: D + 0.3 here, D - 0.3 there, of about the same height."""
    share = 1 / (1 + np.exp(-2 * _places(rng, n)))
    parts = [gaussian_map(rng, each, (n, n)) for each in (D + 0.3, D - 0.3)]
    fine, coarse = (z / np.std(np.diff(z, axis=0)) for z in parts)
    return 1e-9 * (np.sqrt(share) * fine + np.sqrt(1 - share) * coarse)


def quadrants_apart(make, count, n=256):
    """(D_i - D_j) over their standard errors, and of ln G, for pairs of quadrants (pairs, 2)."""
    rows = []
    for seed in range(count):
        z, h = make(np.random.default_rng(seed), 2.5, n), n // 2
        found = [fj.identify(q, DX) for q in (z[:h, :h], z[:h, h:], z[h:, :h], z[h:, h:])]
        for a, b in itertools.combinations(found, 2):
            # Close to D = 2, G may underflow.
            apart = np.array([a.D - b.D, *np.diff(np.log(np.maximum([b.G, a.G], 1e-300)))])
            rows.append(apart / np.sqrt(np.diag(a.covariance + b.covariance)))
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize("make", [rougher_here, finer_here])
def test_a_quadrant_predicts_the_others(make, monkeypatch):
    """Within two standard errors in 90 percent; the errors of a stationary surface do not."""
    maps = 24
    least = 0.9 - 2.5 * math.sqrt(0.9 * 0.1 / (6 * maps))  # within chance
    apart = quadrants_apart(make, maps)
    assert np.sqrt(np.mean(apart[:, 0] ** 2)) < 1.3
    assert np.all(np.mean(np.abs(apart) < 2, axis=0) > least)
    monkeypatch.setattr(module, "patch_covariance", lambda *_: np.zeros((2, 2)))
    apart = quadrants_apart(make, maps)
    assert np.sqrt(np.mean(apart[:, 0] ** 2)) > 1.4


@pytest.mark.slow
@pytest.mark.parametrize("make", [gaussian_map, surface])
def test_stationary_maps_keep_their_errors(make, monkeypatch):
    """Errors of D are hardly wider than those of the fit alone, and cover."""

    dimensions = np.repeat([2.2, 2.5, 2.8], 30)

    def errors():
        maps = (make(np.random.default_rng(i), D, (128, 128)) for i, D in enumerate(dimensions))
        found = [fj.identify(z, DX) for z in maps]
        return np.array(
            [(x.D - D, x.D_standard_error) for x, D in zip(found, dimensions, strict=True)]
        ).T

    error, stated = errors()
    monkeypatch.setattr(module, "patch_covariance", lambda *_: np.zeros((2, 2)))
    wider = stated / errors()[1]
    assert np.median(wider) < 1.05 and wider.mean() < 1.1
    covered = np.mean(np.abs(error) < stated)
    assert covered > 0.68 - 2.5 * math.sqrt(0.68 * 0.32 / error.size)
    if make is gaussian_map:
        assert covered < 0.68 + 0.05 + 2.5 * math.sqrt(0.68 * 0.32 / error.size)
