"""The peers and truths that pages measure with, each against another one; how runs are compared."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from benchmarks import (
    boundary_element,
    branches,
    eigenvalues,
    half_spaces,
    limit_cycle,
    loops,
    many_cycles,
    scale,
    scene_cost,
    scipy_user,
    timing,
    transients,
    whole_design as designs,
)
from benchmarks.extremes import FAMILIES, corner_rows, family_rows
from benchmarks.growth_rate import surfaces
from benchmarks.timing import versions
from fractaljax._sweep.batches import Batches

REGIMES = {"elastic-plastic", "fully plastic", "gross slip"}


def test_loops_and_arrays_agree_in_every_regime():
    D, G = surfaces(100)
    loop, plain = (body(loops.brake()) for body in (loops.tuned_loop, loops.plain_loop))
    states = [loop(d, g) for d, g in zip(D, G, strict=True)]
    others = [plain(d, g) for d, g in zip(D, G, strict=True)]
    assert {state[2] for state in states} == REGIMES
    assert [state[2] for state in states] == [state[2] for state in others]
    rate, omega = np.array([state[:2] for state in states]).T
    for found in (loops.arrays(loops.brake())(D, G), [state[0] for state in others]):
        assert np.max(np.abs(found - rate) / omega) < 1e-14


@pytest.mark.parametrize("mu_s", [0.3, transients.MU_S, 0.7])
def test_smooth_equations_over_friction_are_those_of_each_law(mu_s):
    u = jnp.array([0.3, -0.2, 0.7, 0.4])
    found = branches.smooth_field(0.1)(u, mu_s, None)
    own = transients.accelerations(math.tanh, transients.law(mu_s=mu_s).numbers, 0.1)
    np.testing.assert_allclose(found, [*u[2:], *own(*u.tolist())], rtol=1e-14)


def test_residual_of_a_wave_in_contact():
    """A pressure E q h/2 over its mean closes all gaps; half of that wave leaves half of them."""
    n, dx, E, height = 16, 1e-5, 2e11, 1e-8
    wave = np.cos(2 * np.pi * np.arange(n) / n)[:, None] * np.ones(8)
    pressure = E * np.pi / (n * dx) * height * wave
    mean = 2 * pressure.max()
    assert half_spaces.residual(mean + pressure, height * wave, dx, E) < 1e-12
    left = half_spaces.residual(mean + pressure / 2, height * wave, dx, E)
    assert left == pytest.approx(0.5 * np.sqrt(2), rel=1e-12)


def test_a_peer_is_compared_at_its_residual():
    """With the quickest of our settings that reach it, by ratios within a turn."""
    rows = [
        {"family": family, "setting": setting, "residual": residual, "seconds": seconds}
        for family, setting, residual, seconds in [
            ("fractaljax", "loose", 1e-3, 1.0),
            ("fractaljax", "middle", 1e-6, 3.0),
            ("fractaljax", "tight", 1e-9, 2.0),
            ("Tamaas", "a", 1e-3, 4.0),
            ("Tamaas", "b", 1e-4, 4.0),
            ("Tamaas", "c", 1e-10, 9.0),
        ]
    ]
    boundary_element.beside(rows, [[row["seconds"]] * 3 for row in rows])
    assert [row.get("beside") for row in rows] == [None] * 3 + ["loose", "tight", None]
    assert [row.get("ratio") for row in rows] == [None] * 3 + [4.0, 2.0, None]


@pytest.mark.parametrize("order", [2, 4])
def test_differences_have_their_order(order):
    def power(D, G):
        return D**order + np.log(G) ** order

    D, G = np.array([2.4]), np.array([1e-10])
    slopes = order * D ** (order - 1), order * np.log(G) ** (order - 1)
    found = loops.differences(power, D, G, 0.1, order)
    np.testing.assert_allclose(found, [power(D, G), *slopes], rtol=1e-10)


def test_what_would_take_too_long_in_a_batch_is_left_out(monkeypatch):
    """Going by the batch before, unless that was short."""
    each = {"slow": 0.2, "short": 0.05, "quick": 0.001}  # s for one

    def taking_turns(calls, repeats):
        return {name: [each[name] * many] * repeats for name, many in calls.items()}

    def calls(many, quick):
        return {name: many for name in each if quick(name)}

    monkeypatch.setattr(timing, "taking_turns", taking_turns)
    found = [set(turns) for _, turns in timing.in_batches(calls, (1, 100, 1000), 3, limit=2.0)]
    assert found == [{"slow", "short", "quick"}, {"short", "quick"}, {"quick"}]


@pytest.mark.parametrize("family", eigenvalues.FAMILIES)
def test_truth_and_lapacks_matrices_are_of_the_same_systems(family):
    columns = eigenvalues.FAMILIES[family](np.random.default_rng(2), 3)
    matrices, omega = eigenvalues.state_matrices(columns)
    assert np.all(np.frexp(omega)[0] == 0.5)  # powers of two
    for A, unit, row in zip(matrices, omega, zip(*columns, strict=True), strict=True):
        a, b, c_1, c_2, g = row
        monic = [1, c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g]
        scaled = np.array(monic) / unit ** np.arange(5)
        np.testing.assert_allclose(np.poly(A), scaled, rtol=1e-10, atol=1e-12)
        exact, size = eigenvalues.exact_growth(*row)
        assert abs(float(exact) - np.roots(scaled).real.max() * unit) < 1e-10 * size


def test_extremes_of_a_sine_and_slopes_of_a_cycle():
    t = np.linspace(0, 20, 401)
    found, values = transients.extremes_of(t, np.sin(t), np.cos(t), -np.sin(t))
    np.testing.assert_allclose(found, np.pi * (0.5 + np.arange(len(found))), atol=1e-7)
    np.testing.assert_allclose(np.abs(values), 1, atol=1e-8)
    truth = np.array(list(limit_cycle.SLOPES.values())).T
    found = limit_cycle.differences(lambda place: truth @ place, 1e-3)
    np.testing.assert_allclose(found, truth, rtol=1e-9)
    assert not limit_cycle.slope_errors(truth).any()


@pytest.mark.slow
def test_transient_is_over_where_it_is_read():
    """Half as many periods again move the error by less than a fifth of the floor."""
    law, periods = transients.law(), transients.PERIODS[1e-2]
    counts = periods, 3 * periods // 2
    runs = (transients.tanh_run("SciPy LSODA", law, 1e-2, 1e-8, count) for count in counts)
    short, long = (
        np.array(limit_cycle.relative(*transients.last_period(law, run()))) for run in runs
    )
    assert np.all(np.abs(short - long) < 0.2 * long)


@pytest.mark.slow  # compiles with diffrax and numba
@pytest.mark.optimised
def test_every_integrator_solves_the_same_law():
    """Shorter than a cycle needs: what they read agrees to what their tolerance lets pass."""
    law, read = transients.law(), []
    for family, rtol, bound in (
        ("SciPy LSODA", 1e-10, 0),
        ("diffrax Tsit5", 1e-10, 1e-6),
        ("diffrax KenCarp4", 1e-6, 1e-5),
        ("numbalsoda LSODA", 1e-10, 1e-6),
        ("heyoka", 1e-10, 1e-6),
    ):
        if family.split()[0] in ("SciPy", *versions("diffrax", "numbalsoda", "heyoka")):
            run = transients.tanh_run(family, law, 1e-2, rtol, 6)
            read.append(transients.last_period(law, run()))
            np.testing.assert_allclose(read[-1], read[0], rtol=bound)


def test_ratios_are_to_the_quickest_peer_at_no_larger_an_error():
    own, events = limit_cycle.OWN, limit_cycle.EVENTS
    rows, times = [], {}
    for group, setting, error, own_times in (
        (own, "coarse", 1e-8, [1.0]),
        (own, "fine", 1e-10, [2.0, 4.0]),
        (events, "short", 1e-8, [5.0]),
        (events, "long", 1e-10, [8.0, 12.0]),
        (events, "longer", 1e-11, [9.0, 14.0]),
    ):
        errors = {"period": error, "amplitude": error}
        rows.append(limit_cycle.row(group, setting, seconds=np.median(own_times)) | errors)
        times[rows[-1]["name"]] = own_times
    (head,) = limit_cycle.headline(rows, times)
    assert head["ratio"] == 3.5 and "fine" in head["what"] and head["what"].endswith("long")
    names = ("fj.limit_cycle, default", "fj.limit_cycle, 24 segments", "heyoka by events")
    times = [[0.1, 0.1], [1.0, 2.0], [9.0, 12.0]]
    rows = [
        {"name": name, "devices": 2, "error": {"worst": error}, "seconds_a_cycle": own[0]}
        for name, error, own in zip(names, (1e-8, 1e-10, 1e-10), times, strict=True)
    ]
    (head,) = many_cycles.headline(rows, times)
    assert head["ratio"] == 7.5 and "24 segments" in head["what"]
    assert many_cycles.headline(rows[:2], times[:2]) == []
    lengths = np.array([1.0, 1.0, 2.0, 4.0])
    assert [many_cycles.busy(lengths, n) for n in (1, 2, 4)] == [1, 0.875, 0.5]


@pytest.mark.parametrize(
    "task",
    [designs.TASKS[0], *(pytest.param(t, marks=pytest.mark.slow) for t in designs.TASKS[1:])],
    ids=lambda task: task.name,
)
def test_package_and_loop_evaluate_a_design_alike(task):
    us = np.random.default_rng(3).uniform(size=(12, len(task.bounds)))
    found, loop = np.asarray(jax.jit(jax.vmap(designs.by_package(task)))(us)), designs.by_loop(task)
    np.testing.assert_allclose(found, [loop(u) for u in us], rtol=1e-9, atol=1e-9)
    assert (found[:, 1:].max(axis=1) > 0).any()
    u = np.linspace(0, 1, len(task.bounds))
    np.testing.assert_allclose(task.scaled(task.quantities(u)), u, atol=1e-12)
    ends = [list(task.quantities(u * 0 + end).values()) for end in (0, 1)]
    np.testing.assert_allclose(np.transpose(ends), list(task.bounds.values()))


def test_searches_on_the_loop_and_on_grids():
    """Where the slip limit meets the bound on G, by hand; no method misses it by more."""
    # Where SciPy before 1.16 gets there as well: elsewhere its differences may stop it early.
    task, start = designs.TASKS[0], np.array([0.3, 0.9])
    loop = designs.by_loop(task)
    found, simplex = designs.slsqp(task, loop, None, start), designs.nelder_mead(task, loop, start)
    assert found.answer is not None and simplex.answer is not None
    row = loop(found.answer)
    assert found.answer[1] == pytest.approx(1, abs=1e-12)  # G at its bound, up to rounding
    assert abs(row[2]) < 1e-9 and row[1:].max() < designs.MEETS  # Q_e at its limit
    assert row[0] < loop(simplex.answer)[0] < row[0] + 1

    def rows(us):
        away = np.sum((us - 0.3) ** 2, axis=1)
        return np.column_stack([away, 0.25 - us[:, 0]])  # the first variable is at least 0.25

    start = np.array([0.5, 0.5])
    plain, zoomed = (designs.grid(designs.TASKS[0], rows, 10, start, levels=n) for n in (1, 12))
    assert plain.answer is not None and zoomed.answer is not None
    assert plain.evaluations == 100 and plain.answer[0] > 0.25 - 1e-9
    np.testing.assert_allclose(np.abs(plain.answer - 0.3), 0.05)
    np.testing.assert_allclose(zoomed.answer, 0.3, atol=1e-6)


def test_runs_are_compared_as_wholes_by_the_median_start():
    late, never = np.array([[1.0, 2.0, 3.0], [0.5, 0.1, 0.1]]), np.array([[1.0], [np.inf]])
    assert designs.thinned(late) == [[1, 0.5], [2, 0.1], [3, 0.1]] and designs.thinned(never) == []
    assert designs.reached([late, late, never], 0.2) == {"starts": 2, "seconds": 2.0}
    assert designs.reached([late, never, never], 0.2) == {"starts": 1, "seconds": None}
    t, gap = designs.median_curve([designs.thinned(late), designs.thinned(late), []])
    assert list(t) == [1, 2, 3] and list(gap) == [0.5, 0.1, 0.1]
    runs = [
        {"name": "a", "compile_s": 9.0, "seconds": 3.0, "starts": 3, "near": {"starts": 3}},
        {"name": "b", "compile_s": 0.0, "seconds": 4.0, "starts": 3, "near": {"starts": 3}},
        {"name": "c", "compile_s": 0.0, "seconds": 0.1, "starts": 3, "near": {"starts": 2}},
    ]
    assert [designs.quickest(runs, "near", cold) for cold in (True, False)] == ["b: 4 s", "a: 3 s"]


@pytest.mark.slow
def test_a_job_gives_the_values_at_its_points(tmp_path):
    lengths, picked = (2, 3, 2, 2), (0, 5, 23)
    found = scale.in_this_process(lengths, 2, 10, stores=str(tmp_path), picked=picked)
    scenes = [fj.brake_scene().replace(**scale.at(lengths, point)) for point in picked]
    np.testing.assert_allclose(found["values"], list(map(fj.growth_rate, scenes)), rtol=1e-9)
    assert len(found["times"]) == 2 and found["result_bytes"] == 8 * 24
    assert len(scale.files(str(tmp_path))) == 3
    once = scale.in_this_process(lengths, at_once=True, picked=picked)
    np.testing.assert_allclose(once["values"], found["values"], rtol=1e-9)


def test_batches_that_are_begun_are_written_down(tmp_path, monkeypatch):
    monkeypatch.setattr(Batches, "begin", Batches.begin)  # put back afterwards
    scale.log_begun(str(tmp_path / "begun.txt"))
    for expected in (["0", "1", "2", "3"], ["0", "1", "2", "3", "1"]):
        scale.swept((2, 2, 2, 3), 10, tmp_path / "sweep")
        assert (tmp_path / "begun.txt").read_text().split() == expected
        (tmp_path / "sweep" / "computed" / "c.0.1.0.0").unlink()
    rows = [{"points": n, "seconds": 2e-6 * n} for n in (10, 1000, 100_000)]
    assert scale.slope(rows, "seconds") == pytest.approx(1)
    assert (scale.short(100_000_000), scale.short(4e6)) == ("1e8", "4e6")


def test_operations_are_counted_once_in_loops_and_calls():
    def twice(x):
        return jax.lax.fori_loop(0, 3, lambda i, x: jax.jit(lambda x: x * x + 1)(x), x)

    found = scene_cost.operations(jax.make_jaxpr(twice)(1.0).jaxpr)
    assert (found["mul"], found["add"]) == (1, 2)  # the second add is the loop's counter


@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_row_without_a_part_traces_fewer_operations(quick):
    """What is compiled of the first rows is counted by the quick run of the page."""
    counts = []
    for row in [row for row in scene_cost.ROWS if not quick or "amplitude" not in row.name]:
        counts.append(scene_cost.operations(scene_cost.traced(row)[0].jaxpr.jaxpr).total())
        assert row.without is None or counts[row.without] < counts[-1]


@pytest.mark.slow
def test_scipys_user_has_the_same_brake():
    """The joint and the growth rate by other code, in two regimes and at the reference."""
    scene = fj.brake_scene()
    for D, G in ((2.4, 1.342e-10), (2.55, 1e-10), (2.5, 3e-11), (2.35, 1e-8)):
        moved = scene.replace(D=D, G=G)
        found = scipy_user.joint(D, G)[:2]
        np.testing.assert_allclose(found, fj.stiffness(moved), rtol=1e-11)
        np.testing.assert_allclose(scipy_user.growth_rate(D, G), fj.growth_rate(moved), rtol=1e-9)
    # Stiffness to a hundred roundings of its inputs, growth rates to a few of their own.
    for row, truth, numbers in corner_rows():
        # Exactly coalescing eigenvalues keep half the digits, where a rounding separates them.
        wide, narrow = (1e-7, 1e-3) if row["corner"] == "exact coalescence" else (1e-15, 1e-6)
        if row["quantity"] == "K_n":
            condition = condition_number(truth, numbers)
            wide, narrow = (100 * np.finfo(x).eps * (1 + condition) for x in ("f8", "f4"))
        assert row["float64"] < wide and row["float32"] < narrow, row["corner"]


# The quick run of the page measures two others, tests/contact all quantities of the joint.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mechanism", "critical friction"])
def test_a_family_is_exact_to_what_its_inputs_allow(name):
    (family,) = (family for family in FAMILIES if family.name == name)
    tight = {"margin": 1e-12, "growth_rate": 1e-12, "real": 1e-12}
    for row in family_rows(family, 2000, 60, 5):
        found, name = row["float64"], row["quantity"]
        assert found["worst_beside_rounding"] < 100
        assert found["worst"] < tight.get(name, 1e-6)
        assert found["not_finite_gradient"] == 0
        assert found["not_finite"] == 0 or name == "mu_c"  # K_t = 0 never squeals


def condition_number(truth, numbers):
    """By how much more than themselves all relative changes of the inputs change K_n."""
    exact, total = truth(*numbers)["K_n"], 0.0
    for i, number in enumerate(numbers):
        step = 1e-9 * number  # far less than D is from 2
        high, low = (truth(*numbers[:i], at, *numbers[i + 1 :]) for at in (number + step, number))
        total += float(abs(high["K_n"] - low["K_n"])) / 1e-9
    return total / float(exact) if exact else 0.0
