"""Motions and periodic orbits under a harmonic force.

Truth: tests/hybrid_truth.py with f(t), which knows nothing of the degree of freedom that stands for
the force here, and the linear response in closed form.
"""

import copy
import functools
import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from hybrid_truth import Mechanism, forced_cycle, simulate
from mechanisms import PROBLEMS, changed
from structures import of_problem
from tools import both_modes, primitives, reference_scene, refusals

SLOW = pytest.mark.slow
BELT, START = PROBLEMS["papangelo_2017"], [1.5, 0.0]
FREE = 0.15548755708948883  # Hz, of its limit cycle without excitation
LIFT, LIFT_FREE = PROBLEMS["lift_off"], 0.349007596944771
# The belt with the constant coefficient 0.5, by the same law.
PLAIN = changed(BELT, ["joints.0.friction.mu_s", "joints.0.friction.mu_d"], [0.5, 0.5])
T0, T1, TIMES = 1.3, 25.0, np.linspace(1.3, 25.0, 12)


def forced(problem, amplitude, frequency, phase) -> Mechanism:
    """The mechanism of the other solver, with its force as a function of time."""
    a, phi = np.asarray(amplitude, float), np.broadcast_to(phase, np.shape(amplitude))

    def force(t):
        return a * np.cos(2 * np.pi * frequency * np.asarray(t)[..., None] + phi)

    return replace(Mechanism.of(problem), force=force)


def motion(problem, excitation, **options):
    return fj.simulate(of_problem(problem), START, T1, t0=T0, excitation=excitation, **options)


def response(problem, amplitude, frequency, phase, push):
    """Complex amplitudes X of x = mean + Re X exp(i Omega t) without switches, and the mean."""
    M, C, K = (np.array(problem[name], float) for name in "MCK")
    Omega = 2 * np.pi * frequency
    X = np.linalg.solve(
        K - Omega**2 * M + 1j * Omega * C, np.asarray(amplitude) * np.exp(1j * np.asarray(phase))
    )
    return X, np.linalg.solve(K, push)


# --- motions ------------------------------------------------------------------------------


def agree(problem, start, amplitude, frequency, phase, found):
    """The same switches of the first face at the same times, and the same states at TIMES."""
    truth = simulate(forced(problem, amplitude, frequency, phase), start, T1, t0=T0)
    switched = [(p.t1, p.mode[0] % 7, q.mode[0] % 7) for p, q in itertools.pairwise(truth)]
    switched = [s for s in switched if s[1] != s[2]]
    own = [(t, a % 7, b % 7) for t, face, a, b in found.switches() if face == 1]
    assert [s[1:] for s in own] == [s[1:] for s in switched] and len(own) > 3
    np.testing.assert_allclose([s[0] for s in own], [s[0] for s in switched], rtol=0, atol=1e-9)
    states = [next(p for p in truth if p.t0 <= t <= p.t1).dense(t) for t in TIMES]
    np.testing.assert_allclose(found.at(TIMES), states, rtol=0, atol=1e-8)
    assert found.states.shape[1] == len(start) and float(found.times[0]) == T0


@pytest.mark.slow
def test_motion():
    """Stick and slip from t0 on; the phase counts from the time 0."""
    arguments = [0.7], 0.17, 0.3
    agree(BELT, START, *arguments, motion(BELT, fj.Excitation(*arguments)))


@SLOW
def test_motion_and_orbit_with_lift_off():
    """Two degrees of freedom with a phase each."""
    arguments = [0.5, 0.8], 0.21, [0.2, -1.1]
    given = fj.Excitation({1: 0.8, 0: 0.5}, 0.21, [-1.1, 0.2])
    found = fj.simulate(of_problem(LIFT), LIFT["start"], T1, t0=T0, excitation=given)
    agree(LIFT, LIFT["start"], *arguments, found)
    # A subharmonic of two degrees of freedom.
    arguments = [0.3, 0.3], 2 * LIFT_FREE, 0.3
    found = fj.limit_cycle(of_problem(LIFT), LIFT["start"], excitation=fj.Excitation(*arguments))
    assert int(found.returns) == 2 and 0.5 < float(found.open_fraction[0]) < 0.6
    same(LIFT, found, forced_cycle(forced(LIFT, *arguments), found.state, 1 / LIFT_FREE, settle=30))


@pytest.mark.slow
def test_linear_motion():
    """Without switches: the particular solution and a free decay from the start at t0."""
    a, f, phase = [0.3], 0.22, [0.8]
    found = motion(PLAIN, fj.Excitation(a, f, phase))
    X, mean = response(PLAIN, a, f, phase, np.array([0.5]))

    def steady(t):
        z = X * np.exp(2j * np.pi * f * t)
        return np.concatenate([mean + z.real, (2j * np.pi * f * z).real])

    A = np.array([[0.0, 1.0], [-1.0, -0.1]])
    truth = [
        steady(t) + scipy.linalg.expm(A * (t - T0)) @ (np.array(START) - steady(T0)) for t in TIMES
    ]
    assert not found.switches()
    np.testing.assert_allclose(found.at(TIMES), truth, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_saveat():
    """Only these times, and the same states."""
    given = fj.Excitation([0.7], 0.17, 0.3)
    whole, found = motion(BELT, given), motion(BELT, given, saveat=TIMES)
    np.testing.assert_array_equal(found.times, TIMES)
    np.testing.assert_allclose(found.states, whole.at(TIMES), rtol=1e-14)
    phases = simulate(forced(BELT, [0.7], 0.17, 0.3), START, T1, t0=T0)
    modes = [next(p for p in phases if p.t0 <= t <= p.t1).mode[0] for t in TIMES]
    np.testing.assert_array_equal(found.contact_states[:, 0], modes)
    assert {0, 1} <= set(modes)
    np.testing.assert_allclose(found.end, whole.end, rtol=1e-14)
    for call in (lambda: found.at(TIMES), found.switches):
        with pytest.raises(ValueError, match="a simulation with saveat"):
            call()


@SLOW
def test_saveat_of_a_motion_cut_short():
    """What was not reached is NaN."""
    given = fj.Excitation([0.7], 0.17, 0.3)
    found = motion(BELT, given, saveat=TIMES)
    short = motion(BELT, given, saveat=TIMES, max_steps=64, throw=False)
    assert short.result == fj.SimulationResult.out_of_steps
    reached = np.array([np.isfinite(state).all() for state in np.asarray(short.states)])
    assert reached[0] and not reached[-1]
    np.testing.assert_allclose(short.states[reached], found.states[reached], rtol=1e-12)


@SLOW
def test_motion_and_orbit_of_a_scene():
    """A scene's matrices are diagonal and its faces its degrees of freedom; a structure's not."""
    scene, start, t1 = reference_scene(), [1e-6, 2e-6, 0.1, 0.0], 5e-4
    given = fj.Excitation({"x2": 300.0, "x1": 200.0}, 2500.0, (0.4, 0.1))
    found = [fj.simulate(x, start, t1, excitation=given).end
             for x in (scene, fj.Structure.from_scene(scene))]  # fmt: skip
    still = fj.simulate(scene, start, t1).end
    scale = np.array([1e-6, 1e-6, 0.1, 0.1])
    np.testing.assert_allclose(found[0] / scale, found[1] / scale, rtol=0, atol=1e-8)
    assert (abs(found[0] - still) / scale).max() > 0.1
    # Entrained by a force along the belt: the event-driven motion closes after its period.
    scene, f = reference_scene(), 3092.0
    given = fj.Excitation({"x1": 400.0}, f)
    found = fj.limit_cycle(scene, excitation=given, segments=512)
    np.testing.assert_allclose(found.period * f, 1, rtol=1e-12)
    again = fj.simulate(scene, found.state, float(found.period), excitation=given)
    scale = np.array([1e-6, 1e-6, 0.1, 0.1])
    np.testing.assert_allclose(again.end / scale, found.state / scale, rtol=0, atol=1e-8)
    assert len(again.switches()) >= 2 and (abs(found.multipliers) < 1).all()


@SLOW
def test_derivatives_of_a_motion():
    """Of the end by force, frequency, phase, t0, t1 and P, through stick, in both modes."""
    values = np.array([0.7, 0.17, 0.3, T0, T1, 1.0])

    def problem(x):
        return changed(BELT, ["joints.0.P"], x[5:])

    def outputs(x):
        excitation = fj.Excitation(x[:1], x[1], x[2])
        found = fj.simulate(of_problem(problem(x)), START, x[4], t0=x[3], excitation=excitation)
        return jnp.append(found.end, found.at(x[3:4] + 20.0)[0])

    def truth(x):
        trip = simulate(forced(problem(x), x[:1], *x[1:3]), START, x[4], t0=x[3], rtol=1e-13)
        inside = next(p for p in trip if p.t1 >= x[3] + 20)
        return np.append(trip[-1].end, inside.dense(x[3] + 20))

    expected = _differences(truth, values, 1e-5)
    _, *slopes = jax.jit(lambda x: both_modes(outputs, x))(jnp.asarray(values))
    for slope in slopes:
        np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-6)


def _differences(function, x, h):
    """Central differences (outputs, inputs) of fourth order."""
    columns = []
    for step in h * np.eye(len(x)):
        near, far = (
            (function(x + k * step) - function(x - k * step)) / (2 * k * h) for k in (1, 2)
        )
        columns.append(near + (near - far) / 3)
    return np.array(columns).T


# --- periodic orbits ----------------------------------------------------------------------


@functools.cache
def belt_cycle(a, ratio):
    """With as many segments as the longest needs: one program."""
    return fj.limit_cycle(
        of_problem(BELT), START, excitation=fj.Excitation([a], ratio * FREE, 0.3), segments=512
    )


def same(problem, found, truth):
    """Period, amplitudes, velocities, shares, state and multipliers."""
    assert found.result == fj.CycleResult.converged and truth.kind == "cycle"
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=3e-9)
    close(found.amplitude, truth.amplitude)
    close(found.velocity_min, truth.velocity_min)
    close(found.velocity_max, truth.velocity_max)
    close(found.stick_fraction, truth.stick_fraction)
    close(found.open_fraction, truth.open_fraction)
    close(found.state, truth.state)
    multipliers = np.sort(abs(np.asarray(found.multipliers)))
    assert multipliers.shape == found.state.shape
    np.testing.assert_allclose(multipliers, np.sort(abs(truth.multipliers)), atol=1e-6)


@SLOW
@pytest.mark.parametrize(
    ("a", "ratio", "returns"),
    [(0.3, 1.0, 1), (1.0, 1.05, 1), (0.3, 2.0, 2), (0.3, 3.0, 3), (3.0, 0.5, 2), (1.0, 3.1, 3)],
)
def test_orbit(a, ratio, returns):
    """With stick and without, harmonic and subharmonic; the period is that of the force."""
    found = belt_cycle(a, ratio)
    assert int(found.returns) == returns
    np.testing.assert_allclose(found.period, returns / (ratio * FREE), rtol=1e-12)
    machine = forced(BELT, [a], ratio * FREE, 0.3)
    same(BELT, found, forced_cycle(machine, found.state, returns / (ratio * FREE), settle=30))
    # The motion from `state` is the orbit.
    given = fj.Excitation([a], ratio * FREE, 0.3)
    t1 = float(found.period)
    again = fj.simulate(of_problem(BELT), found.state, t1, excitation=given)
    np.testing.assert_allclose(again.end, found.state, rtol=0, atol=1e-8)
    times, states = found.orbit(7)
    np.testing.assert_allclose(states, again.at(times), rtol=0, atol=1e-8)


@pytest.mark.parametrize(("ratio", "mu"), [(0.8, 0.4), (0.6, 0.2), (0.9, 0.6), (1.2, 0.4)])
def test_an_orbit_attracts_where_its_multipliers_are_below_one(ratio, mu):
    """An undamped oscillator under dry friction; the excitation's multiplier 1 is none of its."""
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=0.5), fj.Coulomb(mu), [1.0], V=0.1, preload=True)
    oscillator = fj.Structure([[1.0]], [[0.0]], [[1.0]], [joint])
    force = fj.Excitation([1.0], ratio / (2 * np.pi))
    cycle = fj.limit_cycle(oscillator, [2.5, 0.0], excitation=force, throw=False)
    assert cycle.result == fj.CycleResult.converged
    assert 0.1 < np.abs(cycle.multipliers).max() < 0.95


@SLOW
def test_linear_orbit():
    """Where nothing switches it is the linear response, also close to resonance."""
    for f, a in ((0.1, 0.5), (0.16, 0.05), (0.7, 2.0)):
        given = fj.Excitation([a], f, [0.8])
        found = fj.limit_cycle(of_problem(PLAIN), START, excitation=given)
        X, mean = response(PLAIN, [a], f, [0.8], np.array([0.5]))
        np.testing.assert_allclose(found.amplitude, 2 * abs(X), rtol=1e-8)
        state = mean[0] + X[0].real, (2j * np.pi * f * X[0]).real
        np.testing.assert_allclose(found.state, state, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.period, 1 / f, rtol=1e-12)
        known = np.exp(np.array([-0.05 + 1j * np.sqrt(1 - 0.05**2)] * 2) / f)
        np.testing.assert_allclose(abs(found.multipliers), abs(known), rtol=1e-8)
        assert int(found.returns) == 1 and float(found.stick_fraction[0]) == 0


@SLOW
@pytest.mark.parametrize(("a", "ratio", "returns"), [(0.3, 1.0, 1), (0.3, 2.0, 2)])
def test_derivatives_of_an_orbit(a, ratio, returns):
    """By force, frequency, phase and P, in both modes, compiled."""
    start = belt_cycle(a, ratio).state
    values = np.array([a, ratio * FREE, 0.3, 1.0])

    def problem(x):
        return changed(BELT, ["joints.0.P"], x[3:])

    def outputs(x):
        given = fj.Excitation(x[:1], x[1], x[2])
        found = fj.limit_cycle(of_problem(problem(x)), start, excitation=given, throw=False)
        rest = found.amplitude, found.stick_fraction, found.state, abs(found.multipliers[:1])
        return jnp.concatenate([found.period[None], *rest])

    def truth(x):
        found = forced_cycle(forced(problem(x), *x[:3][:, None]), start, returns / x[1], 30, 1e-13)
        rest = found.amplitude, found.stick_fraction, found.state, abs(found.multipliers[:1])
        return np.concatenate([[returns / x[1]], *rest])

    expected = _differences(truth, values, 1e-4)
    _, *slopes = jax.jit(lambda x: both_modes(outputs, x))(jnp.asarray(values))
    for slope in slopes:
        np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-5)


@SLOW
def test_many_orbits():
    """A resonance curve by `jax.vmap` under `jax.jit` is that of one after the other."""

    def amplitude(ratio):
        given = fj.Excitation([0.3], ratio * FREE, 0.3)
        found = fj.limit_cycle(of_problem(BELT), START, excitation=given, throw=False)
        return found.amplitude[0], found.returns

    ratios = jnp.array([0.5, 1.0, 2.0, 2.1, 3.0])
    amplitudes, returns = jax.jit(jax.vmap(amplitude))(ratios)
    for k in (0, 1, 2, 4):
        alone = belt_cycle(0.3, float(ratios[k]))
        np.testing.assert_allclose(amplitudes[k], alone.amplitude[0], rtol=1e-9)
        assert int(returns[k]) == int(alone.returns)
    assert np.isnan(amplitudes[3])  # quasi-periodic


@SLOW
def test_attractors():
    """From two starts the one motion under a strong force."""
    given = fj.Excitation([1.0], FREE, 0.3)
    (found,) = fj.attractors(of_problem(BELT), [START, [0.0, 0.0]], excitation=given)
    np.testing.assert_allclose(found.amplitude, belt_cycle(1.0, 1.0).amplitude, rtol=1e-9)


# --- structure and refusals ---------------------------------------------------------------


def test_what_is_not_excited_and_what_cannot_be():
    """No cosine is traced, nor another degree of freedom; a phase is data, not structure."""

    def trace(excitation):
        call = functools.partial(motion, BELT, throw=False)
        return primitives(jax.make_jaxpr(lambda e: call(e).end)(excitation).jaxpr)

    assert "cos" not in trace(None)
    assert trace(fj.Excitation([0.7], 0.17))["cos"] > 0
    one, other = fj.Excitation({0: 0.7}, 0.17), fj.Excitation({0: 0.1}, 0.3, 1.0)
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert copy.copy(one).dofs == (0,)
    scene, start = reference_scene(), np.zeros(4)
    for dof, has, error in (
        ("x3", "x1, x2", ValueError),
        (2, "0, 1", ValueError),
        (True, "", TypeError),
    ):
        with pytest.raises(error, match=f"degree of freedom .*{has}"):
            fj.simulate(scene, start, 1.0, excitation=fj.Excitation({dof: 1.0}, 1.0))
    with pytest.raises(ValueError, match="one degree of freedom twice"):
        fj.simulate(scene, start, 1.0, excitation=fj.Excitation({0: 1.0, "x1": 1.0}, 1.0))
    with pytest.raises(TypeError, match="excitation must be an Excitation, got 3"):
        fj.limit_cycle(scene, excitation=3)  # pyright: ignore[reportArgumentType]


test_refusals = refusals(
    [
        (([1.0, 2.0], 1.0), r"amplitude of the excitation must have shape \(1,\), got \(2,\)"),
        ((1.0, 1.0), r"amplitude of the excitation must have shape \(1,\), got \(\)"),
        (([1.0], 1.0, [0.0, 0.0]), r"phase of the .* shape \(\) or \(1,\), got \(2,\)"),
        (([1.0], 0.0), "frequency must be above 0, got 0.0"),
        (([1.0], np.ones(1)), r"frequency must be a single number, got shape \(1,\)"),
        (([np.nan], 1.0), "amplitude must be finite, got nan"),
        (({}, 1.0), "amplitude must hold at least one degree of freedom"),
        (({"x9": 1.0}, 1.0), "unknown degree of freedom 'x9'; the structure has no names"),
        (({1: 1.0}, 1.0), "unknown degree of freedom 1; the structure has 0"),
        (({0: np.inf}, 1.0), "amplitude at 0 must be finite, got inf"),
    ],
    lambda arguments: motion(BELT, fj.Excitation(*arguments)),
    pattern="^{}",
)


test_refused_times = refusals(
    [
        ({"t0": 30.0}, "t1 must be above 30, got 25.0"),
        ({"t0": np.nan}, "t0 must be finite, got nan"),
        ({"saveat": [2.0, 1.5]}, r"saveat must be in order from t0 to t1, got array\(\[2. , 1.5\]"),
        ({"saveat": [1.0]}, "saveat must be in order from t0 to t1"),
        ({"saveat": [26.0]}, "saveat must be in order from t0 to t1"),
        ({"saveat": 2.0}, r"saveat must have shape \(k,\) with k at least 1, got \(\)"),
        ({"saveat": []}, r"saveat must have shape \(k,\) with k at least 1, got \(0,\)"),
    ],
    lambda bad: fj.simulate(of_problem(BELT), START, T1, **{"t0": T0} | bad),
    pattern="^{}",
)
