"""The spectrum of a map: against that of its waves, and its errors against their scatter."""

import math

import jax
import numpy as np
import pytest

import fractaljax as fj
from tools import refusals

SURFACE = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5)
N, DX = 256, 4e-6
MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)


def heights(seed=0, surface=SURFACE):
    return np.asarray(fj.topography(surface, N * DX, N, key=jax.random.key(seed)))


def inside(found):
    """Points between the ends, where Hann's window does not reach beyond the waves."""
    q = np.asarray(found.q)
    return (q > 6 * 2 * math.pi / (N * DX)) & (q < 0.8 * 2 * math.pi / 1e-5)


def test_spectrum_is_that_of_the_surface_within_its_errors():
    deviations = []
    for seed in range(6):
        found = fj.spectrum_of(heights(seed), DX)
        use = inside(found)
        q, C, error = (np.asarray(x)[use] for x in (found.q, found.C_table, found.ln_C_error))
        deviations.append(np.log(C / np.asarray(SURFACE.C(q))) / error)
    assert abs(np.mean(deviations)) < 0.3 and 0.7 < np.std(deviations) < 1.3


def test_heights_and_contact_of_a_map():
    found = fj.spectrum_of(heights(), DX, shortest=1e-5)
    rough, expected = fj.roughness(found), fj.roughness(SURFACE)
    assert float(rough.Sq) == pytest.approx(float(expected.Sq), rel=0.1)
    assert float(rough.Sdq) == pytest.approx(float(expected.Sdq), rel=0.05)
    pair = [
        float(fj.PerssonContact(x, MATERIAL, 1e3, 1e-6).stiffness(0.4, 0.25)[0])
        for x in (found, SURFACE)
    ]
    assert pair[0] == pytest.approx(pair[1], rel=0.1)


@pytest.mark.parametrize("seed", [0, 3])
def test_waves_as_long_as_the_map_keep_their_height(seed):
    """The window takes half of Sq: the law was then up to three times too stiff."""
    surface, n = fj.SelfAffine(1e-6, 0.8, 2e-3, 1e-3 / 24), 128
    dx, area = 1e-3 / n, 1e-6
    z = levelled(np.asarray(fj.topography(surface, 1e-3, n, seed=seed)))
    found = fj.spectrum_of(z, dx)
    assert float(fj.roughness(found).Sq) == pytest.approx(z.std(), rel=1e-3)
    Sdq = math.sqrt(sum(np.mean((np.diff(z, axis=i) / dx) ** 2) for i in (0, 1)))
    for pressure in (0.01, 0.1):
        P = pressure * MATERIAL.E * Sdq * area
        law = float(fj.PerssonContact(found, MATERIAL, P, area).stiffness(0.4, 0.25)[0])
        assert 1 / 2 < law / float(fj.boundary_element(z, dx, MATERIAL, P).K_n) < 2


def test_the_longest_waves_are_within_their_errors():
    surface, deviations, changes = fj.SelfAffine(1e-6, 0.6, 5e-4, 1e-5), [], []
    for seed in range(12):
        found = fj.spectrum_of(heights(seed, surface), DX)
        long = np.asarray(found.q) < 4 * 2 * math.pi / (N * DX)
        q, C, error = (np.asarray(x)[long] for x in (found.q, found.C_table, found.ln_C_error))
        deviations.append(np.log(C / np.asarray(surface.C(q))) / error)
        changes.append(error[0])
    # Of a few waves the mean of the logarithm is below that of the power.
    assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.3
    assert min(changes) > 0.9  # the longest: four waves under the window


@pytest.mark.parametrize("shape", [(256, 64), (64, 256), (96, 128)])
def test_a_map_with_two_sides_begins_at_the_root_of_its_area(shape):
    surface = fj.SelfAffine(1e-6, 0.8, 2e-3, 2e-5)
    z = levelled(heights(2, surface)[: shape[0], : shape[1]])
    found = fj.spectrum_of(z, DX)
    assert found.q[0] == pytest.approx(2 * math.pi / (DX * math.sqrt(z.size)))
    assert float(fj.roughness(found).Sq) == pytest.approx(z.std(), rel=1e-3)
    assert found.q[-1] == pytest.approx(math.pi / DX)


def test_short_waves_lose_nothing():
    """Sq and Sdq of maps with many waves, over which what the window lacks is spread."""
    ratios = []
    for seed in range(4):
        found = fj.roughness(fj.spectrum_of(heights(seed), DX))
        expected = fj.roughness(SURFACE)
        ratios.append([float(found.Sq / expected.Sq), float(found.Sdq / expected.Sdq)])
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1, atol=0.02)
    np.testing.assert_allclose(ratios, 1, atol=0.06)


def levelled(z):
    """A map minus its least-squares plane."""
    i, j = (x.ravel() for x in np.indices(z.shape))
    plane = np.stack([np.ones(z.size), i, j], axis=1)
    return z - (plane @ np.linalg.lstsq(plane, z.ravel())[0]).reshape(z.shape)


def test_gaps_and_tilt_change_little():
    z = heights(1)
    i, j = np.indices(z.shape)
    tilted = z + 1e-7 * i - 2e-7 * j
    np.testing.assert_allclose(
        fj.spectrum_of(tilted, DX).C_table, fj.spectrum_of(z, DX).C_table, rtol=1e-6
    )
    missing = np.where(np.random.default_rng(0).uniform(size=z.shape) < 0.01, np.nan, z)
    ratio = np.divide(fj.spectrum_of(missing, DX).C_table, fj.spectrum_of(z, DX).C_table)
    use = inside(fj.spectrum_of(z, DX))
    assert abs(np.log(ratio[use])).max() < 0.2


def test_heights_that_are_not_gaussian_are_told():
    z = np.minimum(heights(2), 0.2e-6)  # a plateau
    with pytest.warns(
        UserWarning, match=r"far from Gaussian \(Ssk -.*MeasuredContact.from_heights"
    ):
        fj.spectrum_of(z, DX)
    fj.spectrum_of(z, DX, largest_skewness=5.0)


test_refused = refusals(
    [
        (
            lambda: fj.spectrum_of(np.zeros(500), DX),
            r"^z must be a map \(n, m\), got shape \(500,\)",
        ),
        (lambda: fj.spectrum_of(heights(), DX, shortest=1.0), r"^shortest must leave two points"),
        (lambda: fj.spectrum_of(heights()), r"^dx is needed beside heights"),
    ]
)
