"""Curves of zeros by pseudo-arclength continuation: n - 1 smooth equations in n unknowns.

Each step goes along the cubic through the last two points and their tangents, then back onto the
curve by Newton steps of least length: a fold is a regular point. In two unknowns `trace` finds all
curves in the unit square that cross a lattice.
"""

import dataclasses
import enum
from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class CurveEnd(enum.Enum):
    """Why a curve ends."""

    closed = "where it began"
    edge = "at the edge of the box"
    stuck = "where Newton's method fails however short the step"
    long = "after the largest number of points"


class Curve(NamedTuple):
    """Points (k, n) along a curve, and why it ends at the first and at the last of them."""

    points: np.ndarray
    start: CurveEnd
    end: CurveEnd


@dataclasses.dataclass(frozen=True)
class Continuation:
    """The curves of `equations` in a box, and how to follow them.

    `equations(u)` gives the residual (n - 1,) and the Jacobian (n - 1, n) at u (n,). The tangent t
    has det [t; Jacobian] > 0: in two unknowns the residual is negative on its right. Where that
    orientation flips there is another sheet, or a branch point. An `oriented` curve ends there;
    any other passes straight through.
    """

    equations: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    low: np.ndarray  # (n,) of the box, perhaps infinite
    high: np.ndarray
    valid: Callable[[np.ndarray], bool] = lambda u: True  # True if a zero belongs to the curve
    tolerance: float = 1e-12  # distance from the zero
    oriented: bool = True
    longest: float = 1 / 64  # length of a step
    shortest: float = 1e-7
    settled: float = 0.0  # Newton step at which the iteration stops at once
    small: float = np.inf  # largest residual there, which may be large even close to the zero
    most: int = 5000  # number of points each way
    newton_steps: int = 12  # of one correction, at most
    straight: float = 0.03  # angle between tangents [rad] below which the step becomes longer
    bent: float = 0.15  # angle above which it is halved

    def tangent(self, jacobian: np.ndarray) -> np.ndarray:
        """The unit vector t (n,) with Jacobian t = 0 and det [t; Jacobian] > 0."""
        t = np.linalg.qr(jacobian.T, mode="complete")[0][:, -1]
        return t * np.linalg.slogdet(np.vstack([t, jacobian]))[0]

    def corrected(self, u: np.ndarray, fixed: int | None = None):
        """The zero that Newton's method finds from u, and the Jacobian there; None if it fails.

        The steps are of least length, with the coordinate `fixed` held.
        """
        free = np.arange(len(u)) != (-1 if fixed is None else fixed)
        best, least, zero = np.inf, np.inf, None
        for _ in range(self.newton_steps):
            residual, jacobian = self.equations(u)
            if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
                return None
            step, _, rank, _ = np.linalg.lstsq(jacobian[:, free], -residual)
            size, left = np.linalg.norm(step), np.abs(residual).max()
            falls = least > self.small and left < least / 10
            if size >= best and best <= self.tolerance and not falls:
                break  # down to rounding
            if rank < len(residual) or size > 4 * self.longest:
                return None
            best, least, zero = size, left, (u, jacobian)
            if size <= self.settled and left <= self.small:
                break
            u = u.copy()
            u[free] += step
        return zero if best <= self.tolerance and zero and self.valid(zero[0]) else None

    def curve(self, u: np.ndarray, jacobian: np.ndarray) -> Curve:
        """The whole curve through a zero u, along its tangent."""
        ahead = self.tangent(jacobian)
        onward, end = self._follow(u, ahead, 1)
        if end is CurveEnd.closed:
            return Curve(np.array(onward), end, end)
        backward, start = self._follow(u, -ahead, -1)
        return Curve(np.array(backward[:0:-1] + onward), start, end)

    def _follow(self, u, ahead, sign):
        """Points from u, starting in the direction `ahead`: `sign` times the tangent."""
        points = [u]
        for reached, turned, leaves in self.steps(u, ahead, sign):
            if len(points) > 2 and self.passes(points[0] - u, ahead, reached - u):
                return [*points, points[0]], CurveEnd.closed
            if not (leaves and np.linalg.norm(reached - u) < self.shortest):
                points.append(reached)
            if leaves:
                return points, CurveEnd.edge
            if len(points) >= self.most:
                return points, CurveEnd.long
            u, ahead = reached, turned
        return points, CurveEnd.stuck

    def steps(self, u, ahead, sign=1):
        """Each next point, the direction there, and True for a point on the edge, the last one.

        The points end before the edge where Newton's method fails however short the step.
        """
        length, leaves, before = self.longest / 4, False, None
        while not leaves:
            step = self._step(u, ahead, length, sign, before)
            if step is None:
                length /= 2
                if length < self.shortest:
                    return
                continue
            before = u, ahead
            u, ahead, angle, leaves = step
            yield u, ahead, leaves
            if angle < self.straight:
                length = min(1.5 * length, self.longest)

    def _step(self, u, ahead, length, sign, before):
        """The next point, its direction, the angle to it, True on the edge; None if too long.

        `before` is the previous point with its direction, None at the first point.
        """
        target, fixed = u + length * ahead, None
        if before is not None and self._inside(target):
            size = float(np.linalg.norm(u - before[0]))
            target = cubic(before[0], before[1], u, ahead, 1 + length / size)
        leaves = not self._inside(target)
        if leaves:
            share, fixed, side = self._find_exit(u, target)
            target = u + share * length * ahead
            target[fixed] = side
        zero = self.corrected(target, fixed)
        if zero is None:
            return None
        reached, turned = zero[0], sign * self.tangent(zero[1])
        if not self.oriented and turned @ ahead < 0:
            turned = -turned
        angle = np.arccos(np.clip(turned @ ahead, -1, 1))
        along = (reached - u) @ ahead
        fits = self._inside(reached) and 0 <= along <= 2 * length and angle <= self.bent
        return (reached, turned, angle, leaves) if fits else None

    def _inside(self, u) -> bool:
        return bool(((u >= self.low) & (u <= self.high)).all())

    def _find_exit(self, u, target):
        """Share of the way to an outside target at which it leaves the box, coordinate and side."""
        return min(
            ((side - u[i]) / (target[i] - u[i]), i, side)
            for i in range(len(u))
            for side, outside in (
                (self.low[i], target[i] < self.low[i]),
                (self.high[i], target[i] > self.high[i]),
            )
            if outside
        )

    def passes(self, start, ahead, step) -> bool:
        """True if a step passes the start of the curve, both relative to the step's first point."""
        along = start @ ahead
        aside = np.linalg.norm(start - along * ahead)
        near = aside < 0.1 * np.linalg.norm(step) + self.shortest
        return bool(near and 0 < along <= step @ ahead)


def cubic(first, ahead, last, turned, share: float) -> np.ndarray:
    """The point of the cubic through two points and their unit tangents at a share of the way."""
    way = last - first
    size, y = np.linalg.norm(way), share - 1
    of_square, of_cube = size * (2 * turned + ahead) - 3 * way, size * (turned + ahead) - 2 * way
    return last + y * (size * turned + y * (of_square + y * of_cube))


# --- all curves in the unit square --------------------------------------------------------

Values = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def trace(curves: Continuation, values: Values, lines: int) -> tuple[list[Curve], bool, int]:
    """The curves of one equation in the unit square that cross one of `lines` lines each way.

    `values` gives residuals (k,) and gradients (k, 2) at points (k, 2). Also returned: True if the
    residual is negative at (0, 0), and the number of crossings from which no curve was found.
    """
    branches, failed = [], []
    seeds, negative = _crossings(values, lines)
    for seed in seeds:
        edges = np.flatnonzero((seed == 0) | (seed == 1))
        start = curves.corrected(seed, int(edges[0]) if len(edges) else None)
        if start is None:
            failed.append(seed)
            continue
        # In the same direction: the other side of a narrow tongue is another curve.
        along = curves.tangent(start[1])
        steps = [passing_steps(curve, seed, curves.shortest) for curve in branches]
        if any((each @ along > 0).any() for each in steps):
            continue
        curve = curves.curve(*start)
        if len(curve.points) > 1:
            branches.append(curve)
    missed = sum(
        not any(len(passing_steps(curve, seed, curves.shortest)) for curve in branches)
        for seed in failed
    )
    return branches, negative, missed


def _crossings(values, lines, bisections=30):
    """Zeros (k, 2) on the lines of a lattice, those on the edge of the square first.

    Also True if the value at (0, 0) is negative. Each zero is located by so many `bisections`.
    """
    side = np.linspace(0, 1, lines)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    value, slope = values(grid.reshape(-1, 2))
    value, slope = value.reshape(lines, lines), slope.reshape(lines, lines, 2)
    positive, negative = [], []
    for axis in range(2):
        places, v, s = (np.moveaxis(x, axis, 0) for x in (grid, value, slope[..., axis]))
        ends = places[:-1].reshape(-1, 2), places[1:].reshape(-1, 2)
        low, high = (v[:-1] < 0).ravel(), (v[1:] < 0).ravel()
        differ = low != high
        first, last = ends[0][differ], ends[1][differ]
        positive.append(np.where(low[differ, None], last, first))
        negative.append(np.where(low[differ, None], first, last))
        # Two zeros between two lines: the value falls towards 0 from either end.
        sign = np.where(low, -1.0, 1.0)
        dips = ~differ & (sign * s[:-1].ravel() < 0) & (sign * s[1:].ravel() > 0)
        first, last, sign = ends[0][dips], ends[1][dips], sign[dips]
        inside = _find_other_sign(values, first, last, axis, sign, bisections)
        through = ~np.isnan(inside[:, 0])
        swapped = (sign < 0)[through, None]
        for end in (first, last):
            positive.append(np.where(swapped, inside[through], end[through]))
            negative.append(np.where(swapped, end[through], inside[through]))
    positive, negative = np.concatenate(positive), np.concatenate(negative)
    for _ in range(bisections):
        middle = (positive + negative) / 2
        below = (values(middle)[0] < 0)[:, None]
        positive, negative = np.where(below, positive, middle), np.where(below, middle, negative)
    middle = (positive + negative) / 2
    within = np.minimum(middle, 1 - middle).min(axis=1) > 0
    return middle[np.argsort(within, kind="stable")], bool(value[0, 0] < 0)


def _find_other_sign(values, first, last, axis, sign, bisections):
    """Points (k, 2) between `first` and `last` where the value has the other sign; else NaN."""
    points = np.full_like(first, np.nan)
    for _ in range(bisections):
        middle = (first + last) / 2
        value, slope = values(middle)
        other = (value < 0) != (sign < 0)
        points[other] = middle[other]
        falls = (sign * slope[:, axis] < 0)[:, None]
        first, last = np.where(falls, middle, first), np.where(falls, last, middle)
    return points


def passing_steps(curve, p, shortest):
    """The steps of a curve that pass p, within the error of its polyline."""
    begin, step = curve.points[:-1], np.diff(curve.points, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), shortest**2)
    along = np.clip(((p - begin) * step).sum(axis=1) / length**2, 0, 1)
    off = np.linalg.norm(begin + along[:, None] * step - p, axis=1)
    return step[off < 0.1 * length + 10 * shortest]
