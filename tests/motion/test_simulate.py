"""The motion from a start, against DOP853 event by event and against motions in closed form."""

import functools
import itertools
from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from filippov import PLAIN, Mechanism, run
from tools import state_matrix

PI = np.pi
LONG = 40.0  # in 1/omega: some 170 steps, for which all tests share what is compiled
TIMES = 60  # at which a motion is looked at
REACHED = fj.SimulationResult.reached


def scene_of(m: Mechanism) -> fj.Scene:
    law = fj.Coulomb(m.mu_s) if m.mu_m == m.mu_s else fj.Stribeck(m.mu_s, m.mu_m, m.v_m)
    oscillator = fj.Oscillator(m.m, m.omega_1, m.omega_2, m.xi_1, m.xi_2, m.F, m.V)
    return fj.Scene(fj.FixedContact(m.K_n, m.K_t), law, oscillator)


def omega(m: Mechanism) -> float:
    return float(np.sqrt(m.omega_1**2 + m.omega_2**2 + (m.K_n + m.K_t) / m.m))


def units(m: Mechanism) -> np.ndarray:
    """What makes a state of order one SI."""
    return m.V * np.array([1 / omega(m), 1 / omega(m), 1, 1])


def switches(phases):
    """(time, direction, before, after) of every change of mode in the other solver's phases."""
    return [
        (p.t1, i + 1, p.signs[i], q.signs[i])
        for p, q in itertools.pairwise(phases)
        for i in (0, 1)
        if p.signs[i] != q.signs[i]
    ]


def agree(m: Mechanism, start, duration=LONG, *, ends=1e-9, times=1e-10):
    """Simulate from a start of order one over a time in 1/omega; compare with the other solver.

    Returns both motions. `times` is relative to the duration, `ends` to the size of the motion.
    """
    start, t1 = np.array(start) * units(m), duration / omega(m)
    found, truth = fj.simulate(scene_of(m), start, t1), run(m, start, t1)
    expected = switches(truth)
    assert [s[1:] for s in found.switches()] == [s[1:] for s in expected]
    found_times, true_times = ([s[0] for s in x] for x in (found.switches(), expected))
    np.testing.assert_allclose(found_times, true_times, rtol=0, atol=times * t1)
    end = truth[-1].end / units(m)
    size = max(1, abs(end).max())
    np.testing.assert_allclose(found.end / units(m), end, rtol=0, atol=ends * size)
    np.testing.assert_allclose(found.times[-1], t1, rtol=1e-14)
    return found, truth


def modes_of(phases):
    return {p.signs for p in phases}


# --- against the other solver -------------------------------------------------------------


@functools.cache
def random_case(seed):
    """A mechanism and a start; every third start is on the belt in one direction."""
    rng = np.random.default_rng(seed)
    mu_s, K_n = rng.uniform(0.2, 0.6), rng.uniform(1.5e8, 6e8)
    mechanism = replace(
        PLAIN,
        K_n=K_n,
        K_t=rng.uniform(0.2, 0.75) * K_n,
        V=rng.uniform(0.05, 0.3),
        mu_s=mu_s,
        mu_m=mu_s * rng.uniform(0.4, 0.9),
        v_m=rng.uniform(0.3, 0.8),
        F=rng.choice([-1, 1]) * 10 ** rng.uniform(0, 3.5),
        m=rng.uniform(0.5, 2),
        xi_2=rng.uniform(0, 0.05),
    )
    start = 1.2 * rng.normal(size=4)
    if seed % 3:
        start[1 + seed % 3] = 1
    return mechanism, start


SEEDS = (2, 4, 10, 13, 15, 17, 21, 22)


@pytest.mark.parametrize("seed", SEEDS)
def test_random_motions(seed):
    """Eight mechanisms with the Stribeck law: the same switches at the same times, the same end."""
    found, _ = agree(*random_case(seed))
    assert len(found.switches()) > 12


def test_random_motions_do_everything():
    """Those eight see every mode but stick in both directions at once."""
    seen = set()
    for seed in SEEDS:
        m, start = random_case(seed)
        seen |= modes_of(run(m, start * units(m), LONG / omega(m), rtol=1e-8))
    assert seen == set(itertools.product((1, 0, -1), repeat=2)) - {(0, 0)}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_coulomb_motions(seed):
    """The same with constant friction."""
    m, start = random_case(seed)
    found, _ = agree(replace(m, mu_m=m.mu_s), start)
    assert len(found.switches()) >= 3


def test_stick_in_both_directions():
    """Both directions stick at once, and let go one by one."""
    m = replace(PLAIN, K_n=5.35e8, K_t=2.768e8, V=0.0672, mu_s=0.321, mu_m=0.275, F=-2860.0)
    # Where the springs alone would hold the mass: both loads press it on the belt.
    f = m.F / np.sqrt(2)
    x_1, x_2 = f / (m.m * m.omega_1**2 + m.K_t), -f / (m.m * m.omega_2**2 + m.K_n)
    found, truth = agree(m, np.array([x_1, x_2, m.V, m.V]) / units(m))
    assert truth[0].signs == (0, 0) and len(found.switches()) >= 3
    stuck = (np.asarray(found.modes) == 0).all(axis=1)
    np.testing.assert_allclose(found.states[stuck, 2:], m.V, rtol=1e-15)


@pytest.mark.parametrize("v", [(1.0, 1.0), (1.0, -0.3), (0.2, 1.0)])
@pytest.mark.parametrize("x", [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (0.1, 0.5)])
def test_start_on_the_belt(x, v):
    """From v = 0 exactly: to either side, or stick, and what the first switch is then."""
    found, truth = agree(PLAIN, [*x, *v], 8.0)
    np.testing.assert_array_equal(found.modes[0], truth[0].signs)


def beside_the_belt(count):
    """Mechanisms and starts with one velocity or both a few ulp, or up to 1e-6, off the belt's."""
    rng = np.random.default_rng(0)
    for k in range(count):
        start = 1.2 * rng.normal(size=4)
        for i in ((2,), (3,), (2, 3))[k % 3]:
            ulps = rng.choice([1, 2, 10]) * np.finfo(float).eps
            start[i] = 1 + rng.choice([-1, 1]) * (ulps if k % 2 else 10 ** rng.uniform(-15, -6))
        yield random_case(k)[0], start


def test_start_beside_the_belt():
    """A guard that is just above zero and rises has no root behind it: time goes forward."""
    reversals = 0
    for m, start in beside_the_belt(60):
        start, t1 = start * units(m), 3 / omega(m)
        found, truth = fj.simulate(scene_of(m), start, t1, rtol=1e-12), run(m, start, t1, 1e-13)
        assert (np.diff(found.times) >= 0).all()
        end = truth[-1].end / units(m)
        size = max(1, abs(end).max())
        np.testing.assert_allclose(found.end / units(m), end, rtol=0, atol=1e-10 * size)
        reversals += len(truth) > 2
    assert reversals > 10


def test_short_slip_before_a_switch_of_the_other_direction():
    """The reproducer of a step backwards in time: the design of the README, at default rtol."""
    scene = fj.brake_scene().replace(D=2.4319698833358783, G=1.2340705508799051e-10)
    K_n, K_t = map(float, fj.stiffness(scene))
    parts = vars(scene.oscillator) | vars(scene.friction)
    m = Mechanism(K_n=K_n, K_t=K_t, **{name: float(value) for name, value in parts.items()})
    start, t1 = [-4.25546516e-06, 1.14128067e-06, 0.116792001, 0.187975114], 0.8 / 52283.1
    found, truth = fj.simulate(scene, start, t1), run(m, start, t1)
    assert (np.diff(found.times) >= 0).all()
    assert [s[1:] for s in found.switches()] == [s[1:] for s in switches(truth)]
    np.testing.assert_allclose(found.end / units(m), truth[-1].end / units(m), rtol=0, atol=1e-10)


def test_steep_friction_reaches_the_end():
    """Steps that friction shortens do not shorten what is left of the time for ever."""
    m = replace(PLAIN, v_m=0.05)
    agree(m, [0.5, -0.5, 0.2, 0.3], 1e-4 * omega(m))


def test_friction_that_becomes_steep_within_a_step():
    """What a step of the usual length would miss by 1e-7 is kept to rtol by a shorter one."""
    m = replace(PLAIN, V=0.005, F=-6000.0, v_m=0.008, mu_s=0.3, mu_m=0.16)
    agree(m, [0.0, -0.1, 1.0, 0.16], 0.2)


@pytest.mark.parametrize("duration", [1e-6, 0.01, 0.2])
def test_shorter_than_a_step(duration):
    """One step is enough, and it ends where it should."""
    found, _ = agree(PLAIN, [0.5, -0.3, 0.4, 0.2], duration)
    assert (np.diff(found.times) > 0).sum() == 1


def test_tangential_contact_without_stiffness():
    """K_t = 0: direction 2 hears nothing of direction 1 and still switches."""
    m = replace(PLAIN, K_t=0.0, F=-300.0)
    _, truth = agree(m, [0.5, 1.5, 1.0, -1.0])
    assert modes_of(truth) >= {(0, 1), (1, -1)}


GRAZING = {  # start, and how much more x2 than there only just meets v_i = 0
    "stick, from below": ([-1.0, 1.4, 0.0, -0.4], 0.275109844501594),
    "stick in 2": ([1.6, 0.3, 0.2, -0.3], 0.212690333886485),
    "reversal of 1": ([0.2, 0.6, -1.2, 1.8], 0.272568646727768),
    "reversal of 2": ([-1.3, 0.3, 0.1, -1.1], 0.179861399543233),
    "reversal of 2 while 1 slips back": ([-1.3, -0.5, 3.9, 0.9], 0.010415209373468),
}


@pytest.mark.parametrize("distance", [1e-3, 1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("case", GRAZING)
def test_grazing(case, distance):
    """A sliding velocity that only just does, or does not, reach zero: both as they should be."""
    start, more = GRAZING[case]
    counts = []
    for side in (-1, 1):
        moved = np.add(start, [0, more + side * distance, 0, 0])
        # Where a parabola has its zeros is known to no more than the root of its depth.
        found, _ = agree(PLAIN, moved, 10.0, ends=1e-8, times=1e-8)
        counts.append(len(found.switches()))
    assert abs(counts[0] - counts[1]) == 2


# --- closed forms -------------------------------------------------------------------------


def test_mass_on_the_belt():
    """A constant load: stick at V until the spring reaches the friction limit, then slip."""
    m = replace(PLAIN, K_t=0.0, F=-300.0)
    f, K_1 = m.F / np.sqrt(2), m.m * m.omega_1**2
    x_2 = -f / (m.m * m.omega_2**2 + m.K_n)
    load = m.K_n * x_2
    assert load > 0
    damping = 2 * m.xi_1 * m.omega_1 * m.m * m.V
    first, last = f / K_1, (f - damping + m.mu_s * load) / K_1
    leaves = (last - first) / m.V
    t1 = 1.2 * leaves
    found = fj.simulate(scene_of(m), [first, x_2, m.V, 0.0], t1)
    (time, direction, before, after), *more = found.switches()
    assert (direction, before, after) == (1, 0, 1) and not more
    np.testing.assert_allclose(time, leaves, rtol=1e-12)
    t = np.linspace(0, leaves, TIMES)
    x = found.at(t)
    np.testing.assert_allclose(x[:, 0], first + m.V * t, rtol=0, atol=1e-13 * abs(last))
    np.testing.assert_allclose(x[:, 1], x_2, rtol=1e-12)
    np.testing.assert_allclose(x[:, 2], m.V, rtol=1e-14)
    assert 0 < found.end[2] < m.V


def test_linear_motion():
    """Coulomb friction without a switch is a linear equation: the matrix exponential."""
    m = replace(PLAIN, mu_s=0.3, mu_m=0.3, F=300.0)  # the equilibrium attracts
    matrix, force = state_matrix(scene_of(m).oscillator, m.mu_s, m.K_n, m.K_t), np.zeros(4)
    force[2:] = np.array([1, -1]) * m.F / np.sqrt(2) / m.m
    still = np.linalg.solve(matrix, -force)
    start = still + 0.1 * units(m) * [1, -2, 0.5, 1]
    t1 = LONG / omega(m)
    found = fj.simulate(scene_of(m), start, t1)
    assert found.switches() == [] and np.max(found.states[:, 2:]) < m.V
    for t, state in zip(found.times[::20], found.states[::20], strict=True):
        truth = still + scipy.linalg.expm(matrix * float(t)) @ (start - still)
        np.testing.assert_allclose(state / units(m), truth / units(m), rtol=0, atol=2e-11)


def test_free_oscillators():
    """No contact, no damping: two oscillators, each with its own energy, whatever they switch."""
    m = replace(PLAIN, K_n=0.0, K_t=0.0, xi_1=0.0, xi_2=0.0, F=0.0)
    start = np.array([1.5, -0.7, 0.4, 1.3]) * units(m)
    found = fj.simulate(scene_of(m), start, LONG / omega(m))
    assert len(found.switches()) > 8
    for i, rate in enumerate((m.omega_1, m.omega_2)):
        t, x, v = found.times, start[i], start[2 + i]
        truth = x * np.cos(rate * t) + v / rate * np.sin(rate * t)
        np.testing.assert_allclose(found.states[:, i], truth, rtol=0, atol=1e-10 * units(m)[i])
        energy = (rate * found.states[:, i]) ** 2 + found.states[:, 2 + i] ** 2
        np.testing.assert_allclose(energy, energy[0], rtol=1e-10)


# --- how good, and how it looks -----------------------------------------------------------


def test_error_follows_rtol():
    """The error stays below rtol and falls with it."""
    m, t1 = PLAIN, 20 / omega(PLAIN)
    start = np.array([1.0, 0.2, 0.3, 0.1]) * units(m)
    truth = run(m, start, t1, rtol=1e-13)[-1].end / units(m)
    errors = []
    for rtol in (1e-7, 1e-9, 1e-11):
        end = fj.simulate(scene_of(m), start, t1, rtol=rtol).end / units(m)
        errors.append(abs(end - truth).max())
        assert errors[-1] < rtol, (rtol, errors)
    assert errors[0] > 20 * errors[1] > 20 * errors[2], errors


def test_at():
    """Between steps, at switches and at both ends it is the motion; at a step the step itself."""
    m, start = random_case(4)
    found, truth = agree(m, start)
    t1 = LONG / omega(m)
    inside = np.random.default_rng(0).uniform(0, t1, TIMES - 2)
    times = np.sort([0.0, *inside, t1])
    states = np.asarray(found.at(times))
    assert states.shape == (TIMES, 4)
    for t, state in zip(times, states, strict=True):
        phase = next(p for p in truth if t <= p.t1 * (1 + 1e-15))
        expected = phase.dense(min(t, phase.t1))
        np.testing.assert_allclose(state / units(m), expected / units(m), rtol=0, atol=1e-9)
    steps = np.flatnonzero(np.diff(found.times) > 0)[-TIMES:]
    states = np.asarray(found.at(found.times[steps]))
    np.testing.assert_allclose(states, np.asarray(found.states)[steps], rtol=1e-15)


@pytest.mark.parametrize("regularisation", [None, 0.03])
def test_at_no_other_times(regularisation):
    """Times outside the simulation, and of another shape, are refused; t1 itself is not."""
    m, t1 = PLAIN, 1e-5
    start = np.array([1.0, 0.2, 0.3, 0.1]) * units(m)
    found = fj.simulate(scene_of(m), start, t1, regularisation=regularisation)
    np.testing.assert_allclose(found.at([0.0, t1]), [start, found.end], rtol=1e-12)
    text = r"^times must be from 0 to the end of the simulation, .*, got "
    with pytest.raises(ValueError, match=text + r"2e-05$"):
        found.at([0.0, 2e-5])
    with pytest.raises(ValueError, match=text + r"-1e-09$"):
        found.at([-1e-9])
    with pytest.raises(ValueError, match=r"^times must be finite, got nan$"):
        found.at([np.nan])
    with pytest.raises(ValueError, match=r"^times must have shape \(k,\), got \(\)$"):
        found.at(1e-6)
    late = jax.jit(lambda times: found.at(times))
    with pytest.raises(RuntimeError, match="times must be from 0 to the end of the simulation"):
        jax.block_until_ready(late(jnp.array([2e-5])))


def test_what_a_trajectory_holds():
    """It starts at the start; modes go with velocities; unused steps repeat the last state."""
    m, start = random_case(2)
    found, _ = agree(m, start)
    np.testing.assert_allclose(found.states[0], start * units(m), rtol=1e-15)
    assert found.times[0] == 0 and found.result == REACHED
    times, states, modes = (np.asarray(x) for x in (found.times, found.states, found.modes))
    assert times.shape == (len(times),) and states.shape == (len(times), 4)
    assert modes.shape == (len(times), 2) and set(modes.flat) <= {-1.0, 0.0, 1.0}
    assert (np.diff(times) >= 0).all()
    used = int((np.diff(times) > 0).sum())
    assert used < len(times) - 1
    np.testing.assert_array_equal(
        states[used + 1 :], np.broadcast_to(states[used], (len(times) - used - 1, 4))
    )
    np.testing.assert_array_equal(found.end, states[-1])
    sliding = 1 - states[:, 2:] / m.V
    assert (modes * sliding >= -1e-12).all() and (abs(sliding[modes == 0]) < 1e-12).all()


def test_many_starts():
    """jax.vmap over starts and jax.jit give what one start after the other gives."""
    m = PLAIN
    starts = np.random.default_rng(6).normal(size=(4, 4)) * units(m)
    t1, scene = 6 / omega(m), scene_of(m)

    @jax.jit
    @jax.vmap
    def together(start):
        motion = fj.simulate(scene, start, t1, max_steps=64)
        return motion.end, motion.times, motion.modes[-1]

    ends, times, modes = together(starts)
    assert times.shape == (4, 65)
    for k, start in enumerate(starts):
        alone = fj.simulate(scene, start, t1)
        np.testing.assert_allclose(ends[k] / units(m), alone.end / units(m), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(modes[k], alone.modes[-1])
        np.testing.assert_allclose(times[k, -1], t1, rtol=1e-14)


# --- derivatives --------------------------------------------------------------------------

BY = ("K_n", "mu_s", "V", "x1", "x2", "v1", "v2", "t1")
SWITCHES = 6


@functools.cache
def derivative_case():
    """Motion of the plain mechanism with stick in 1 and 2 and a reversal; numbers by name."""
    m, duration = PLAIN, 20.0
    start = np.array([1.0, 0.2, 0.3, 0.1]) * units(m)
    values = np.array([m.K_n, m.mu_s, m.V, *start, duration / omega(m)])
    return values, np.array([*values[:3], *units(m), values[-1]])


def moved(x) -> Mechanism:
    return replace(PLAIN, K_n=x[0], mu_s=x[1], V=x[2])


@functools.cache
def differences():
    """End and times of switches, by `BY`: central differences with the other solver, scaled."""
    values, scale = derivative_case()

    def outputs(x):
        phases = run(moved(x), x[3:7], x[7], rtol=3e-14)
        times = [s[0] for s in switches(phases)]
        assert len(times) == SWITCHES
        return np.array([*phases[-1].end / units(PLAIN), *np.array(times) * omega(PLAIN)])

    columns = []
    for step in np.diag(scale):
        wide, narrow = (
            (outputs(values + h * step) - outputs(values - h * step)) / (2 * h)
            for h in (2e-4, 1e-4)
        )
        columns.append(narrow + (narrow - wide) / 3)
    return np.array(columns).T


@functools.cache
def derivative(mode):
    """The same by jax."""
    values, scale = derivative_case()

    def outputs(x):
        scene = scene_of(PLAIN).replace(K_n=x[0], mu_s=x[1], V=x[2])
        motion = fj.simulate(scene, x[3:7], x[7])
        changed = jnp.any(motion.modes[1:] != motion.modes[:-1], axis=1)
        (k,) = jnp.nonzero(changed, size=SWITCHES)
        times = motion.times[k + 1] * omega(PLAIN)
        return jnp.concatenate([motion.end / units(PLAIN), times])

    return np.asarray(mode(outputs)(jnp.asarray(values))) * scale


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives(mode):
    """By K_n, mu_s, V, the start and t1, of the end and of every switch, through all of them."""
    values, _ = derivative_case()
    kinds = [s[1:] for s in switches(run(PLAIN, values[3:7], values[7]))]
    assert {(1, 1, 0), (2, 1, 0), (1, 1, -1)} <= set(kinds)
    found, truth = derivative(mode), differences()
    np.testing.assert_allclose(found, truth, rtol=1e-7, atol=1e-7 * abs(truth).max())
    # What happens before the end does not depend on when it is.
    np.testing.assert_array_equal(found[4:, BY.index("t1")], 0)


def test_both_modes_agree():
    """Forward and reverse derivatives are the same numbers."""
    forward, reverse = derivative(jax.jacfwd), derivative(jax.jacrev)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-11 * abs(forward).max())


# --- ends and refusals --------------------------------------------------------------------


def test_out_of_steps():
    """max_steps used up: told or raised; what was reached is part of the motion."""
    m, start = random_case(1)
    start, t1 = start * units(m), LONG / omega(m)
    short = fj.simulate(scene_of(m), start, t1, max_steps=16, throw=False)
    whole = fj.simulate(scene_of(m), start, t1)
    assert short.result == fj.SimulationResult.out_of_steps
    assert short.times.shape == (17,) and short.times[-1] < t1
    np.testing.assert_allclose(
        np.asarray(short.states) / units(m),
        np.asarray(whole.states)[:17] / units(m),
        rtol=0,
        atol=1e-13,
    )
    np.testing.assert_array_equal(short.modes, whole.modes[:17])
    with pytest.raises(RuntimeError, match=r"^max_steps were used up before the end time$"):
        fj.simulate(scene_of(m), start, t1, max_steps=16)


def test_diverged():
    """A motion that grows beyond all bounds: told or raised, and no number is lost on the way."""
    start = [6e-4, 0.0, 0.0, 0.0]  # 80 V/omega
    found = fj.simulate(scene_of(PLAIN), start, 0.02, throw=False)
    assert found.result == fj.SimulationResult.diverged
    assert np.isfinite(found.states).all() and found.times[-1] < 0.02
    assert abs(found.end / units(PLAIN)).max() > 1e3
    with pytest.raises(RuntimeError, match=r"^the motion grew beyond all bounds$"):
        fj.simulate(scene_of(PLAIN), start, 0.02)


GOOD = {"start": [0.0, 0.0, 0.0, 0.0], "t1": 1e-3}


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"start": [0.0] * 3}, r"start must have shape \(4,\), got \(3,\); use jax.vmap for many"),
        ({"start": [np.nan, 0, 0, 0]}, "start must be finite, got nan"),
        ({"t1": 0.0}, "t1 must be above 0, got 0.0"),
        ({"t1": -1.0}, "t1 must be above 0, got -1.0"),
        ({"t1": np.inf}, "t1 must be above 0, got inf"),
        ({"rtol": 0.0}, "rtol must be above 0 and at most 0.1, got 0.0"),
        ({"rtol": 0.5}, "rtol must be above 0 and at most 0.1, got 0.5"),
        ({"rtol": 1e-300}, "rtol must be at least 9.1e-13 in float64, got 1e-300"),
        ({"max_steps": 0}, "max_steps must be a whole number of at least 1, got 0"),
        ({"max_steps": 10.0}, "max_steps must be a whole number of at least 1, got 10.0"),
        ({"regularisation": 0.0}, "regularisation must be above 0, got 0.0"),
        ({"regularisation": -0.01}, "regularisation must be above 0, got -0.01"),
    ],
)
def test_refusals(bad, message):
    """The message holds the argument, the bound and the value."""
    with pytest.raises(ValueError, match=f"^{message}$"):
        fj.simulate(scene_of(PLAIN), **GOOD | bad)


def test_one_scene_and_one_end():
    """A scene that holds arrays, or several end times, are refused with their shape."""
    with pytest.raises(ValueError, match=r"^F must be a scalar, got shape \(2,\); use jax.vmap"):
        fj.simulate(scene_of(PLAIN).replace(F=jnp.ones(2)), **GOOD)
    with pytest.raises(ValueError, match=r"^t1 must .*\(2,\)"):
        fj.simulate(scene_of(PLAIN), GOOD["start"], np.array([1e-3, 2e-3]))


# --- regularised --------------------------------------------------------------------------


@functools.cache
def smooth(eps, implicit=False):
    """The motion of the derivatives' case by the regularised law."""
    values, _ = derivative_case()
    options = {"solver": diffrax.Kvaerno5(), "max_steps": 200_000} if implicit else {}
    return fj.simulate(scene_of(PLAIN), values[3:7], values[7], regularisation=eps, **options)


def test_regularised_converges():
    """The distance to the exact motion, all along, falls with eps."""
    values, _ = derivative_case()
    exact = fj.simulate(scene_of(PLAIN), values[3:7], values[7])
    times = np.linspace(0, values[7], TIMES)
    distances = []
    for eps in (0.03, 0.01, 0.003, 0.001):
        found = smooth(eps)
        assert found.result == REACHED
        np.testing.assert_allclose(found.times[-1], values[7], rtol=1e-14)
        apart = np.asarray(found.at(times) - exact.at(times)) / units(PLAIN)
        distances.append(abs(apart).max())
        np.testing.assert_allclose(found.at(times[-1:])[0], found.end, rtol=0, atol=1e-14)
        sliding = PLAIN.V - np.asarray(found.states)[:, 2:]
        expected = np.where(abs(sliding) < eps, 0, np.sign(sliding))
        np.testing.assert_array_equal(found.modes, expected)
    ratios = np.array(distances[:-1]) / distances[1:]
    assert (ratios > 2).all() and distances[-1] < 0.03, distances


def test_regularised_by_both_solvers():
    """An explicit and an implicit solver find the same motion."""
    times = np.linspace(0, derivative_case()[0][7], TIMES)
    one, other = (np.asarray(smooth(0.003, i).at(times)) / units(PLAIN) for i in (False, True))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


def test_regularised_field():
    """The motion obeys Eq. 39 with tanh(v/eps): its own derivative by time, in SI units."""
    m, eps = PLAIN, 0.01
    found = smooth(eps)
    k = np.arange(5, 150, 12)
    x_1, x_2, v_1, v_2 = np.asarray(found.states)[k].T
    t, h = np.asarray(found.times)[k], 1e-4 / omega(m)
    around = [np.asarray(found.at(t + n * h))[:, 2:].T for n in (-2, -1, 1, 2)]
    rates = (around[0] - 8 * around[1] + 8 * around[2] - around[3]) / (12 * h)
    f, drop = m.F / np.sqrt(2), m.mu_s - m.mu_m

    def mu(v):
        return m.mu_s * np.tanh(v / eps) - 1.5 * drop * v / m.v_m + 0.5 * drop * (v / m.v_m) ** 3

    first = f + mu(m.V - v_1) * m.K_n * x_2 - 2 * m.xi_1 * m.omega_1 * m.m * v_1
    second = -f - mu(m.V - v_2) * m.K_t * x_1 - 2 * m.xi_2 * m.omega_2 * m.m * v_2
    first -= (m.m * m.omega_1**2 + m.K_t) * x_1
    second -= (m.m * m.omega_2**2 + m.K_n) * x_2
    truth = np.array([first, second]) / m.m
    np.testing.assert_allclose(rates, truth, rtol=0, atol=3e-3 * abs(truth).max())


def test_regularised_out_of_steps():
    """max_steps bounds a regularised motion as well."""
    values, _ = derivative_case()
    arguments = scene_of(PLAIN), values[3:7], 30 * values[7]
    found = fj.simulate(*arguments, regularisation=0.003, throw=False)
    assert found.result == fj.SimulationResult.out_of_steps
    assert values[7] < found.times[-1] < 30 * values[7]
    with pytest.raises(RuntimeError, match="max_steps were used up"):
        fj.simulate(*arguments, regularisation=0.003)
