"""The zeros of a smooth field over the unit square as curves, by pseudo-arclength continuation.

A lattice shows where the field changes sign; from there each branch is followed, a step along the
tangent and Newton's steps back across it, so that folds are points like any other. The tangent
always has the negative side on its right, which tells the two sides of a narrow tongue apart.

A field has `values(ps)`, values (n,) and gradients (n, 2) at points (n, 2); `at(p)`, value,
gradient and whatever else is known at one; `accepts` of the latter; `broken(p, ahead)`, why a
branch cannot be followed beyond p; and `rounding`, the least distance that means anything.
"""

import equinox as eqx
import numpy as np

_HALVINGS = 30  # to find a zero on an edge of the lattice
_LONGEST, _SHORTEST = 1 / 64, 1e-7  # steps along a branch
_STRAIGHT, _BENT = 0.03, 0.15  # turn of the tangent in a step [rad]: lengthen it, shorten it
_NEWTON_STEPS = 12
_TOLERANCE = 1e-12  # distance from the zero, beside the window; or what the dtype allows
_MOST_POINTS = 5000  # of a branch


class BranchEnd(eqx.Enumeration):
    """Why a branch of a stability boundary ends."""

    window = "at the edge of the window"
    closed = "where it began"
    regime = "where the regime of the joint changes"
    undamped = "where both directions have lost their damping"
    friction_correction = "at mu_m = 0.3, where Eq. 19 has a step"
    lost = "where it could not be followed"


# --- following a branch -------------------------------------------------------------------


def _tangent(gradient):
    """Unit vector along the boundary, with the negative side on its right."""
    along = np.array([gradient[1], -gradient[0]])
    return along / np.linalg.norm(along)


def _corrected(field, p, across):
    """The point of the boundary that Newton's steps along `across(gradient)` lead to, or None.

    `across` returns the direction of the step; it is 0 along what must not move.
    """
    best = None
    for _ in range(_NEWTON_STEPS):
        value, gradient, point = field.at(p)
        direction = across(gradient)
        slope = gradient @ direction
        if not np.isfinite(value) or not np.isfinite(slope) or slope == 0:
            return None
        step = -value / slope * direction
        size = np.linalg.norm(step)
        if best is not None and size >= best[0]:
            break  # rounding
        best = size, p, gradient, point
        if size > 4 * _LONGEST:
            return None
        p = p + step
    if best is None or best[0] > max(_TOLERANCE, field.rounding):
        return None
    _, p, gradient, point = best
    return (p, gradient) if field.accepts(point) else None


def _edge_of(p, q):
    """Share of the way from p, inside, to q, outside, at which it leaves, and axis and side."""
    return min(
        ((side - p[axis]) / (q[axis] - p[axis]), axis, side)
        for axis in range(2)
        for side in (0.0, 1.0)
        if (q[axis] - side) * (0.5 - side) < 0
    )


def _inside(p):
    return bool(((p >= 0) & (p <= 1)).all())


def _stepped(field, p, ahead, length, sign):
    """One step: the next point and its gradient, the turn there, and whether on an edge; or None.

    None if the step is too long for the boundary, and a shorter one is to be tried.
    """
    target, across = p + length * ahead, _anywhere
    leaves = not _inside(target)
    if leaves:
        share, axis, side = _edge_of(p, target)
        target = p + share * length * ahead
        target[axis], across = side, _along_edge(axis)
    found = _corrected(field, target, across)
    if found is None:
        return None
    along = (found[0] - p) @ ahead
    turn = np.arccos(np.clip(sign * _tangent(found[1]) @ ahead, -1, 1))
    fits = _inside(found[0]) and 0 <= along <= 2 * length and turn <= _BENT
    return (*found, turn, leaves) if fits else None


def _follow(field, start, sign):
    """Points from `start` along the boundary, sign times its tangent, and why they end."""
    p, gradient = start
    points, length = [p], _LONGEST / 4
    while len(points) < _MOST_POINTS:
        ahead = sign * _tangent(gradient)
        step = _stepped(field, p, ahead, length, sign)
        if step is None:
            length /= 2
            if length < _SHORTEST:
                return points, field.broken(p, ahead)
            continue
        following, gradient, turn, leaves = step
        if len(points) > 2 and _passes(start[0] - p, ahead, following - p):
            return [*points, start[0]], BranchEnd.closed
        if not (leaves and np.linalg.norm(following - p) < _SHORTEST):
            points.append(following)
        if leaves:
            return points, BranchEnd.window
        p = following
        if turn < _STRAIGHT:
            length = min(1.5 * length, _LONGEST)
    return points, BranchEnd.lost


def _anywhere(gradient):
    """Steps across the boundary, the shortest way."""
    return gradient


def _along_edge(axis):
    """Steps along an edge of the window only."""
    free = np.eye(2)[1 - axis]
    return lambda gradient: free * np.sign(gradient[1 - axis])


def _passes(back, ahead, step):
    along = back @ ahead
    aside = np.linalg.norm(back - along * ahead)
    return 0 < along <= step @ ahead and aside < 0.1 * np.linalg.norm(step) + _SHORTEST


# --- the lattice --------------------------------------------------------------------------


def _crossings(field, lines):
    """Scaled points (n, 2) of the boundary on the lines of a lattice, those on the window first."""
    side = np.linspace(0, 1, lines)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    values, slopes = field.values(grid.reshape(-1, 2))
    values, slopes = values.reshape(lines, lines), slopes.reshape(lines, lines, 2)
    positive, negative = [], []
    for axis in range(2):
        places, value, slope = (np.moveaxis(x, axis, 0) for x in (grid, values, slopes[..., axis]))
        ends = places[:-1].reshape(-1, 2), places[1:].reshape(-1, 2)
        low, high = (value[:-1] < 0).ravel(), (value[1:] < 0).ravel()
        differ = low != high
        first, last = ends[0][differ], ends[1][differ]
        positive.append(np.where(low[differ, None], last, first))
        negative.append(np.where(low[differ, None], first, last))
        # A tongue between two lines: towards 0 from one end and away from it to the other.
        sign = np.where(low, -1.0, 1.0)
        dips = ~differ & (sign * slope[:-1].ravel() < 0) & (sign * slope[1:].ravel() > 0)
        first, last, sign = ends[0][dips], ends[1][dips], sign[dips]
        inside = _beyond(field, first, last, axis, sign)
        for end in (first, last):
            through = ~np.isnan(inside[:, :1]).any(axis=1)
            swapped = (sign < 0)[through, None]
            positive.append(np.where(swapped, inside[through], end[through]))
            negative.append(np.where(swapped, end[through], inside[through]))
    positive, negative = np.concatenate(positive), np.concatenate(negative)
    for _ in range(_HALVINGS):
        middle = (positive + negative) / 2
        inside = (field.values(middle)[0] < 0)[:, None]
        positive, negative = np.where(inside, positive, middle), np.where(inside, middle, negative)
    middle = (positive + negative) / 2
    within = np.minimum(middle, 1 - middle).min(axis=1) > 0
    return middle[np.argsort(within, kind="stable")], bool(values[0, 0] < 0)


def _beyond(field, first, last, axis, sign):
    """Points (n, 2) between `first` and `last` with the other sign of the field; NaN if none."""
    found = np.full_like(first, np.nan)
    for _ in range(_HALVINGS):
        middle = (first + last) / 2
        value, slope = field.values(middle)
        other = (value < 0) != (sign < 0)
        found[other] = middle[other]
        falls = (sign * slope[:, axis] < 0)[:, None]
        first, last = np.where(falls, middle, first), np.where(falls, last, middle)
    return found


def _passing(points, p):
    """The steps of a branch that pass p, within what its polyline can be off."""
    points = np.asarray(points)
    begin, step = points[:-1], np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), _SHORTEST**2)
    along = np.clip(((p - begin) * step).sum(axis=1) / length**2, 0, 1)
    off = np.linalg.norm(begin + along[:, None] * step - p, axis=1)
    return step[off < 0.1 * length + 10 * _SHORTEST]


def trace(field, lines):
    """Branches (points, start, end), whether the field is negative at (0, 0), crossings left."""
    branches, failed = [], []
    seeds, negative = _crossings(field, lines)
    for seed in seeds:
        edges = np.flatnonzero((seed == 0) | (seed == 1))
        across = _along_edge(edges[0]) if len(edges) else _anywhere
        start = _corrected(field, seed, across)
        if start is None:
            failed.append(seed)
            continue
        # On the same hand: the other side of a narrow tongue is another branch.
        along = _tangent(start[1])
        if any((_passing(points, seed) @ along > 0).any() for points, *_ in branches):
            continue
        onwards, end = _follow(field, start, 1)
        if end == BranchEnd.closed:
            branches.append((onwards, end, end))
            continue
        backwards, begin = _follow(field, start, -1)
        points = backwards[:0:-1] + onwards
        if len(points) > 1:
            branches.append((points, begin, end))
    untraced = [p for p in failed if not any(len(_passing(x, p)) for x, *_ in branches)]
    return branches, negative, len(untraced)
