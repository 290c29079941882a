"""Designs over the surfaces of many joints, each of which has limits of its own."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.design import screened, solver_of
from fractaljax._design.joints import state_of, states_of
from fractaljax._design.problem import limits_of_joints, linearise, state_problem
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
    residuals, slopes = limits_of_joints(problem, drawn)
    assert (residuals.max(axis=1) <= 0).mean() < 0.1
    _, moved = screened(problem, 8, 12)
    assert ((moved >= 0) & (moved <= 1)).all()
    assert (limits_of_joints(problem, moved)[0].max(axis=1) <= 0).mean() > 0.7
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
def test_a_design_of_many_joints_stays_near():
    """From an even spread over the bounds alone the nearest that is found is at 0.27."""
    x = several_joints(4, mu=0.5)
    found = fj.design(x, bounds_of(x), progress=False)
    assert not found.violated and found.growth_rate <= found.target
    assert found.value < 0.0035
