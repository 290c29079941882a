"""Textbook curves in two and three unknowns: folds, loops, a branch point, ends, and order."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import scipy.integrate

from fractaljax._continuation import Continuation, CurveEnd, trace


def curves(residual, jacobian, low=-np.inf, high=np.inf, n=2, **options):
    def equations(u):
        return np.atleast_1d(residual(u)), np.atleast_2d(jacobian(u))

    return Continuation(equations, np.full(n, low), np.full(n, high), **options)


def from_point(problem, start):
    """The curve through the zero next to `start`."""
    return problem.curve(*problem.corrected(np.array(start, float)))


CIRCLE = curves(lambda u: u @ u - 1, lambda u: 2 * u)
TILTED = curves(  # the unit sphere and the plane x = z
    lambda u: [u @ u - 1, u[0] - u[2]], lambda u: [2 * u, [1.0, 0.0, -1.0]], n=3
)
CUBIC = curves(  # the twisted cubic (t, t^2, t^3)
    lambda u: [u[1] - u[0] ** 2, u[2] - u[0] ** 3],
    lambda u: [[-2 * u[0], 1, 0], [-3 * u[0] ** 2, 0, 1]],
    low=-1.0,
    high=1.0,
    n=3,
)
FOLDS = curves(lambda u: u[0] + u[1] - 3 * u[1] ** 3, lambda u: [1, 1 - 9 * u[1] ** 2], -1.0, 1.0)


@pytest.mark.parametrize(("problem", "n"), [(CIRCLE, 2), (TILTED, 3)])
def test_a_circle_closes(problem, n):
    """Every point on it, once around, and the length to second order in the step."""
    lengths, start = [], np.eye(n)[1]
    for longest in (1 / 64, 1 / 128):
        curve = from_point(dataclasses.replace(problem, longest=longest), start)
        assert curve.start is curve.end is CurveEnd.closed
        np.testing.assert_array_equal(curve.points[0], curve.points[-1])
        np.testing.assert_allclose(np.linalg.norm(curve.points, axis=1), 1, rtol=1e-14)
        steps = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
        assert steps.max() < 1.1 * longest
        lengths.append(steps.sum())
    off = 2 * np.pi - np.array(lengths)
    assert 0 < off[1] < 1e-3
    assert off[0] / off[1] == pytest.approx(4, rel=0.1)


def test_orientation():
    """In two unknowns the negative side, here the inside, is on the right."""
    points = from_point(CIRCLE, [1, 0]).points
    angle = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
    assert angle[-1] - angle[0] == pytest.approx(-2 * np.pi, abs=1e-9)
    for problem, u in (
        (CIRCLE, [0.6, 0.8]),
        (TILTED, [0.0, 1.0, 0.0]),
        (CUBIC, [0.5, 0.25, 0.125]),
    ):
        jacobian = problem.equations(np.array(u))[1]
        t = problem.tangent(jacobian)
        np.testing.assert_allclose(jacobian @ t, 0, atol=1e-15)
        assert np.linalg.det(np.vstack([t, jacobian])) > 0
        assert np.linalg.norm(t) == pytest.approx(1, rel=1e-14)


def test_a_curve_in_three_dimensions_ends_on_the_box():
    curve = from_point(CUBIC, [0.1, 0.0, 0.0])
    assert curve.start is curve.end is CurveEnd.edge
    x, y, z = curve.points.T
    assert sorted((x[0], x[-1])) == pytest.approx([-1, 1], rel=1e-12)
    np.testing.assert_allclose([y, z], [x**2, x**3], rtol=0, atol=1e-12)
    assert (np.sign(x[-1]) * np.diff(x) > 0).all()
    length = np.linalg.norm(np.diff(curve.points, axis=0), axis=1).sum()
    exact, _ = scipy.integrate.quad(lambda t: np.sqrt(1 + 4 * t**2 + 9 * t**4), -1, 1)
    assert length == pytest.approx(exact, rel=1e-4)


def test_folds_branch_points_and_why_a_curve_ends():
    """x = 3 y^3 - y turns back twice, at y = +-1/3."""
    curve = from_point(FOLDS, [0.0, 0.0])
    x, y = curve.points.T
    np.testing.assert_allclose(x, 3 * y**3 - y, rtol=0, atol=1e-12)
    assert curve.start is curve.end is CurveEnd.edge
    assert sorted(x[[0, -1]]) == [-1, 1]
    assert np.count_nonzero(np.diff(np.sign(np.diff(x)))) == 2
    assert x[np.abs(y - 1 / 3) < 0.1].min() == pytest.approx(-2 / 9, abs=1e-4)
    # Bernoulli's lemniscate crosses itself at 0: half of it, or the whole figure of eight.
    half = from_point(lemniscate(), [1, 0])
    assert half.start is half.end is CurveEnd.stuck
    assert np.linalg.norm(half.points[[0, -1]], axis=1).max() < 1e-5
    assert half.points[1:-1, 0].min() > 0
    whole = from_point(lemniscate(oriented=False), [1, 0])
    assert whole.end is CurveEnd.closed
    assert whole.points[:, 0].min() == pytest.approx(-1, abs=1e-3)
    length = np.linalg.norm(np.diff(whole.points, axis=0), axis=1).sum()
    assert length == pytest.approx(5.244115108584239, rel=1e-3)  # 2 times the lemniscate constant
    line = {"residual": lambda u: u[1], "jacobian": lambda u: [0.0, 1.0]}
    assert from_point(curves(**line, most=10), [0, 0]).end is CurveEnd.long
    beyond = from_point(curves(**line, valid=lambda u: u[0] < 1, most=150), [0, 0])
    assert beyond.points[:, 0].max() == pytest.approx(1, abs=1e-6)
    assert CurveEnd.stuck in (beyond.start, beyond.end)
    undefined = curves(lambda u: u[1] if u[0] < 1 else np.nan, line["jacobian"], most=150)
    assert from_point(undefined, [0, 0]).points[:, 0].max() == pytest.approx(1, abs=1e-6)


def lemniscate(**options):
    return curves(
        lambda u: (u @ u) ** 2 - u[0] ** 2 + u[1] ** 2,
        lambda u: 4 * (u @ u) * u - 2 * np.array([u[0], -u[1]]),
        **options,
    )


def corrected(problem, u, **options) -> Any:
    return problem.corrected(np.array(u, float), **options)


def test_newtons_method_converges_or_says_so():
    """Quadratically, to the nearest point; None without a zero, or where the Jacobian is 0."""
    u, jacobian = corrected(CIRCLE, [0.63, 0.79])
    assert abs(u @ u - 1) < 1e-15
    np.testing.assert_array_equal(jacobian, [2 * u])
    assert lemniscate().corrected(np.zeros(2)) is None
    assert CIRCLE.corrected(np.array([0.0, 0.1])) is None  # beyond the longest step
    assert curves(lambda u: u @ u + 1e-3, lambda u: 2 * u).corrected(np.array([0.1, 0])) is None
    fixed, _ = corrected(CIRCLE, [0.6, 0.79], fixed=0)
    assert fixed.tolist() == pytest.approx([0.6, 0.8], rel=1e-14) and fixed[0] == 0.6


def in_square(function, slope, lines=21):
    """`trace` of a function of points (k, 2) with gradient (k, 2)."""
    problem = curves(lambda u: function(u[None])[0], lambda u: slope(u[None])[0], low=0.0, high=1.0)
    return trace(problem, lambda us: (function(us), slope(us)), lines)


def circle(radius, x=0.5):
    centre = np.array([[x, 0.5]])
    return in_square(
        lambda us: ((us - centre) ** 2).sum(axis=1) - radius**2, lambda us: 2 * (us - centre)
    )


def test_loops_arcs_tongues_and_no_zero():
    (curve,), negative, untraced = circle(0.3)
    assert curve.start is curve.end is CurveEnd.closed
    np.testing.assert_allclose(np.linalg.norm(curve.points - 0.5, axis=1), 0.3, rtol=1e-14)
    assert (negative, untraced) == (False, 0)
    # A circle through all four edges is four arcs; ends have a coordinate of exactly 0 or 1.
    found, negative, _ = circle(0.6)
    assert len(found) == 4 and not negative
    for curve in found:
        assert curve.start is curve.end is CurveEnd.edge
        for p in curve.points[[0, -1]]:
            assert {0.0, 1.0} & set(p.tolist())
            assert np.linalg.norm(p - 0.5) == pytest.approx(0.6, rel=1e-14)
    # Thinner than a hundredth of a cell and parallel to the lattice: both its sides.
    found, *_ = in_square(
        lambda us: (us[:, 1] - 0.512345) ** 2 - 1e-8,
        lambda us: np.stack([0 * us[:, 0], 2 * (us[:, 1] - 0.512345)], axis=-1),
    )
    heights = sorted(float(curve.points[:, 1].mean()) for curve in found)
    assert heights == pytest.approx([0.512245, 0.512445], abs=1e-12)
    assert circle(0.1, x=2.0) == ([], False, 0)
    assert circle(9.0) == ([], True, 0)
