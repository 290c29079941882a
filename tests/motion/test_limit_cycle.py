"""Limit cycles: the exact law against 40 digits and against an independent event-driven solver."""

import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from filippov import Mechanism, return_slopes
from fractaljax.base.parts import substitute
from tools import motionless_scene, reference_cycle, reference_scene

ROWS = json.loads((Path(__file__).parents[1] / "reference" / "cycle.json").read_text())["rows"]
CYCLES = [row for row in ROWS if row["kind"] == "cycle"]
INPUTS = ("K_n", "K_t", "mu_s", "V")
OUTPUTS = ("period", "amplitude_1", "amplitude_2", "stick_fraction_1", "stick_fraction_2")
OMEGA, V = 2e4, 0.15  # of the reference scene: lengths are in V/OMEGA


def scene_of(row):
    """The scene of a row; Coulomb friction is a Stribeck law without a drop."""
    names = ("m", "omega_1", "omega_2", "xi_1", "xi_2", "F", "V")
    return fj.Scene(
        fj.FixedContact(row["K_n"], row["K_t"]),
        fj.Stribeck(row["mu_s"], row["mu_m"], row["v_m"]),
        fj.Oscillator(**{name: row[name] for name in names}),
    )


@functools.partial(jax.jit, static_argnames="segments")
def everything(row, start, segments):
    """The cycle of a row, and the Jacobian of OUTPUTS by INPUTS; mu_m follows under Coulomb."""

    def outputs(x):
        changes: dict[str, Any] = dict(zip(INPUTS, x, strict=True))
        scene = substitute(scene_of(row), changes)
        coulomb = row["mu_m"] == row["mu_s"]
        mu_m = jnp.where(coulomb, changes["mu_s"], row["mu_m"])
        scene = substitute(scene, {"mu_m": mu_m})
        cycle = fj.limit_cycle(scene, start, segments=segments, throw=False)
        return jnp.stack([cycle.period, *cycle.amplitude, *cycle.stick_fraction]), cycle

    x = jnp.stack([jnp.asarray(row[name]) for name in INPUTS])
    return jax.jacfwd(outputs, has_aux=True)(x)


def numbers_of(row):
    """The row's numbers, as an argument that compiles once for all rows."""
    names = (
        "K_n",
        "K_t",
        "mu_s",
        "mu_m",
        "v_m",
        "m",
        "omega_1",
        "omega_2",
        "xi_1",
        "xi_2",
        "F",
        "V",
    )
    return {name: jnp.asarray(row[name]) for name in names}


def check(row, jacobian, cycle):
    """Everything that the table says of a cycle."""
    close = functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=0)
    ratio = row["turns"] / int(cycle.turns)
    assert ratio == round(ratio)  # the table may have counted a cycle several times over
    close(cycle.period * ratio, row["period"])
    length = row["V"] * row["period"] / ratio
    # With K_t = 0 direction 2 may be at rest.
    close(cycle.amplitude, row["amplitude"], atol=1e-10 * length)
    close(cycle.velocity_min, row["velocity_min"], atol=1e-9 * row["V"])
    close(cycle.velocity_max, row["velocity_max"], atol=1e-9 * row["V"])
    close(cycle.stick_fraction, row["stick_fraction"], atol=1e-9)
    close(cycle.tension_fraction, row["tension_fraction"], atol=1e-9)
    # The share of the slowest multiplier that is the integration's, not the orbit's.
    trivial = np.abs(np.array(cycle.multipliers) - 1).min()
    assert trivial < 1e-6
    truth = np.array([[d[output] for d in row["derivatives"].values()] for output in OUTPUTS])
    value, error = truth[..., 0].copy(), truth[..., 1].copy()
    value[0] /= ratio
    size = np.array([length, length, length, 1.0, 1.0]) / [row["V"], 1, 1, 1, 1]
    scale = size[:, None] / [row[name] or row["K_n"] for name in INPUTS]
    bound = 1e-7 * np.abs(value) + 1e-7 * scale + 10 * error + 1e-300
    # The peak-to-peak value of a direction at rest has a kink.
    moves = [True, *(np.asarray(row["amplitude"]) > 1e-9 * length), True, True]
    np.testing.assert_array_less(np.abs(jacobian - value)[moves], bound[moves])


def test_truth_of_forty_digits():
    """The reference cycle: period, amplitudes, stick fraction and itinerary."""
    cycle = reference_cycle()
    assert cycle.result == fj.CycleResult.converged
    assert float(cycle.period * OMEGA) == pytest.approx(6.467445952469732345405, rel=1e-10)
    expected = [2.290139035337965256497, 2.705760209010626533626]
    np.testing.assert_allclose(cycle.amplitude * OMEGA / V, expected, rtol=1e-10)
    np.testing.assert_allclose(cycle.stick_fraction, [0.09687693645118127308, 0], atol=1e-10)
    assert cycle.regularisation_error == 0
    steps = [(s.direction, s.before, s.after) for s in cycle.switches()]
    assert steps == [
        (2, "+", "-"),
        (2, "-", "+"),
        (1, "+", "-"),
        (1, "-", "stick"),
        (1, "stick", "+"),
    ]
    assert float(cycle.error) < 1e-10


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_forty_digits(mode):
    """By K_n at fixed K_t/K_n, scaled and in SI, in forward and in reverse mode."""

    def measures(K_n):
        scene = substitute(reference_scene(), {"K_n": K_n, "K_t": 0.5 * K_n})
        cycle = fj.limit_cycle(scene, throw=False)
        omega = jnp.sqrt(K_n)
        T, x = cycle.period, cycle.amplitude[0]
        return jnp.stack([T * omega, x * omega / V, T, x])

    truth = [
        5.273421486479947551e-10,
        1.263706994327e-11,
        -3.778482645969588942e-13,
        -2.137527543171888603e-14,
    ]
    np.testing.assert_allclose(jax.jit(mode(measures))(4e8), truth, rtol=1e-8)


def test_random_scenes_against_the_event_driven_solver():
    """Period, amplitudes, velocities, stick, tension and derivatives of every one-turn cycle."""
    simple = [row for row in CYCLES if row["turns"] == 1]
    assert len(simple) >= 55
    for row in simple:
        jacobian, cycle = everything(numbers_of(row), jnp.array(row["start"]), 40)
        assert cycle.result == fj.CycleResult.converged, row
        check(row, np.asarray(jacobian), cycle)


@pytest.mark.slow
def test_cycles_of_several_turns():
    """Up to four maxima of x1 in one period, on more segments, from a state on the cycle."""
    several = [row for row in CYCLES if row["turns"] > 1]
    assert len(several) >= 6
    for row in several:
        jacobian, cycle = everything(numbers_of(row), jnp.array(row["state"]), 160)
        assert cycle.result == fj.CycleResult.converged, row
        check(row, np.asarray(jacobian), cycle)


@pytest.mark.slow
def test_every_scene_in_one_batch():
    """More scenes than go through the machine together, of every outcome: each as on its own."""
    numbers = jax.tree.map(lambda *x: jnp.stack(x), *map(numbers_of, ROWS))
    starts = jnp.array([row["start"] for row in ROWS])

    def one(numbers, start):
        cycle = fj.limit_cycle(scene_of(numbers), start, segments=40, throw=False)
        return cycle.period, cycle.amplitude, cycle.result._value

    batch = jax.jit(jax.vmap(one))(numbers, starts)
    single = jax.jit(one)
    assert len(ROWS) > 64 and len(set(batch[2].tolist())) >= 4
    for i in range(len(ROWS)):
        period, amplitude, result = (np.asarray(x[i]) for x in batch)
        alone = single(jax.tree.map(lambda x, i=i: x[i], numbers), starts[i])
        assert result == alone[2], ROWS[i]
        np.testing.assert_allclose(period, alone[0], rtol=1e-9)
        np.testing.assert_allclose(amplitude, alone[1], rtol=1e-9)


def test_motions_without_a_cycle():
    """The equilibrium attracts, the motion diverges, or it never repeats: each is told apart."""
    seen = set()
    for row in ROWS:
        if row["kind"] == "cycle":
            continue
        _, cycle = everything(numbers_of(row), jnp.array(row["start"]), 40)
        allowed = {
            "equilibrium": [fj.CycleResult.equilibrium],
            # Two of these wander for thousands of turns.
            "diverged": [fj.CycleResult.diverged, fj.CycleResult.exhausted],
            "not periodic": [fj.CycleResult.not_periodic, fj.CycleResult.exhausted],
        }[row["kind"]]
        assert any(bool(cycle.result == member) for member in allowed), row
        assert np.isnan([float(cycle.period), *cycle.amplitude, *cycle.state]).all()
        seen |= {row["kind"]}
    assert len(seen) == 3


@pytest.mark.slow
def test_error_falls_with_the_eighth_power():
    """Order of convergence in the number of segments, and the estimate that comes with it."""
    errors, estimates = [], []
    counts = (20, 28, 40)
    for segments in counts:
        cycle = fj.limit_cycle(reference_scene(), segments=segments, throw=False)
        errors.append(abs(float(cycle.period * OMEGA) / 6.467445952469732345405 - 1))
        estimates.append(float(cycle.error))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert order > 7.5
    assert all(error < estimate for error, estimate in zip(errors, estimates, strict=True))


@pytest.mark.slow
def test_batch_equals_single_cycles():
    """`jax.vmap` over scenes, more than run together and not a multiple of it."""

    def measures(K_n):
        scene = substitute(reference_scene(), {"K_n": K_n, "K_t": K_n / 2})
        cycle = fj.limit_cycle(scene, throw=False)
        return cycle.period, cycle.amplitude, cycle.result == fj.CycleResult.converged

    K_n = np.linspace(2e8, 6e8, 70)
    periods, amplitudes, found = jax.jit(jax.vmap(measures))(jnp.asarray(K_n))
    assert found.all()
    for k in (0, 7, 69):
        row = CYCLES[0] | {"K_n": K_n[k], "K_t": K_n[k] / 2}
        scene = scene_of(row)
        start = np.zeros(4)
        start[:2] = fj.equilibrium(
            scene.oscillator, K_n[k], K_n[k] / 2, scene.friction.coefficient(V)
        )
        o = scene.oscillator
        start[0] += V / np.sqrt(o.omega_1**2 + o.omega_2**2 + 1.5 * K_n[k])
        _, single = everything(numbers_of(row), jnp.asarray(start), 40)
        np.testing.assert_allclose(periods[k], single.period, rtol=1e-9)
        np.testing.assert_allclose(amplitudes[k], single.amplitude, rtol=1e-9)


@pytest.mark.slow
def test_a_member_that_fails_marks_only_itself():
    """A start that runs away leaves its neighbours, their values and gradients, as they are."""
    cycle = reference_cycle()
    away = jnp.array([1.0, 100.0, -1.0])[:, None] * cycle.state[None]

    def sizes(scale, start):
        scene = substitute(reference_scene(), {"V": scale * V})
        found = fj.limit_cycle(scene, start, throw=False)
        return jnp.where(
            found.result == fj.CycleResult.converged, found.amplitude[0], 0
        ), found.result

    gradient = jax.jit(jax.vmap(jax.grad(sizes, has_aux=True), in_axes=(None, 0)))
    slopes, results = gradient(1.0, away)
    assert (results == fj.CycleResult.diverged).tolist() == [False, True, False]
    assert slopes[1] == 0
    assert slopes[0] == pytest.approx(float(slopes[2]), rel=1e-7)
    assert slopes[0] > 0


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradient_by_the_surface(mode):
    """d amplitude/d(D, G) of the reference brake against differences."""
    scene = fj.brake_scene()

    @jax.jit
    def amplitude(x):
        moved = substitute(scene, {"D": x[0], "G": x[1]})
        return fj.limit_cycle(moved, throw=False).amplitude[0]

    at = jnp.array([2.4, 1.342e-10])
    slopes = jax.jit(mode(amplitude))(at)
    for k, size in enumerate([1e-5, 1e-15]):
        step = size * jnp.eye(2)[k]
        difference = (amplitude(at + step) - amplitude(at - step)) / (2 * size)
        assert float(slopes[k]) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.slow
def test_second_derivatives():
    """The Hessian is that of the orbit's equations too, not of the search."""

    def period(K_n):
        scene = substitute(reference_scene(), {"K_n": K_n, "K_t": K_n / 2})
        return fj.limit_cycle(scene, throw=False).period

    slope = jax.jit(jax.jacfwd(period))
    difference = (slope(4.01e8) - slope(3.99e8)) / 2e6
    assert float(jax.jit(jax.jacfwd(slope))(4e8)) == pytest.approx(float(difference), rel=1e-3)


def test_mass_on_a_belt_under_constant_load():
    """K_t = 0 and F < 0: x2 rests, and x1 is the classic stick-slip oscillator with load K_n x2.

    It sticks until the spring force has grown from where the slip ended, at -x about the
    equilibrium of sliding, to the static limit: the stick lasts (difference of displacements)/V.
    """
    scene = reference_scene().replace(K_t=0.0, F=-500.0, V=0.02)
    o = scene.oscillator
    cycle = fj.limit_cycle(scene)
    load = 4e8 * 500 / np.sqrt(2) / (float(o.omega_2) ** 2 + 4e8)
    assert cycle.amplitude[1] < 1e-9 * cycle.amplitude[0]
    assert cycle.tension_fraction == 0
    exits = [s for s in cycle.switches() if s.before == "stick"]
    (enter,) = [s for s in cycle.switches() if s.after == "stick"]
    (leave,) = exits
    run = fj.simulate(scene, cycle.state, 1.1 * float(cycle.period))
    x_enter, x_leave = (float(run.at(np.array([s.time]))[0, 0]) for s in (enter, leave))
    damping = 2 * 0.001 * float(o.omega_1) * 0.02
    limit = (0.4 * load - 500 / np.sqrt(2) - damping) / float(o.omega_1) ** 2
    assert x_leave == pytest.approx(limit, rel=1e-9)
    stuck = float(cycle.stick_fraction[0] * cycle.period)
    assert stuck == pytest.approx((x_leave - x_enter) / 0.02, rel=1e-7)


LIGHTLY_DAMPED = Mechanism(
    m=1.0,
    omega_1=7040.0,
    omega_2=5190.0,
    xi_1=0.000154,
    xi_2=0.000735,
    F=2.51,
    V=0.307,
    K_n=5.08e8,
    K_t=3.23e8,
    mu_s=0.251,
    mu_m=0.14,
    v_m=0.535,
)


def test_an_orbit_that_repels():
    """The motion passes it slowly: its numbers are given, with multipliers, but it is no limit."""
    m = LIGHTLY_DAMPED
    scene = scene_of(vars(m))
    cycle = fj.limit_cycle(scene, throw=False)
    assert cycle.result == fj.CycleResult.unstable and cycle.turns == 1
    y = m.scaled(np.asarray(cycle.state))
    truth = np.linalg.eigvals(return_slopes(m, y[[0, 1, 3]], 1, 1e-12))
    expected = np.sort(np.abs([*truth, 1.0]))
    np.testing.assert_allclose(np.sort(np.abs(cycle.multipliers)), expected, rtol=1e-7)
    assert expected[-1] > 1.0001 and np.isfinite(cycle.amplitude).all()
    with pytest.raises(RuntimeError, match=r"^a limit cycle was found, but it repels: [^\n]*$"):
        fj.limit_cycle(scene)


def test_physical_outcomes_raise_only_if_asked():
    """A motion that dies out is a result; with `throw` it is an error with that message."""
    cycle = fj.limit_cycle(motionless_scene(), throw=False)
    assert cycle.result == fj.CycleResult.equilibrium
    assert np.isnan(cycle.amplitude).all()
    text = r"^the motion dies out: the sliding equilibrium attracts it$"
    with pytest.raises(RuntimeError, match=text):
        fj.limit_cycle(motionless_scene())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": [0.0, 0.0]}, r"start must have shape \(4,\), got \(2,\)"),
        ({"start": [np.nan, 0, 0, 0]}, "start must be finite, got nan"),
        ({"rtol": 0}, "rtol must be above 0 and at most 0.1, got 0"),
        ({"rtol": 1e-300}, "rtol must be at least 9.1e-13 in float64, got 1e-300"),
        ({"segments": 3}, "segments must be a whole number of at least 16, got 3"),
        ({"max_turns": 0}, "max_turns must be at least 1, got 0"),
        ({"regularisation": 0}, "regularisation must be above 0, got 0"),
    ],
)
def test_bad_arguments(arguments, message):
    """One line that names the argument, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        fj.limit_cycle(reference_scene(), **arguments)


def test_a_tolerance_that_the_precision_cannot_hold():
    """In float32 the default is what that holds, and less is refused."""
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), reference_scene())
    with pytest.raises(ValueError, match=r"^rtol must be at least 0.00049 in float32, got 1e-09$"):
        fj.limit_cycle(scene, rtol=1e-9)


def test_a_fixed_contact_traces_no_contact_law():
    """What a scene does not need is not in its program: no contact law, no friction slope."""

    def operations(scene):
        program = jax.make_jaxpr(lambda s: fj.limit_cycle(s, throw=False).period)(scene)
        return str(program).count("\n")

    fixed = reference_scene()
    assert operations(fixed.replace(friction=fj.Coulomb(0.3))) < operations(fixed)
    assert operations(fixed) < operations(fj.brake_scene())


@pytest.mark.slow
def test_single_precision():
    """float32 in, float32 out, to what it can hold."""
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), reference_scene())
    cycle = fj.limit_cycle(scene, throw=False)
    assert cycle.period.dtype == jnp.float32
    assert cycle.result == fj.CycleResult.converged
    assert float(cycle.period * OMEGA) == pytest.approx(6.467446, rel=1e-4)


@pytest.mark.slow
def test_design_for_a_quiet_cycle():
    """`design` takes an amplitude as its objective, and does no worse than a fine sweep."""
    scene = fj.brake_scene()

    def amplitude(scene):
        return 1e6 * fj.limit_cycle(scene, throw=False).amplitude[0]

    best = fj.design(
        scene,
        {"D": (2.39, 2.41)},
        objective=amplitude,
        target=1e4,
        K_n_min=0.0,
        starts=2,
        lattice=32,
        progress=False,
    )
    sweep = jax.jit(jax.vmap(lambda D: amplitude(substitute(scene, {"D": D}))))
    sizes = sweep(jnp.linspace(2.39, 2.41, 65))
    assert not best.violated
    assert best.value <= float(jnp.nanmin(sizes)) * (1 + 1e-6)
    assert best.value < 0.99 * float(amplitude(scene))
