"""Persson's law: against quadrature in 40 digits and its published form, its limits, gradients."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf
from scipy.integrate import quad
from scipy.special import erf

import fractaljax as fj
from tools import both_modes, primitives, refusals

mp: Any = mpmath
MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
E, L, L_S = 1.154e11, 1e-2, 1e-4
NAMES = ("D", "ln G", "ln P", "ln area", "ln L", "ln E")
# D, G, P, area, L, E: contact from 1e-6 to all, smooth and rough, and areas unlike L^2.
POINTS = [
    (2.4, 1.342e-10, 1907.3, 1.3e-4, L, E),
    (2.05, 1e-12, 1.0, 1e-4, L, E),
    (2.5, 1e-10, 30.0, 4e-4, L, E),
    (2.9, 1e-12, 1e3, 1e-4, L, E),
    (2.7, 1e-9, 1e6, 2.5e-5, L, E),
    (2.1, 1e-9, 1e5, 1e-5, L, E),
]


def contact(D, G, P, area=1e-4, L=L, E=E, **others):
    material = fj.Material(E=E, nu=0.3, sigma_y=3.55e8, H=9.94e8)
    return fj.PerssonContact(fj.Surface(D, G), material, P, area, L, L_S, **others)


def stiffness(*numbers, **others):
    return contact(*numbers, **others).stiffness(0.4, 0.25)


def exact_compliance(D, G, P, area, L, E):
    """1/K_n without the layer of atoms, by quadrature in 40 digits of ln(q/q_low)."""
    D, G, P, area, L, E = map(mpf, (D, G, P, area, L, E))
    step, L = mp.log(mpf(1.5)), min(L, mp.sqrt(area))
    count = 1 + int(mp.floor(mp.log(L / mpf(L_S)) / step + mpf(10) ** -9))
    end = count * step

    def m(x):
        return (L * (G / L) ** (D - 2)) ** 2 / 2 * mp.exp(2 * (D - 3) * (x - step / 2))

    def q(x):
        return 2 * mp.pi / L * mp.exp(x - step / 2)

    def g2(x):
        return m(0) * q(0) ** 2 * mp.expm1(2 * (D - 2) * x) / (2 * (D - 2))

    def integrand(u):
        x = mp.exp(u)
        s = mp.sqrt(2) * P / (area * E * mp.sqrt(g2(x)))
        energy = mpf("0.45") + 3 * mpf("0.55") * mp.erf(s) ** 2
        return x * m(x) * q(x) / mp.sqrt(g2(x)) * energy * mp.exp(-(s**2))

    top = mp.log(end)
    cuts = [-60, -40, -30, -24, -18, -14, -11, -8, -6, -4, -3, -2, -1, -0.4, -0.1, -0.03, -0.01]
    middle = mp.quad(integrand, [top + x for x in (*cuts, 0)]) / mp.sqrt(2 * mp.pi) / P
    middle *= 1 + mp.erf(mp.sqrt(2) * P / (area * E * mp.sqrt(g2(end)))) ** 4 / 2
    Sq = L * (G / L) ** (D - 2)
    Sq *= mp.sqrt(step / 2 * sum(mp.exp(2 * (D - 3) * n * step) for n in range(count)))
    cells = mp.sqrt(area / L**2)
    finite = mpf("1.05") * mp.exp(mpf("1.24") * (D - mpf("2.5"))) * cells * E * L
    finite *= (P / (cells * E * Sq * L)) ** (1 / (4 - D))
    return middle / (1 + (middle * finite) ** mpf("2.4")) ** (1 / mpf("2.4"))


def exact_stiffness(D, *logs):
    G, P, area, L, E = map(mp.exp, logs)
    return 1 / (exact_compliance(D, G, P, area, L, E) + mpf("3e-10") / (E * area))


@jax.jit
def log_stiffness(x):
    """ln K_n, its gradient in both modes by NAMES: one program for all points."""
    return both_modes(lambda x: jnp.log(stiffness(x[0], *jnp.exp(x[1:]))[0]), x)


@functools.cache
def found(point):
    return log_stiffness(jnp.asarray([point[0], *map(math.log, point[1:])]))


@pytest.mark.parametrize("point", POINTS, ids=str)
def test_stiffness_is_the_quadrature(point):
    with mpmath.workdps(40):
        exact = float(mp.log(exact_stiffness(point[0], *map(mp.log, point[1:]))))
    value, forward, reverse = found(point)
    assert abs(float(value) - exact) < 1e-12
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("point", POINTS[::3], ids=str)
def test_slopes_are_those_of_the_quadrature(point, name):
    i = NAMES.index(name)
    with mpmath.workdps(40):
        row = [mpf(point[0]), *map(mp.log, point[1:])]

        def moved(h):
            return mp.log(exact_stiffness(*row[:i], row[i] + h, *row[i + 1 :]))

        h = mpf("1e-8")
        exact = float((moved(h) - moved(-h)) / (2 * h))
    for slope in found(point)[1:]:
        assert float(slope[i]) == pytest.approx(exact, rel=1e-9, abs=1e-11)


def test_middle_range_is_yang_and_perssons_mean_separation():
    """u(p) as they print it, with C(q) and w(q), differentiated in p by differences."""
    D, G, p, gamma_P = 2.4, 1e-10, 4e8, 0.45
    step, H = math.log(1.5), 3 - D
    count = 1 + math.floor(math.log(L / L_S) / step)
    low, high = (2 * math.pi / L * math.exp(x * step) for x in (-0.5, count - 0.5))

    def C(q):  # the mean square height is the integral of 2 pi C q dq, half a square per ln q
        half = (L * (G / L) ** (D - 2)) ** 2 / 2
        return half * (q * L / 2 / math.pi) ** (-2 * H) / (2 * math.pi * q**2)

    moment = C(low) * low ** (2 * H + 2) / (2 - 2 * H)

    def w(q):
        return (math.pi * moment * (q ** (2 - 2 * H) - low ** (2 - 2 * H))) ** -0.5

    def energy(s):
        return (gamma_P + 3 * (1 - gamma_P) * erf(s) ** 2) * math.exp(-(s**2))

    def over_p(q, p, h):
        """The inner integral of dp'/p' between p (1 - h) and p (1 + h)."""
        points = np.polynomial.legendre.leggauss(8)
        x = p * (1 + h * points[0])
        return h * p * sum(b * energy(w(q) * a / E) / a for a, b in zip(x, points[1], strict=True))

    h = 1e-3

    def of_wave(y):  # g is 0 at the longest wave: a square takes the root away
        q = low * math.exp(y**2)
        return 2 * y * q * q**2 * C(q) * w(q) * over_p(q, p, h)

    fall, _ = quad(of_wave, 0, math.sqrt(math.log(high / low)), epsabs=0, epsrel=1e-10, limit=200)
    middle = math.sqrt(math.pi) * fall / (2 * h * p * 1e-4)  # -du/dP
    middle *= 1 + erf(w(high) * p / E) ** 4 / 2  # ours, fitted: towards full contact
    Sq = float(fj.roughness(fj.Surface(D, G), L, L_S).Sq)
    finite = 1.05 * math.exp(1.24 * (D - 2.5)) * E * L * (p * L / (E * Sq)) ** (1 / (4 - D))
    expected = ((1 / middle) ** 2.4 + finite**2.4) ** (1 / 2.4)
    assert float(stiffness(D, G, p * 1e-4)[0]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow  # compiles third derivatives
def test_finite_and_positive_from_1_newton_to_1e6_with_gradients_of_three_orders():
    def log_K_n(D, log_G, log_P, area):
        return jnp.log(stiffness(D, jnp.exp(log_G), jnp.exp(log_P), area)[0])

    D, G, P, area = np.meshgrid(
        [2.01, 2.3, 2.5, 2.7, 2.99], [1e-14, 1e-10, 1e-6], [1.0, 1e3, 1e6], [1e-7, 1e-4, 1e-2]
    )
    given = [x.ravel() for x in (D, np.log(G), np.log(P), area)]
    names = (0, 1, 2, 3)
    value, slopes = jax.jit(jax.vmap(jax.value_and_grad(log_K_n, names)))(*given)
    bend = jax.jit(jax.vmap(jax.grad(jax.grad(jax.grad(log_K_n, 2), 2), 2)))(*given)
    for found in (value, *slopes, bend):
        assert np.isfinite(found).all()
    assert (np.asarray(slopes[2]) > -1e-12).all()  # stiffer under more load
    assert (np.asarray(slopes[1]) < 1e-12).all()  # and where it is smoother


@pytest.mark.parametrize("D", [2.1, 2.4, 2.8])
def test_small_loads_follow_the_finite_size_law(D):
    row = [D, *map(math.log, (1e-10, 1e-6, 1e-4, L, E))]
    alpha = log_stiffness(jnp.asarray(row))[1][NAMES.index("ln P")]
    assert float(alpha) == pytest.approx(1 / (4 - D), abs=1e-3)


def test_many_areas_side_by_side():
    """Four times the area under four times the load is four joints, but for their highest hills.

    At small loads, where these carry all, it is as stiff as two. No wave is longer than the side of
    the area; full contact is as stiff as a layer of atoms, and its gap is closed.
    """
    one, four = stiffness(2.4, 1e-10, 2e5), stiffness(2.4, 1e-10, 8e5, 4e-4)
    np.testing.assert_allclose(four, 4 * np.asarray(one), rtol=0.01)
    one, four = stiffness(2.4, 1e-10, 1e-6), stiffness(2.4, 1e-10, 4e-6, 4e-4)
    np.testing.assert_allclose(four, 2 * 2 ** (1 / 1.6) * np.asarray(one), rtol=1e-3)
    small = stiffness(2.4, 1e-10, 500.0, 1e-6, L)
    np.testing.assert_allclose(small, stiffness(2.4, 1e-10, 500.0, 1e-6, 1e-3), rtol=1e-14)
    assert float(stiffness(2.7, 1e-12, 1e6)[0]) == pytest.approx(E * 1e-4 / 3e-10, rel=1e-12)
    assert 0 <= float(mean_gap(contact(2.7, 1e-12, 1e6))) < 1e-20


def test_real_area_is_persson_s():
    Sdq = float(fj.roughness(fj.Surface(2.4, 1e-10), L, L_S).Sdq)
    for P in (1.0, 1e4):
        area = float(contact(2.4, 1e-10, P).real_area(0.25))
        # Half a step of the spectrum at its ends is what Eq. 13's sum and the band differ by.
        assert area / 1e-4 == pytest.approx(erf(math.sqrt(2) * P / (1e-4 * E * Sdq)), rel=0.02)
    assert float(contact(2.4, 1e-10, 1e6).real_area(0.25)) == 1e-4


@jax.jit
def mean_gap(law):
    return law.mean_gap()


@jax.jit
def gap_and_stiffness(P):
    return jax.grad(lambda P: contact(2.4, 1e-10, P).mean_gap())(P), stiffness(2.4, 1e-10, P)[0]


@pytest.mark.parametrize("P", [1.0, 300.0, 2e4])
def test_mean_gap_falls_with_the_load_by_the_compliance(P):
    fall, K_n = gap_and_stiffness(P)
    layer = 3e-10 / (E * 1e-4)
    assert float(fall) == pytest.approx(layer - 1 / float(K_n), rel=1e-9)


def test_tangential_stiffness_has_mindlin_s_ratio_or_is_0_in_gross_slip():
    for nu, ratio in ((0.3, 0.8235294117647058), (0.0, 1.0), (0.5, 2 / 3)):
        material = fj.Material(E=E, nu=nu, sigma_y=3.55e8, H=9.94e8)
        law = fj.PerssonContact(fj.Surface(2.4, 1e-10), material, 500.0, 1e-4, L, L_S)
        K_n, K_t = law.stiffness(0.4, 0.25)
        assert float(K_t / K_n) == pytest.approx(ratio, rel=1e-14)
    given = contact(2.4, 1e-10, 500.0, stiffness_ratio=0.3).stiffness(0.4, 0.25)
    assert float(given[1] / given[0]) == pytest.approx(0.3, rel=1e-14)
    for Q in (200.0, 200.1, 1e6):  # mu_s P = 200 N
        assert float(slipping(Q)) == 0 == float(jax.grad(slipping)(Q))
    assert float(slipping(0.0)) == pytest.approx(float(stiffness(2.4, 1e-10, 500.0)[1]), rel=1e-14)
    assert 0 < float(slipping(199.999)) < 0.01 * float(slipping(0.0))
    assert float(jax.grad(slipping)(100.0)) < 0


def test_partial_slip_gives_back_the_tangential_displacement():
    """The integral of dQ/K_t is mu (2 - nu)/(2 - 2 nu) of the approach from P - Q/mu to P."""
    P, mu, most = 500.0, 0.4, 150.0
    displacement, _ = quad(
        lambda Q: 1 / float(slipping(Q)), 0, most, epsrel=1e-10, epsabs=0, limit=100
    )
    gaps = [float(mean_gap(contact(2.4, 1e-10, load))) for load in (P - most / mu, P)]
    approach = gaps[0] - gaps[1]  # without the layer of atoms, 1e-5 of it here
    assert displacement == pytest.approx(mu * 1.7 / 1.4 * approach, rel=1e-4)


@jax.jit
def slipping(Q):
    return stiffness(2.4, 1e-10, 500.0, Q=Q)[1]


def test_a_scene_without_tangential_load_evaluates_the_law_once():
    counts = [
        primitives(jax.make_jaxpr(lambda P, given=given: stiffness(2.4, 1e-10, P, **given))(500.0))
        for given in ({}, {"Q": 100.0})
    ]
    assert counts[0]["erf"] == 2  # of the kernel, of the real area
    assert counts[1]["erf"] == 4


def brake() -> fj.Scene:
    return fj.brake_scene().replace(contact=contact(2.4, 1.342e-10, 1907.3))


@pytest.mark.slow
def test_scene_takes_the_law():
    scene = brake()
    fixed = scene.replace(contact=fj.FixedContact(*map(float, fj.stiffness(scene))))
    assert float(fj.growth_rate(scene)) == pytest.approx(float(fj.growth_rate(fixed)), rel=1e-9)
    for measure in (fj.critical_friction, fj.growth_rate):
        assert float(measure(scene)) == pytest.approx(float(measure(fixed)), rel=1e-6)
    assert fj.Scene.from_toml(scene.to_toml()).to_toml() == scene.to_toml()
    assert "PerssonContact" in repr(scene)
    # The friction bounds the tangential load, so the stiffness moves with it.
    loaded = scene.replace(Q=150.0, friction=fj.Coulomb(0.4))
    mu = float(fj.critical_friction(loaded))
    below, above = (
        float(fj.growth_rate(loaded.replace(friction=fj.Coulomb(x))))
        for x in (0.99 * mu, 1.01 * mu)
    )
    assert below < 0 < above


@pytest.mark.slow
def test_design_moves_the_surface_of_the_law():
    scene = brake()
    best = fj.design(scene, {"K_t/K_n": (0.2, 1), "G": (1e-12, 1e-8)}, K_n_min=1e8, progress=False)
    assert best.outcome.startswith("found")
    assert float(fj.growth_rate(best.scene)) < 0
    assert best.wavelengths == (L, L_S)
    assert "K_n >= K_n_min" not in best.violated
    # Mindlin's ratio couples the modes whatever the surface.
    lost = fj.design(scene, {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}, progress=False)
    assert lost.outcome.startswith("infeasible")
    assert {"growth_rate <= target", "K_n >= K_n_min"} >= set(lost.violated) != set()


def test_float32_and_vmap():
    with jax.enable_x64(False):
        single = [float(jax.jit(stiffness)(*point)[0]) for point in POINTS]
    exact = [math.exp(found(point)[0]) for point in POINTS]
    np.testing.assert_allclose(single, exact, rtol=2e-5)
    columns = [np.asarray(x) for x in zip(*POINTS, strict=True)]
    batch = jax.jit(jax.vmap(lambda *x: stiffness(*x)[0]))(*columns)
    np.testing.assert_allclose(batch, exact, rtol=1e-13)


test_refuses_what_is_outside = refusals(
    [
        ({"P": 0.0}, "P must be above 0, got 0.0"),
        ({"area": -1.0}, "area must be above 0, got -1.0"),
        ({"L_s": 0.0}, "L_s must be above 0, got 0.0"),
        ({"L_s": 1.0}, "L must be at least L_s = 1.0, got 0.01"),
        ({"Q": -1.0}, "Q must be at least 0, got -1.0"),
        ({"stiffness_ratio": -1.0}, "stiffness_ratio must be at least 0, got -1.0"),
    ],
    lambda wrong: fj.PerssonContact(
        fj.Surface(2.4, 1e-10), MATERIAL, **dict(P=1.0, area=1e-4, L=L, L_s=L_S) | wrong
    ),
    pattern="^{}$",
    plain=True,
)
