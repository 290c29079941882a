"""Growth rate and modes of scenes: a 40-digit chain, exact facts, derivatives, what is traced."""

import dataclasses
import functools
from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from quartics import coefficients, in_units, quartic_roots
from structures import two_joints
from tools import both_gradients, primitives, reference_scene

BRAKE = fj.brake_scene()
OSCILLATOR = BRAKE.oscillator


def fixed(K_n=4e8, kappa=0.5, mu=0.4):
    return fj.Scene(fj.FixedContact(K_n, kappa * K_n), fj.Coulomb(mu), OSCILLATOR)


NAMES = ("K_n", "K_t", "mu_s", "mu_m", "v_m", "m", "omega_1", "omega_2", "xi_1", "xi_2", "V", "F")


def numbers_of(scene):
    """The quantities `chain` needs; K_n and K_t of whatever contact the scene has."""
    parts = dict(zip(("K_n", "K_t"), fj.stiffness(scene), strict=True))
    for part in (scene.friction, scene.oscillator):
        parts |= {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    return {name: mp.mpf(float(parts[name])) for name in NAMES}


def chain(x, slope=True):
    """Critical eigenvalue of a fixed contact with Stribeck friction; all numbers mpmath."""
    u, drop = x["V"] / x["v_m"], x["mu_s"] - x["mu_m"]
    mu = x["mu_s"] - 3 * drop / 2 * u + drop / 2 * u**3
    falling = (-3 * drop / 2 + 3 * drop / 2 * u**2) / x["v_m"]
    m, K_n, K_t = x["m"], x["K_n"], x["K_t"]
    k_1, k_2 = m * x["omega_1"] ** 2 + K_t, m * x["omega_2"] ** 2 + K_n
    f = x["F"] / mp.sqrt(2)
    static = mp.lu_solve(mp.matrix([[k_1, -mu * K_n], [mu * K_t, k_2]]), mp.matrix([f, -f]))
    c_1, c_2 = 2 * x["xi_1"] * x["omega_1"], 2 * x["xi_2"] * x["omega_2"]
    if slope:
        c_1, c_2 = c_1 + falling * K_n * static[1] / m, c_2 - falling * K_t * static[0] / m
    unit, scaled = in_units(k_1 / m, k_2 / m, c_1, c_2, mu**2 * K_n * K_t / m**2)
    upper = (s for s in quartic_roots(coefficients(*scaled)) if s.imag > -(mp.mpf(10) ** -30))
    return unit * max(upper, key=lambda s: s.real)


@functools.cache
def _exact_slopes(items):
    x, h = dict(items), mp.mpf(10) ** -12

    def moved(name, factor):
        return chain(x | {name: x[name] * factor})

    return {name: (moved(name, 1 + h) - moved(name, 1 - h)) / (2 * h * x[name]) for name in NAMES}


def exact_slopes(x):
    """d lambda/d(name) of `chain` by central differences, complex, to 20 digits."""
    return _exact_slopes(tuple(x.items()))


@pytest.mark.parametrize(("slope", "tabled"), [(True, 22.080110302126), (False, 23.3109730404)])
def test_reference_brake(slope, tabled):
    exact, found = chain(numbers_of(BRAKE), slope), fj.stability(BRAKE, slope)
    for growth in (fj.growth_rate(BRAKE, slope), found.growth_rate):
        assert float(growth) == pytest.approx(tabled, rel=1e-11)
        assert float(growth) == pytest.approx(float(exact.real), rel=1e-12)
    assert float(found.frequency) == pytest.approx(float(exact.imag / (2 * mp.pi)), rel=1e-14)
    assert float(found.damping_ratio) == pytest.approx(float(-exact.real / abs(exact)), rel=1e-12)


def fixed_like(scene):
    return scene.replace(contact=fj.FixedContact(*fj.stiffness(scene)))


SCENES = {
    "reference": {},
    "stable": {"mu_s": 0.26},
    "overdamped": {"xi_1": 30.0, "xi_2": 50.0},
    "driven by the slope": {"F": 5e3, "V": 0.02, "v_m": 0.1},
}


def of_numbers(scene, changes):
    return fj.growth_rate(scene.replace(**changes))


@jax.jit
def gradients(scene, changes):
    return both_gradients(lambda changes: of_numbers(scene, changes), changes)


@pytest.mark.parametrize("name", SCENES)
def test_growth_rate_and_its_gradients(name):
    """By every quantity of the oscillator and the friction law, in both modes.

    The scale of an error is |d lambda/dx|: the growth rate is the real part of an eigenvalue that
    is known to so many digits as a complex number, and its own derivative may be far smaller.
    """
    scene = fixed_like(BRAKE.replace(**SCENES[name]))
    x = numbers_of(scene)
    exact = chain(x)
    growth = float(fj.growth_rate(scene))
    assert abs(growth - exact.real) <= 1e-12 * abs(exact)
    for found in gradients(scene, {key: float(value) for key, value in x.items()}):
        for key, slope in exact_slopes(x).items():
            assert abs(float(found[key]) - slope.real) <= 1e-9 * abs(slope), key


KNOWN = {"D": 2.4, "log G": float(np.log(1.342e-10)), "P": 1907.3, "E": 1.154e11}
KNOWN |= {"mu_s": 0.4, "mu_m": 0.25}


def changed(x):
    others = {name: value for name, value in x.items() if name != "log G"}
    return BRAKE.replace(G=jnp.exp(x["log G"]), **others)


@jax.jit
def through_contact(x):
    return both_gradients(lambda x: fj.growth_rate(changed(x)), x)


@pytest.mark.slow
def test_gradients_through_the_contact_law():
    """d lambda = lambda_K dK + lambda_x dx, with lambda_K exact and dK by differences."""
    stiffness = jax.jit(lambda x: jnp.stack(fj.stiffness(changed(x))))
    slopes = exact_slopes(numbers_of(BRAKE))
    found = through_contact(KNOWN)
    for name, x in KNOWN.items():
        h, d = 1e-3 if name == "D" else 6e-4 * abs(x), []
        for k in (1, 2, 3):  # sixth order
            up, down = (stiffness(KNOWN | {name: x + sign * k * h}) for sign in (1, -1))
            d.append((up - down) / (2 * k * h))
        dK_n, dK_t = map(float, 1.5 * d[0] - 0.6 * d[1] + 0.1 * d[2])
        wanted = slopes["K_n"] * dK_n + slopes["K_t"] * dK_t + slopes.get(name, 0)
        for gradient in found:
            assert abs(float(gradient[name]) - wanted.real) <= 1e-9 * abs(wanted), name


def test_fully_plastic_joint_has_no_gradient():
    """No elastic contact, no stiffness: D and G change nothing, exactly."""
    for found in through_contact(KNOWN | {"log G": float(np.log(1.342e-8))}):
        assert float(found["D"]) == float(found["log G"]) == 0


@pytest.mark.slow
def test_second_derivatives():
    """The Hessian against differences of the exact gradient, on the scale of |d2 lambda|."""
    scene = fixed_like(BRAKE)
    x, names = numbers_of(scene), ["K_n", "K_t", "mu_s", "V", "xi_2"]
    hessian = jax.jit(
        jax.hessian(lambda values: of_numbers(scene, dict(zip(names, values, strict=True))))
    )(jnp.array([float(x[name]) for name in names]))
    h = mp.mpf(10) ** -8
    for i, name in enumerate(names):
        up, down = (exact_slopes(x | {name: x[name] * (1 + k * h)}) for k in (1, -1))
        for j, other in enumerate(names):
            wanted = (up[other] - down[other]) / (2 * h * x[name])
            assert abs(float(hessian[i, j]) - wanted.real) <= 1e-8 * abs(wanted), (name, other)


def test_eigenvalues_rebuild_the_characteristic_polynomial():
    """s^4 + (c1+c2) s^3 + (a+b+c1 c2) s^2 + (c1 b+c2 a) s + (ab + mu^2 K_n K_t/m^2)."""
    scene = fixed().replace(m=2.5, xi_1=0.03, xi_2=0.08)
    w_1, w_2 = float(OSCILLATOR.omega_1), float(OSCILLATOR.omega_2)
    a, b, c_1, c_2 = w_1**2 + 2e8 / 2.5, w_2**2 + 4e8 / 2.5, 0.06 * w_1, 0.16 * w_2
    wanted = np.array(coefficients(a, b, c_1, c_2, 0.16 * 8e16 / 6.25))
    built = np.poly(np.asarray(fj.stability(scene).eigenvalues))
    scale = np.sqrt(a + b) ** np.arange(5)
    np.testing.assert_allclose(built / scale, wanted / scale, rtol=0, atol=1e-14)


@pytest.mark.parametrize("kappa", [0.3, 0.8])
def test_undamped_flutter_boundary(kappa):
    """Undamped flutter iff |a - b| < 2 mu sqrt(K_n K_t)/m, told apart at 1e-9 of mu."""
    scene = fixed(kappa=kappa).replace(xi_1=0.0, xi_2=0.0)
    o = scene.oscillator
    apart = float(o.omega_1) ** 2 + kappa * 4e8 - float(o.omega_2) ** 2 - 4e8
    mu_c = abs(apart) / (2 * 4e8 * np.sqrt(kappa))
    assert float(fj.growth_rate(scene.replace(mu=mu_c * (1 + 1e-9)))) > 0
    assert float(fj.growth_rate(scene.replace(mu=mu_c * (1 - 1e-9)))) == 0


@pytest.mark.parametrize(("K_n", "growth"), [(3e8, 624), (4e8, 477), (5e8, 257)])
def test_growth_of_the_limit_cycle_cases(K_n, growth):
    """Section 3.3 of the source: mu_s 0.4, mu_m 0.25, v_m 0.5, V 0.15, F 5, kappa 0.5."""
    scene = reference_scene().replace(K_n=K_n, K_t=K_n / 2)
    assert float(fj.growth_rate(scene)) == pytest.approx(growth, abs=0.5)


def test_bare_oscillator_and_its_list_of_modes():
    """Without contact the two directions decay by themselves: -xi_i omega_i, at omega_i."""
    found = fj.stability(fixed(K_n=0.0))
    decay = [float(OSCILLATOR.xi_1 * OSCILLATOR.omega_1)]
    decay += [float(OSCILLATOR.xi_2 * OSCILLATOR.omega_2)]
    np.testing.assert_allclose(found.growth_rate, -min(decay), rtol=1e-14)
    np.testing.assert_allclose(sorted(found.eigenvalues.real), -np.repeat(decay[::-1], 2), 1e-14)
    frequency = float(OSCILLATOR.omega_1) * np.sqrt(1 - 1e-6) / (2 * np.pi)
    np.testing.assert_allclose(found.frequency, frequency, 1e-14)
    np.testing.assert_allclose(found.damping_ratio, 0.001, rtol=1e-13)
    np.testing.assert_allclose(np.abs(found.shapes), np.eye(2)[[0, 0, 1, 1]], atol=1e-15)
    squeals, undamped = (
        fj.stability(fixed().replace(**x)) for x in ({}, {"xi_1": 0.0, "xi_2": 0.0, "mu": 0.01})
    )
    (mode,) = squeals.unstable()
    assert (mode.growth_rate, mode.frequency) == (squeals.growth_rate, squeals.frequency)
    assert mode.resolution == squeals.resolution < 1e-9 and mode.largest == "x1"
    assert len(undamped.unresolved()) == 2 and not undamped.unstable()
    assert len(squeals.least_damped(1)) == 1
    assert "growth_rate=" in repr(squeals) and "\n" not in repr(squeals)


@pytest.mark.parametrize("slope", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SCENES)
def test_modes_are_those_of_the_structure_of_two_degrees_of_freedom(name, slope):
    """The closed form and LAPACK's route: each within the other's resolution, and its shapes."""
    scene = fixed_like(BRAKE.replace(**SCENES[name]))
    own, other = (fj.stability(x, slope) for x in (scene, fj.Structure.from_scene(scene)))
    assert own.names == other.names == ("x1", "x2")
    apart = np.abs(own.eigenvalues - other.eigenvalues)
    assert (apart <= own.resolutions + other.resolutions).all()
    np.testing.assert_allclose(own.shapes, other.shapes, rtol=0, atol=1e-11)
    np.testing.assert_allclose(own.frequencies, other.frequencies, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(own.damping_ratios, other.damping_ratios, atol=1e-12)
    for mine, theirs in zip(own.least_damped(), other.least_damped(), strict=True):
        assert mine.largest == theirs.largest
        assert mine.frequency == pytest.approx(theirs.frequency, rel=1e-12)
    assert len(own.unstable()) == len(other.unstable())


@pytest.mark.slow
def test_vmapped_is_looped():
    """One program over D and G, against one scene at a time."""
    D, G = jnp.array([[2.3, 2.6]]), jnp.array([[1e-11], [1e-9]])
    one = jax.jit(lambda D, G: fj.stability(BRAKE.replace(D=D, G=G)))
    many = jax.jit(jax.vmap(jax.vmap(one, (0, None)), (None, 0)))(D[0], G[:, 0])
    assert many.eigenvalues.shape == many.damping_ratios.shape == (2, 2, 4)
    assert many.resolution.shape == (2, 2)
    looped = [float(one(x, y).growth_rate) for y in G[:, 0] for x in D[0]]
    np.testing.assert_allclose(many.growth_rate.ravel(), looped, rtol=0, atol=1e-14 * 6e3)
    with pytest.raises(ValueError, match="modes are listed of one result"):
        many.unstable()


def traced(scene, slope=True, function=fj.growth_rate) -> Counter:
    question = functools.partial(function, friction_slope=slope)
    return primitives(jax.make_jaxpr(question)(scene).jaxpr)


RATIO = BRAKE.replace(stiffness_ratio=0.5)


def test_a_scene_traces_what_it_needs_and_nothing_else():
    """Strictly less work the less a scene holds."""
    slope = fixed_like(BRAKE)
    sizes = [traced(scene).total() for scene in (fixed(), slope, RATIO, BRAKE)]
    assert sizes == sorted(set(sizes)), sizes
    assert traced(slope, False).total() < traced(slope).total()
    assert traced(fixed(), False) == traced(fixed())
    # The one exp and log are those of the closed form, in single precision; no cbrt, no pow.
    plain, fractal = traced(fixed()), traced(BRAKE)
    assert not {"log1p", "expm1", "cbrt", "pow", "cos", "acos"} & set(plain)
    assert (plain["exp"], plain["log"]) == (1, 1)
    assert fractal["exp"] > 1 and fractal["log"] > 1
    assert fractal["cbrt"] == 1  # Eq. 36
    assert traced(RATIO)["cbrt"] == 0


@pytest.mark.parametrize("function", [fj.growth_rate, fj.stability, fj.margin])
def test_no_loop_no_lapack_no_callback(function):
    """Concrete numbers trace plain arithmetic only, and no check that calls back."""
    for scene in (BRAKE, fixed(), RATIO):
        names = set(traced(scene, function=function))
        words = ("while", "scan", "eig", "sort", "callback", "custom_call")
        assert not {name for name in names if any(word in name for word in words)}
        assert "custom_call" not in jax.jit(function).lower(scene).as_text()


ARRAYS = BRAKE.replace(D=np.array([2.4, 2.5]))
QUESTIONS: list[Any] = [fj.growth_rate, fj.stability, fj.critical_friction, fj.margin]
WINDOWS = {"x": ("K_t/K_n", 0, 1), "y": ("mu", 0.1, 0.2)}
FLAGGED = [
    *((question, BRAKE) for question in QUESTIONS),
    *((question, fixed()) for question in QUESTIONS),
    *((question, two_joints(4)) for question in (*QUESTIONS[:2], fj.margin, fj.assemble)),
    (functools.partial(fj.hopf_boundary, **WINDOWS), BRAKE),
    (functools.partial(fj.design, progress=False), BRAKE),
    (lambda _, friction_slope: fj.constraints.DampingRatio(0.01, friction_slope=friction_slope), 0),
    (lambda _, friction_slope: fj.constraints.Frequency(1.0, friction_slope=friction_slope), 0),
]


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_scene_of_arrays_is_refused_with_a_hint(question):
    with pytest.raises(ValueError, match=r"D must be a scalar, got shape \(2,\); use jax.vmap"):
        question(ARRAYS)


def test_friction_slope_is_true_or_false():
    for question, x in FLAGGED:
        for wrong in ("no", 0, None):
            with pytest.raises(TypeError, match="friction_slope must be True or False, got"):
                question(x, friction_slope=wrong)
