"""The band that is fitted: as given, or what looks like a power law to the instrument."""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from fractaljax._identify.band import check_band, choose_band, noise_model
from fractaljax._identify.spectrum import PowerSpectrum
from fractaljax._identify.stylus import tip_limit

LENGTH, NYQUIST, RATIO = 2e-3, 5e5, 1.5
F = np.arange(1, 1000) / LENGTH
CHANCE = np.random.default_rng(3).gamma(3, 1 / 3, F.size)  # three tapers


def spectrum(factor: ArrayLike = 1.0, floor=0.0, chance: ArrayLike = CHANCE, p=2.0):
    one = np.ones_like(F)
    power = (1e-20 * (F / 1e5) ** -p * np.asarray(factor) + floor) * np.asarray(chance)
    return PowerSpectrum(F, power, 3 * one, 1 / F, 0 * one, "profile", NYQUIST)


@pytest.mark.parametrize(
    ("measured", "top", "low", "high", "warning"),
    [
        (spectrum(), NYQUIST, (2.5e3, 3.75e3), (NYQUIST / 2,) * 2, None),
        (spectrum(), 6e4, (2.5e3, 3.75e3), (6e4, 6e4), None),
        # S = 1e-20 (f/1e5)^-2 falls to twice 2e-20 at 5e4 1/m.
        (spectrum(floor=2e-20), NYQUIST, (2.5e3, 3.75e3), (4.5e4, 5.5e4), "noise floor"),
        (spectrum(1 / (1 + (2e4 / F) ** 2)), NYQUIST, (3e4, 1e5), (NYQUIST / 2,) * 2, "plateau"),
        # A Gaussian filter halves amplitudes at its cut-off.
        (spectrum(4.0 ** -((F / 1e5) ** 2)), NYQUIST, (2.5e3, 3.75e3), (1e4, 5e4), "roll-off"),
    ],
)
def test_chosen_band(measured, top, low, high, warning):
    """From five periods in the length to half of Nyquist, less what is not a power law."""
    found = choose_band(measured, LENGTH, RATIO, top)
    assert low[0] <= found.low <= low[1] and high[0] <= found.high <= high[1]
    assert [line[: len(warning or "")] for line in found.warnings] == [warning] * bool(warning)
    if warning is None:
        bins = math.log(found.high / found.low) / math.log(RATIO)
        assert bins == pytest.approx(round(bins))
    if warning == "noise floor":
        assert found.noise.floor == pytest.approx(2e-20, rel=0.1)


@pytest.mark.parametrize(
    "band", [(2e5, 1e5), (1e5, 1e5), (100.0, 1e5), (1e4, 6e5), (np.nan, 1e5), (1e5, 1.02e5)]
)
def test_a_bad_band_is_refused(band):
    with pytest.raises(ValueError, match="band must "):
        check_band(band, spectrum(), LENGTH, RATIO, NYQUIST)


def test_a_given_band_is_kept():
    found = check_band((3e3, 2e5), spectrum(), LENGTH, RATIO, 1e5)
    assert (found.low, found.high) == (3e3, 2e5)
    assert found.warnings == ("the band goes beyond the instrument's limit of 1e+05 1/m",)
    with pytest.raises(ValueError, match="the instrument's limit of 3000 1/m leaves no band"):
        choose_band(spectrum(), LENGTH, RATIO, 3e3)
    noise = noise_model(spectrum(np.where(F < 0.85 * NYQUIST, 1, 1e-3)), (2.5e3, NYQUIST), RATIO)
    assert noise.flat_prior.mean == pytest.approx(-0.5, abs=0.05) and not noise.aliased


@pytest.mark.parametrize("p", [1.6, 2.2])
@pytest.mark.parametrize("limit", [3e4, 1.5e5])
def test_a_tip_follows_up_to_six_times_the_rms_curvature(p, limit):
    """int_0^f (2 pi f)^4 S df by quadrature."""
    fine = np.linspace(0, limit, 200_001)[1:]
    curvature = np.trapezoid((2 * math.pi * fine) ** 4 * 1e-20 * (fine / 1e5) ** -p, fine) ** 0.5
    exact = spectrum(chance=1.0, p=p)
    found = tip_limit(exact, LENGTH, RATIO, 1 / (6 * curvature))
    assert found == pytest.approx(limit, rel=0.02)
    assert tip_limit(exact, LENGTH, RATIO, 1e-12) == NYQUIST
