"""Heights missing at random move D by less than its standard error."""

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._identify.gaps import _surrogate
from fractaljax._identify.spectrum import map_spectra, profile_spectrum
from synthetic import DX, gaussian_map, gaussian_profile


def moved(z, share, seed=0):
    """By how many standard errors D and ln G differ from those of the whole heights."""
    missing = np.random.default_rng(seed + 100).random(z.shape) < share
    whole, found = fj.identify(z, DX), fj.identify(np.where(missing, np.nan, z), DX)
    by = (found.D - whole.D) / whole.D_standard_error
    return by, np.log(found.G / whole.G) / whole.ln_G_standard_error, found


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_a_map_with_missing_points(share):
    """D of the filled map alone is off by -0.5, -1 and -2 standard errors."""
    by_D, by_ln_G, found = moved(gaussian_map(np.random.default_rng(0), 2.4, (400, 400)), share)
    assert abs(by_D) < 0.3 and abs(by_ln_G) < 0.3
    assert abs(found.D - 2.4) < found.D_standard_error
    assert abs(found.structure_function.D - 2.4) < 0.03
    assert all("missing" in line for line in found.warnings)


@pytest.mark.parametrize(
    ("D", "make"),
    [
        (2.2, lambda rng: gaussian_profile(rng, 2.2, 4096)),
        (2.5, lambda rng: gaussian_profile(rng, 2.5, 4096)),
        (2.6, lambda rng: gaussian_map(rng, 2.6, (160, 200))),
    ],
)
def test_no_bias(D, make):
    """In the mean: filling alone moves D by -1.2 to -2 standard errors."""
    rows = [moved(make(np.random.default_rng(seed)), 0.2, seed)[:2] for seed in range(8)]
    np.testing.assert_array_less(np.abs(np.mean(rows, axis=0)), 0.5)


@pytest.mark.parametrize("shape", [(2048,), (192, 128)])
def test_a_surrogate_has_the_spectrum(shape):
    """Its own spectrum is the one it was made of, up to a factor."""
    if len(shape) == 1:
        z = gaussian_profile(np.random.default_rng(0), 2.4, *shape)
        spectrum_of = lambda z: profile_spectrum([z], DX)  # noqa: E731
    else:
        z = gaussian_map(np.random.default_rng(0), 2.4, shape)
        spectrum_of = lambda z: map_spectra(z, DX, DX)[0]  # noqa: E731
    wanted = spectrum_of(z)
    found = spectrum_of(_surrogate(wanted, shape, (DX,) * len(shape), np.random.default_rng(1)))
    inside = (wanted.f > 10 * wanted.f[0]) & (wanted.f < 0.9 * wanted.nyquist)
    log = np.log(found.power / wanted.power)[inside]
    slope = np.polyfit(np.log(wanted.f[inside]), log, 1)[0]
    assert abs(slope) < 0.15 and log.std() < 0.5
