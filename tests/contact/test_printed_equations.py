"""The fractal joint against the source's equations as printed, and against their integrals."""

import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.integrate import quad

import fractaljax as fj

MATERIAL = fj.Material(1.154e11, 0.3, 3.55e8, 9.94e8)


def brake_joint(D=2.4, G=1.342e-10, P=1907.3, mu_s=0.4, mu_m=0.25):
    """The state of the reference joint, with some of its numbers changed."""
    return fj.contact_state(fj.Surface(D, G), MATERIAL, P, mu_s=mu_s, mu_m=mu_m)


def test_load_is_the_sum_of_its_asperities():
    """H a below a_e and 4/3 E sqrt(R) delta^(3/2) above it, integrated over n(a), carry P."""
    state = brake_joint()
    D, G, E, a_l = 2.4, 1.342e-10, 1.154e11, float(state.a_l)

    def per_log_area(load):
        # n(a) da (Eq. 25) per unit of ln a
        return lambda x: load(np.exp(x)) * (D - 1) / 2 * np.exp((D - 1) / 2 * (np.log(a_l) - x))

    def elastic(a):
        delta = 2 ** ((11 - 3 * D) / 2) * G ** (D - 2) * np.log(1.5) ** 0.5
        delta *= np.pi ** ((D - 3) / 2) * a ** ((3 - D) / 2)
        return 4 / 3 * E * np.sqrt(a / (np.pi * delta)) * delta**1.5

    low, high = np.log(float(state.a_e)), np.log(a_l)
    options = {"epsabs": 0, "epsrel": 1e-13}
    plastic = quad(per_log_area(lambda a: 9.94e8 * a), low - 150, low, limit=200, **options)[0]
    carried = quad(per_log_area(elastic), low, high, **options)[0]
    np.testing.assert_allclose(plastic + carried, 1907.3, rtol=1e-13)
    np.testing.assert_allclose(plastic / 1907.3, state.plastic_share, rtol=1e-13)
    area = quad(per_log_area(lambda a: a), low - 150, high, limit=200, **options)[0]
    np.testing.assert_allclose(area, state.A_r, rtol=1e-13)


@pytest.mark.parametrize("D", [2.001, 2.4, 2.5, 2.97])
def test_dimensionless_stiffness_as_printed(D):
    """Eqs. 31 and 37 as the source prints them, in 40 digits."""
    A_r, a_e, nu, slip = 2.7e-3, 1.8e-6, 0.3, 0.4
    with mp.workdps(40):
        d, A, a, n, q = (mpf(x) for x in (D, A_r, a_e, nu, slip))
        bracket = ((3 - d) / (d - 1) * A) ** ((2 - d) / 2) - a ** ((2 - d) / 2)
        bracket *= A ** ((d - 1) / 2)
        normal = mpf(4) / 3 * (4 - d) / (2 - d) * ((d - 1) / (3 - d)) ** ((3 - d) / 2)
        normal *= bracket / mp.sqrt(mp.pi)
        powers = (d - 1) ** ((3 - d) / 2) * (3 - d) ** ((d - 1) / 2)
        tangential = 8 / (mp.sqrt(mp.pi) * (2 - n) * (2 + 2 * n)) * powers / (2 - d)
        tangential *= mp.cbrt(1 - q) * bracket
    found_normal = fj.dimensionless_normal_stiffness(D, A_r, a_e)
    found_tangential = fj.dimensionless_tangential_stiffness(D, nu, A_r, a_e, slip)
    np.testing.assert_allclose(found_normal, float(normal), rtol=2e-15)
    np.testing.assert_allclose(found_tangential, float(tangential), rtol=2e-15)


def test_equation_34():
    """Q_e at D = 2.5 as printed, with the plus sign that the print lost."""
    state = brake_joint(D=2.5, mu_s=0.9)
    sigma_y, nu, E, G = 3.55e8, 0.3, 1.154e11, 1.342e-10
    a_l, a_e = float(state.a_l), float(state.a_e)
    plastic = 24 * sigma_y / (np.pi * (6 - 3 * nu)) * a_l**0.75 * (a_l**0.25 - a_e**0.25)
    elastic = (2 * nu - 1) * E / (6 - 3 * nu) * 2 ** (19 / 4) * np.pi ** (-7 / 4)
    elastic *= (np.log(1.5) * G) ** 0.5 * a_l**0.75 * (np.log(a_l) - np.log(a_e))
    assert state.regime == fj.Regime.elastic_plastic
    np.testing.assert_allclose(np.asarray(state.Q_e), plastic + elastic, rtol=1e-13)
