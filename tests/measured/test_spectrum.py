"""Theoretical spectra and structure function against quadrature, estimates against both."""

import math

import jax
import mpmath
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.measured.spectrum import (
    map_spectra,
    mean_cosine_power,
    profile_spectrum,
    theoretical_spectrum,
)
from fractaljax.measured.structure_function import theoretical_structure_function
from synthetic import DX, gaussian_map, gaussian_profile


@pytest.mark.parametrize("D", [2.05, 2.5, 2.95])
def test_profile_is_what_is_seen_of_a_map(D):
    """A wave f crossed at the angle a is seen as f |cos a|: the mean of S_r(f/|cos a|)/|cos a|."""
    surface, f, p = fj.Surface(D, 1e-9), 1e4, 7 - 2 * D
    with mpmath.workdps(40):
        mean = mpmath.quad(lambda a: mpmath.cos(a) ** (p - 1), [0, mpmath.pi / 2]) * 2 / mpmath.pi
    assert float(mean_cosine_power(p)) == pytest.approx(float(mean), rel=1e-10)
    radial = 1e-9 ** (2 * D - 4) / 2 * f**-p
    assert float(theoretical_spectrum(surface, f, "map")) / radial == pytest.approx(1, rel=1e-12)
    seen = float(theoretical_spectrum(surface, f))
    assert seen / (radial * float(mean)) == pytest.approx(1, rel=1e-10)


@pytest.mark.parametrize("D", [2.05, 2.5, 2.95])
def test_structure_function_is_the_integral_of_the_spectrum(D):
    """2 int C (1 - cos 2 pi f tau) df, by quadrature in pieces."""
    surface, tau, p = fj.Surface(D, 1e-9), 3e-6, 7 - 2 * D
    C = float(theoretical_spectrum(surface, 1.0))
    with mpmath.workdps(30):

        def rise(u):
            return 2 * u**-p * mpmath.sin(u / 2) ** 2

        # u = v^40 takes the singularity of u^(2-p) away.
        low = mpmath.quad(lambda v: rise(v**40) * 40 * v**39, [0, 1])
        low += mpmath.quad(rise, [1, 2 * mpmath.pi])
        high = mpmath.mpf(2 * mpmath.pi) ** (1 - p) / (p - 1) - mpmath.quadosc(
            lambda u: u**-p * mpmath.cos(u), [2 * mpmath.pi, mpmath.inf], omega=1
        )
        whole = 2 * C * (2 * mpmath.pi * tau) ** (p - 1) * (low + high)
    found = float(theoretical_structure_function(surface, tau))
    assert found / float(whole) == pytest.approx(1, rel=1e-8)


@pytest.mark.parametrize("law", [theoretical_spectrum, theoretical_structure_function])
def test_theory_has_gradients(law):
    """Both modes agree with differences; vmap runs over frequencies or distances."""

    @jax.jit
    def value(D, log_G):
        return jax.numpy.log(law(fj.Surface(D, jax.numpy.exp(log_G)), 2.0))

    at, h = (2.4, math.log(1e-9)), 1e-5
    for i in range(2):
        up = [x + h * (i == j) for j, x in enumerate(at)]
        down = [x - h * (i == j) for j, x in enumerate(at)]
        difference = (value(*up) - value(*down)) / (2 * h)
        for mode in (jax.jacfwd, jax.jacrev):
            assert float(jax.jit(mode(value, argnums=i))(*at)) == pytest.approx(
                float(difference), rel=1e-6
            )
    x = jax.numpy.array([0.5, 2.0])
    many = jax.vmap(lambda x: law(fj.Surface(2.4, 1e-9), x))(x)
    np.testing.assert_allclose(many, law(fj.Surface(2.4, 1e-9), x), rtol=1e-14)


def test_another_kind_is_refused():
    with pytest.raises(ValueError, match="kind must be 'profile' or 'map', got 'row'"):
        theoretical_spectrum(fj.Surface(2.5, 1e-9), 1.0, "row")


@pytest.mark.parametrize("D", [2.2, 2.5, 2.8])
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
    """Rings of a map that is not square, dx and dy different; all waves, along x, along y."""
    rng, surface = np.random.default_rng(2), fj.Surface(2.4, 1e-9)
    spectra = [
        map_spectra(gaussian_map(rng, 2.4, (96, 160), dy=0.7e-6), DX, 0.7e-6) for _ in range(8)
    ]
    for which in range(3):
        f = spectra[0][which].f
        middle = (f > 8e4) & (f < 4e5)
        mean = np.mean([s[which].power[middle] for s in spectra], axis=0)
        ratio = mean / np.asarray(theoretical_spectrum(surface, f[middle], "map"))
        assert ratio.mean() == pytest.approx(1, abs=0.05)
