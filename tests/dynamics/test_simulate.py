"""The motion from a start, against DOP853 event by event and against motions in closed form."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
import hybrid_truth
from mechanisms import PLAIN, source_form
from tools import both_modes, refusals, scene_of, state_matrix

LONG = 40.0  # in 1/omega: some 170 steps
TIMES = 60  # at which a motion is compared
RESULT = fj.SimulationResult


# One number of steps for all: each friction law is compiled once.
simulate = functools.partial(fj.simulate, max_steps=256)


def motion(m, start, t1, rtol=None) -> fj.Trajectory:
    scene = scene_of(m)
    if m["mu_m"] == m["mu_s"]:
        scene = scene.replace(friction=fj.Coulomb(m["mu_s"]))
    return simulate(scene, start, t1, rtol=rtol)


def run(m, start, t1, rtol=1e-12) -> list[hybrid_truth.Phase]:
    """The motion of the other solver."""
    return hybrid_truth.simulate(hybrid_truth.Mechanism.of(source_form(**m)), start, t1, rtol)


def omega(m) -> float:
    return float(np.sqrt(m["omega_1"] ** 2 + m["omega_2"] ** 2 + (m["K_n"] + m["K_t"]) / m["m"]))


def units(m) -> np.ndarray:
    """SI units of a state of order one."""
    return m["V"] * np.array([1 / omega(m), 1 / omega(m), 1, 1])


def switches(phases):
    """(time, direction, before, after) of every switch in the other solver's phases."""
    return [
        (p.t1, i + 1, p.mode[i], q.mode[i])
        for p, q in itertools.pairwise(phases)
        for i in (0, 1)
        if p.mode[i] != q.mode[i]
    ]


def agree(m, start, duration=LONG, *, ends=1e-9, times=1e-10):
    """Simulate from a start of order one over a time in 1/omega; compare with the other solver.

    Returns both motions. `times` is relative to the duration, `ends` to the size of the motion.
    """
    start, t1 = np.array(start) * units(m), duration / omega(m)
    found, truth = motion(m, start, t1), run(m, start, t1)
    expected = switches(truth)
    assert [s[1:] for s in found.switches()] == [s[1:] for s in expected]
    found_times, true_times = ([s[0] for s in x] for x in (found.switches(), expected))
    np.testing.assert_allclose(found_times, true_times, rtol=0, atol=times * t1)
    end = truth[-1].end / units(m)
    size = max(1, abs(end).max())
    np.testing.assert_allclose(found.end / units(m), end, rtol=0, atol=ends * size)
    np.testing.assert_allclose(found.times[-1], t1, rtol=1e-14)
    np.testing.assert_array_equal(found.contact_states[0], truth[0].mode)
    assert (np.diff(found.times) >= 0).all()
    return found, truth


# --- against the other solver -------------------------------------------------------------


def random_case(seed):
    """A mechanism and a start; two of three starts are on the belt in one direction."""
    rng = np.random.default_rng(seed)
    mu_s, K_n = rng.uniform(0.2, 0.6), rng.uniform(1.5e8, 6e8)
    mechanism = PLAIN | {
        "K_n": K_n,
        "K_t": rng.uniform(0.2, 0.75) * K_n,
        "V": rng.uniform(0.05, 0.3),
        "mu_s": mu_s,
        "mu_m": mu_s * rng.uniform(0.4, 0.9),
        "v_m": rng.uniform(0.3, 0.8),
        "F": rng.choice([-1, 1]) * 10 ** rng.uniform(0, 3.5),
        "m": rng.uniform(0.5, 2),
        "xi_2": rng.uniform(0, 0.05),
    }
    start = 1.2 * rng.normal(size=4)
    if seed % 3:
        start[1 + seed % 3] = 1
    return mechanism, start


@pytest.mark.slow
def test_random_motions():
    """The same switches at the same times and the same end, through every contact state but one.

    That one, stick in both directions, has a test of its own.
    """
    seen = set()
    for seed in (2, 4, 10, 13, 15, 17, 21, 22):
        found, truth = agree(*random_case(seed))
        assert len(found.switches()) > 12
        seen |= {p.mode for p in truth}
    assert seen == set(itertools.product((1, 0, -1), repeat=2)) - {(0, 0)}


def coulomb(seed):
    m, start = random_case(seed)
    return m | {"mu_m": m["mu_s"]}, start


BOTH_STICK = PLAIN | {"K_n": 5.35e8, "K_t": 2.768e8, "V": 0.0672, "F": -2860.0}
BOTH_STICK |= {"mu_s": 0.321, "mu_m": 0.275}
LOADED = PLAIN | {"K_t": 0.0, "F": -300.0}
STEEP = PLAIN | {"v_m": 0.05}
STEEPER = PLAIN | {"V": 0.005, "F": -6000.0, "v_m": 0.008, "mu_s": 0.3, "mu_m": 0.16}
CASES = {  # mechanism, start, duration, fewest switches
    **{f"Coulomb {seed}": (*coulomb(seed), LONG, 3) for seed in (1, 2, 3)},
    # Every step is shortened by friction, and once more by the end.
    "steep friction": (STEEP, [0.5, -0.5, 0.2, 0.3], 1e-4 * omega(STEEP), 0),
    # A step of the usual length would miss it by 1e-7.
    "friction steep within a step": (STEEPER, [0.0, -0.1, 1.0, 0.16], 0.2, 0),
    "K_t = 0": (LOADED, [0.5, 1.5, 1.0, -1.0], LONG, 4),
    **{f"one step of {h}": (PLAIN, [0.5, -0.3, 0.4, 0.2], h, 0) for h in (1e-6, 0.01, 0.2)},
    **{
        f"on the belt {x}, {v}": (PLAIN, [*x, *v], 8.0, 0)
        for x in [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (0.1, 0.5)]
        for v in [(1.0, 1.0), (1.0, -0.3), (0.2, 1.0)]
    },
}


@pytest.mark.parametrize("case", CASES)
def test_special_motions(case):
    mechanism, start, duration, fewest = CASES[case]
    found, _ = agree(mechanism, start, duration)
    assert len(found.switches()) >= fewest
    assert not case.startswith("one step") or (np.diff(found.times) > 0).sum() == 1


def test_stick_in_both_directions_and_a_short_slip():
    """Both directions stick at once, and let go one by one."""
    m, f = BOTH_STICK, BOTH_STICK["F"] / np.sqrt(2)
    # Where the springs alone would hold the mass: both loads press it on the belt.
    V, K_1, K_2 = m["V"], m["omega_1"] ** 2 + m["K_t"], m["omega_2"] ** 2 + m["K_n"]
    found, truth = agree(m, np.array([f / K_1, -f / K_2, V, V]) / units(m))
    assert truth[0].mode == (0, 0) and len(found.switches()) >= 3
    stuck = (np.asarray(found.contact_states) == 0).all(axis=1)
    np.testing.assert_allclose(found.states[stuck, 2:], V, rtol=1e-15)
    # The design of the README once made a step backwards in time here.
    scene = fj.brake_scene().replace(D=2.4319698833358783, G=1.2340705508799051e-10)
    K_n, K_t = map(float, fj.stiffness(scene))
    parts = vars(scene.oscillator) | vars(scene.friction)
    m = {"K_n": K_n, "K_t": K_t} | {name: float(value) for name, value in parts.items()}
    start = [-4.25546516e-06, 1.14128067e-06, 0.116792001, 0.187975114] / units(m)
    agree(m, start, 0.8 / 52283.1 * omega(m), ends=1e-10)


@pytest.mark.slow
def test_start_beside_the_belt():
    """Velocities a few ulp, or up to 1e-6, off the belt's: no root behind the start is taken."""
    rng, reversals = np.random.default_rng(0), 0
    for k in range(60):
        m, start = random_case(k)[0], 1.2 * rng.normal(size=4)
        for i in ((2,), (3,), (2, 3))[k % 3]:
            ulps = rng.choice([1, 2, 10]) * np.finfo(float).eps
            start[i] = 1 + rng.choice([-1, 1]) * (ulps if k % 2 else 10 ** rng.uniform(-15, -6))
        start, t1 = start * units(m), 3 / omega(m)
        found, truth = motion(m, start, t1, 1e-12), run(m, start, t1, 1e-13)
        assert (np.diff(found.times) >= 0).all()
        end = truth[-1].end / units(m)
        size = max(1, abs(end).max())
        np.testing.assert_allclose(found.end / units(m), end, rtol=0, atol=1e-10 * size)
        reversals += len(truth) > 2
    assert reversals > 10


GRAZING = {  # start, and how much more x2 than there only just meets v_i = 0
    "stick, from below": ([-1.0, 1.4, 0.0, -0.4], 0.275109844501594),
    "stick in 2": ([1.6, 0.3, 0.2, -0.3], 0.212690333886485),
    "reversal of 1": ([0.2, 0.6, -1.2, 1.8], 0.272568646727768),
    "reversal of 2": ([-1.3, 0.3, 0.1, -1.1], 0.179861399543233),
    "reversal of 2 while 1 slips back": ([-1.3, -0.5, 3.9, 0.9], 0.010415209373468),
}


@pytest.mark.parametrize("case", GRAZING)
def test_grazing(case):
    """A sliding velocity that only just does, or does not, reach zero: both are followed."""
    start, more = GRAZING[case]
    for distance in (1e-3, 1e-5, 1e-7, 1e-9):
        counts = []
        for side in (-1, 1):
            moved = np.add(start, [0, more + side * distance, 0, 0])
            # The zeros of a parabola are known only to the root of the error of its depth.
            found, _ = agree(PLAIN, moved, 10.0, ends=1e-8, times=1e-8)
            counts.append(len(found.switches()))
        assert abs(counts[0] - counts[1]) == 2


# --- closed forms -------------------------------------------------------------------------


def test_mass_on_the_belt():
    """A constant load: stick at V until the spring reaches the friction limit, then slip."""
    m, f, V = LOADED, LOADED["F"] / np.sqrt(2), LOADED["V"]
    K_1, x_2 = m["omega_1"] ** 2, -f / (m["omega_2"] ** 2 + m["K_n"])
    load = m["K_n"] * x_2
    assert load > 0
    damping = 2 * m["xi_1"] * m["omega_1"] * V
    first, last = f / K_1, (f - damping + m["mu_s"] * load) / K_1
    leaves = (last - first) / V
    found = motion(m, [first, x_2, V, 0.0], 1.2 * leaves)
    (time, *switch), *more = found.switches()
    assert switch == [1, 0, 1] and not more and 0 < found.end[2] < V
    np.testing.assert_allclose(time, leaves, rtol=1e-12)
    t = np.linspace(0, leaves, TIMES)
    x = found.at(t)
    np.testing.assert_allclose(x[:, 0], first + V * t, rtol=0, atol=1e-13 * abs(last))
    np.testing.assert_allclose(x[:, 1], x_2, rtol=1e-12)
    np.testing.assert_allclose(x[:, 2], V, rtol=1e-14)


def test_linear_motion():
    """Coulomb friction without a switch is a linear equation: the matrix exponential."""
    m = PLAIN | {"mu_s": 0.3, "mu_m": 0.3, "F": 300.0}  # the equilibrium attracts
    matrix, force = state_matrix(scene_of(m).oscillator, 0.3, m["K_n"], m["K_t"]), np.zeros(4)
    force[2:] = np.array([1, -1]) * m["F"] / np.sqrt(2)
    equilibrium = np.linalg.solve(matrix, -force)
    start = equilibrium + 0.1 * units(m) * [1, -2, 0.5, 1]
    found = motion(m, start, LONG / omega(m))
    assert found.switches() == [] and np.max(found.states[:, 2:]) < m["V"]
    for t, state in zip(found.times[::20], found.states[::20], strict=True):
        truth = equilibrium + scipy.linalg.expm(matrix * float(t)) @ (start - equilibrium)
        np.testing.assert_allclose(state / units(m), truth / units(m), rtol=0, atol=2e-11)


def test_free_oscillators():
    """No contact, no damping: two oscillators, each with its own energy, whatever they switch."""
    m = PLAIN | dict.fromkeys(("K_n", "K_t", "xi_1", "xi_2", "F"), 0.0)
    start = np.array([1.5, -0.7, 0.4, 1.3]) * units(m)
    found = motion(m, start, LONG / omega(m))
    assert len(found.switches()) > 8
    for i, rate in enumerate((m["omega_1"], m["omega_2"])):
        t, x, v = found.times, start[i], start[2 + i]
        truth = x * np.cos(rate * t) + v / rate * np.sin(rate * t)
        np.testing.assert_allclose(found.states[:, i], truth, rtol=0, atol=1e-10 * units(m)[i])
        energy = (rate * found.states[:, i]) ** 2 + found.states[:, 2 + i] ** 2
        np.testing.assert_allclose(energy, energy[0], rtol=1e-10)


def test_error_follows_rtol():
    """The error stays below rtol and falls with it."""
    t1, start = 20 / omega(PLAIN), np.array([1.0, 0.2, 0.3, 0.1]) * units(PLAIN)
    truth = run(PLAIN, start, t1, rtol=1e-13)[-1].end / units(PLAIN)
    rtols = np.array([1e-7, 1e-9, 1e-11])
    ends = [motion(PLAIN, start, t1, rtol).end for rtol in rtols]
    errors = [abs(end / units(PLAIN) - truth).max() for end in ends]
    assert (errors < rtols).all() and errors[0] > 20 * errors[1] > 20 * errors[2], errors


# --- the trajectory -----------------------------------------------------------------------


def test_trajectory():
    """`at` between steps, at switches and at both ends; unused steps repeat the last state."""
    m, start = random_case(4)
    found, truth = agree(m, start)
    t1 = LONG / omega(m)
    times = np.sort([0.0, *np.random.default_rng(0).uniform(0, t1, TIMES - 2), t1])
    for t, state in zip(times, np.asarray(found.at(times)), strict=True):
        phase = next(p for p in truth if t <= p.t1 * (1 + 1e-15))
        expected = phase.dense(min(t, phase.t1))
        np.testing.assert_allclose(state / units(m), expected / units(m), rtol=0, atol=1e-9)
    times, states, contact = (
        np.asarray(x) for x in (found.times, found.states, found.contact_states)
    )
    steps = np.flatnonzero(np.diff(times) > 0)[-TIMES:]
    np.testing.assert_allclose(found.at(times[steps]), states[steps], rtol=1e-15)
    np.testing.assert_allclose(states[0], start * units(m), rtol=1e-15)
    used = int((np.diff(times) > 0).sum())
    assert used < len(times) - 1 and set(contact.flat) <= {-1.0, 0.0, 1.0}
    assert (states[used:] == states[used]).all() and (states[-1] == found.end).all()
    sliding = 1 - states[:, 2:] / m["V"]
    assert (contact * sliding >= -1e-12).all() and (abs(sliding[contact == 0]) < 1e-12).all()


@pytest.mark.slow
def test_many_starts():
    """`jax.vmap` over starts gives what one start after the other gives."""
    starts, t1 = np.random.default_rng(6).normal(size=(4, 4)) * units(PLAIN), 6 / omega(PLAIN)
    together = jax.jit(jax.vmap(lambda start: simulate(scene_of(PLAIN), start, t1)))
    found = together(starts)
    for k, start in enumerate(starts):
        alone = motion(PLAIN, start, t1)
        n = len(alone.times)
        moved = np.asarray(found.states[k, :n] - alone.states) / units(PLAIN)
        np.testing.assert_allclose(moved, 0, atol=1e-12)
        np.testing.assert_array_equal(found.contact_states[k, :n], alone.contact_states)


@pytest.mark.slow
def test_ends():
    """max_steps used up, or no bound: told or raised; what was reached is part of the motion."""
    m, start = random_case(1)
    start, t1 = start * units(m), 2 * LONG / omega(m)
    short = simulate(scene_of(m), start, t1, throw=False)
    assert short.result == RESULT.out_of_steps and short.times.shape == (257,)
    assert LONG / omega(m) < short.times[-1] < t1
    whole = np.asarray(motion(m, start, LONG / omega(m)).states)[:100]
    moved = (np.asarray(short.states)[:100] - whole) / units(m)
    np.testing.assert_allclose(moved, 0, atol=1e-13)
    with pytest.raises(RuntimeError, match=r"^max_steps were used up before the end time$"):
        simulate(scene_of(m), start, t1)
    start = [6e-4, 0.0, 0.0, 0.0]  # 80 V/omega
    found = fj.simulate(scene_of(PLAIN), start, 0.02, throw=False)
    assert found.result == RESULT.diverged and found.times[-1] < 0.02
    assert np.isfinite(found.states).all() and abs(found.end / units(PLAIN)).max() > 1e3
    with pytest.raises(RuntimeError, match=r"^the motion grew beyond all bounds$"):
        fj.simulate(scene_of(PLAIN), start, 0.02)
    # max_steps bounds a regularised motion as well.
    arguments = scene_of(PLAIN), VALUES[3:7], 30 * VALUES[7]
    found = fj.simulate(*arguments, regularisation=0.003, throw=False)
    assert found.result == RESULT.out_of_steps
    assert VALUES[7] < found.times[-1] < 30 * VALUES[7]


@pytest.mark.slow
def test_single_precision():
    """float32 in, float32 out, to what it can hold."""
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), scene_of(PLAIN))
    start, t1 = np.array([1.0, 0.2, 0.3, 0.1]) * units(PLAIN), 10 / omega(PLAIN)
    found = fj.simulate(scene, jnp.asarray(start, jnp.float32), jnp.float32(t1))
    truth = run(PLAIN, start, t1)[-1].end / units(PLAIN)
    assert found.end.dtype == jnp.float32
    np.testing.assert_allclose(found.end / units(PLAIN), truth, rtol=0, atol=2e-3)


# --- derivatives --------------------------------------------------------------------------

BY = ("K_n", "mu_s", "V", "x1", "x2", "v1", "v2", "t1")
SWITCHES = 6
START = np.array([1.0, 0.2, 0.3, 0.1]) * units(PLAIN)
VALUES = np.array([*(PLAIN[name] for name in BY[:3]), *START, 20 / omega(PLAIN)])
SCALE = np.array([*VALUES[:3], *units(PLAIN), VALUES[-1]])


def differences():
    """End and times of switches, by `BY`: central differences with the other solver, scaled."""

    def outputs(x):
        m = PLAIN | dict(zip(BY, x[:3], strict=False))
        phases = run(m, x[3:7], x[7], rtol=3e-14)
        times = [s[0] for s in switches(phases)]
        assert len(times) == SWITCHES
        return np.array([*phases[-1].end / units(PLAIN), *np.array(times) * omega(PLAIN)])

    columns = []
    for step in np.diag(SCALE):
        wide, narrow = (
            (outputs(VALUES + h * step) - outputs(VALUES - h * step)) / (2 * h)
            for h in (2e-4, 1e-4)
        )
        columns.append(narrow + (narrow - wide) / 3)
    return np.array(columns).T


@pytest.mark.slow
def test_derivatives():
    """By `BY` in both modes, of the end and of every switch, through all of them."""
    kinds = {s[1:] for s in switches(run(PLAIN, VALUES[3:7], VALUES[7]))}
    assert {(1, 1, 0), (2, 1, 0), (1, 1, -1)} <= kinds

    def outputs(x):
        scene = scene_of(PLAIN).replace(**dict(zip(BY, x[:3], strict=False)))
        found = simulate(scene, x[3:7], x[7])
        changed = jnp.any(found.contact_states[1:] != found.contact_states[:-1], axis=1)
        (k,) = jnp.nonzero(changed, size=SWITCHES)
        times = found.times[k + 1] * omega(PLAIN)
        return jnp.concatenate([found.end / units(PLAIN), times])

    _, *slopes = jax.jit(lambda x: both_modes(outputs, x))(jnp.asarray(VALUES))
    truth = differences()
    for found in slopes:
        bound = {"rtol": 1e-7, "atol": 1e-7 * abs(truth).max()}
        np.testing.assert_allclose(np.asarray(found) * SCALE, truth, **bound)
        # What happens before the end does not depend on when it is.
        np.testing.assert_array_equal(found[4:, BY.index("t1")], 0)


# --- regularised --------------------------------------------------------------------------


@functools.cache
def smooth(eps):
    """The motion of the derivatives' case by the regularised law."""
    return fj.simulate(scene_of(PLAIN), VALUES[3:7], VALUES[7], regularisation=eps)


@pytest.mark.slow
def test_regularised_converges():
    """The distance to the exact motion, all along, falls with eps."""
    exact = motion(PLAIN, VALUES[3:7], VALUES[7])
    times, distances = np.linspace(0, VALUES[7], TIMES), []
    for eps in (0.03, 0.01, 0.003, 0.001):
        found = smooth(eps)
        assert found.result == RESULT.reached
        np.testing.assert_allclose(found.times[-1], VALUES[7], rtol=1e-14)
        apart = np.asarray(found.at(times) - exact.at(times)) / units(PLAIN)
        distances.append(abs(apart).max())
        np.testing.assert_allclose(found.at(times)[-1], found.end, rtol=0, atol=1e-14)
        sliding = PLAIN["V"] - np.asarray(found.states)[:, 2:]
        expected = np.where(abs(sliding) < eps, 0, np.sign(sliding))
        np.testing.assert_array_equal(found.contact_states, expected)
    ratios = np.array(distances[:-1]) / distances[1:]
    assert (ratios > 2).all() and distances[-1] < 0.03, distances


# --- refusals -----------------------------------------------------------------------------

GOOD = {"mechanism": scene_of(PLAIN), "start": [0.0, 0.0, 0.0, 0.0], "t1": 1e-3}


test_refusals = refusals(
    [
        ({"start": [0.0] * 3}, r"start must have shape \(4,\), got \(3,\)"),
        ({"start": 0.0}, r"start must have shape \(4,\), got \(\)"),
        (
            {"start": jnp.zeros((3, 4))},
            r"start must have shape \(4,\), got \(3, 4\); use jax.vmap for many",
        ),
        ({"start": [np.nan, 0, 0, 0]}, "start must be finite, got nan"),
        ({"t1": -1.0}, "t1 must be above 0, got -1.0"),
        ({"t1": np.inf}, "t1 must be above 0, got inf"),
        ({"t1": np.array([1e-3, 2e-3])}, r"t1 must be a single number, got shape \(2,\)"),
        ({"rtol": 0.5}, "rtol must be above 0 and at most 0.1, got 0.5"),
        ({"rtol": 1e-300}, "rtol must be at least 9.1e-13 in float64, got 1e-300"),
        ({"max_steps": 0}, "max_steps must be a whole number of at least 1, got 0"),
        ({"max_steps": True}, "max_steps must be a whole number of at least 1, got True"),
        ({"regularisation": -0.01}, "regularisation must be above 0, got -0.01"),
        (
            {"mechanism": scene_of(PLAIN).replace(F=jnp.ones(2))},
            r"F must be a scalar, got shape \(2,\); use jax.vmap for many scenes",
        ),
    ],
    lambda bad: fj.simulate(**GOOD | bad),
    pattern="^{}$",
)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 1.0], "^times must be from t0 to the end of the simulation, .*, got 1.0$"),
        ([-1e-9], "^times must be from t0 to the end of the simulation, .*, got -1e-09$"),
        ([np.nan], "^times must be finite, got nan$"),
        (1e-6, r"^times must have shape \(k,\), got \(\)"),
    ],
)
def test_times_outside(times, message):
    """Of the exact and of the regularised motion."""
    found = motion(PLAIN, VALUES[3:7], VALUES[7])
    for motion_of in (found, smooth(0.03)):
        with pytest.raises(ValueError, match=message):
            motion_of.at(times)
    states = jax.jit(lambda times: found.at(times))(jnp.array([1.0, 0.0]))
    assert np.isnan(states[0]).all()
    np.testing.assert_allclose(states[1], found.states[0], rtol=1e-14)
