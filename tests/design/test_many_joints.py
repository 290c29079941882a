"""Designs over the surfaces of many joints, each of which has limits of its own."""

import functools
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from fractaljax._design.design import default_solver, designs_to_screen
from fractaljax._design.few_modes import project_on_modes
from fractaljax._design.joint_limits import make_joint_limits
from fractaljax._design.joints import joint_state, joint_states
from fractaljax._design.rows import evaluate, linearise
from fractaljax._design.solvers import slsqp
from fractaljax._design.starts import spread_designs
from random_brakes import random_brake
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
    found = joint_states(parts)
    assert list(found) == list(parts)
    for name, part in parts.items():
        wanted = joint_state(part)
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
    problem = fj.DesignProblem(x, bounds_of(x), **STATED)
    drawn = spread_designs(12, 8)
    nothing = np.zeros((len(drawn), 0))  # of an envelope
    residuals, slopes = make_joint_limits(problem)(drawn, nothing)
    assert (residuals.max(axis=1) <= 0).mean() < 0.1
    _, moved = designs_to_screen(problem, 8, 12)
    assert ((moved >= 0) & (moved <= 1)).all()
    within = make_joint_limits(problem)(moved, nothing[: len(moved)])[0]
    assert (within.max(axis=1) <= 0).mean() > 0.7
    # A few designs, one by one, are as those of a batch.
    for few, many in zip(
        make_joint_limits(problem)(drawn[:3], nothing[:3]), (residuals, slopes), strict=True
    ):
        np.testing.assert_allclose(few, many[:3], rtol=1e-10, atol=1e-12)
    # One in three is near the given design.
    away = np.abs(moved - np.asarray(problem.start)).mean(axis=1)
    assert np.median(away[::3]) < 0.1 < np.median(away[2::3])
    # They are those of the whole problem, in an order of their own: model first.
    row, jacobian, _ = linearise(problem, drawn[:1], np.zeros((1, 0)))
    k = problem.model_residuals
    np.testing.assert_allclose(residuals[0, :k], row[0, 1 : 1 + k], rtol=1e-12)
    np.testing.assert_allclose(slopes[0, :k], jacobian[0, 1 : 1 + k], rtol=1e-9, atol=1e-12)
    assert default_solver(problem) is None

    few = several_joints(2)
    problem = fj.DesignProblem(few, bounds_of(few), **STATED)
    np.testing.assert_array_equal(designs_to_screen(problem, 8, 12)[1], spread_designs(12, 4))
    assert default_solver(problem) is slsqp


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [None, {"j1.D": 0.01}])
def test_limits_of_joints_are_those_of_each_condition(tolerance):
    """With scatter, their quantiles; slopes against differences."""
    x = several_joints(3, mu=0.5)
    asked: dict[str, Any] = dict(envelope=fj.Envelope.of({"j0.mu": (0.4, 0.6), "j2.P": (1e3, 2e3)}))
    asked["tolerance"] = None if tolerance is None else fj.Tolerance.of(tolerance)
    problem = fj.DesignProblem(x, bounds_of(x), **STATED | asked)
    us = np.asarray(problem.start) + np.linspace(-0.05, 0.05, 6) * [[1], [-1], [0.5]]
    conditions = np.array([[0.4, 1e3], [0.6, 2e3], [0.5, 1.5e3]])
    found, slopes = make_joint_limits(problem)(us, conditions)
    rows = evaluate(problem, us, conditions)[:, problem.joint_columns]
    k = problem.model_residuals
    np.testing.assert_allclose(found[:, :k], rows[:, :k], rtol=1e-12)
    np.testing.assert_allclose(-np.expm1(-found[:, k:]), rows[:, k:], rtol=1e-12)
    # The same design under another condition is another.
    assert np.abs(make_joint_limits(problem)(us, conditions[::-1])[0] - found).max() > 0.01
    step = 1e-6 * np.cos(np.arange(6.0))
    ends = [make_joint_limits(problem)(us + way * step, conditions)[0] for way in (1, -1)]
    np.testing.assert_allclose(slopes @ step, (ends[0] - ends[1]) / 2, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
@pytest.mark.optimised
def test_a_design_of_many_joints_stays_near():
    """Under a range of friction, from a few starts."""
    x = several_joints(4, mu=0.5)
    asked: Any = dict(envelope={"j0.mu": (0.45, 0.6)}, starts=12, progress=False)
    found = fj.design(x, bounds_of(x), **asked)
    assert not found.violated and found.growth_rate <= found.target
    assert found.value < 0.003848


@functools.cache
def parametric_brake():
    """A random brake with a pad stiffer by a share, damping of two coefficients, and its problem.

    Loads and friction of its nine joints are designed besides.
    """
    x = random_brake(7)
    pad = np.array([name.startswith("pad") for name in x.names or ()])
    M, C, K = (np.asarray(A) for A in (x.M, x.C, x.K))
    columns = np.stack([M.ravel() * 1e8, K.ravel()], axis=1)
    alpha, beta = np.linalg.lstsq(columns, C.ravel())[0] * [1e8, 1]
    joints = dict(zip(x.joint_names, x.joints, strict=True))
    given = {"alpha": alpha, "beta": beta, "stiffer": 0.0}
    terms = [("alpha", M), ("beta", K)], [(1.0, K), ("stiffer", K * np.outer(pad, pad))]
    brake = fj.ParametricStructure(M, *terms, joints, given, names=x.names)
    bounds = {"alpha": (5.0, 40.0), "beta": (5e-8, 1e-6), "stiffer": (-0.4, 0.4)}
    for name, joint in joints.items():
        P = float(joint.contact.P)
        bounds |= {f"{name}.P": (0.6 * P, 1.6 * P), f"{name}.mu": (0.2, 0.65)}
    return brake, fj.DesignProblem(brake, bounds, **dict(STATED, K_n_min=None))


def rates_by_scipy(x, count: int) -> np.ndarray:
    """The `count` largest growth rates [1/s] of a structure whose joints have Coulomb friction."""
    M, C, K = (np.array(A) for A in (x.M, x.C, x.K))
    n = len(M)
    for joint in x.joints:
        t, across = np.zeros((2, n))
        for direction, weights in ((t, joint.tangential), (across, joint.normal)):
            for dof, weight in weights:
                direction[dof] = weight
        K_n, K_t = map(float, joint.stiffness())
        mu = float(joint.friction.mu_s)
        K += K_n * np.outer(across - mu * t, across) + K_t * np.outer(t + mu * across, t)
    unit = 1e5  # of time, 1/s
    below = -np.linalg.solve(M, np.hstack([K / unit, C]))
    s: Any = scipy.linalg.eigvals(np.block([[np.zeros((n, n)), unit * np.eye(n)], [below]]))
    return np.sort(s[s.imag >= 0].real)[::-1][:count]


@pytest.mark.slow
def test_rows_and_slopes_of_loads_friction_and_parameters_of_a_brake():
    """Growth rates and their slopes against SciPy's eigenvalues; limits against differences."""
    x, problem = parametric_brake()
    names, columns = list(problem.names), problem.growth_columns
    start = np.asarray(problem.start)
    u = np.clip(start + 0.05 * np.cos(np.arange(len(start))), 0, 1)
    nothing = np.zeros((1, 0))

    def rates(u):
        return rates_by_scipy(
            x.replace(**{name: float(q) for name, q in problem.quantities(u).items()}),
            problem.modes,
        )

    rows, jacobians = (found[0] for found in linearise(problem, u[None], nothing)[:2])
    scale = float(problem.growth_scale)
    found = float(problem.target) + scale * np.sinh(rows[columns])
    np.testing.assert_allclose(found, rates(u), rtol=1e-9, atol=1e-6)
    slopes = jacobians[columns] * scale * np.cosh(rows[columns])[:, None]
    for name in ("pair_3.P", "pair_5.mu", "stiffer", "alpha", "beta"):
        i, step = names.index(name), 1e-5 * (np.arange(len(u)) == names.index(name))
        wanted = (rates(u + step) - rates(u - step)) / 2e-5
        np.testing.assert_allclose(
            slopes[:, i], wanted, rtol=1e-5, atol=1e-5 * np.abs(wanted).max()
        )
        limits = [
            make_joint_limits(problem)((u + way)[None], nothing)[0][0] for way in (step, -step)
        ]
        by = make_joint_limits(problem)(u[None], nothing)[1][0][:, i]
        np.testing.assert_allclose(by, (limits[0] - limits[1]) / 2e-5, rtol=1e-6, atol=1e-7)
        assert (np.abs(by).max() > 0) == ("." in name)


@pytest.mark.slow
def test_a_brake_in_few_modes_has_nearly_its_growth_rates():
    """In designs that its space is of, and near them."""
    _, problem = parametric_brake()
    start = np.asarray(problem.start)
    us = np.clip(start + 0.1 * np.random.default_rng(0).uniform(-1, 1, (13, len(start))), 0, 1)
    rough = project_on_modes(problem, us[:12])
    assert rough is not None and rough.x.n < 100
    both = [
        linearise(each, us[[3, 12]], np.zeros((2, 0)))[0][:, each.growth_columns]
        for each in (problem, rough)
    ]
    whole, few = (float(problem.growth_scale) * np.sinh(rows) for rows in both)
    np.testing.assert_allclose(few[0], whole[0], rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(few[1], whole[1], rtol=1e-3, atol=0.1)
    assert np.abs(few[1] - whole[1]).max() > 1e-8

    def objective(x):
        return x.joints[0].contact.P

    assert project_on_modes(problem.with_fields(objective=objective), us) is None
    few_joints = several_joints(4)
    small = fj.DesignProblem(few_joints, bounds_of(few_joints), **STATED)
    assert project_on_modes(small, np.asarray(small.start)[None]) is None
