"""Limit cycles of the regularised law: another mechanism's, and told apart from the exact one's."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._dynamics import smooth
from fractaljax._dynamics.scaled import hybrid_system
from tools import both_modes, motionless_scene, reference_cycle, reference_scene

K_N = 4e8
# Of the exact law, as in reference/cycle.json: peak to peak of x1 in V/sqrt(K_n/m), and its
# derivative by K_n with K_t/K_n held [m/N].
AMPLITUDE = 2.290139035337965
SLOPE = 1.263706994327e-11
COARSE, MIDDLE, FINE = 0.03, 1.5e-3, 1.5e-5  # m/s; the belt runs at 0.15
RESULT = fj.CycleResult
SLOW = pytest.mark.slow


def moved_scene(K_n) -> fj.Scene:
    return reference_scene().replace(K_n=K_n, K_t=K_n / 2)


def scaled_amplitude(cycle, K_n=K_N):
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


@SLOW
def test_eps_decides_what_is_found():
    """At 0.03 m/s direction 2 never reverses and the amplitude is 20 % off; at 0.0015, 0.3 %."""
    coarse, middle = cycle(COARSE), cycle(MIDDLE)
    assert coarse.result == middle.result == RESULT.depends_on_eps
    assert float(coarse.velocity_max[1]) < 0.8 * 0.15 < 1.2 * 0.15 < float(middle.velocity_max[1])
    assert float(scaled_amplitude(coarse)) > 1.2 * AMPLITUDE
    assert float(coarse.regularisation_error) > 0.3
    off = float(scaled_amplitude(middle)) / AMPLITUDE - 1
    assert 1e-3 < off < 6e-3
    np.testing.assert_allclose(middle.regularisation_error, off, rtol=1e-6)
    with pytest.raises(RuntimeError, match="choose a smaller regularisation"):
        fj.limit_cycle(reference_scene(), regularisation=COARSE)
    # At 1.5e-5 m/s, with an implicit solver, the cycle is the exact one's to 1e-4.
    found = cycle(FINE)
    assert found.result == RESULT.converged
    assert 0 < float(found.regularisation_error) < 1e-4
    np.testing.assert_allclose(scaled_amplitude(found), AMPLITUDE, rtol=1e-4)


@SLOW
@pytest.mark.parametrize("eps", [COARSE, 2e-3, MIDDLE, 1e-3])
def test_error_is_the_largest_difference(eps):
    """From the exact law's cycle, of period and both amplitudes. One return is one period."""
    exact, found = reference_cycle(), cycle(eps)
    assert int(found.returns) == 1
    pairs = zip([found.period, *found.amplitude], [exact.period, *exact.amplitude], strict=True)
    largest = max(abs(float(one) / float(other) - 1) for one, other in pairs)
    np.testing.assert_allclose(found.regularisation_error, largest, rtol=1e-9)


@SLOW
@pytest.mark.parametrize("eps", [COARSE, MIDDLE])
def test_orbit(eps):
    """The motion through one period returns to `state`, and everything told of it is its own."""
    found, scale = cycle(eps), np.asarray(hybrid_system(reference_scene()).units)
    motion = fj.simulate(reference_scene(), found.state, float(found.period), regularisation=eps)
    end = np.asarray(motion.end)
    np.testing.assert_allclose(end / scale, found.state / scale, rtol=0, atol=1e-8)
    x = np.asarray(motion.at(np.linspace(0, float(found.period), 20_001)))
    low, high = x.min(axis=0), x.max(axis=0)
    size = high - low
    np.testing.assert_allclose(found.amplitude, size[:2], rtol=1e-5)
    np.testing.assert_allclose(found.velocity_max, high[2:], rtol=0, atol=1e-4 * size[2:].max())
    np.testing.assert_allclose(found.velocity_min, low[2:], rtol=0, atol=1e-4 * size[2:].max())
    middle = (x[1:] + x[:-1]) / 2
    slow = (abs(0.15 - middle[:, 2:]) < eps).mean(axis=0)
    np.testing.assert_allclose(found.stick_fraction, slow, rtol=0, atol=2e-4)
    np.testing.assert_allclose(found.tension_fraction, (middle[:, 1] < 0).mean(), atol=2e-4)
    np.testing.assert_allclose(x[0, 0], high[0], rtol=1e-12)  # `state` is where x1 is largest
    np.testing.assert_allclose(found.state[2], 0, atol=1e-10)
    times, states = found.orbit(20)
    np.testing.assert_allclose(times, np.arange(20) / 20 * float(found.period), rtol=1e-14)
    off = (np.asarray(states) - x[:-1:1000]) / scale
    np.testing.assert_allclose(off, 0, atol=1e-7)
    with pytest.raises(ValueError, match="a regularised cycle has no switches"):
        found.switches()


@SLOW
def test_multipliers():
    """One is 1, the others attract; their product is the divergence's integral (Liouville)."""
    found, system = cycle(COARSE), hybrid_system(reference_scene())
    values = np.asarray(found.multipliers)
    assert abs(values[0] - 1) < 1e-6 and (abs(values[1:]) < 1).all()
    y = found.orbit(4096)[1] / system.units[None]

    def divergence(y):
        return jnp.trace(
            jax.jacfwd(lambda y: smooth.SmoothSystem(system, jnp.asarray(COARSE)).field(y))(y)
        )

    mean = float(jax.jit(jax.vmap(divergence))(y).mean())
    expected = np.exp(mean * float(found.period * system.omega))
    np.testing.assert_allclose(np.prod(values).real, expected, rtol=1e-3)


@SLOW
def test_no_motion_and_too_few_steps():
    """Where steady sliding attracts there is no cycle of either law."""
    found = fj.limit_cycle(motionless_scene(), regularisation=COARSE, throw=False)
    assert found.result == RESULT.not_periodic
    for value in (found.period, found.amplitude, found.state, found.regularisation_error):
        assert np.isnan(value).all()
    # Where max_steps ends the integration the result says so, and what to do.
    stiff = {"regularisation": 1e-5, "max_steps": 64}
    found = fj.limit_cycle(reference_scene(), throw=False, **stiff)
    assert found.result == RESULT.too_stiff
    assert np.isnan([found.period, *found.amplitude, found.regularisation_error]).all()
    with pytest.raises(RuntimeError, match="Kvaerno5"):
        fj.limit_cycle(reference_scene(), **stiff)


@SLOW
def test_values_are_near_and_derivatives_far():
    """Those of the regularised cycle, in both modes."""

    def amplitude(K_n):
        found = fj.limit_cycle(moved_scene(K_n[0]), regularisation=MIDDLE, throw=False)
        return scaled_amplitude(found, K_n[0])

    # Compiled whole: what the amplitude does not need then has no derivatives.
    _, *slopes = jax.jit(lambda x: both_modes(amplitude, x))(jnp.array([K_N]))
    np.testing.assert_allclose(slopes, difference(), rtol=5e-3)
    # Where values are 0.3 percent off, the derivative by K_n is off by more than ten.
    assert abs(difference() / SLOPE - 1) > 0.1


def test_field():
    """tanh(v/eps) for sgn v: far from v = 0 that of slip, at v = 0 without friction."""
    system = hybrid_system(reference_scene())
    y = np.random.default_rng(0).normal(size=(4, 100))

    def found(u):
        y[2:] = u
        return np.asarray(smooth.SmoothSystem(system, jnp.asarray(1e-3)).field(jnp.asarray(y)))

    slip = np.where(abs(y[2:] - 1) < 0.1, 0.5, y[2:])
    exact = found(slip), system.field(y, np.sign(1 - slip))
    np.testing.assert_allclose(*exact, rtol=0, atol=1e-12)

    def free():
        F, K, C = (np.asarray(x)[:, None] for x in (system.F, system.K, system.C))
        return F - K * y[:2] - C * y[2:]

    np.testing.assert_allclose(found(1.0)[2:], free(), rtol=0, atol=1e-14)
    # At v = eps/2 it is tanh(1/2) of the static friction, less the slope of Eq. 38.
    rates = found(1 - 0.5e-3 / 0.15)[2:]
    mu = (rates - free()) / np.array(system.loads(y[:2]))
    drop = 0.15 * 0.5e-3 / 0.5 * 1.5
    np.testing.assert_allclose(mu, 0.4 * np.tanh(0.5) - drop, rtol=0, atol=1e-9)


def cosine(n):
    """Nodes of a cosine with its rate, unevenly over one period, the last ones repeated."""
    t = np.linspace(0, 2 * np.pi, n)
    t = np.concatenate([t + 0.3 * np.sin(t) * 2 * np.pi / n, [2 * np.pi] * 5])
    return t, np.cos(t - 0.3), -np.sin(t - 0.3)


def test_extremes_and_share_below_zero():
    """Of four components at once, between the nodes too."""
    t, x, rate = cosine(40)
    factors = np.array([1.0, -2.0, 0.0, 3.0])
    states, rates = (jnp.asarray(c[:, None] * factors) for c in (x, rate))
    found = jax.jit(smooth.extremes)(jnp.asarray(t), states, rates)
    np.testing.assert_allclose(found, [-abs(factors), abs(factors)], rtol=0, atol=1e-5)
    # With its derivative in both modes, also where it is 0 or 1.
    t, x, rate = (jnp.asarray(c) for c in cosine(60))

    def share(level):
        return smooth.share_below_zero(t, x - level, rate)

    levels = np.array([-0.7, 0.0, 0.99, -2.0, 2.0])
    functions = share, jax.jacfwd(share), jax.jacrev(share)
    found, *slopes = (jax.jit(jax.vmap(function))(levels) for function in functions)
    truth = 1 - np.arccos(levels[:3]) / np.pi
    np.testing.assert_allclose(found, [*truth, 0, 1], rtol=0, atol=1e-5)
    for slope in slopes:
        truth = 1 / (np.pi * np.sqrt(1 - levels[:3] ** 2))
        np.testing.assert_allclose(slope, [*truth, 0, 0], rtol=2e-3)
