"""The band that is fitted: as given, or what looks like a power law."""

import math
from typing import Any

import numpy as np
import pytest

from fractaljax.measured.band import _missing_share, chosen_band, given_band, nature_of
from fractaljax.measured.spectrum import Spectrum

LENGTH, NYQUIST, RATIO = 2e-3, 5e5, 1.5
F = np.arange(1, 1000) / LENGTH
CHANCE = np.random.default_rng(3).gamma(3, 1 / 3, F.size)  # three tapers


def spectrum(factor: Any = 1.0, floor=0.0):
    power = (1e-20 * (F / 1e5) ** -2.0 * factor + floor) * CHANCE
    one = np.ones_like(F)
    return Spectrum(F, power, 3 * one, 1 / F, 0 * one, "profile", NYQUIST)


def test_a_plain_law_is_used_from_five_periods_to_half_of_nyquist():
    found = chosen_band(spectrum(), LENGTH, RATIO, NYQUIST)
    assert found.high == NYQUIST / 2 and found.notes == ()
    assert 5 / LENGTH <= found.low < RATIO * 5 / LENGTH
    bins = math.log(found.high / found.low) / math.log(RATIO)
    assert bins == pytest.approx(round(bins))


def test_an_instrument_ends_it():
    assert chosen_band(spectrum(), LENGTH, RATIO, 6e4).high == 6e4
    with pytest.raises(ValueError, match="the instrument's limit of 3000 1/m leaves no band"):
        chosen_band(spectrum(), LENGTH, RATIO, 3e3)


def test_noise_ends_it_where_the_law_is_twice_the_floor():
    """S = 1e-20 (f/1e5)^-2 falls to twice 2e-20 at 5e4 1/m."""
    found = chosen_band(spectrum(floor=2e-20), LENGTH, RATIO, NYQUIST)
    assert found.nature.floor == pytest.approx(2e-20, rel=0.1)
    assert found.high == pytest.approx(5e4, rel=0.1)
    assert "noise floor" in found.notes[0]


def test_a_plateau_is_left_out():
    corner = 2e4
    found = chosen_band(spectrum(1 / (1 + (corner / F) ** 2)), LENGTH, RATIO, NYQUIST)
    assert found.low > 1.5 * corner and "plateau" in found.notes[0]


def test_a_filter_is_left_out():
    """A Gaussian filter halves amplitudes at its cut-off."""
    found = chosen_band(spectrum(4.0 ** -((F / 1e5) ** 2)), LENGTH, RATIO, NYQUIST)
    assert found.high < 0.5e5 and "roll-off" in found.notes[0]


def test_waves_that_end_below_nyquist_are_missed_in_a_cut():
    nature = nature_of(spectrum(np.where(F < 0.85 * NYQUIST, 1, 1e-3)), (2.5e3, NYQUIST), RATIO)
    assert nature.expected == pytest.approx(-0.5, abs=0.05) and not nature.folded


@pytest.mark.parametrize("p", [1.2, 2.0, 2.8])
def test_what_is_missing_is_the_mean_over_directions(p):
    """|cos a|^(p-1) where |cos a| < u, beside the mean of all, by quadrature."""
    u = 0.02
    a = (np.arange(4_000_000) + 0.5) * (np.pi / 2 / 4_000_000)
    seen = np.cos(a) ** (p - 1)
    share = seen[np.cos(a) < u].sum() / seen.sum()
    assert _missing_share(p) * u**p == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize(
    "band", [(2e5, 1e5), (1e5, 1e5), (100.0, 1e5), (1e4, 6e5), (np.nan, 1e5), (1e5, 1.02e5)]
)
def test_a_band_that_is_none_is_refused(band):
    with pytest.raises(ValueError, match="band must "):
        given_band(band, spectrum(), LENGTH, RATIO, NYQUIST)


def test_a_given_band_is_kept_and_its_excess_said():
    found = given_band((3e3, 2e5), spectrum(), LENGTH, RATIO, 1e5)
    assert (found.low, found.high) == (3e3, 2e5)
    assert found.notes == ("the band goes beyond the instrument's limit of 1e+05 1/m",)
