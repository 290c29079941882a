"""The page of whole designs, run small; its errors are held, not its times."""

import jax
import numpy as np
import pytest

from benchmarks.designs import methods as design_methods
from benchmarks.designs.tasks import TASKS, by_loop, by_package
from benchmarks.designs.whole_design import reached, thinned
from benchmarks.designs.whole_design_page import median_curve, quickest
from tools import quick_benchmark


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_package_and_loop_judge_a_design_alike(task):
    us = np.random.default_rng(3).uniform(size=(12, len(task.bounds)))
    found = np.asarray(jax.jit(jax.vmap(by_package(task)))(us))
    loop = by_loop(task)
    np.testing.assert_allclose(found, [loop(u) for u in us], rtol=1e-9, atol=1e-9)
    assert (found[:, 1:].max(axis=1) > 0).any()


def test_scaled_variables_are_the_quantities_of_a_scene():
    for task in TASKS:
        u = np.linspace(0, 1, len(task.bounds))
        np.testing.assert_allclose(task.scaled(task.quantities(u)), u, atol=1e-12)
        ends = [list(task.quantities(u * 0 + end).values()) for end in (0, 1)]
        np.testing.assert_allclose(np.transpose(ends), list(task.bounds.values()))
        assert task.quantities(task.own)["D"] == pytest.approx(2.4)
        assert task.starts(3).shape == (3, len(task.bounds))


def test_methods_on_the_loop_end_in_the_optimum_from_nearby():
    """Where the slip limit meets the bound on G, by hand; no method misses it by more.

    From the own surface some versions of SciPy's SLSQP end at the other bound.
    """
    task = TASKS[0]
    loop = by_loop(task)
    start = np.array([0.45, 0.9])
    found = design_methods.slsqp(task, loop, None, start)
    assert found.answer is not None
    row = loop(found.answer)
    assert found.answer[1] == pytest.approx(1, abs=1e-12)  # G at its bound, up to rounding
    assert abs(row[2]) < 1e-9  # Q_e at its limit
    assert row[1:].max() < design_methods.MEETS
    assert found.evaluations >= len(found.seen) - 1
    simplex = design_methods.nelder_mead(task, loop, start)
    assert simplex.answer is not None
    assert row[0] < loop(simplex.answer)[0] < row[0] + 1


def test_grids_keep_the_best_that_meets_every_requirement():
    task = TASKS[0]

    def rows(us):
        away = np.sum((us - 0.3) ** 2, axis=1)
        return np.column_stack([away, 0.25 - us[:, 0]])  # the first variable is at least 0.25

    start = np.array([0.5, 0.5])
    grid = design_methods.grid(task, rows, 10, start)
    assert grid.answer is not None and grid.evaluations == 100
    np.testing.assert_allclose(np.abs(grid.answer - 0.3), 0.05)
    assert grid.answer[0] > 0.25 - 1e-9
    zoomed = design_methods.zoomed_grid(task, rows, 10, start)
    assert zoomed.answer is not None
    np.testing.assert_allclose(zoomed.answer, 0.3, atol=1e-6)


def test_what_is_shown_of_runs():
    late, never = np.array([[1.0, 2.0, 3.0], [0.5, 0.1, 0.1]]), np.array([[1.0], [np.inf]])
    assert thinned(late) == [[1, 0.5], [2, 0.1], [3, 0.1]] and thinned(never) == []
    assert reached([late, late, never], 0.2) == {"starts": 2, "seconds": 2.0}
    assert reached([late, never, never], 0.2) == {"starts": 1, "seconds": None}
    t, gap = median_curve([thinned(late), thinned(late), []])
    assert list(t) == [1, 2, 3] and list(gap) == [0.5, 0.1, 0.1]
    runs = [
        # Whole runs count: b comes near first.
        {"name": "a", "compile_s": 9.0, "seconds": 3.0, "near": {"starts": 3, "seconds": 2.0}},
        {"name": "b", "compile_s": 0.0, "seconds": 4.0, "near": {"starts": 3, "seconds": 1.0}},
        {"name": "c", "compile_s": 0.0, "seconds": 0.1, "near": {"starts": 2, "seconds": 0.1}},
    ]
    for cold, name in ((True, "b"), (False, "a")):
        best = quickest([run | {"starts": 3} for run in runs], "near", cold)
        assert best is not None and best["name"] == name


@pytest.mark.slow  # compiles two designs
def test_whole_design_benchmark_finds_the_optimum_and_never_a_better_one(tmp_path):
    numbers, page = quick_benchmark("whole_design", tmp_path)
    assert len(numbers["tasks"]) == 2
    for task in numbers["tasks"]:
        best = task["optimum"]
        assert best["agree"] >= 2 and best["dense_gap"] > -1e-9
        assert best["off_exact"] < 1e-8
        assert f"## {task['title']}" in page
    for run in numbers["runs"]:
        assert f"| {run['name']} |" in page
        assert run["seconds"] > 0 and run["evaluations"] > 0
        if run["family"] == "design":
            assert run["exact"]["starts"] == run["starts"] and run["violation"] == 0
            assert run["compile_s"] > 0
        if run["family"] in ("grid", "zoom") and "^2" in run["name"]:
            assert run["violation"] == 0 and run["gap"]["worst"] < 0.1
    scattered = [run for run in numbers["runs"] if run["family"].startswith("scattered")]
    assert all(run["gap"]["worst"] < 1e-6 for run in scattered)
