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
