"""The friction at which squeal starts: closed form, first root, derivatives, corner cases."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.optimize

import fractaljax as fj
from fractaljax._mechanism.quantities import with_friction_times
from fractaljax._stability.critical_friction import _lattice
from fractaljax._stability.two_directions import (
    critical_frequency,
    hopf_test_function,
    two_directions,
)
from quartics import log_uniform, many_rightmost, stacked
from tools import both_gradients, both_modes, mostly_slow, reference_scene

BRAKE = fj.brake_scene()
slow = pytest.mark.slow

gradient = jax.jit(jax.grad(fj.critical_friction))
constant = jax.jit(functools.partial(fj.critical_friction, friction_slope=False))


@jax.jit
def growth_at(scene, factor):
    return fj.growth_rate(with_friction_times(scene, factor))


growths_at = jax.jit(jax.vmap(growth_at, (None, 0)))


def fixed(K_n=4e8, K_t=6e7, friction=None, **changes):
    """The reference oscillator on a joint of known stiffness, with constant friction."""
    friction = fj.Coulomb(0.4) if friction is None else friction
    return fj.Scene(fj.FixedContact(K_n, K_t), friction, BRAKE.oscillator).replace(**changes)


NAMES = ("K_n", "K_t", "m", "omega_1", "omega_2", "xi_1", "xi_2")


def exact(*numbers):
    """Root in mu of the third Hurwitz determinant of the quartic's coefficients."""
    K_n, K_t, m, omega_1, omega_2, xi_1, xi_2 = (mp.mpf(x) for x in numbers)
    a, b = omega_1**2 + K_t / m, omega_2**2 + K_n / m
    c_1, c_2 = 2 * xi_1 * omega_1, 2 * xi_2 * omega_2
    a_3, a_2, a_1 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a
    return mp.sqrt(((a_3 * a_2 * a_1 - a_1**2) / a_3**2 - a * b) / (K_n * K_t)) * m


def of_numbers(numbers):
    return constant(fixed().replace(**dict(zip(NAMES, numbers, strict=True))))


@pytest.mark.parametrize(
    ("K_n", "ratio", "tabled"),
    [(4e8, 0.15, 0.7540173), (3.2e9, 0.15, 0.7827956), (4e8, 0.5, 0.2355233)],
)
def test_tabled_values(K_n, ratio, tabled):
    """And by the growth rate, which does not know of the closed form."""
    scene = fixed(K_n, ratio * K_n)
    found = float(fj.critical_friction(scene))
    assert found == pytest.approx(tabled, abs=5e-8)
    assert float(growth_at(scene, found / 0.4 * (1 - 1e-10))) < 0
    assert float(growth_at(scene, found / 0.4 * (1 + 1e-10))) > 0
    # A law without slope and one whose slope is left out are the same.
    stribeck = scene.replace(friction=fj.Stribeck(0.4, 0.25, 0.5))
    assert float(constant(stribeck)) == pytest.approx(tabled, abs=5e-8)


def test_closed_form_is_the_root_of_the_hurwitz_determinant():
    rng, n = np.random.default_rng(0), 200
    K_n, m, omega = log_uniform(rng, 5, 11, n), log_uniform(rng, -1, 1, n), (2, 5, (2, n))
    omega = log_uniform(rng, *omega)
    columns = K_n, K_n * rng.uniform(0.01, 1, n), m, *omega, *log_uniform(rng, -5, 0, (2, n))
    found = jax.jit(jax.vmap(of_numbers))([jnp.asarray(x) for x in columns])
    for value, *x in zip(found, *columns, strict=True):
        wanted = exact(*x)
        # a - b may have lost digits to rounding.
        a, b = x[3] ** 2 + x[1] / x[2], x[4] ** 2 + x[0] / x[2]
        assert abs(float(value) - wanted) <= 1e-14 * wanted * (1 + (a + b) / abs(a - b))
    # A slope that hardly exists takes the other route to the same number.
    scene = fixed(friction=fj.Stribeck(0.4, 0.4, 0.5))
    assert float(fj.critical_friction(scene)) == pytest.approx(float(constant(scene)), rel=1e-13)
    text = str(jax.make_jaxpr(fj.critical_friction)(fixed()))
    assert "while" not in text and "scan" not in text


def test_gradients_of_the_closed_form_in_a_batch_and_at_held_stiffness():
    at = (4e8, 6e7, 1.0, 6283.0, 5026.0, 0.001, 0.007)
    wanted = []
    for i, x in enumerate(map(mp.mpf, at)):
        h = x * mp.mpf(10) ** -15
        ends = [exact(*at[:i], x + sign * h, *at[i + 1 :]) for sign in (1, -1)]
        wanted.append(float((ends[0] - ends[1]) / (2 * h)))
    for found in jax.jit(lambda x: both_gradients(of_numbers, x))(list(at)):
        np.testing.assert_allclose(found, wanted, rtol=1e-11)
    assert float(gradient(fixed()).friction.mu_s) == 0  # the scene's own friction does not matter
    scene, Vs = reference_scene(), jnp.array([0.05, 0.15, 0.6])
    many = jax.vmap(lambda V: fj.critical_friction(scene.replace(V=V)))(Vs)
    one = [fj.critical_friction(scene.replace(V=V)) for V in Vs]
    np.testing.assert_allclose(many, one, rtol=1e-12)
    held = BRAKE.replace(contact=fj.FixedContact(*fj.stiffness(BRAKE)))
    closed = float(constant(held))
    assert closed != pytest.approx(float(fj.critical_friction(BRAKE)), rel=1e-3)
    lin = two_directions(with_friction_times(held, closed / held.coefficient()), False).polynomial
    assert abs(float(hopf_test_function(lin))) < 1e-15


@pytest.mark.parametrize("law", ["fractal", "asperity"])
def test_laws_that_yield_are_searched_up_to_the_limit_of_eq_19(law):
    """mu_m <= 0.9: beyond it the first root of an asperity joint was 2.2, where there is none."""
    contact = BRAKE.contact
    if law == "asperity":
        contact = fj.AsperityContact(contact.surface, contact.material, contact.P, 1e-4)
    factors = _lattice(BRAKE.replace(contact=contact))
    assert (
        float(factors[-1]) * 0.25 == pytest.approx(0.9, rel=1e-15) and factors.max() == factors[-1]
    )
    assert _lattice(fixed())[-1] > 1000


SCENES = {
    "slope": reference_scene(),
    "driven": reference_scene().replace(F=5e3, V=0.02, v_m=0.1, K_t=1e8),
    "fractal": BRAKE,
    "fractal, constant friction": BRAKE.replace(friction=fj.Coulomb(0.4)),
    "fractal, ratio given": BRAKE.replace(stiffness_ratio=0.3),
    "undamped, fractal": BRAKE.replace(friction=fj.Coulomb(0.4), xi_1=0.0, xi_2=0.0, D=2.41),
}
QUICK = ("slope", "driven", "fractal")


@pytest.mark.parametrize("name", mostly_slow(SCENES, *QUICK))
def test_first_root_is_where_squeal_starts(name):
    """No growth below, growth 0 at it and squeal above; the same as Brent's method finds."""
    scene = SCENES[name]
    factor = float(fj.critical_friction(scene)) / float(scene.coefficient())
    below = jnp.linspace(0.002, 1 - 1e-9, 400) * factor
    assert (growths_at(scene, below) <= 0).all()
    assert float(growth_at(scene, factor * (1 + 1e-6))) > 0
    if "undamped" not in name:  # there it is 0 below, not negative
        root = scipy.optimize.brentq(
            lambda f: float(growth_at(scene, f)), factor * 0.9, factor * 1.02, xtol=1e-14
        )
        assert factor == pytest.approx(root, rel=1e-12)
        assert abs(float(growth_at(scene, factor))) < 1e-8


def leaf(scene, quantity):
    return scene.contact.surface.D if quantity == "D" else scene.oscillator.V


def critical(scene, x, quantity):
    return fj.critical_friction(eqx.tree_at(lambda s: leaf(s, quantity), scene, x))


@functools.partial(jax.jit, static_argnums=2)
def value_and_slopes(scene, x, quantity):
    """The critical friction, and its derivative in forward and in reverse mode."""
    found = both_modes(lambda x: critical(scene, x[0], quantity), jnp.asarray(x)[None])
    return jnp.stack([jnp.ravel(number)[0] for number in found])


bend = jax.jit(jax.jacfwd(jax.grad(critical, 1), 1), static_argnums=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_gradients_of_the_first_root(name):
    """Both modes and the second derivative against differences of the root."""
    scene, quantity = SCENES[name], "D" if name == "fractal" else "V"
    at = float(leaf(scene, quantity))
    h = (2e-4 if name == "fractal" else 2e-3) * at

    d = []
    for k in (1, 2, 3):  # sixth order
        up, down = (np.asarray(value_and_slopes(scene, at + x, quantity)) for x in (k * h, -k * h))
        d.append((up - down) / (2 * k * h))
    difference, _, bent = 1.5 * d[0] - 0.6 * d[1] + 0.1 * d[2]
    _, forward, reverse = np.asarray(value_and_slopes(scene, at, quantity))
    assert reverse == pytest.approx(difference, rel=1e-5)
    assert forward == pytest.approx(reverse, rel=1e-12)
    if name == "driven":  # second derivatives compile slowly
        assert float(bend(scene, at, quantity)) == pytest.approx(bent, rel=1e-4)


INFINITE = {
    "no K_t": fixed(K_t=0.0),
    "no K_n": fixed(K_n=0.0),
    "neither, with a slope": fixed(0.0, 0.0, fj.Stribeck(0.4, 0.25, 0.5)),
    "fully plastic": BRAKE.replace(G=1.342e-8),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", INFINITE)
def test_no_coupling_no_squeal(name):
    """Infinite, with a derivative of 0."""
    assert float(fj.critical_friction(INFINITE[name])) == np.inf
    assert all(float(x) == 0 for x in jax.tree.leaves(gradient(INFINITE[name])))


def test_without_or_with_unequal_damping():
    """The friction of coalescence; with one undamped direction, any friction at all."""
    scene = fixed(xi_1=0.0, xi_2=0.0)
    a, b = 6283.185307179586**2 + 6e7, 5026.548245743669**2 + 4e8
    wanted = abs(a - b) / (2 * np.sqrt(4e8 * 6e7))
    assert float(fj.critical_friction(scene)) == pytest.approx(wanted, rel=1e-14)
    assert all(jnp.isfinite(x) for x in jax.tree.leaves(gradient(scene)))
    assert float(fj.critical_friction(fixed(xi_2=0.0))) == 0
    # Friction that rises with speed, and F the other way: driven by any friction at all.
    driven = reference_scene().replace(xi_1=0.0, xi_2=0.0, F=-5.0)
    assert float(fj.critical_friction(driven)) == 0
    assert all(jnp.isfinite(x) for x in jax.tree.leaves(gradient(driven)))
    # Light damping: 2 sqrt(c_1 c_2)/(c_1 + c_2) = 0.7171 times the friction without damping.
    ratio = constant(fixed(xi_1=1e-6, xi_2=7e-6)) / constant(fixed(xi_1=0.0, xi_2=0.0))
    assert float(ratio) == pytest.approx(0.7171, abs=5e-5)
    assert np.isnan(fj.critical_friction(reference_scene().replace(v_m=1e-150)))


@pytest.mark.slow
def test_searched_up_to_the_limit_of_the_friction_correction():
    """mu_m <= 0.9: a joint that does not squeal up to there has no critical friction."""
    scene = BRAKE.replace(friction=fj.Coulomb(0.4), stiffness_ratio=0.02, D=2.6)
    assert float(fj.critical_friction(scene)) == np.inf
    held = scene.replace(contact=fj.FixedContact(*fj.stiffness(scene)))
    assert 0.9 < float(fj.critical_friction(held)) < np.inf


def test_hopf_test_function_is_negative_exactly_where_it_squeals():
    """100,000 systems of either sign of damping, against the growth rate."""
    rng, n = np.random.default_rng(4), 100_000
    a, b, g = log_uniform(rng, -1, 1, n), log_uniform(rng, -1, 1, n), log_uniform(rng, -6, 2, n)
    c_1, c_2 = log_uniform(rng, -5, 1, (2, n)) * rng.choice([-1, 1], (2, n))
    lin = stacked((a, b, c_1, c_2, g))
    growth = np.real(many_rightmost(lin))
    test = np.asarray(jax.jit(jax.vmap(hopf_test_function))(lin))
    sure = np.abs(growth) > 1e-11 * (np.abs(c_1) + np.abs(c_2) + np.sqrt(a + b))
    assert sure.mean() > 0.99
    assert ((growth < 0) & sure).sum() > 5000
    np.testing.assert_array_equal((test < 0)[sure], (growth > 0)[sure])
    # omega^2 = a_1/a_3 is the imaginary eigenvalue there.
    scene = fixed().replace(mu=fj.critical_friction(fixed()))
    found = critical_frequency(two_directions(scene, True).polynomial)
    assert float(found) == pytest.approx(float(fj.stability(scene).frequency), rel=1e-12)


@pytest.mark.parametrize("scene", [fixed(), pytest.param(BRAKE, marks=slow)])
def test_float32(scene):
    small = fj.critical_friction(jax.tree.map(lambda x: x.astype(jnp.float32), scene))
    assert small.dtype == jnp.float32
    assert float(small) == pytest.approx(float(fj.critical_friction(scene)), rel=1e-4)
