"""The constrained search against problems whose solution is known, and against SciPy."""

import itertools

import numpy as np
import pytest
from scipy.optimize import minimize

from fractaljax.optimise.search import _bfgs, _quadratic_step, search

SLACK = 1e-9


def model_of(f, c):
    """Values and Jacobians of a batch from functions of one point, by complex step."""

    def model(us):
        h = 1e-30
        values = np.array([np.concatenate([[f(u)], c(u)]) for u in us])
        columns = [
            np.imag([np.concatenate([[f(u + s)], c(u + s)]) for u in us.astype(complex)]) / h
            for s in 1j * h * np.eye(us.shape[1])
        ]
        jacobian = np.stack(columns, axis=2)
        return values[:, 0], values[:, 1:], jacobian[:, 0], jacobian[:, 1:]

    return model


def best_of(model, ends):
    """The least value among end points that meet every constraint."""
    values, excess, _, _ = model(ends)
    meets = (excess <= 0).all(axis=1)
    i = np.where(meets, values, np.inf).argmin()
    assert meets[i]
    return ends[i], values[i]


def starts(n, v=2, seed=0):
    return np.random.default_rng(seed).uniform(size=(n, v))


def circle(u):
    return np.array([0.09 - (u[0] - 0.5) ** 2 - (u[1] - 0.5) ** 2])


@pytest.mark.parametrize(
    ("f", "c", "solution"),
    [
        # Outside a circle, nearest to a point inside it: along the radius.
        (lambda u: (u[0] - 0.6) ** 2 + (u[1] - 0.5) ** 2, circle, (0.8, 0.5)),
        # Two curves meet in a corner.
        (
            lambda u: u[0] + 2 * u[1],
            lambda u: np.array([0.25 - u[0] * u[1], u[0] ** 2 - 0.36]),
            (0.6, 0.25 / 0.6),
        ),
        # The bounds alone decide.
        (lambda u: u[0] - u[1], lambda u: np.array([-1 + 0 * u[0]]), (0.0, 1.0)),
        # Nothing decides: a smooth minimum inside.
        (
            lambda u: (u[0] - 0.3) ** 2 + 5 * (u[1] - 0.7 - u[0] ** 2 / 2) ** 2,
            lambda u: np.array([-1 + 0 * u[0]]),
            (0.3, 0.745),
        ),
    ],
)
def test_known_solutions(f, c, solution):
    """Curved, cornered, bounded and free minima, to the accuracy of the slack."""
    model = model_of(f, c)
    ends, _ = search(model, starts(12), SLACK, progress=False)
    point, _ = best_of(model, ends)
    np.testing.assert_allclose(point, solution, atol=1e-8)


def test_random_problems_against_slsqp():
    """Random curved constraints: no worse than SciPy's SLSQP from the same starts."""
    rng = np.random.default_rng(5)
    for _ in range(4):
        centre, weights = rng.uniform(size=2), rng.normal(size=(3, 5))

        def f(u, centre=centre):
            return ((u - centre) ** 2).sum()

        def c(u, weights=weights):
            basis = np.array([1 + 0 * u[0], u[0], u[1], u[0] * u[1], u[0] ** 2])
            return weights @ basis - 0.3 + 2 * ((u - 0.5) ** 2).sum()

        model, us = model_of(f, c), starts(24, seed=9)
        expected = np.inf
        for u in us:
            answer = minimize(
                f,
                u,
                method="SLSQP",
                bounds=[(0, 1)] * 2,
                constraints={"type": "ineq", "fun": lambda u, c=c: -c(u)},
            )
            if (c(answer.x) <= 1e-7).all():
                expected = min(expected, answer.fun)
        if np.isinf(expected):
            continue
        _, value = best_of(model, search(model, us, SLACK, progress=False)[0])
        assert value <= expected + 1e-6


def test_paths_begin_and_end_where_they_should():
    """Every path leads from its start to its end point, inside the box."""
    model, us = model_of(lambda u: u[0], circle), starts(5)
    ends, path_to = search(model, us, SLACK, progress=False)
    for i in range(5):
        path = path_to(i)
        np.testing.assert_array_equal(path[0], us[i])
        np.testing.assert_array_equal(path[-1], ends[i])
        assert (path >= 0).all() and (path <= 1).all()


def test_quadratic_step_against_brute_force():
    """The step has the least exact penalty of the model inside the box, by a fine scan of it."""
    rng = np.random.default_rng(2)
    n, k = 20, 3
    slope, excess = rng.normal(size=(n, 2)), 0.02 * rng.normal(size=(n, k))
    jacobian = rng.normal(size=(n, k, 2))
    root = rng.normal(size=(n, 2, 2))
    hessian = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    low, high = np.full((n, 2), -0.05), np.full((n, 2), 0.07)
    steps, multipliers, gain = _quadratic_step(slope, hessian, excess, jacobian, low, high)
    assert (steps >= low).all() and (steps <= high).all() and (multipliers >= 0).all()

    def penalty(i, p):
        quadratic = slope[i] @ p + p @ hessian[i] @ p / 2
        return quadratic + 100 * np.maximum(excess[i] + jacobian[i] @ p, 0).sum()

    side = np.linspace(-0.05, 0.07, 61)
    for i in range(n):
        scanned = min(penalty(i, np.array(p)) for p in itertools.product(side, side))
        assert penalty(i, steps[i]) <= scanned + 1e-9
        assert gain[i] == pytest.approx(penalty(i, np.zeros(2)) - penalty(i, steps[i]), abs=1e-12)


def test_where_nothing_is_gained_no_step_is_taken():
    """At a corner of two constraints both hold to rounding: the penalty has its least there."""
    slope, hessian, excess = np.array([[1.0, 2.0]]), np.eye(2)[None], np.zeros((1, 2))
    low, high = np.full((1, 2), -0.05), np.full((1, 2), 0.05)
    steps, _, gain = _quadratic_step(slope, hessian, excess, -np.eye(2)[None], low, high)
    np.testing.assert_array_equal(steps, 0)
    np.testing.assert_array_equal(gain, 0)


def test_a_settled_search_stops():
    """Fewer evaluations than the steps allow, and none the worse for it."""
    model, calls = model_of(lambda u: u[0] + 2 * u[1], lambda u: np.array([0.25 - u[0] * u[1]])), []

    def counted(us):
        calls.append(len(us))
        return model(us)

    ends, _ = search(counted, starts(6), SLACK, progress=False, steps=(5, 400))
    point, _ = best_of(model, ends)
    np.testing.assert_allclose(point, (0.5**0.5, 0.5**1.5), atol=1e-7)
    assert len(calls) < 100


def test_bfgs_stays_positive_definite_and_learns_curvature():
    """The secant condition where curvature is positive; positive definite where it is not."""
    step = np.array([[0.1, 0.2], [0.1, 0.0], [0.0, 0.0]])
    change = np.array([[0.4, 0.3], [-5.0, 0.0], [0.0, 0.0]])
    updated = _bfgs(np.tile(np.eye(2), (3, 1, 1)), step, change)
    np.testing.assert_allclose(updated[0] @ step[0], change[0], rtol=1e-12)
    assert (np.linalg.eigvalsh(updated) > 0).all()
    np.testing.assert_array_equal(updated[2], np.eye(2))
