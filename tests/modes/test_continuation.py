"""Zeros of a known field as curves: a circle, a tongue between two lines, and no zero at all."""

import numpy as np
import pytest

from fractaljax.modes.continuation import BranchEnd, trace


class Field:
    """A function of NumPy arrays (n, 2) and its gradient."""

    rounding = 1e-15

    def __init__(self, function, gradient):
        self.values = lambda ps: (function(ps), gradient(ps))

    def at(self, p):
        (value,), (gradient,) = self.values(p[None])
        return value, gradient, None

    def accepts(self, point):
        return True

    def broken(self, p, ahead):
        return BranchEnd.lost


def circle(radius, x=0.5, y=0.5):
    centre = np.array([x, y])
    return Field(
        lambda ps: ((ps - centre) ** 2).sum(axis=1) - radius**2, lambda ps: 2 * (ps - centre)
    )


def test_circle():
    """One loop, every point on it, all of it, the inside on its right."""
    ((points, start, end),), negative, untraced = trace(circle(0.3), 21)
    points = np.array(points) - 0.5
    assert (start, end) == (BranchEnd.closed, BranchEnd.closed)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.3, rtol=1e-14)
    angle = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
    assert angle[-1] - angle[0] == pytest.approx(-2 * np.pi, abs=1e-9)
    assert (negative, untraced) == (False, 0)


def test_arcs_end_on_the_edges():
    """A circle through all four edges is four arcs; ends have a coordinate of exactly 0 or 1."""
    branches, negative, _ = trace(circle(0.6), 21)
    assert len(branches) == 4
    for points, start, end in branches:
        assert start == end == BranchEnd.window
        for p in (points[0], points[-1]):
            assert {0.0, 1.0} & set(p.tolist())
            assert np.linalg.norm(p - 0.5) == pytest.approx(0.6, rel=1e-14)
    assert not negative


def test_tongue_between_two_lines_of_the_lattice():
    """Thinner than a hundredth of a cell and parallel to the lattice: both its sides."""

    def function(ps):
        return (ps[:, 1] - 0.512345) ** 2 - 1e-8

    def gradient(ps):
        return np.stack([0 * ps[:, 0], 2 * (ps[:, 1] - 0.512345)], axis=-1)

    branches, *_ = trace(Field(function, gradient), 21)
    heights = sorted(float(np.mean([p[1] for p in points])) for points, *_ in branches)
    assert heights == pytest.approx([0.512245, 0.512445], abs=1e-12)


def test_no_zero():
    assert trace(circle(0.1, x=2.0), 21) == ([], False, 0)
    assert trace(circle(9.0), 21) == ([], True, 0)
