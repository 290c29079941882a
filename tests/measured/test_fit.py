"""Power laws through spectra that are known: exactly, folded, with a floor, and with chance."""

import math

import numpy as np
import pytest

from fractaljax.measured.fit import bin_edges, curvature, fit, shape
from fractaljax.measured.spectrum import Spectrum

NYQUIST, BAND, RATIO = 5e5, (5e3, 2.5e5), 1.5
F = np.arange(1e3, NYQUIST, 1e3)


def spectrum(power, kind="profile", spread=0.0):
    """Ordinates a thousand 1/m apart."""
    one = np.ones_like(F)
    return Spectrum(F, power, one, 1 / F, spread * one, kind, NYQUIST)


def law(p, folded=False):
    return 1e-20 * shape(F / NYQUIST, p, folded)


@pytest.mark.parametrize("kind", ["profile", "map"])
@pytest.mark.parametrize("p", [1.1, 2.0, 2.9])
def test_an_exact_law_is_found_exactly(kind, p):
    found = fit(spectrum(law(p), kind), BAND, RATIO)
    assert (found.p, found.log_A) == pytest.approx((p, math.log(1e-20)), abs=1e-5)
    assert found.flat == pytest.approx(0, abs=1e-5) and found.scatter == 0
    np.testing.assert_allclose(found(F), law(p), rtol=1e-4)
    np.testing.assert_allclose(found.power, found(found.f), rtol=1e-4)


def test_folding_is_the_sum_over_all_bands():
    """In closed form at p = 2: the sum of (u + 2j)^-2 over all j is (pi/2)^2/sin^2(pi u/2)."""
    u = np.array([0.01, 0.3, 0.5, 0.99])
    np.testing.assert_allclose(
        shape(u, 2.0, True), (np.pi / 2) ** 2 / np.sin(np.pi * u / 2) ** 2, rtol=2e-9
    )
    j = np.arange(1, 200_001)[:, None]
    direct = u**-2.6 + ((u + 2 * j) ** -2.6 + (2 * j - u) ** -2.6).sum(axis=0)
    np.testing.assert_allclose(shape(u, 2.6, True), direct, rtol=1e-8)


def test_a_folded_law_is_found():
    found = fit(spectrum(law(1.8, folded=True)), BAND, RATIO, folded=True)
    assert found.p == pytest.approx(1.8, abs=1e-5)


@pytest.mark.parametrize(("kind", "level"), [("profile", 1.0), ("map", F / NYQUIST)])
def test_a_floor_is_found(kind, level):
    """Flat for a profile; over |f| of a map white noise grows with f."""
    found = fit(spectrum(law(2.4) + 3e-20 * level, kind), BAND, RATIO, beyond=1e6)
    assert (found.p, found.flat) == pytest.approx((2.4, 3.0), rel=1e-3)


@pytest.mark.parametrize(("kind", "curve"), [("profile", 2.5 * 3.5), ("map", 3.5**2)])
def test_the_width_of_the_window_is_taken_into_account(kind, curve):
    """Smearing a law of exponent p adds half of its second derivative times the mean square width:
    p (p + 1)/f^2 along a line, (p + 1)^2/f^2 over |f| in a plane."""
    spread = 4e6
    found = fit(spectrum(law(2.5) * (1 + curve / 2 * spread / F**2), kind, spread), BAND, RATIO)
    assert found.p == pytest.approx(2.5, abs=1e-5)


def test_errors_are_those_of_many_draws():
    """Exponential ordinates, as of a Gaussian profile: the covariance is that of the estimates."""
    rng = np.random.default_rng(0)
    drawn = [
        fit(spectrum(law(2.0) * rng.exponential(size=F.size)), BAND, RATIO) for _ in range(300)
    ]
    p, log_A = np.array([(one.p, one.log_A) for one in drawn]).T
    said = np.median([np.sqrt(np.diag(one.covariance)[:2]) for one in drawn], axis=0)
    # The unknown flat share widens the errors by what no draw here has: at most a half.
    for values, truth, error in ((p, 2.0, said[1]), (log_A, math.log(1e-20), said[0])):
        assert values.mean() == pytest.approx(truth, abs=4 * values.std() / math.sqrt(300))
        assert values.std() < 1.1 * error < 1.7 * values.std()


def test_a_bend_is_measured():
    bent = law(2.0) * np.exp(-0.05 * np.log(F / 5e4) ** 2)
    c, _ = curvature(fit(spectrum(bent), BAND, RATIO, beyond=1e-3))
    assert c == pytest.approx(-0.05, abs=0.005)
    straight, error = curvature(fit(spectrum(law(2.0)), BAND, RATIO, beyond=1e-3))
    assert abs(straight) < 1e-3 < error


def test_bins_tile_the_band_from_above():
    edges = bin_edges((1.0, 1.5**4), 1.5)
    np.testing.assert_allclose(edges, 1.5 ** np.arange(5.0))
    np.testing.assert_allclose(bin_edges((0.9, 1.5**4), 1.5), [0.9, *edges[1:]])  # a wider one
    np.testing.assert_allclose(bin_edges((0.75, 1.5**4), 1.5), [0.75, *edges])  # one more
    np.testing.assert_allclose(bin_edges((1.0, 1.2), 1.5), [1.0, 1.2])
