"""Limit cycles of the regularised law: another mechanism's, and told apart from the exact one's."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.motion import regularised
from fractaljax.motion.stick_slip import rest, stick_slip, units
from tools import reference_scene

K_N = 4e8
# Of the exact law, by the integrator of tests/filippov.py: peak to peak of x1 in V/sqrt(K_n/m),
# and its derivative by K_n with K_t/K_n held [m/N].
AMPLITUDE = 2.290139035337965
SLOPE = 1.263706994327e-11
COARSE, MIDDLE, FINE = 0.03, 1.5e-3, 1.5e-5  # m/s; the belt runs at 0.15
DEPENDS, CONVERGED = fj.CycleResult.depends_on_eps, fj.CycleResult.converged


def moved_scene(K_n) -> fj.Scene:
    return reference_scene().replace(K_n=K_n, K_t=K_n / 2)


def scaled_amplitude(cycle, K_n):
    return cycle.amplitude[0] * jnp.sqrt(K_n) / 0.15


@functools.cache
def cycle(eps, K_n=K_N) -> fj.LimitCycle:
    implicit = {"solver": diffrax.Kvaerno5(), "max_steps": 50_000} if eps == FINE else {}
    return fj.limit_cycle(moved_scene(K_n), regularisation=eps, throw=False, **implicit)


def difference() -> float:
    """d amplitude / d K_n, as a central difference."""
    h = 1e-4 * K_N
    ends = [float(scaled_amplitude(cycle(MIDDLE, K_N + d), K_N + d)) for d in (h, -h)]
    return (ends[0] - ends[1]) / (2 * h)


def period_later(found: fj.LimitCycle, eps) -> fj.Trajectory:
    return fj.simulate(reference_scene(), found.state, float(found.period), regularisation=eps)


# --- what it finds ------------------------------------------------------------------------


@pytest.mark.parametrize("eps", [1e-3, 2e-3])
def test_a_turn_is_not_taken_several_times_for_a_period(eps):
    """Where the motion has settled, turns differ by rounding and interpolation only."""
    found, exact = cycle(eps), fj.limit_cycle(moved_scene(K_N))
    assert int(found.turns) == 1
    assert float(found.period) == pytest.approx(float(exact.period), rel=1e-2)


def test_a_large_eps_finds_another_motion():
    """At 0.03 m/s direction 2 never reverses, and everything is tens of percent off: it is told."""
    found = cycle(COARSE)
    assert found.result == DEPENDS
    assert float(found.velocity_max[1]) < 0.8 * 0.15
    assert float(scaled_amplitude(found, K_N)) > 1.2 * AMPLITUDE
    assert float(found.regularisation_error) > 0.3
    with pytest.raises(RuntimeError, match="choose a smaller regularisation"):
        fj.limit_cycle(reference_scene(), regularisation=COARSE)


def test_a_smaller_eps_is_nearer_but_not_there():
    """At 0.0015 m/s the amplitude is off by 0.3 percent, above what passes for converged."""
    found = cycle(MIDDLE)
    off = float(scaled_amplitude(found, K_N)) / AMPLITUDE - 1
    assert 1e-3 < off < 6e-3
    assert found.result == DEPENDS
    np.testing.assert_allclose(found.regularisation_error, off, rtol=1e-6)
    assert float(found.velocity_max[1]) > 1.2 * 0.15 and int(found.turns) == 1


def test_error_is_the_largest_difference():
    """`regularisation_error` is that from the exact law's cycle, of period and both amplitudes."""
    exact = fj.limit_cycle(reference_scene())
    np.testing.assert_allclose(scaled_amplitude(exact, K_N), AMPLITUDE, rtol=1e-9)
    for eps in (COARSE, MIDDLE):
        found = cycle(eps)
        pairs = [
            (found.period, exact.period),
            (found.amplitude[0], exact.amplitude[0]),
            (found.amplitude[1], exact.amplitude[1]),
        ]
        largest = max(abs(float(one) / float(other) - 1) for one, other in pairs)
        np.testing.assert_allclose(found.regularisation_error, largest, rtol=1e-9)


@pytest.mark.parametrize("eps", [COARSE, MIDDLE])
def test_what_a_cycle_holds(eps):
    """Amplitudes, velocities and shares are those of the motion through one period."""
    found = cycle(eps)
    motion = period_later(found, eps)
    times = np.linspace(0, float(found.period), 20_001)
    x = np.asarray(motion.at(times))
    low, high = x.min(axis=0), x.max(axis=0)
    size = high - low
    np.testing.assert_allclose(found.amplitude, size[:2], rtol=1e-5)
    np.testing.assert_allclose(found.velocity_max, high[2:], rtol=0, atol=1e-4 * size[2:].max())
    np.testing.assert_allclose(found.velocity_min, low[2:], rtol=0, atol=1e-4 * size[2:].max())
    middle = (x[1:] + x[:-1]) / 2
    slow = (abs(0.15 - middle[:, 2:]) < eps).mean(axis=0)
    np.testing.assert_allclose(found.stick_fraction, slow, rtol=0, atol=2e-4)
    np.testing.assert_allclose(found.tension_fraction, (middle[:, 1] < 0).mean(), atol=2e-4)
    # `state` is where x1 is largest.
    np.testing.assert_allclose(x[0, 0], high[0], rtol=1e-12)
    np.testing.assert_allclose(found.state[2], 0, atol=1e-10)


@pytest.mark.parametrize("eps", [COARSE, MIDDLE])
def test_periodic(eps):
    """One period of the regularised motion from `state` leads back to it."""
    found = cycle(eps)
    scale = np.asarray(units(stick_slip(reference_scene())))
    end = np.asarray(period_later(found, eps).end)
    np.testing.assert_allclose(end / scale, found.state / scale, rtol=0, atol=1e-8)


def test_multipliers():
    """One is 1, the others attract; their product is the divergence's integral (Liouville)."""
    eps = COARSE
    found = cycle(eps)
    values = np.asarray(found.multipliers)
    assert abs(values[0] - 1) < 1e-6 and (abs(values[1:]) < 1).all()
    system = stick_slip(reference_scene())
    _, x = found.orbit(4096)
    y = x / units(system)[None]

    def divergence(y):
        return jnp.trace(jax.jacfwd(lambda y: regularised.field(0.0, y, (system, eps)))(y))

    mean = float(jax.jit(jax.vmap(divergence))(y).mean())
    expected = np.exp(mean * float(found.period * system.omega))
    np.testing.assert_allclose(np.prod(values).real, expected, rtol=1e-3)


def test_orbit():
    """`orbit(n)` is n states evenly over the period, from `state` on; it has no switches."""
    found = cycle(MIDDLE)
    times, states = found.orbit(16)
    assert times.shape == (16,) and states.shape == (16, 4)
    np.testing.assert_allclose(times, np.arange(16) / 16 * float(found.period), rtol=1e-14)
    motion = period_later(found, MIDDLE)
    scale = np.asarray(units(stick_slip(reference_scene())))
    off = (np.asarray(states) - np.asarray(motion.at(times))) / scale
    np.testing.assert_allclose(off, 0, atol=1e-7)
    np.testing.assert_allclose(np.asarray(states)[0] / scale, found.state / scale, atol=1e-12)
    with pytest.raises(ValueError, match="switches"):
        found.switches()


@pytest.mark.slow
def test_a_fine_eps_converges():
    """At 1.5e-5 m/s, with an implicit solver, the cycle is the exact one's to 1e-4."""
    found = cycle(FINE)
    assert found.result == CONVERGED
    assert 0 < float(found.regularisation_error) < 1e-4
    np.testing.assert_allclose(scaled_amplitude(found, K_N), AMPLITUDE, rtol=1e-4)


# --- derivatives --------------------------------------------------------------------------


def test_amplitude_near_slope_far():
    """Where values are 0.3 percent off, the derivative by K_n is off by more than ten."""
    assert abs(difference() / SLOPE - 1) > 0.1


@pytest.mark.slow
def test_derivatives():
    """Forward and reverse derivatives are one number, that of the regularised cycle."""

    def amplitude(K_n):
        found = fj.limit_cycle(moved_scene(K_n), regularisation=MIDDLE, throw=False)
        return scaled_amplitude(found, K_n)

    # Compiled whole: what the amplitude does not need has no derivatives then.
    forward, reverse = (float(jax.jit(mode(amplitude))(K_N)) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-6)
    np.testing.assert_allclose(forward, difference(), rtol=5e-3)


# --- the parts ----------------------------------------------------------------------------


def test_field():
    """tanh(v/eps) for sgn v: far from rest that of the slip modes, at rest without friction."""
    system = stick_slip(reference_scene())
    y = np.random.default_rng(0).normal(size=(4, 100))
    y[2:] = np.where(abs(y[2:] - 1) < 0.1, 0.5, y[2:])
    found = np.asarray(regularised.field(0.0, jnp.asarray(y), (system, 1e-3)))
    exact = system.field(y, np.sign(1 - y[2:]))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)
    y[2:] = 1
    found = regularised.field(0.0, jnp.asarray(y), (system, 1e-3))
    np.testing.assert_allclose(found[2:], np.array(system.free(y)), rtol=0, atol=1e-14)
    # Half-way: tanh(1/2) of the static friction.
    y[2:] = 1 - 0.5e-3 / 0.15
    free, load = np.array(system.free(y)), np.array(system.loads(y))
    found = np.asarray(regularised.field(0.0, jnp.asarray(y), (system, 1e-3)))[2:]
    mu = (found - free) / load
    drop = 0.15 * 0.5e-3 / 0.5 * 1.5
    np.testing.assert_allclose(mu, 0.4 * np.tanh(0.5) - drop, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_too_few_steps_are_told():
    """Where max_steps ends the integration the result says so, and what to do."""
    stiff = {"regularisation": 1e-5, "max_steps": 64}
    found = fj.limit_cycle(reference_scene(), throw=False, **stiff)
    assert found.result == fj.CycleResult.too_stiff
    assert np.isnan([found.period, *found.amplitude, found.regularisation_error]).all()
    with pytest.raises(RuntimeError, match="Kvaerno5"):
        fj.limit_cycle(reference_scene(), **stiff)


def test_no_motion():
    """Where steady sliding attracts there is no cycle of either law, and nothing is made up."""
    quiet = reference_scene().replace(mu_s=0.05, mu_m=0.04, xi_1=0.05, xi_2=0.05)
    found = fj.limit_cycle(quiet, regularisation=COARSE, throw=False)
    assert found.result not in (CONVERGED, DEPENDS)
    for value in (found.period, found.amplitude, found.state, found.regularisation_error):
        assert np.isnan(value).all()
    still = rest(quiet, stick_slip(quiet))
    assert np.isfinite(still).all()


def cosine(n):
    """Nodes of a cosine with its rate, unevenly over one period, the last ones repeated."""
    t = np.linspace(0, 2 * np.pi, n)
    t = np.concatenate([t + 0.3 * np.sin(t) * 2 * np.pi / n, [2 * np.pi] * 5])
    return t, np.cos(t - 0.3), -np.sin(t - 0.3)


def test_extremes():
    """Of four components at once, between the nodes too."""
    t, x, rate = cosine(40)
    factors = np.array([1.0, -2.0, 0.0, 3.0])
    states, rates = (jnp.asarray(c[:, None] * factors) for c in (x, rate))
    found = regularised.extremes(jnp.asarray(t), states, rates)
    np.testing.assert_allclose(found, [-abs(factors), abs(factors)], rtol=0, atol=1e-5)


def test_share():
    """How long a quantity is below zero, as a share of the time, with the derivative of that."""
    t, x, rate = (jnp.asarray(c) for c in cosine(60))

    @jax.jit
    @jax.vmap
    def share(level):
        def at(level):
            return regularised.share(t, x - level, rate)

        return at(level), jax.jacfwd(at)(level), jax.jacrev(at)(level)

    levels = np.array([-0.7, 0.0, 0.99, -2.0, 2.0])
    found, *slopes = share(levels)
    np.testing.assert_array_equal(found[3:], [0, 1])
    truth = 1 - np.arccos(levels[:3]) / np.pi
    np.testing.assert_allclose(found[:3], truth, rtol=0, atol=1e-5)
    for slope in slopes:
        truth = 1 / (np.pi * np.sqrt(1 - levels[:3] ** 2))
        np.testing.assert_allclose(slope[:3], truth, rtol=2e-3)
        np.testing.assert_array_equal(slope[3:], 0)
