"""Theoretical spectra and structure function against quadrature, estimates against theory."""

import math

import mpmath
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._identify.band import missing_share
from fractaljax._identify.spectrum import (
    log_mean_cosine_power,
    map_spectra,
    profile_spectrum,
    theoretical_spectrum,
)
from fractaljax._identify.structure_function import second_differences, structure_function
from synthetic import DX, gaussian_map, gaussian_profile


@pytest.mark.parametrize("D", [2.05, 2.5, 2.95])
def test_profile_is_a_cut_through_a_map(D):
    """A wave f crossed at the angle a is seen as f |cos a|: the mean of S_r(f/|cos a|)/|cos a|."""
    surface, f, p, u = fj.Surface(D, 1e-9), 1e4, 7 - 2 * D, 1e-3
    with mpmath.workdps(40):
        mean = mpmath.quad(lambda a: mpmath.cos(a) ** (p - 1), [0, mpmath.pi / 2]) * 2 / mpmath.pi
        # Waves beyond Nyquist's are crossed with |cos a| < u, u the frequency relative to it.
        least = mpmath.acos(u)
        missing = mpmath.quad(lambda a: mpmath.cos(a) ** (p - 1), [least, mpmath.pi / 2])
    radial = 1e-9 ** (2 * D - 4) / 2 * f**-p
    assert math.exp(log_mean_cosine_power(p)) == pytest.approx(float(mean), rel=1e-10)
    assert theoretical_spectrum(surface, f, "map") / radial == pytest.approx(1, rel=1e-12)
    assert theoretical_spectrum(surface, f) / (radial * float(mean)) == pytest.approx(1, rel=1e-10)
    share = float(missing * 2 / mpmath.pi / mean)
    assert missing_share(p) * u**p == pytest.approx(share, rel=1e-5)


@pytest.mark.parametrize("p", [1.5, 2.8])
def test_structure_function_is_the_integral_of_the_spectrum(p):
    """W = 4 V(tau) - V(2 tau), V = 2 int f^-p (1 - cos 2 pi f tau) df, by quadrature in pieces."""
    tau, end = 3e-6, 1e6
    with mpmath.workdps(20):

        def rise(u):
            return 2 * u**-p * mpmath.sin(u / 2) ** 2

        # u = v^40 removes the singularity of u^(2-p).
        low = mpmath.quad(lambda v: rise(v**40) * 40 * v**39, [0, 1])
        low += mpmath.quad(rise, [1, 2 * mpmath.pi])
        high = mpmath.mpf(2 * mpmath.pi) ** (1 - p) / (p - 1) - mpmath.quadosc(
            lambda u: u**-p * mpmath.cos(u), [2 * mpmath.pi, mpmath.inf], omega=1
        )
        V = float(2 * (2 * mpmath.pi * tau) ** (p - 1) * (low + high))
    W = second_differences(p, np.array(tau))
    assert W / ((4 - 2 ** (p - 1)) * V) == pytest.approx(1, rel=1e-8)
    # The mean of |1 - exp(i x)|^4 is 6: beyond `end` the cosines average out.
    missing = W - second_differences(p, np.array(tau), end)
    assert missing == pytest.approx(6 * end ** (1 - p) / (p - 1))


@pytest.mark.parametrize(
    "line",
    [
        np.sin(np.arange(4096) / 500),  # W as the fourth power of distance: D = 2 at most
        np.random.default_rng(0).standard_normal(4096),  # the same at all distances
    ],
)
def test_structure_function_at_its_bound_is_no_opinion(line):
    """A fit that ends at D = 2.0025 or 2.9975 knows neither D nor its error."""
    found = structure_function([line], DX, (1e4, 1e5), end=None)
    assert math.isnan(found.D) and math.isnan(found.G) and math.isnan(found.D_standard_error)


@pytest.mark.parametrize("D", [2.2, 2.8])
def test_estimate_has_the_mean_of_theory(D):
    """Away from both ends, over 60 profiles."""
    rng, surface = np.random.default_rng(1), fj.Surface(D, 1e-9)
    spectra = [profile_spectrum([gaussian_profile(rng, D, 512)], DX) for _ in range(60)]
    middle = (spectra[0].f > 2e4) & (spectra[0].f < 4e5)
    f = spectra[0].f[middle]
    ratio = np.mean([s.power[middle] for s in spectra], axis=0) / theoretical_spectrum(surface, f)
    assert ratio.mean() == pytest.approx(1, abs=0.03)
    low, high = ratio[: f.size // 2].mean(), ratio[f.size // 2 :].mean()
    assert low / high == pytest.approx(1, abs=0.06)


def test_map_estimate_has_the_mean_of_theory():
    """A map that is not square, dx and dy different; all waves, along x, along y."""
    rng, surface = np.random.default_rng(2), fj.Surface(2.4, 1e-9)
    spectra = [
        map_spectra(gaussian_map(rng, 2.4, (96, 160), dy=0.7e-6), DX, 0.7e-6) for _ in range(8)
    ]
    for which in range(3):
        f = spectra[0][which].f
        middle = (f > 8e4) & (f < 4e5)
        mean = np.mean([s[which].power[middle] for s in spectra], axis=0)
        ratio = mean / theoretical_spectrum(surface, f[middle], "map")
        assert ratio.mean() == pytest.approx(1, abs=0.05)
