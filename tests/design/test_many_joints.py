"""Designs over the surfaces of many joints, each of which has limits of its own."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.design import screened, solver_of
from fractaljax._design.joints import state_of, states_of
from fractaljax._design.problem import evaluate, limits_of_joints, linearise, state_problem
from fractaljax._design.solvers import slsqp
from fractaljax._design.starts import screened_designs
from structures import two_joints

NONE: dict[str, Any] = dict.fromkeys(("objective", "target", "envelope", "tolerance"))
STATED: dict[str, Any] = NONE | dict(
    K_n_min=0.0,
    constraints=(),
    quantile=0.95,
    area_ratio_min=2.0,
    slip_ratio_max=0.9,
    friction_slope=True,
)
ENDS: dict[str, tuple[float, float]] = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}


def several_joints(count: int, P: float = 1500.0, mu: float = 0.3) -> Any:
    """Four degrees of freedom with fractal joints between the first and the others."""
    plain, contact = two_joints(4), fj.brake_scene().contact
    joints = {}
    for i in range(count):
        own = fj.FractalContact(contact.surface, contact.material, P * (1 + i / 10))
        ends = [(0, 2), (1, 2), (0, 3), (1, 3)][i]
        joints[f"j{i}"] = fj.Joint(own, fj.Coulomb(mu + i / 20), *ends, V=1.0)
    return fj.Structure(plain.M, plain.C, plain.K, joints)


def bounds_of(x) -> dict[str, tuple[float, float]]:
    return {f"{name}.{q}": ends for name in x.joint_names for q, ends in ENDS.items()}


def test_states_of_joints_that_share_a_law_are_those_of_each():
    x = several_joints(4)
    parts = dict(zip(x.joint_names, x.joints, strict=True))
    # One has a stiffness ratio, which is another law.
    parts["odd"] = several_joints(1).replace(**{"j0.stiffness_ratio": 0.5}).joints[0]
    found = states_of(parts)
    assert list(found) == list(parts)
    for name, part in parts.items():
        wanted = state_of(part)
        for key in ("K_n", "K_t", "log_area_ratio", "slip_ratio"):
            one, other = getattr(found[name], key), getattr(wanted, key)
            if other is None:
                assert one is None
            else:
                np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.slow
def test_designs_that_are_screened_are_inside_the_limits_of_all_joints():
    """Of those of an even spread nearly none is; two joints, as before, take those as they are."""
    x = several_joints(4)
    problem = state_problem(x, bounds_of(x), **STATED)
    drawn = screened_designs(12, 8)
    residuals, slopes = limits_of_joints(problem, drawn, np.zeros((len(drawn), 0)))
    assert (residuals.max(axis=1) <= 0).mean() < 0.1
    _, moved = screened(problem, 8, 12)
    assert ((moved >= 0) & (moved <= 1)).all()
    assert (
        limits_of_joints(problem, moved, np.zeros((len(moved), 0)))[0].max(axis=1) <= 0
    ).mean() > 0.7
    # One in three is near the given design.
    away = np.abs(moved - np.asarray(problem.start)).mean(axis=1)
    assert np.median(away[::3]) < 0.1 < np.median(away[2::3])
    # They are those of the whole problem, in an order of their own: model first.
    row, jacobian, _ = linearise(problem, drawn[:1], np.zeros((1, 0)))
    k = problem.model_residuals
    np.testing.assert_allclose(residuals[0, :k], row[0, 1 : 1 + k], rtol=1e-12)
    np.testing.assert_allclose(slopes[0, :k], jacobian[0, 1 : 1 + k], rtol=1e-9, atol=1e-12)
    assert solver_of(problem) is None

    few = several_joints(2)
    problem = state_problem(few, bounds_of(few), **STATED)
    np.testing.assert_array_equal(screened(problem, 8, 12)[1], screened_designs(12, 4))
    assert solver_of(problem) is slsqp


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [None, {"j1.D": 0.01}])
def test_limits_of_joints_are_those_of_each_condition(tolerance):
    """With scatter, their quantiles; slopes against differences."""
    x = several_joints(3, mu=0.5)
    asked: dict[str, Any] = dict(envelope=fj.Envelope.of({"j0.mu": (0.4, 0.6), "j2.P": (1e3, 2e3)}))
    asked["tolerance"] = None if tolerance is None else fj.Tolerance.of(tolerance)
    problem = state_problem(x, bounds_of(x), **STATED | asked)
    us = np.asarray(problem.start) + np.linspace(-0.05, 0.05, 6) * [[1], [-1], [0.5]]
    conditions = np.array([[0.4, 1e3], [0.6, 2e3], [0.5, 1.5e3]])
    found, slopes = limits_of_joints(problem, us, conditions)
    rows = evaluate(problem, us, conditions)[:, problem.joint_columns]
    k = problem.model_residuals
    np.testing.assert_allclose(found[:, :k], rows[:, :k], rtol=1e-12)
    np.testing.assert_allclose(-np.expm1(-found[:, k:]), rows[:, k:], rtol=1e-12)
    # The same design under another condition is another.
    assert np.abs(limits_of_joints(problem, us, conditions[::-1])[0] - found).max() > 0.01
    step = 1e-6 * np.cos(np.arange(6.0))
    ends = [limits_of_joints(problem, us + way * step, conditions)[0] for way in (1, -1)]
    np.testing.assert_allclose(slopes @ step, (ends[0] - ends[1]) / 2, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_a_design_of_many_joints_stays_near():
    """From an even spread over the bounds alone the nearest that is found is at 0.27."""
    x = several_joints(4, mu=0.5)
    found = fj.design(x, bounds_of(x), progress=False)
    assert not found.violated and found.growth_rate <= found.target
    assert found.value < 0.0035


@pytest.mark.slow
def test_a_design_of_many_joints_under_an_envelope_stays_near():
    """With the limits of joints among the other requirements the nearest was at 0.00391."""
    x = several_joints(4, mu=0.5)
    found = fj.design(x, bounds_of(x), envelope={"j0.mu": (0.45, 0.6)}, progress=False)
    assert not found.violated and found.growth_rate <= found.target
    assert found.value < 0.00386
