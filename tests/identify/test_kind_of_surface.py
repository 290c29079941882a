"""What `identify` hands on has the heights of what was measured, or is its spectrum."""

import math

import numpy as np
import pytest

import fractaljax as fj

N, SIDE = 192, 1e-3
DX = SIDE / N


@pytest.mark.parametrize(("lay", "rolloff"), [(1.5, 3e-4), (1.5, 2e-4), (None, 3e-4)])
@pytest.mark.parametrize("seed", [0, 2])
def test_no_law_has_several_times_the_height_of_the_map(lay, rolloff, seed):
    """With H of 1 the roll-off is not seen in a few long waves, but the height of the map tells."""
    surface = fj.SelfAffine(1e-6, 1.0, rolloff, 2 * DX, lay=lay)
    z = np.asarray(fj.topography(surface, SIDE, N, seed=seed))
    found = fj.identify(z, DX)
    handed_on, Sq = found.surface, found.Sq
    assert isinstance(handed_on, fj.SelfAffine) and (handed_on.lay is None) == (lay is None)
    error = found.scatter.standard_deviations["ln Sq"]
    assert abs(math.log(float(handed_on.Sq) / Sq)) < max(error, 0.05) < 0.2
    assert (
        abs(math.log(float(handed_on.rolloff) / rolloff)) < 3 * found.self_affine.ln_rolloff_error
    )


@pytest.mark.parametrize(("seed", "row"), [(0, 333), (0, 100), (2, 900), (3, 600)])
def test_a_profile_has_the_height_of_its_surface(seed, row):
    """The roll-off of a short profile is seen by its height, which a power law has six times."""
    surface = fj.SelfAffine(2e-6, 0.8, 1e-4, 4e-6)
    z = np.asarray(fj.topography(surface, 1.2e-3, 1000, seed=seed))[row]
    found = fj.identify(z, 1.2e-6)
    fit = found.self_affine
    assert isinstance(found.surface, fj.SelfAffine) and fit.has_rolloff
    ln_Sq, H, rolloff, _ = np.sqrt(np.diagonal(fit.covariance))
    assert ln_Sq < 0.2 and abs(math.log(fit.Sq / 2e-6)) < 3 * ln_Sq
    assert abs(fit.H - 0.8) < 3 * H and abs(math.log(fit.rolloff / 1e-4)) < 3 * rolloff


def ridges(seed, step=None):
    """A rough map with two waves along x, perhaps rounded to steps [m]."""
    x = np.arange(N) * DX
    rough = np.asarray(fj.topography(fj.SelfAffine(2e-8, 0.6, 1e-4, 1e-5), SIDE, N, seed=seed))
    fine, coarse = 1e-7 * np.sin(2 * np.pi * x / 7e-5), 3e-8 * np.sin(2 * np.pi * x / 2e-4 + 1)
    z = rough + (fine + coarse)[:, None]
    return z if step is None else np.round(z / step) * step


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("step", [None, 8e-9])
def test_the_measured_spectrum_is_that_of_all_waves(seed, step):
    """Steps of height spoil D at high frequencies long before they add to the spectrum."""
    z = ridges(seed, step)
    found = fj.identify(z, DX)
    measured = found.surface
    assert isinstance(measured, fj.MeasuredSpectrum)
    assert measured.q[-1] == pytest.approx(math.pi / DX)
    rough, same = fj.roughness(measured), fj.roughness(fj.spectrum_of(z, DX))
    assert float(rough.Sq) == pytest.approx(found.Sq, rel=2e-3)
    assert float(rough.Sdq) == pytest.approx(float(same.Sdq), rel=0.1)


def test_how_far_a_law_may_be_off_is_an_option():
    """The waves across a lay of 30, and a power law with twice the height of the map."""
    z = ridges(0, 8e-9)
    steep = fj.identify(z, DX, analysis=fj.SpectralAnalysis(gradient=10)).surface
    assert isinstance(steep, fj.SelfAffine)
    z = np.asarray(fj.topography(fj.SelfAffine(1e-6, 1.0, 3e-4, 2 * DX), SIDE, N, seed=0))
    found = fj.identify(z, DX)
    assert found.level > found.analysis.level == 2
    strict = fj.SpectralAnalysis(level=0)
    assert isinstance(fj.identify(z, DX, analysis=strict).surface, fj.MeasuredSpectrum)


def test_root_mean_square_is_that_about_the_plane():
    z = ridges(0)
    i, j = np.indices(z.shape)
    tilted = z + 1e-6 + 1e-8 * i - 3e-8 * j
    plane = np.stack([np.ones(z.size), i.ravel(), j.ravel()], axis=1)
    left = tilted.ravel() - plane @ np.linalg.lstsq(plane, tilted.ravel())[0]
    assert fj.identify(tilted, DX).Sq == pytest.approx(left.std(), rel=1e-9)
    line = tilted[:, 0] - np.polyval(np.polyfit(np.arange(N), tilted[:, 0], 1), np.arange(N))
    assert fj.identify(tilted[:, 0], DX).Sq == pytest.approx(line.std(), rel=1e-9)
