"""The friction at which squeal starts: closed form, first root, derivatives, corner cases."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.optimize

import fractaljax as fj
from fractaljax.mechanism.oscillator import Linearised
from fractaljax.mechanism.quantities import sliding_friction, with_friction_times
from fractaljax.modes.critical_friction import (
    coupling_reserve,
    critical_frequency,
    linearised,
)
from fractaljax.modes.stability import _critical_eigenvalue
from tools import reference_scene

_gradient = jax.jit(jax.grad(fj.critical_friction))
_constant = jax.jit(functools.partial(fj.critical_friction, friction_slope=False))


@jax.jit
def growth_at(scene, factor):
    return fj.growth_rate(with_friction_times(scene, factor))


growths_at = jax.jit(jax.vmap(growth_at, (None, 0)))


def fixed(K_n, K_t, **changes):
    """The reference oscillator on a joint of known stiffness, with constant friction."""
    scene = fj.Scene(fj.FixedContact(K_n, K_t), fj.Coulomb(0.4), fj.brake_scene().oscillator)
    return scene.replace(**changes)


def exact_critical_friction(K_n, K_t, m, omega_1, omega_2, xi_1, xi_2):
    """Root in mu of the third Hurwitz determinant of the quartic's coefficients."""
    K_n, K_t, m, omega_1, omega_2, xi_1, xi_2 = (
        mp.mpf(x) for x in (K_n, K_t, m, omega_1, omega_2, xi_1, xi_2)
    )
    a, b = omega_1**2 + K_t / m, omega_2**2 + K_n / m
    c_1, c_2 = 2 * xi_1 * omega_1, 2 * xi_2 * omega_2
    a_3, a_2, a_1 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a
    return mp.sqrt(((a_3 * a_2 * a_1 - a_1**2) / a_3**2 - a * b) / (K_n * K_t)) * m


NAMES = ("K_n", "K_t", "m", "omega_1", "omega_2", "xi_1", "xi_2")


def of_numbers(numbers):
    return _constant(fixed(4e8, 6e7).replace(**dict(zip(NAMES, numbers, strict=True))))


@pytest.fixture(autouse=True)
def _forty_digits():
    with mp.workdps(40):
        yield


# --- the closed form ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("K_n", "ratio", "tabled"),
    [(4e8, 0.15, 0.7540173), (3.2e9, 0.15, 0.7827956), (4e8, 0.5, 0.2355233)],
)
def test_reference_values(K_n, ratio, tabled):
    scene = fixed(K_n, ratio * K_n)
    assert float(fj.critical_friction(scene)) == pytest.approx(tabled, abs=5e-8)
    # A law without slope and one whose slope is left out are the same.
    stribeck = scene.replace(friction=fj.Stribeck(0.4, 0.25, 0.5))
    assert float(_constant(stribeck)) == pytest.approx(tabled, abs=5e-8)


def test_unequal_damping_destabilises():
    """Light damping: 2 sqrt(c_1 c_2)/(c_1 + c_2) = 0.7171 times the friction without damping."""
    scene = fixed(4e8, 6e7, xi_1=1e-6, xi_2=7e-6)
    ratio = _constant(scene) / _constant(scene.replace(xi_1=0.0, xi_2=0.0))
    assert float(ratio) == pytest.approx(0.7171, abs=5e-5)


def random_numbers(n, seed=0):
    rng = np.random.default_rng(seed)
    K_n, m = 10 ** rng.uniform(5, 11, n), 10 ** rng.uniform(-1, 1, n)
    omega = 10 ** rng.uniform(2, 5, (2, n))
    return K_n, K_n * rng.uniform(0.01, 1, n), m, *omega, *10 ** rng.uniform(-5, 0, (2, n))


def test_closed_form_is_the_root_of_the_hurwitz_determinant():
    columns = random_numbers(200)
    found = jax.vmap(of_numbers)([jnp.asarray(x) for x in columns])
    for value, *x in zip(found, *columns, strict=True):
        wanted = exact_critical_friction(*x)
        # a - b may have lost digits to rounding.
        a, b = x[3] ** 2 + x[1] / x[2], x[4] ** 2 + x[0] / x[2]
        assert abs(float(value) - wanted) <= 1e-14 * wanted * (1 + (a + b) / abs(a - b))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradients_of_the_closed_form(mode):
    at = (4e8, 6e7, 1.0, 6283.0, 5026.0, 0.001, 0.007)
    found = mode(of_numbers)([jnp.asarray(x) for x in at])
    for i, slope in enumerate(found):
        x = list(map(mp.mpf, at))

        def along(value, i=i, x=x):
            numbers = dict(zip(NAMES, x, strict=True)) | {NAMES[i]: value}
            return exact_critical_friction(**numbers)

        h = x[i] * mp.mpf(10) ** -15
        wanted = (along(x[i] + h) - along(x[i] - h)) / (2 * h)
        assert float(slope) == pytest.approx(float(wanted), rel=1e-11)


def test_scenes_own_friction_does_not_matter_to_the_closed_form():
    gradient = _gradient(fixed(4e8, 6e7))
    assert float(gradient.friction.mu) == 0


# --- the first root -----------------------------------------------------------------------

SCENES = {
    "slope": reference_scene(),
    "fractal": fj.brake_scene(),
    "fractal, constant friction": fj.brake_scene().replace(friction=fj.Coulomb(0.4)),
    "fractal, ratio given": fj.brake_scene().replace(stiffness_ratio=0.3),
    "driven": reference_scene().replace(F=5e3, V=0.02, v_m=0.1, K_t=1e8),
    "undamped, fractal": fj.brake_scene().replace(
        friction=fj.Coulomb(0.4), xi_1=0.0, xi_2=0.0, D=2.41
    ),
}


QUICK = ("slope", "fractal", "undamped, fractal")
slow = pytest.mark.slow


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=slow) for name in SCENES]
)
def test_first_root_is_where_squeal_starts(name):
    """No growth below, growth 0 at it and squeal above; the same as Brent's method finds."""
    scene = SCENES[name]
    critical = float(fj.critical_friction(scene))
    factor = critical / float(sliding_friction(scene))
    below = jnp.linspace(0.002, 1 - 1e-9, 400) * factor
    assert (growths_at(scene, below) <= 0).all()
    assert float(growth_at(scene, factor * (1 + 1e-6))) > 0
    if "undamped" not in name:  # there it is 0 below, not negative
        root = scipy.optimize.brentq(
            lambda f: float(growth_at(scene, f)), factor * 0.9, factor * 1.02, xtol=1e-14
        )
        assert factor == pytest.approx(root, rel=1e-12)
        assert abs(float(growth_at(scene, factor))) < 1e-8


def test_closed_form_and_first_root_agree():
    """A slope that hardly exists takes the other route to the same number."""
    scene = fixed(4e8, 6e7, friction=fj.Stribeck(0.4, 0.4, 0.5))
    assert float(fj.critical_friction(scene)) == pytest.approx(float(_constant(scene)), rel=1e-13)


def test_stiffness_can_be_held():
    scene = fj.brake_scene()
    held = scene.replace(contact=fj.FixedContact(*fj.stiffness(scene)))
    closed = float(_constant(held))
    assert closed != pytest.approx(float(_constant(scene)), rel=1e-3)
    lin = linearised(with_friction_times(held, closed / sliding_friction(held)), False)
    assert abs(float(coupling_reserve(lin))) < 1e-15


@pytest.mark.parametrize("name", ["slope", pytest.param("fractal", marks=slow), "driven"])
def test_gradients_of_the_first_root(name):
    """Both modes and the second derivative against differences of the root."""
    scene = SCENES[name]
    quantity = "D" if scene.contact.fractal else "V"
    at = {"slope": 0.15, "fractal": 2.4, "driven": 0.02}[name]

    def critical(x):
        return fj.critical_friction(scene.replace(**{quantity: x}))

    f = jax.jit(critical)
    h = (2e-4 if scene.contact.fractal else 2e-3) * at
    d = [float(f(at + k * h) - f(at - k * h)) / (2 * k * h) for k in (1, 2, 3)]
    slope = 1.5 * d[0] - 0.6 * d[1] + 0.1 * d[2]
    gradient = jax.jit(jax.grad(critical))
    assert float(gradient(at)) == pytest.approx(slope, rel=1e-5)
    assert float(jax.jit(jax.jacfwd(critical))(at)) == pytest.approx(float(gradient(at)), rel=1e-12)
    if name == "fractal":
        return  # its second derivative takes a minute to compile
    d = [float(gradient(at + k * h) - gradient(at - k * h)) / (2 * k * h) for k in (1, 2, 3)]
    bend = 1.5 * d[0] - 0.6 * d[1] + 0.1 * d[2]
    assert float(jax.jit(jax.jacfwd(gradient))(at)) == pytest.approx(bend, rel=1e-4)


# --- corner cases -------------------------------------------------------------------------


def finite(tree):
    return all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(tree))


def test_without_damping_it_is_the_friction_of_coalescence():
    scene = fixed(4e8, 6e7, xi_1=0.0, xi_2=0.0)
    a, b = 6283.185307179586**2 + 6e7, 5026.548245743669**2 + 4e8
    wanted = abs(a - b) / (2 * np.sqrt(4e8 * 6e7))
    assert float(fj.critical_friction(scene)) == pytest.approx(wanted, rel=1e-14)
    assert finite(_gradient(scene))


def test_one_undamped_direction_squeals_at_any_friction():
    assert float(fj.critical_friction(fixed(4e8, 6e7, xi_2=0.0))) == 0


@pytest.mark.parametrize(
    "scene",
    [
        fixed(4e8, 0.0),
        fixed(0.0, 6e7),
        fixed(0.0, 0.0),
        fixed(0.0, 0.0, friction=fj.Stribeck(0.4, 0.25, 0.5)),
        fj.brake_scene().replace(G=1.342e-8),  # fully plastic
    ],
)
def test_no_coupling_no_squeal(scene):
    """Infinite, with a derivative of 0."""
    assert float(fj.critical_friction(scene)) == np.inf
    gradient = _gradient(scene)
    assert finite(gradient)
    assert all(float(x) == 0 for x in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_searched_as_far_as_the_friction_correction_goes():
    """mu_m <= 0.9: a joint that squeals at no friction below has none."""
    scene = fj.brake_scene().replace(friction=fj.Coulomb(0.4), stiffness_ratio=0.02, D=2.6)
    assert float(fj.critical_friction(scene)) == np.inf
    held = scene.replace(contact=fj.FixedContact(*fj.stiffness(scene)))
    assert 0.9 < float(fj.critical_friction(held)) < np.inf


def test_a_mechanism_driven_by_any_friction_at_all():
    """Undamped and beyond v_m: friction that rises with speed, and F the other way."""
    scene = reference_scene().replace(xi_1=0.0, xi_2=0.0, F=-5.0)
    assert float(fj.critical_friction(scene)) == 0
    assert finite(_gradient(scene))


def test_reserve_is_negative_exactly_where_it_squeals():
    """100,000 systems of either sign of damping, against the growth rate."""
    rng, n = np.random.default_rng(4), 100_000
    a, b, g = 10 ** rng.uniform(-1, 1, n), 10 ** rng.uniform(-1, 1, n), 10 ** rng.uniform(-6, 2, n)
    c_1, c_2 = 10 ** rng.uniform(-5, 1, (2, n)) * rng.choice([-1, 1], (2, n))
    lin = Linearised(*map(jnp.asarray, (a, b, c_1, c_2, g)))
    growth = jax.jit(jax.vmap(lambda x: _critical_eigenvalue(x).real))(lin)
    reserve = jax.jit(jax.vmap(coupling_reserve))(lin)
    sure = np.abs(growth) > 1e-11 * (np.abs(c_1) + np.abs(c_2) + np.sqrt(a + b))
    assert sure.mean() > 0.99
    assert ((np.asarray(growth) < 0) & sure).sum() > 5000
    np.testing.assert_array_equal(np.asarray(reserve < 0)[sure], np.asarray(growth > 0)[sure])


def test_frequency_at_the_boundary():
    """omega^2 = a_1/a_3 is the imaginary eigenvalue there."""
    scene = fixed(4e8, 6e7)
    scene = scene.replace(mu=fj.critical_friction(scene))
    found = critical_frequency(linearised(scene, True))
    assert float(found) == pytest.approx(float(fj.stability(scene).frequency), rel=1e-12)


# --- structure ----------------------------------------------------------------------------


def test_closed_form_traces_no_search():
    text = str(jax.make_jaxpr(fj.critical_friction)(fixed(4e8, 6e7)))
    assert "while" not in text
    assert "scan" not in text


def test_vmapped_is_looped():
    scene, Vs = reference_scene(), jnp.array([0.05, 0.15, 0.6])
    many = jax.vmap(lambda V: fj.critical_friction(scene.replace(V=V)))(Vs)
    one = [fj.critical_friction(scene.replace(V=V)) for V in Vs]
    np.testing.assert_allclose(many, one, rtol=1e-12)


def test_a_scene_of_arrays_is_refused_with_a_hint():
    with pytest.raises(ValueError, match=r"D must be a scalar, got shape \(2,\); use jax.vmap"):
        fj.critical_friction(fj.brake_scene().replace(D=np.array([2.4, 2.5])))


def test_single_precision():
    for scene in (fixed(4e8, 6e7), fj.brake_scene()):
        small = fj.critical_friction(jax.tree.map(lambda x: x.astype(jnp.float32), scene))
        assert small.dtype == jnp.float32
        assert float(small) == pytest.approx(float(fj.critical_friction(scene)), rel=1e-4)
