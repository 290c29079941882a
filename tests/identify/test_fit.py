"""Power laws through spectra that are known: exact, aliased, with a floor, and with chance."""

import math

import numpy as np
import pytest
from scipy.special import zeta

from fractaljax._identify.fit import Bins, FlatPrior, bin_edges, curvature, fit, shape
from fractaljax._identify.spectrum import PowerSpectrum

NYQUIST, BAND, RATIO = 5e5, (5e3, 2.5e5), 1.5
F = np.arange(1e3, NYQUIST, 1e3)


def spectrum(power, kind="profile", spread=0.0):
    """Ordinates a thousand 1/m apart."""
    one = np.ones_like(F)
    return PowerSpectrum(F, power, one, 1 / F, spread * one, kind, NYQUIST)


def law(p, aliased=False):
    return 1e-20 * shape(F / NYQUIST, p, aliased)


def plateau(f):
    """Below 2e4 1/m, as constant and slope by p of its logarithm."""
    return 0.0, -np.log1p((2e4 / f) ** 2) / 2


def damped(f):
    return -np.log1p(f / 1e5), 0.0


SPREAD = 4e6  # 1/m^2: a window smears a law by half its second derivative times its width


def aliased_law(p):
    return law(p, aliased=True)


EXACT = [  # (power by p, p, flat, kind, spread, options)
    (law, 1.1, 0, "profile", 0, {}),
    (law, 2.9, 0, "profile", 0, {}),
    (law, 1.1, 0, "map", 0, {}),
    (law, 2.9, 0, "map", 0, {}),
    (aliased_law, 1.8, 0, "profile", 0, {"aliased": True}),
    (lambda p: law(p) * (1 + p * (p + 1) / 2 * SPREAD / F**2), 2.5, 0, "profile", SPREAD, {}),
    (lambda p: law(p) * (1 + (p + 1) ** 2 / 2 * SPREAD / F**2), 2.5, 0, "map", SPREAD, {}),
    (lambda p: law(p) + 3e-20, 2.4, 3.0, "profile", 0, {"flat_prior": FlatPrior(deviation=1e6)}),
    (
        lambda p: law(p) + 3e-20 * F / NYQUIST,
        2.4,
        3.0,
        "map",
        0,
        {"flat_prior": FlatPrior(deviation=1e6)},
    ),
    (lambda p: law(p) - 3e-21, 2.0, -0.3, "profile", 0, {"flat_prior": FlatPrior(-0.3)}),
    (lambda p: law(p) * np.exp(plateau(F)[1] * p), 2.2, 0, "profile", 0, {"factor": plateau}),
    (lambda p: law(p) / (1 + F / 1e5), 2.0, 0, "profile", 0, {"factor": damped}),
]


@pytest.mark.parametrize(("power", "p", "flat", "kind", "spread", "options"), EXACT)
def test_an_exact_law_is_found_exactly(power, p, flat, kind, spread, options):
    """With its floor, its aliased waves and the smearing by a window; and its slope by p."""
    exact, h = spectrum(power(p), kind, spread), 1e-5
    found = fit(exact, BAND, RATIO, **options)
    assert found.p == pytest.approx(p, abs=1e-5)
    assert found.log_A == pytest.approx(math.log(1e-20), abs=1e-4)
    assert found.flat == pytest.approx(flat, abs=1e-4) and found.scatter == 0
    if not spread and "factor" not in options:
        np.testing.assert_allclose(found(F), power(p), rtol=1e-3)
    np.testing.assert_allclose(found.power, found(found.f), rtol=1e-4)
    bins, slope = Bins(exact, BAND, RATIO), (power(p + h) - power(p - h)) / (2 * h * power(p))
    np.testing.assert_allclose(found.slope[:, 1], bins(slope[np.isin(F, bins.f)]), rtol=1e-4)


def test_aliasing_is_the_sum_over_all_bands():
    """In closed form at p = 2: the sum of (u + 2j)^-2 over all j is (pi/2)^2/sin^2(pi u/2)."""
    u = np.array([0.01, 0.3, 0.5, 0.99])
    closed = (np.pi / 2) ** 2 / np.sin(np.pi * u / 2) ** 2
    np.testing.assert_allclose(shape(u, 2.0, True), closed, rtol=1e-12)
    j = np.arange(1, 200_001)[:, None]
    direct = u**-2.6 + ((u + 2 * j) ** -2.6 + (2 * j - u) ** -2.6).sum(axis=0)
    np.testing.assert_allclose(shape(u, 2.6, True), direct, rtol=1e-8)
    u = np.linspace(0.005, 1, 200)
    for p in (1.02, 1.7, 2.9, 4.5, 8.0):
        exact = u**-p + 2**-p * (zeta(p, 1 + u / 2) + zeta(p, 1 - u / 2))
        np.testing.assert_allclose(shape(u, p, True), exact, rtol=1e-13)


@pytest.mark.parametrize("aliased", [False, True])
def test_the_first_law_changes_the_time_only(aliased):
    """Steps from another spectrum's law end where those from the usual first law do."""
    rng = np.random.default_rng(3)
    drawn = [spectrum(law(p, aliased) * rng.exponential(size=F.size)) for p in (1.4, 2.6)]
    other, usual = (fit(one, BAND, RATIO, aliased=aliased) for one in drawn)
    found = fit(drawn[1], BAND, RATIO, aliased=aliased, scatter=usual.scatter, start=other)
    for name in ("log_A", "p", "flat"):
        assert getattr(found, name) == pytest.approx(getattr(usual, name), abs=1e-5)


def test_errors_and_a_bend_are_measured():
    """Exponential ordinates, as of a Gaussian profile: the covariance is that of the estimates."""
    rng = np.random.default_rng(0)
    drawn = [
        fit(spectrum(law(2.0) * rng.exponential(size=F.size)), BAND, RATIO) for _ in range(300)
    ]
    found = np.array([(one.log_A, one.p) for one in drawn])
    said = np.median([np.sqrt(np.diag(one.covariance)[:2]) for one in drawn], axis=0)
    # The unknown flat share widens the errors by what no draw here has: at most a half.
    for values, truth, error in zip(found.T, (math.log(1e-20), 2.0), said, strict=True):
        assert values.mean() == pytest.approx(truth, abs=4 * values.std() / math.sqrt(300))
        assert values.std() < 1.1 * error < 1.7 * values.std()
    bent = law(2.0) * np.exp(-0.05 * np.log(F / 5e4) ** 2)
    c, _ = curvature(fit(spectrum(bent), BAND, RATIO, flat_prior=FlatPrior(deviation=1e-3)))
    assert c == pytest.approx(-0.05, abs=0.005)
    straight, error = curvature(
        fit(spectrum(law(2.0)), BAND, RATIO, flat_prior=FlatPrior(deviation=1e-3))
    )
    assert abs(straight) < 1e-3 < error


@pytest.mark.parametrize(
    ("band", "edges"),
    [
        ((1.0, 1.5**4), 1.5 ** np.arange(5.0)),
        ((0.9, 1.5**4), [0.9, *1.5 ** np.arange(1.0, 5.0)]),  # a wider one
        ((0.75, 1.5**4), [0.75, *1.5 ** np.arange(5.0)]),  # one more
        ((1.0, 1.2), [1.0, 1.2]),
    ],
)
def test_bins_tile_the_band_from_above(band, edges):
    np.testing.assert_allclose(bin_edges(band, 1.5), edges)
