"""The frequency up to which a tip follows a surface of a known spectrum."""

import math

import numpy as np
import pytest

from fractaljax.measured.spectrum import Spectrum
from fractaljax.measured.stylus import tip_limit

LENGTH, NYQUIST = 4e-3, 5e5
F = np.arange(1, 2001) / LENGTH


@pytest.mark.parametrize("p", [1.6, 2.2])
@pytest.mark.parametrize("limit", [3e4, 1.5e5])
def test_rms_curvature_up_to_the_limit_is_a_sixth_of_that_of_the_tip(p, limit):
    """int_0^f (2 pi f)^4 S df by quadrature."""
    power = 1e-20 * (F / 1e5) ** -p
    fine = np.linspace(0, limit, 200_001)[1:]
    curvature = np.trapezoid((2 * math.pi * fine) ** 4 * 1e-20 * (fine / 1e5) ** -p, fine) ** 0.5
    one = np.ones_like(F)
    spectrum = Spectrum(F, power, one, 1 / F, 0 * one, "profile", NYQUIST)
    found = tip_limit(spectrum, LENGTH, 1.5, 1 / (6 * curvature))
    assert found == pytest.approx(limit, rel=0.02)
    assert tip_limit(spectrum, LENGTH, 1.5, 1e-12) == NYQUIST
