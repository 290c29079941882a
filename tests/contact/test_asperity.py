"""The revised asperity law: 40 digits in the other order of integration, the source as a limit."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf

import fractaljax as fj
from fractaljax._contact import asperity, fractal
from tools import both_modes

mp: Any = mpmath
E, NU, SIGMA_Y, H, GAMMA, MU_M = 1.154e11, 0.3, 3.55e8, 9.94e8, 1.5, 0.25
LOG_L_S = math.log(1e-4)
MATERIAL = fj.Material(E=E, nu=NU, sigma_y=SIGMA_Y, H=H)
NAMES = ("D", "ln G", "ln L_s", "ln E", "ln sigma_y", "ln H")
# D, G, L_s and ln(a_l/a_s): of elastic to plastic bases, few and many, of all three regimes.
POINTS = [
    (2.4, 1.342e-10, 1e-4, 5.0),
    (2.05, 1e-12, 1e-4, 3.0),
    (2.5, 1e-12, 1e-5, 8.0),
    (2.9, 1e-9, 1e-4, 12.0),
    (2.7, 1e-9, 1e-6, 9.0),
    (2.4, 1e-13, 1e-3, 1e-3),
]


def contact(D, G, P, L_s: Any = 1e-4, E: Any = E, sigma_y: Any = SIGMA_Y, H: Any = H, **others):
    material = fj.Material(E=E, nu=NU, sigma_y=sigma_y, H=H)
    return fj.AsperityContact(fj.Surface(D, G, GAMMA), material, P, L_s, **others)


def log_K_n(D, log_G, log_P, log_L_s: Any = LOG_L_S, *logs):
    law = contact(D, *jnp.exp(jnp.stack([log_G, log_P, log_L_s, *logs])))
    return jnp.log(law.stiffness(0.4, MU_M)[0])


alpha = jax.jit(jax.grad(log_K_n, 2))
# Under a fixed load, by D and the logarithms of G, L_s, E, sigma_y and H.
slopes_of_log_K_n = jax.jit(
    lambda x, log_P: both_modes(lambda x: log_K_n(x[0], x[1], log_P, *x[2:]), x)
)


@jax.jit
def measures(law):
    """K_n, K_t and A_r."""
    return *law.stiffness(0.4, MU_M), law.real_area(MU_M)


def exact(log_b, D, *logs):
    """(A_r, P, K_n) of bases up to b times the smallest, in 40 digits.

    The integral over the bases that have a given y is a power law; that over y is by quadrature.
    """
    G, L_s, E, sigma_y, H = map(mp.exp, logs)
    b, a_s = mp.exp(log_b), mp.pi * L_s**2 / 8
    p_1 = mpf("1.1") * (1 - mpf("0.228") * MU_M) * sigma_y

    def delta(a):  # Eq. 16
        height = mpf(2) ** ((11 - 3 * D) / 2) * G ** (D - 2) * mp.sqrt(mp.log(GAMMA))
        return height * mp.pi ** ((D - 3) / 2) * a ** ((3 - D) / 2)

    def depth_at_yield(a):  # Eqs. 17 and 20
        return (3 * mp.pi * p_1 / (4 * E)) ** 2 * a / (mp.pi * delta(a))

    y_s = delta(a_s) / depth_at_yield(a_s)

    def growth(y):
        s = min(max((y - 1) / 53, 0), 1)
        return 1 + 3 * s**2 - 2 * s**3

    def pressure(y):
        if y <= 1:
            return p_1 * mp.sqrt(y)
        return H - (H - p_1) * max(1 - mp.log(y) / mp.log(54), 0)

    def bases(y, power):
        """Integral of n(B) B^p Y^-(1+p) from 1 to where Y falls below y; Y = y_s B^(2-D)."""
        end = min(b, (y_s / y) ** (1 / (D - 2)))
        q = -(D + 1) / 2 + power + (D - 2) * (1 + power) + 1
        return (D - 1) / 2 * b ** ((D - 1) / 2) * y_s ** -(1 + power) * mp.powm1(end, q) / q

    cuts = sorted(y for y in (1, 54, y_s * b ** (2 - D)) if 0 < y < y_s)

    def total(integrand):
        # y = x^2: roots of y at 0
        ends = [mp.sqrt(y) for y in (0, *cuts, y_s)]
        return mp.quad(lambda x: 2 * x * integrand(x**2), ends)

    area = total(lambda y: y * growth(y) * bases(y, 1)) * a_s
    load = total(lambda y: y * growth(y) * pressure(y) * bases(y, 1)) * a_s
    root = total(lambda y: mp.sqrt(y * growth(y)) * bases(y, mpf("0.5")))
    return area, load, 2 * E * mp.sqrt(a_s / mp.pi) * root


def exact_row(point):
    D, G, L_s, log_b = map(mpf, map(str, point))
    return log_b, D, *map(mp.log, (G, L_s, mpf(E), mpf(SIGMA_Y), mpf(H)))


@functools.cache
def oracle(point):
    """ln A_r, ln P, ln K_n of a point."""
    with mpmath.workdps(40):
        return [float(mp.log(x)) for x in exact(*exact_row(point))]


@pytest.mark.parametrize("point", POINTS, ids=str)
def test_area_and_stiffness_are_the_quadrature(point):
    D, G, L_s, _ = point
    log_area, log_P, log_stiffness = oracle(point)
    K_n, _, area = measures(contact(D, G, math.exp(log_P), L_s))
    assert math.log(K_n) == pytest.approx(log_stiffness, abs=1e-12)
    assert math.log(area) == pytest.approx(log_area, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS[:5:4], ids=str)
def test_slopes_under_a_fixed_load_are_those_of_the_quadrature(point):
    D, G, L_s, _ = point
    parameters = [D, *map(math.log, (G, L_s, E, SIGMA_Y, H))]
    log_P = oracle(point)[1]
    _, *both_slopes = slopes_of_log_K_n(jnp.asarray(parameters), log_P)
    with mpmath.workdps(40):
        row, h = exact_row(point), mpf("1e-9")

        def slope(i):
            """Slopes of ln P and ln K_n by the ith of ln b, D, ln G, ..."""
            ends = [exact(*row[:i], row[i] + x, *row[i + 1 :])[1:] for x in (-h, h)]
            return [(mp.log(b) - mp.log(a)) / (2 * h) for a, b in zip(*ends, strict=True)]

        of_load, of_stiffness = slope(0)
        for i in range(len(NAMES)):
            load, stiffness = slope(i + 1)
            expected = float(stiffness - of_stiffness * load / of_load)
            for slopes in both_slopes:
                assert float(slopes[i]) == pytest.approx(expected, rel=1e-9, abs=1e-11), NAMES[i]


@pytest.mark.parametrize(
    "D, G, P", [(2.4, 1.342e-10, 1907.3), (2.5, 1e-10, 3e3), (2.7, 1e-9, 10.0)]
)
def test_flattened_bases_that_yield_at_once_are_the_source_s_law(D, G, P):
    """Each base as flat as it gets, plastic below a_e, and as stiff as Eq. 29 has it."""
    surface = fj.Surface(D, G, GAMMA)
    state = fj.contact_state(surface, MATERIAL, P, mu_s=0.4, mu_m=MU_M)
    D = surface.D
    # The smallest base as small as to carry nothing.
    log_a_s = math.log(state.a_e) - 80 / (3 - float(D))
    log_a_e, log_a_l = math.log(state.a_e) - log_a_s, math.log(state.a_l) - log_a_s
    k_mu = fractal.friction_correction(jnp.asarray(MU_M))
    p_e = float(fractal.critical_pressure_ratio(MATERIAL, k_mu))
    borders = [jnp.asarray(log_a_e * k / 8) for k in range(1, 9)]

    def spot(log_a):
        elastic = log_a > log_a_e
        load = jnp.where(elastic, p_e * jnp.exp((D - 2) / 2 * (log_a_e - log_a)), 1.0)
        stiffness = jnp.where(elastic, 2 * (4 - D) / (3 * (3 - D)), 0.0)
        return asperity.Sums(jnp.ones_like(log_a), load, stiffness)

    sums = asperity.base_sums(jnp.asarray(log_a_l), D, borders, spot)
    log_count, A_r = (D - 1) / 2 * log_a_l, float(state.A_r)
    assert float(jnp.exp(log_count + log_a_s) * sums.area) == pytest.approx(A_r, rel=1e-10)
    assert float(H * jnp.exp(log_count + log_a_s) * sums.load) == pytest.approx(P, rel=1e-10)
    K_n = 2 * E / math.sqrt(math.pi) * jnp.exp(log_count + log_a_s / 2) * sums.stiffness
    assert float(K_n) == pytest.approx(float(state.K_n), rel=1e-10)


@jax.jit
@jax.jacfwd
def _moments(x, beta):
    mean = asperity.mean_spot(x[None], beta)
    return jnp.stack([mean.area[0], mean.load[0]]) * jnp.exp(2 * x)


@pytest.mark.parametrize("log_y", [-3.0, 0.0, 2.0, math.log(54), 6.0])
def test_the_mean_over_depths_has_zhao_s_asperity_as_its_slope(log_y):
    """d(Y^2 mean A)/dY = Y f, and likewise the load; beyond the ends of its table too."""
    beta, y = 0.37, math.exp(log_y)
    slope = _moments(jnp.asarray(log_y), jnp.asarray(beta)) / y
    s = np.clip((y - 1) / 53, 0, 1)
    area = y * (1 + 3 * s**2 - 2 * s**3)
    share = np.clip(math.log(y) / math.log(54), 0, 1)
    pressure = beta * math.sqrt(y) if y < 1 else beta + (1 - beta) * share
    np.testing.assert_allclose(slope, [area, area * pressure], rtol=1e-12)


@pytest.mark.parametrize("D", [2.1, 2.4, 2.8])
def test_small_loads_touch_the_smallest_bases_only(D):
    exponent = alpha(D, math.log(1e-10), math.log(1e-8), LOG_L_S)
    assert float(exponent) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("D", [2.1, 2.3])
def test_elastic_joints_follow_the_power_law_of_the_largest_base(D):
    exponent = alpha(D, math.log(1e-25), 0.0, math.log(1e-9))
    assert float(exponent) == pytest.approx((D - 1) / (4 - D), abs=0.03)


@functools.cache
def _batch():
    D, G, P, L_s = np.meshgrid(
        [2.001, 2.3, 2.5, 2.7, 2.999], [1e-14, 1e-10, 1e-6], [1e-3, 1.0, 1e3, 1e6], [1e-6, 1e-3]
    )
    return [x.ravel() for x in (D, np.log(G), np.log(P), np.log(L_s))]


@pytest.mark.slow
def test_finite_and_positive_from_1_newton_to_1e6_with_gradients_of_three_orders():
    exact, slopes = jax.jit(jax.vmap(jax.value_and_grad(log_K_n, (0, 1, 2, 3))))(*_batch())
    bend = jax.jit(jax.vmap(jax.grad(jax.grad(jax.grad(log_K_n, 2), 2), 2)))(*_batch())
    for numbers in (exact, *slopes, bend):
        assert np.isfinite(numbers).all()
    assert (np.asarray(slopes[2]) > 0).all() and (np.asarray(slopes[2]) < 1.1).all()
    with jax.enable_x64(False):
        single = [jnp.asarray(x, jnp.float32) for x in _batch()]
        value, slope = jax.jit(jax.vmap(jax.value_and_grad(log_K_n)))(*single)
    assert value.dtype == jnp.float32 and np.isfinite(slope).all()
    np.testing.assert_allclose(value, exact, atol=1e-4)


def test_the_load_is_found_to_the_last_digit():
    def load(D, log_G, log_P, log_L_s):
        law = contact(D, *jnp.exp(jnp.stack([log_G, log_P, log_L_s])), domain_extension=True)
        return law._solve(MU_M).load

    np.testing.assert_allclose(jax.jit(jax.vmap(load))(*_batch()), np.exp(_batch()[2]), rtol=1e-12)


@pytest.mark.parametrize("D", ["2.001", "2.4", "2.5", "2.999"])
def test_domain_extension_solves_its_equation(D):
    with mpmath.workdps(40):
        exact = mpf(D)

        def excess(psi):
            grown = psi ** ((3 - exact) / 2)
            rest = (1 + psi ** (-(exact - 1) / 2)) ** (-(3 - exact) / (exact - 1))
            return (grown - rest) / ((3 - exact) / (exact - 1)) - 1

        expected = float(mp.log(mp.findroot(excess, 2)))
    log_psi = asperity.log_domain_extension(jnp.asarray(float(D)))
    assert float(log_psi) == pytest.approx(expected, rel=1e-13)


def test_domain_extension_shares_the_load_and_has_known_ends():
    """psi adds bases of every size alike: K_n is that of one count under a part of the load."""
    psi = math.exp(float(asperity.log_domain_extension(jnp.asarray(2.4))))
    count = psi ** ((3 - 2.4) / 2)
    more = measures(contact(2.4, 1e-10, 500.0, domain_extension=True))[0]
    part = measures(contact(2.4, 1e-10, 500.0 / count))[0]
    assert float(more) == pytest.approx(count * float(part), rel=1e-12)
    ends = asperity.log_domain_extension(jnp.asarray([2.0, 3.0]))
    np.testing.assert_allclose(np.exp(ends), [(3 + 5**0.5) / 2, math.e - 1], rtol=1e-14)


def test_tangential_stiffness():
    K_n, K_t, _ = measures(contact(2.4, 1e-10, 500.0))
    assert float(K_t / K_n) == pytest.approx((2 - 2 * NU) / (2 - NU), rel=1e-14)
    K_n, K_t, _ = measures(contact(2.4, 1e-10, 500.0, stiffness_ratio=0.5))
    assert float(K_t / K_n) == 0.5


@pytest.mark.slow
def test_scene_comes_back_from_its_file_and_has_gradients():
    law = contact(2.4, 1.342e-10, 1907.3, domain_extension=True)
    scene = fj.brake_scene().replace(contact=law)
    text = scene.to_toml()
    assert 'law = "asperity"' in text and "domain_extension = true" in text
    back = fj.Scene.from_toml(text)
    assert float(fj.growth_rate(back)) == float(fj.growth_rate(scene))

    def growth(x):
        return fj.growth_rate(scene.replace(D=x[0], G=jnp.exp(x[1])))

    x, h = jnp.array([2.4, math.log(1.342e-10)]), 1e-5
    program = jax.jit(lambda x: both_modes(growth, x))
    value, *both_slopes = program(x)
    assert float(value) == pytest.approx(float(fj.growth_rate(scene)), rel=1e-9)
    for i, step in enumerate(h * np.eye(2)):
        slope = (program(x + step)[0] - program(x - step)[0]) / (2 * h)
        for slopes in both_slopes:
            assert float(slopes[i]) == pytest.approx(float(slope), rel=1e-6)


def test_friction_beyond_eq_19_is_refused():
    friction = fj.Stribeck(1.2, 1.0, 0.5)
    with pytest.raises(ValueError, match=r"mu_m must be at most 0\.9"):
        fj.brake_scene().replace(contact=contact(2.4, 1e-10, 500.0), friction=friction)


@pytest.mark.slow
def test_boundary_elements_are_softer_and_as_sensitive():
    """On (10 mm)^2 they have d ln K_n/dD of 13 to 14 and d ln K_n/d ln G of -0.3."""
    surface = fj.Surface(2.4, 1.342e-10)
    compared = fj.compare_laws(
        surface, MATERIAL, [1000.0, 3000.0], area=1e-4, seeds=3, n=64, progress=False
    ).curves
    ratio = compared["asperity"].K_n / compared["boundary elements"].K_n
    assert (np.asarray(ratio) > 1).all() and (np.asarray(ratio) < 3).all()
    parameters = (2.4, math.log(1.342e-10), math.log(1907.3), math.log(1e-4))
    slopes = jax.grad(log_K_n, (0, 1))(*parameters)
    assert 12 < float(slopes[0]) < 14 and -0.4 < float(slopes[1]) < -0.25
