"""Designs with something asked of their limit cycle, which is followed from one to the next."""

import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design import followed
from fractaljax._design.constraints import CycleAmplitude, VelocityLevel
from fractaljax._design.rows import linearise
from mechanisms import PROBLEMS
from structures import of_problem
from tools import refusals

BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
LOUD: dict[str, Any] = {"target": 1e4, "K_n_min": 0.0, "progress": False}
OPTIONS: dict[str, Any] = dict(
    target=1e4, K_n_min=0.0, envelope=None, tolerance=None, quantile=0.95
)
OPTIONS |= dict(area_ratio_min=2.0, slip_ratio_max=0.9, friction_slope=True)
LIMIT = 12e-6


def problem(x=None, bounds=None, objective=None, constraints=()):
    x, bounds = x or fj.brake_scene(), bounds or BOUNDS
    return fj.DesignProblem(x, bounds, objective=objective, constraints=constraints, **OPTIONS)


def rows(problem, u):
    """Objective and residuals, and their Jacobian, at one design."""
    u = np.atleast_1d(np.asarray(u, float))
    row, jacobian, _ = linearise(problem, u[None], np.zeros((1, 0)))
    return row[0, problem.named_columns], jacobian[0, problem.named_columns]


def searched(problem, u):
    """The cycle that the search finds at a design."""
    x = problem.mechanism_at(jnp.asarray(u), problem.nominal_condition)
    return fj.limit_cycle(x, throw=False)


def brake_cycle():
    return fj.limit_cycle(fj.brake_scene())


def belt_cycle():
    belt = PROBLEMS["papangelo_2017"]
    return fj.limit_cycle(of_problem(belt), belt["start"])


@pytest.mark.slow
@pytest.mark.parametrize("found", [brake_cycle, belt_cycle])
def test_root_mean_square_velocity(found):
    """By quadrature of the orbit between its switches; the level is relative to 1 nm/s."""
    cycle = found()
    system, n = cycle._system, len(cycle.amplitude)
    period = float(cycle.period * system.omega)
    edges = [0.0, *(s.time * float(system.omega) for s in cycle.switches()), period]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cuts = np.concatenate([np.linspace(*ends, 33)[:-1] for ends in itertools.pairwise(edges)])
    lengths = np.diff(cuts, append=period)[:, None]
    times = cuts[:, None] + lengths * (1 + nodes) / 2
    at = jax.jit(lambda t: cycle._orbit.at(system, t))
    states = np.asarray(at(jnp.asarray(times.ravel())))
    for i in range(n):
        squares = states[n + i].reshape(times.shape) ** 2
        truth = math.sqrt((squares * lengths * weights / 2).sum() / period)
        truth *= float(system.units[n + i])
        assert float(cycle.velocity_rms[i]) == pytest.approx(truth, rel=1e-9)
        level = 20 * math.log10(truth / 1e-9)
        assert float(cycle.velocity_level[i]) == pytest.approx(level, abs=1e-8)


@pytest.mark.slow
def test_followed_cycles_are_those_of_the_search():
    """Across changes of itinerary, in value and slope, in whatever order they are asked for."""
    asked = problem(objective=CycleAmplitude(dof=1), constraints=[VelocityLevel(90.0)])
    own = np.asarray(asked.start)
    itineraries = set()
    for away in ([0.0, 0.0], [0.0, -0.1], [0.0, 0.1], [0.02, 0.01]):
        u = own + np.array(away)
        found, slopes = rows(asked, u)
        cycle = searched(asked, u)
        itineraries.add(tuple((s.direction, s.after) for s in cycle.switches()))
        assert cycle.result == fj.CycleResult.converged
        level = (float(cycle.velocity_level[0]) - 90) / 10
        np.testing.assert_allclose(
            [found[0], found[-1]], [float(cycle.amplitude[1]), level], rtol=1e-8, atol=1e-9
        )
        for i in range(2):
            step = 1e-5 * np.eye(2)[i]
            ends = [searched(asked, u + sign * step) for sign in (1, -1)]
            sizes = [[float(c.amplitude[1]), float(c.velocity_level[0]) / 10] for c in ends]
            slope = (np.array(sizes[0]) - sizes[1]) / 2e-5
            np.testing.assert_allclose(slopes[[0, -1], i], slope, rtol=2e-5)
    assert len(itineraries) > 1


@pytest.mark.slow
def test_a_cycle_that_ends():
    """At rest the measures are 0, of one that the motion reaches by itself they are not."""
    asked = problem(objective=CycleAmplitude(), constraints=[VelocityLevel(90.0)])
    for name, u in (("rest", [0.27, 0.55]), ("squeal", np.asarray(asked.start))):
        cycle = searched(asked, np.asarray(u))
        row, slopes = rows(asked, u)
        if name == "rest":
            assert cycle.result == fj.CycleResult.equilibrium
            assert row[0] == 0 and row[-1] == -9 and not slopes[[0, -1]].any()
        else:
            assert row[0] == pytest.approx(float(cycle.amplitude[0]), rel=1e-9)


@pytest.mark.slow
def test_nearest_design_below_an_amplitude(monkeypatch):
    """It is at the limit, and no nearer one has a smaller cycle, though at one it has ended.

    The cycle is searched for once.
    """
    searches = []
    monkeypatch.setattr(
        followed,
        "limit_cycle",
        lambda *args, **how: searches.append(1) or fj.limit_cycle(*args, **how),
    )
    best = fj.design(fj.brake_scene(), BOUNDS, constraints=[CycleAmplitude(LIMIT)], **LOUD)
    assert len(best.history["D"]) > 8 and len(searches) == 1
    assert best.violated == () and best.active == ("cycle amplitude <= 1.2e-05 m",)
    cycle = fj.limit_cycle(best.scene)
    assert float(cycle.amplitude[0]) == pytest.approx(LIMIT, rel=1e-6)
    ((name, (before, after)),) = (best.cycles or {}).items()
    assert name == "cycle amplitude of dof 0 [m]" and name in str(best)
    own = float(fj.limit_cycle(best.initial).amplitude[0])
    assert [before, after] == pytest.approx([own, LIMIT], rel=1e-6)
    asked = problem()
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * 0.98 * math.sqrt(best.value)
    us = jnp.asarray(np.asarray(asked.start) + ring)
    cycles = jax.jit(jax.vmap(lambda u: searched(asked, u)))(us)
    at_rest = cycles.result == fj.CycleResult.equilibrium
    assert ((cycles.amplitude[:, 0] > LIMIT) | at_rest).all() and at_rest.sum() <= 1


@pytest.mark.slow
def test_a_run_is_repeated_from_its_file_and_a_structure(tmp_path):
    """With the objective, its degree of freedom and the limits."""
    limits = [VelocityLevel(95.0, dof=1)]
    bounds, objective = {"D": (2.39, 2.41)}, CycleAmplitude(dof=1)
    first = fj.design(fj.brake_scene(), bounds, objective, constraints=limits, **LOUD)
    first.save(tmp_path / "run.toml")
    again = fj.repeat_design(tmp_path / "run.toml", progress=False)
    assert again.value == first.value and again.cycles == first.cycles
    assert again.options["objective"].dof == 1 and len(first.cycles or {}) == 2
    # The belt: the speed at which its stick-slip cycle is half as large.
    belt = of_problem(PROBLEMS["papangelo_2017"])
    own = float(fj.limit_cycle(belt).amplitude[0])
    best = fj.design(belt, {"V": (0.3, 1.5)}, constraints=[CycleAmplitude(0.6 * own)], **LOUD)
    assert best.violated == ()
    assert float(fj.limit_cycle(best.scene).amplitude[0]) == pytest.approx(0.6 * own, rel=1e-6)


test_refusals = refusals(
    [
        (lambda x: problem(constraints=[CycleAmplitude()]), "as a requirement needs at_most"),
        (
            lambda x: problem(objective=CycleAmplitude(dof=2)),
            "dof of cycle amplitude must be below 2",
        ),
        (lambda x: CycleAmplitude(-1.0), "cycle amplitude at_most must be above 0, got -1.0"),
        (lambda x: CycleAmplitude(1.0, dof=-1), "dof must be a whole number of at least 0, got -1"),
        (
            lambda x: fj.design(x, objective=VelocityLevel(), envelope={"P": (900.0, 1100.0)}),
            "velocity level takes no envelope and no tolerance",
        ),
    ],
    lambda call: call(fj.brake_scene()),
)
