"""Limit cycles: the exact law against 40 digits and against an independent event-driven solver."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
import hybrid_truth
from fractaljax._base.parts import substitute
from fractaljax._dynamics.acceptance import growth_of
from fractaljax._dynamics.cycle import repels
from fractaljax._dynamics.guard import NONE
from fractaljax._dynamics.orbit import solve_periodic_orbits
from fractaljax._dynamics.search import find_attractor
from fractaljax._dynamics.segments import flow
from mechanisms import PLAIN, source_form
from tools import (
    both_modes,
    motionless_scene,
    primitives,
    reference_cycle,
    reference_scene,
    refusals,
    scene_of,
)

ROWS = json.loads((Path(__file__).parents[1] / "reference" / "cycle.json").read_text())["rows"]
CYCLES = [row for row in ROWS if row["kind"] == "cycle"]
INPUTS = ("K_n", "K_t", "mu_s", "V")
OUTPUTS = ("period", "amplitude_1", "amplitude_2", "stick_fraction_1", "stick_fraction_2")
OMEGA, V = 2e4, 0.15  # of the reference scene: lengths are in V/OMEGA
PERIOD = 6.467445952469732345405  # of the reference scene, in 1/OMEGA
REPELLING = dict(
    zip(
        PLAIN,
        (1.0, 7040.0, 5190.0, 0.000154, 0.000735, 2.51, 0.307, 5.08e8, 3.23e8, 0.251, 0.14, 0.535),
        strict=True,
    )
)
SEGMENTS = 160  # for up to four returns in one period
SLOW = pytest.mark.slow


@jax.jit
def everything(row, start):
    """The cycle of a row, and the Jacobian of OUTPUTS by INPUTS in forward and reverse mode."""

    def outputs(x):
        K_n, K_t, mu_s, V = x
        mu_m = jnp.where(row["mu_m"] == row["mu_s"], mu_s, row["mu_m"])  # Coulomb it stays
        changes = {"K_n": K_n, "K_t": K_t, "mu_s": mu_s, "mu_m": mu_m, "V": V}
        scene = substitute(scene_of(row), changes)
        cycle = fj.limit_cycle(scene, start, segments=SEGMENTS, throw=False)
        return jnp.stack([cycle.period, *cycle.amplitude, *cycle.stick_fraction]), cycle

    x = jnp.stack([row[name] for name in INPUTS])
    _, forward, reverse, cycle = both_modes(outputs, x, has_aux=True)
    return cycle, forward, reverse


@functools.cache
def _solved(numbers, start):
    row = {name: jnp.asarray(x) for name, x in zip(PLAIN, numbers, strict=True)}
    return everything(row, jnp.asarray(start))


def solved(row, start):
    """`everything` of a row: compiled once for all rows, and run once for all tests."""
    return _solved(tuple(float(row[name]) for name in PLAIN), tuple(start))


def check(row, cycle, forward, reverse):
    """Everything that the table says of a cycle."""
    close = functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=0)
    ratio = row["returns"] / int(cycle.returns)
    assert cycle.result == fj.CycleResult.converged and ratio == round(ratio), row
    close(cycle.period * ratio, row["period"])
    length = row["V"] * row["period"] / ratio
    # With K_t = 0 direction 2 may not move.
    close(cycle.amplitude, row["amplitude"], atol=1e-10 * length)
    close(cycle.velocity_min, row["velocity_min"], atol=1e-9 * row["V"])
    close(cycle.velocity_max, row["velocity_max"], atol=1e-9 * row["V"])
    close(cycle.stick_fraction, row["stick_fraction"], atol=1e-9)
    close(cycle.tension_fraction, row["tension_fraction"], atol=1e-9)
    multipliers = np.abs(np.array(cycle.multipliers) - 1)
    assert multipliers.min() < 1e-6
    known = [abs(complex(*pair)) ** (1 / ratio) for pair in row["multipliers"]]
    np.testing.assert_allclose(
        np.sort(np.abs(cycle.multipliers)), np.sort([*known, 1.0]), rtol=0, atol=2e-5
    )
    close(reverse, forward, rtol=1e-7, atol=1e-9 * abs(np.asarray(forward)).max())
    truth = np.array([[d[output] for d in row["derivatives"].values()] for output in OUTPUTS])
    value, error = truth[..., 0].copy(), truth[..., 1].copy()
    value[0] /= ratio
    size = np.array([length, length, length, 1.0, 1.0]) / [row["V"], 1, 1, 1, 1]
    scale = size[:, None] / [row[name] or row["K_n"] for name in INPUTS]
    bound = 1e-7 * np.abs(value) + 1e-7 * scale + 10 * error + 1e-300
    # The peak-to-peak value of a direction that does not move has a kink.
    moves = [True, *(np.asarray(row["amplitude"]) > 1e-9 * length), True, True]
    np.testing.assert_array_less(np.abs(forward - value)[moves], bound[moves])


def test_forty_digits():
    """The reference cycle: period, amplitudes, stick fraction and itinerary."""
    cycle = reference_cycle()
    assert cycle.result == fj.CycleResult.converged and cycle.regularisation_error == 0
    assert float(cycle.period * OMEGA) == pytest.approx(PERIOD, rel=1e-10)
    expected = [2.290139035337965256497, 2.705760209010626533626]
    np.testing.assert_allclose(cycle.amplitude * OMEGA / V, expected, rtol=1e-10)
    np.testing.assert_allclose(cycle.stick_fraction, [0.09687693645118127308, 0], atol=1e-10)
    found = "; ".join(f"{s.direction} {s.before} {s.after}" for s in cycle.switches())
    assert found == "2 + -; 2 - +; 1 + -; 1 - stick; 1 stick +"
    assert float(cycle.error) < 1e-10


@SLOW
@pytest.mark.optimised
def test_derivatives_of_forty_digits():
    """By K_n at fixed K_t/K_n, of period and amplitude in SI, in forward and in reverse mode."""
    _, *jacobians = solved(CYCLES[0], CYCLES[0]["start"])
    for jacobian in jacobians:
        by_K_n = jacobian[:2, 0] + 0.5 * jacobian[:2, 1]
        truth = [-3.778482645969588942e-13, -2.137527543171888603e-14]
        np.testing.assert_allclose(by_K_n, truth, rtol=1e-8)


def test_cycles_of_one_return():
    """Random and special scenes: all numbers, multipliers, and derivatives in both modes."""
    simple = [row for row in CYCLES if row["returns"] == 1]
    assert len(simple) >= 55
    for row in simple:
        check(row, *solved(row, row["start"]))


@SLOW
def test_cycles_of_several_returns():
    """Up to four in one period, from a state on the cycle."""
    several = [row for row in CYCLES if row["returns"] > 1]
    assert len(several) >= 6
    for row in several:
        check(row, *solved(row, row["state"]))


@SLOW
def test_motions_without_a_cycle():
    """The equilibrium attracts, the motion diverges, or it never repeats: three results."""
    R = fj.CycleResult
    allowed = {
        "equilibrium": [R.equilibrium],
        # Two of these wander for thousands of returns.
        "diverged": [R.diverged, R.exhausted],
        "not periodic": [R.not_periodic, R.exhausted],
    }
    rows = [row for row in ROWS if row["kind"] != "cycle"]
    assert {row["kind"] for row in rows} == set(allowed)
    for row in rows:
        cycle, *_ = solved(row, row["start"])
        assert any(bool(cycle.result == member) for member in allowed[row["kind"]]), row
        assert np.isnan([float(cycle.period), *cycle.amplitude, *cycle.state]).all()
    with pytest.raises(RuntimeError, match=r"^the motion dies out: the sliding equilibrium"):
        fj.limit_cycle(motionless_scene())


def test_orbit_that_repels():
    """The motion passes it slowly: it has numbers and multipliers, but it is no limit."""
    scene = scene_of(REPELLING)
    cycle = fj.limit_cycle(scene, throw=False)
    assert cycle.result == fj.CycleResult.unstable and cycle.returns == 1
    m = hybrid_truth.Mechanism.of(source_form(**REPELLING))
    start, period = np.asarray(cycle.state) / m.units, float(cycle.period) * m.omega
    trip = list(hybrid_truth.phases(m.scaled, start, 1e-12, period))
    expected = np.sort(np.abs(np.linalg.eigvals(hybrid_truth.monodromy(m.scaled, trip))))
    np.testing.assert_allclose(np.sort(np.abs(cycle.multipliers)), expected, rtol=1e-7)
    assert expected[-1] > 1.0001 and np.isfinite(cycle.amplitude).all()
    with pytest.raises(RuntimeError, match="but it repels"):
        fj.limit_cycle(scene)
    # Its growth is that of its exact derivatives, not of those that Newton's method has.
    system, segments = cycle._system, jax.tree.map(lambda x: x[..., None], cycle._orbit.segments)
    found = jax.jit(solve_periodic_orbits)(system, segments, jnp.array([True]), jnp.ones(1), 1e-9)
    (growth,) = growth_of(system, found)
    np.testing.assert_allclose(growth, np.log(expected[-1]), rtol=1e-4)


def test_segments_keep_their_shares_of_a_phase():
    """Phases are too long, and one segment is far shorter than the change: it stays positive."""
    cycle = reference_cycle()
    system, known = cycle._system, jax.tree.map(lambda x: x[..., None], cycle._orbit.segments)
    k = int(np.flatnonzero(np.asarray(known.guard) == NONE)[0])  # the next one goes on from it
    h = known.duration.at[k : k + 2, 0].set(known.duration[k : k + 2].sum() * jnp.array([1e-5, 1]))
    y = known.y.at[:, k + 1].set(flow(system, known.y[:, k], h[k], known.s[:, k]))
    given = dataclasses.replace(known, y=y, duration=1.01 * h)
    found = jax.jit(solve_periodic_orbits)(system, given, jnp.array([True]), jnp.ones(1), 1e-9)
    durations = found.segments.duration[known.used]
    assert found.converged and float(durations.min()) > 0
    assert float(durations.sum()) == pytest.approx(float(known.duration.sum()), rel=1e-8)
    shares = durations[k : k + 2] / given.duration[k : k + 2, 0]
    assert shares[0] == pytest.approx(float(shares[1]), rel=1e-12)


def test_orbit():
    """`simulate`, which searches its events, runs through the same states and switches."""
    scene, cycle = reference_scene(), reference_cycle()
    times, states = cycle.orbit(64)
    run = fj.simulate(scene, cycle.state, 1.5 * float(cycle.period))
    states, scale = np.asarray(states), np.abs(states).max(axis=0)
    np.testing.assert_allclose(np.asarray(run.at(times)) / scale, states / scale, atol=1e-10)
    again = run.at(np.full(64, float(cycle.period)))[0]
    np.testing.assert_allclose(again / scale, cycle.state / scale, atol=1e-9)
    switched = [(t, i) for t, i, _, _ in run.switches() if t < cycle.period]
    assert [i for _, i in switched] == [s.direction for s in cycle.switches()]
    np.testing.assert_allclose(
        [t for t, _ in switched], [s.time for s in cycle.switches()], rtol=1e-9
    )
    frequencies, lines = cycle.spectrum(64)
    np.testing.assert_allclose(frequencies, np.arange(1, 33) * cycle.frequency, rtol=1e-12)
    variance = (np.asarray(lines) ** 2)[:-1].sum(axis=0) / 2
    np.testing.assert_allclose(variance, states[:, :2].var(axis=0), rtol=1e-4)
    with pytest.raises(ValueError, match="needs one cycle, outside of jit: index the batch first"):
        jax.tree.map(lambda x: x[None], cycle).switches()
    assert repr(cycle).startswith("LimitCycle(period=0.000323") and len(repr(cycle)) < 1000


@pytest.mark.parametrize(
    "slow",
    [
        {},
        # Creep groan: 35 Hz, a period of 128 of the fastest ones.
        pytest.param({"K_n": 8e8, "omega_1": 295.0, "xi_1": 0.01}, marks=SLOW),
    ],
)
def test_mass_on_a_belt_under_constant_load(slow):
    """K_t = 0 and F < 0: x2 does not move, and x1 is the classic stick-slip oscillator.

    It sticks until the spring force reaches the static limit under the load K_n x2. So the stick
    lasts the difference of displacements over V.
    """
    scene = reference_scene().replace(**{"K_t": 0.0, "F": -500.0, "V": 0.02} | slow)
    o = scene.oscillator
    cycle = fj.limit_cycle(scene)
    K_n = float(scene.contact.K_n)
    load = K_n * 500 / np.sqrt(2) / (float(o.omega_2) ** 2 + K_n)
    assert cycle.amplitude[1] < 1e-9 * cycle.amplitude[0] and cycle.tension_fraction == 0
    (leave,) = [s for s in cycle.switches() if s.before == "stick"]
    (enter,) = [s for s in cycle.switches() if s.after == "stick"]
    run = fj.simulate(scene, cycle.state, 1.1 * float(cycle.period))
    x_enter, x_leave = run.at(np.linspace(enter.time, leave.time, 64))[jnp.array([0, -1]), 0]
    damping = 2 * float(o.xi_1 * o.omega_1) * 0.02
    limit = (0.4 * load - 500 / np.sqrt(2) - damping) / float(o.omega_1) ** 2
    assert float(x_leave) == pytest.approx(limit, rel=1e-9)
    stuck = float(cycle.stick_fraction[0] * cycle.period)
    assert stuck == pytest.approx(float(x_leave - x_enter) / 0.02, rel=1e-7)


NUMBERS = ("amplitude", "velocity_min", "velocity_max", "normal_force")
NUMBERS += ("stick_fraction", "open_fraction", "tension_fraction", "multipliers")


def test_what_nobody_asks_for_is_not_in_the_program():
    """A period has neither extremes nor multipliers; each number of a cycle has its own part."""

    def count(name):
        found = jax.make_jaxpr(lambda scene: getattr(fj.limit_cycle(scene), name))
        return sum(primitives(found(reference_scene())).values())

    least = count("period")
    assert count("state") < 1.01 * least
    assert all(count(name) > 1.02 * least for name in NUMBERS)


def test_numbers_of_a_batch_are_those_of_its_cycles():
    """One scene squeals, one is quiet: there everything is not a number."""
    scenes = [reference_scene(), motionless_scene(), reference_scene().replace(V=0.2)]
    cycles = [fj.limit_cycle(scene, throw=False) for scene in scenes]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *cycles)
    for name in NUMBERS:
        found, each = getattr(batch, name), [getattr(cycle, name) for cycle in cycles]
        np.testing.assert_allclose(found, np.stack(each), rtol=1e-12, atol=1e-15)
        assert np.isfinite(each[0]).all() and np.isnan(each[1]).all()
    shown = repr(batch)
    assert all(f"{name}=array(" in shown for name in NUMBERS[:-1])


def blocks(largest):
    """Multipliers of that modulus: real, a pair, a double one without its eigenvectors, alone."""
    pair = largest * np.array([[np.cos(1), -np.sin(1)], [np.sin(1), np.cos(1)]])
    yield np.diag([largest, 0.5, -0.2])
    yield np.diag([-largest, 0.999, 0.0])
    yield np.block([[pair, np.ones((2, 1))], [np.zeros((1, 2)), np.full((1, 1), 0.7)]])
    yield np.array([[largest, 1.0, 0.0], [0.0, largest, 0.0], [0.0, 0.0, 0.1]])
    yield np.diag([largest, 0.0, 0.0])


@pytest.mark.parametrize("largest", [0.0, 0.3, 1 - 1e-6, 1 + 1e-6, 1.0009, 30.0])
def test_repels(largest):
    """The largest multiplier decides, except the one of the motion itself; in a batch."""
    rng = np.random.default_rng(1)
    rates, matrices = rng.normal(size=(5, 4)), []
    for block, rate in zip(blocks(largest), rates, strict=True):
        basis = np.column_stack([rate, rng.normal(size=(4, 3))])
        inner = np.eye(4)
        inner[0, 1:], inner[1:, 1:] = rng.normal(size=3), block
        matrices.append(basis @ inner @ np.linalg.inv(basis))
    one = jax.jit(jax.vmap(repels, in_axes=(0, 0, None)))
    found = one(jnp.asarray(matrices), jnp.asarray(rates), 1e-9)
    expected = [largest > 1 or max(abs(np.linalg.eigvals(b))) > 1 for b in blocks(largest)]
    np.testing.assert_array_equal(found, expected)
    # Within the error of the orbit it is left open.
    assert not np.any(one(jnp.asarray(matrices), jnp.asarray(rates), 1e-2)) or largest > 1.1


@SLOW
def test_error_falls_with_the_eighth_power():
    """Order of convergence in the number of segments, the estimate and what it corrects."""
    counts = (16, 28)
    # With this tolerance all segments are used, and the error is above it.
    scene = reference_scene()
    cycles = [fj.limit_cycle(scene, segments=n, rtol=1e-12, throw=False) for n in counts]
    errors = [abs(float(cycle.period * OMEGA) / PERIOD - 1) for cycle in cycles]
    assert np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0]) > 7.5
    assert all(e < float(cycle.error) for e, cycle in zip(errors, cycles, strict=True))
    # Within the tolerance it is corrected by its estimate.
    corrected = fj.limit_cycle(scene, segments=24)
    assert abs(float(corrected.period * OMEGA) / PERIOD - 1) < 0.01 * float(corrected.error)


@SLOW
@pytest.mark.optimised
def test_batch():
    """Scenes of every outcome together: each as on its own, and so its gradient."""
    outcomes = [int(solved(row, row["start"])[0].result._value) for row in ROWS]
    rows = [row for i, row in enumerate(ROWS) if outcomes[:i].count(outcomes[i]) < 2]
    numbers = {name: jnp.array([float(row[name]) for row in rows]) for name in PLAIN}
    starts = jnp.array([row["start"] for row in rows])

    def size(V, numbers, start):
        cycle = fj.limit_cycle(scene_of(numbers | {"V": V}), start, segments=40, throw=False)
        ok = cycle.result == fj.CycleResult.converged
        return jnp.where(ok, cycle.amplitude[0], 0), (cycle.period, cycle.result._value)

    measures = jax.jit(jax.vmap(jax.value_and_grad(size, has_aux=True)))
    (sizes, (periods, results)), slopes = measures(numbers["V"], numbers, starts)
    assert len(set(results.tolist())) == len(set(outcomes)) >= 4
    for i, row in enumerate(rows):
        cycle, forward, _ = solved(row, row["start"])
        assert results[i] == cycle.result._value, row
        np.testing.assert_allclose(periods[i], cycle.period, rtol=1e-9)
        if cycle.result == fj.CycleResult.converged:
            np.testing.assert_allclose(sizes[i], cycle.amplitude[0], rtol=1e-9)
            bound = 1e-9 * float(cycle.amplitude[0]) / row["V"]
            np.testing.assert_allclose(slopes[i], forward[1, 3], rtol=1e-6, atol=bound)
        else:
            assert sizes[i] == slopes[i] == 0  # no NaN in the gradient of the others either


@SLOW
def test_gradient_by_the_surface_and_second_derivatives():
    """d amplitude/d(D, G) of the reference brake in both modes, against differences."""

    def amplitude(x):
        moved = substitute(fj.brake_scene(), {"D": x[0], "G": x[1]})
        return fj.limit_cycle(moved, throw=False).amplitude[0]

    found = jax.jit(lambda x: both_modes(amplitude, x))
    at = jnp.array([2.4, 1.342e-10])
    _, *slopes = found(at)
    for k, size in enumerate([1e-5, 1e-15]):
        step = size * jnp.eye(2)[k]
        difference = float(found(at + step)[0] - found(at - step)[0]) / (2 * size)
        assert [float(slope[k]) for slope in slopes] == pytest.approx([difference] * 2, rel=1e-6)

    # The Hessian is that of the orbit's equations too, not of the search.
    def period(K_n):
        scene = substitute(reference_scene(), {"K_n": K_n, "K_t": K_n / 2})
        return fj.limit_cycle(scene, throw=False).period

    @jax.jit
    def slope_and_bend(K_n):
        return jax.jvp(jax.jacfwd(period), (K_n,), (1.0,))

    (_, bend), (high, _), (low, _) = (slope_and_bend(K_n) for K_n in (4e8, 4.01e8, 3.99e8))
    assert float(bend) == pytest.approx(float(high - low) / 2e6, rel=1e-3)


@SLOW
def test_single_precision():
    """float32 in, float32 out, to what it can hold; less is refused."""
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), reference_scene())
    cycle = fj.limit_cycle(scene, throw=False)
    assert cycle.period.dtype == jnp.float32 and cycle.result == fj.CycleResult.converged
    assert float(cycle.period * OMEGA) == pytest.approx(PERIOD, rel=1e-4)


@SLOW
def test_attractors():
    """At K_n = 6e8 the starts end in several distinct cycles, each of them attracting."""
    found = fj.attractors(reference_scene().replace(K_n=6e8, K_t=3e8))
    cycles = [cycle for cycle in found if np.isfinite(cycle.period)]
    assert len(cycles) >= 2
    assert min(np.diff(sorted(float(cycle.period) for cycle in cycles))) > 1e-6
    assert all(abs(cycle.multipliers[1]) < 1 for cycle in cycles)


@SLOW
def test_design_for_a_quiet_cycle():
    """`design` takes an amplitude as its objective, and does no worse than a fine sweep."""
    scene = fj.brake_scene()

    def amplitude(scene):
        return fj.limit_cycle(scene, throw=False).amplitude[0]

    options = {"K_n_min": 0.0, "progress": False}
    objective = fj.constraints.CycleAmplitude()
    best = fj.design(scene, {"D": (2.39, 2.41)}, objective, target=1e4, **options)
    sizes = [float(amplitude(scene.replace(D=D))) for D in np.linspace(2.39, 2.41, 65)]
    assert not best.violated
    assert best.value <= np.nanmin(sizes) * (1 + 1e-6)
    assert best.value < 0.99 * sizes[32]  # of the scene as it is


def test_program_has_what_the_scene_needs():
    """A given stiffness traces no contact law, and constant friction no slope."""

    def operations(scene):
        program = jax.make_jaxpr(lambda s: fj.limit_cycle(s, throw=False).period)(scene)
        return str(program).count("\n")

    fixed = reference_scene()
    assert operations(fixed.replace(friction=fj.Coulomb(0.3))) < operations(fixed)
    assert operations(fixed) < operations(fj.brake_scene())


test_refusals = refusals(
    [
        ({"start": [0.0, 0.0]}, r"start must have shape \(4,\), got \(2,\)"),
        ({"start": [np.nan, 0, 0, 0]}, "start must be finite, got nan"),
        ({"rtol": 0}, "rtol must be above 0 and at most 0.1, got 0"),
        ({"rtol": 1e-300}, "rtol must be at least 9.1e-13 in float64, got 1e-300"),
        ({"segments": 3}, "segments must be a whole number of at least 16, got 3"),
        ({"max_returns": 0}, "max_returns must be a whole number of at least 1, got 0"),
        ({"max_returns": True}, "max_returns must be a whole number of at least 1, got True"),
        ({"regularisation": 0}, "regularisation must be above 0, got 0"),
        ({"regularisation": 0.1, "max_steps": 0}, "max_steps must be a whole number of at least 1"),
        ({"starts": [0.0] * 4}, r"starts must have shape \(k, 4\), got \(4,\)"),
    ],
    lambda bad: (fj.attractors if "starts" in bad else fj.limit_cycle)(reference_scene(), **bad),
)


def test_another_contact_law_needs_no_other_program(monkeypatch):
    """The search knows stiffnesses and loads alone, so that users do not wait for it twice."""
    reference_cycle()
    traced, place = [], "fractaljax._dynamics.limit_cycle.find_attractor"
    monkeypatch.setattr(
        place, lambda *arguments: traced.append(arguments) or find_attractor(*arguments)
    )
    fj.limit_cycle(reference_scene().replace(contact=fj.brake_scene().contact))
    assert not traced
    jax.make_jaxpr(lambda x: fj.limit_cycle(x, segments=47))(reference_scene())
    assert len(traced) == 1  # the test sees it
