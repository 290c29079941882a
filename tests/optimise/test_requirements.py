"""Averages over conditions, and that nothing is traced which a design does not ask for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.optimise.constraints import NormalStiffness
from fractaljax.optimise.requirements import Problem, Request, _linearise, expected_shortfall
from fractaljax.optimise.task import pose

OPTIONS = dict(
    bounds={"D": (2.1, 2.9), "G": (1e-12, 1e-8)},
    objective=None,
    target=None,
    K_n_min=None,
    constraints=(),
    envelope=None,
    risk="worst",
    tolerance=None,
    quantile=0.95,
    area_ratio_min=2.0,
    slip_ratio_max=0.9,
    friction_slope=True,
    starts=4,
    lattice=4,
    seed=0,
)


def posed(**changes):
    return pose(fj.brake_scene(), OPTIONS | changes)


def traced(task, conditions=None):
    """The program of a search, as text, and how many operations it has."""
    us = jnp.full((4, 2), 0.5)
    jaxpr = jax.make_jaxpr(_linearise, static_argnums=0)(task.problem, task.request, us, conditions)
    return str(jaxpr), len(jaxpr.jaxpr.eqns[0].params["jaxpr"].eqns)


def test_only_what_is_asked_is_traced():
    """No ordering of conditions or scatter without them, and no larger a program."""
    plain, plain_size = traced(posed())
    assert not any(word in plain for word in ("sort", "cumsum", "log_sum_exp", "reduce_max"))
    assert "f64[4,3,1]" not in plain and "f64[55" not in plain
    scattered, _ = traced(posed(tolerance={"D": 0.005}))
    assert "cumsum" in scattered and "f64[55" in scattered
    envelope = fj.Envelope({"P": (1500.0, 2500.0)})
    conditions = jnp.full((4, 3, 1), 2000.0)
    enveloped, size = traced(posed(envelope=envelope), conditions)
    assert "f64[4,3,1]" in enveloped and "cumsum" not in enveloped and size >= plain_size
    ratio = fj.brake_scene().replace(stiffness_ratio=0.2)
    without_law = pose(ratio, OPTIONS)
    assert traced(without_law)[1] < plain_size


def test_names_are_in_the_order_of_the_requirements():
    """Plain functions and constraints keep their places."""

    def coarse(scene):
        return scene.contact.surface.D - 2.42

    task = posed(constraints=(NormalStiffness(4e8), coarse, NormalStiffness(5e8)))
    names = task.problem.names(task.request)
    assert names[-3:] == ["K_n >= 4e+08 N/m", "coarse", "K_n >= 5e+08 N/m"]
    values = task.problem.requirements(task.request, task.request.start)
    assert len(values) == len(names)
    assert values[-2] == pytest.approx(2.4 - 2.42)


def test_new_numbers_need_no_new_program():
    """Two designs of one kind differ in leaves alone."""
    first, second = (
        posed(
            envelope=fj.Envelope({"P": (1500.0, high)}),
            tolerance={"D": sigma},
            constraints=(NormalStiffness(limit),),
        )
        for high, sigma, limit in [(2500.0, 0.005, 1e8), (2600.0, 0.004, 2e8)]
    )
    assert first.problem == second.problem and hash(first.problem) == hash(second.problem)
    structures = [jax.tree.structure(task.request) for task in (first, second)]
    assert structures[0] == structures[1]


@pytest.mark.parametrize(("count", "alpha"), [(10, 0.9), (10, 0.85), (7, 0.0), (4, 0.99)])
def test_expected_shortfall_is_the_mean_of_the_worst(count, alpha):
    """Against the integral of the quantile function over the tail."""
    values = np.sort(np.random.default_rng(count).normal(size=count))
    levels = np.linspace(alpha, 1, 200001)[:-1] + (1 - alpha) / 400000
    tail = values[np.minimum((levels * count).astype(int), count - 1)]
    assert expected_shortfall(count, alpha) @ values == pytest.approx(tail.mean(), abs=1e-4)
    assert expected_shortfall(count, alpha).sum() == pytest.approx(1, rel=1e-14)


def averaged(risk, each):
    problem = Problem(("D",), fj.growth_rate, (), True, True, ("P",), risk[0])
    request = posed().request
    request = Request(
        **{**vars(request), "risk": None if risk[1] is None else jnp.asarray(risk[1])}
    )
    return np.asarray(problem.averaged(request, jnp.asarray(each)))


def test_ways_to_take_an_envelope():
    """Worst, at least the worst and smooth, and a mean of the tail; in that order of size."""
    each = np.random.default_rng(0).normal(size=(10, 3))
    worst = averaged(("worst", None), each)
    np.testing.assert_array_equal(worst, each.max(axis=0))
    smooth = averaged(("smooth", 0.02), each)
    assert (smooth >= worst).all() and (smooth <= worst + 0.02 * np.log(10)).all()
    tail = averaged(("cvar", expected_shortfall(10, 0.8)), each)
    np.testing.assert_allclose(tail, np.sort(each, axis=0)[-2:].mean(axis=0))
