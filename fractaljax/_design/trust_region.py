"""The solver of designs over many joints: steps in a trust region, with the limits of joints exact.

Growth rates cost eigenvalues and are linear in a step; what joints alone require costs next to
nothing and is curved, so that steps keep to it as it is. What a step leaves unmet is penalised by
its largest. Near coalescing modes growth rates bend sharply: a step that fails by that is corrected
to second order. (R. Fletcher, "Practical methods of optimization", 1987, sections 12.4 and 14.4.)
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .solvers import minimized

Limits = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

_RADIUS_MAX = 0.25  # of a step, in the bounds
_STEEPEST = 1e3  # curvature that is believed
_HARDER, _TIMES = 100.0, 2  # penalties of what is unmet
_NEARLY = 0.1  # unmet by so little, it is worth a way of its own
_INSIDE, _HELD = 1e-7, 1e-6  # by how much steps are inside limits, and within what one holds them
_STEP_ITERATIONS = 40
_EXACT, _LEAST = 1e-2, 1e-12  # what is lost by a step: as a share of the gain, and at least
_POOR = 0.25  # share of what a step promised, below which it is corrected, and the next is shorter
_CORRECTION = 0.5  # share of a step, above which a correction is not worth an evaluation
_FLAT = 1e-8  # of a change of slopes and a step: nothing is learnt


class Accuracy(NamedTuple):
    """How a way begins and where it ends."""

    first: float  # radius of the first step, in the bounds
    radius: float  # below which steps are not tried
    gain: float  # as a share of what is lowered, below which steps are not worth it
    steps: int
    meets: bool = False  # whether what is left unmet is penalised harder


ROUGH, NEAR = Accuracy(0.1, 3e-3, 1e-2, 40), Accuracy(0.03, 1e-3, 1e-3, 40)
SETTLED, FINE = Accuracy(0.02, 1e-5, 1e-4, 60, True), Accuracy(0.02, 1e-7, 1e-7, 100, True)


class Local(NamedTuple):
    """An objective and requirements at a design (v,), with their slopes.

    The largest of `aimed`, if there are any, is minimised besides.
    """

    value: float
    slope: np.ndarray  # (v,)
    aimed: np.ndarray  # (a,)
    aimed_slopes: np.ndarray  # (a, v)
    unmet: np.ndarray  # (r,), at most 0 where met
    unmet_slopes: np.ndarray  # (r, v)

    def merit(self, penalty: float) -> float:
        """What steps lower."""
        return self.value + self.largest + penalty * self.excess

    @property
    def largest(self) -> float:
        """The largest of `aimed`, 0 without any."""
        return float(self.aimed.max()) if len(self.aimed) else 0.0

    @property
    def excess(self) -> float:
        """By how much the most violated requirement is."""
        return max(0.0, float(self.unmet.max(initial=0)))

    def predict(self, step: np.ndarray, curvature: np.ndarray) -> "Local":
        """What the slopes make of a step, with the curvature (v, v) in the value."""
        return self._replace(
            value=self.value + self.slope @ step + step @ curvature @ step / 2,
            slope=self.slope + curvature @ step,
            aimed=self.aimed + self.aimed_slopes @ step,
            unmet=self.unmet + self.unmet_slopes @ step,
        )

    def correct(self, step: np.ndarray, there: "Local") -> "Local":
        """The same, with residuals shifted so that the slopes give after `step` what is there."""
        return self._replace(
            aimed=there.aimed - self.aimed_slopes @ step,
            unmet=there.unmet - self.unmet_slopes @ step,
        )


def in_trust_region(
    at: Callable[[np.ndarray], Local],
    limits: Limits,
    start: np.ndarray,
    curvature: float,
    accuracy: Accuracy,
    penalty: float,
    met: float = 0.0,
) -> np.ndarray:
    """A design (v,) in [0, 1]^v with the least objective that meets all, from `start`.

    `limits` gives residuals (l,) that every step keeps to, and their slopes (l, v); `curvature` is
    that of the objective at least. `penalty` is that of what is unmet at first, above `met`.
    """
    u, radius = start, accuracy.first
    learnt = curvature * np.eye(len(start))
    for _ in range(_TIMES if accuracy.meets else 1):
        learning = limits, curvature, accuracy, radius, penalty
        u, learnt, excess = _descended(at, u, learnt, *learning)
        if met < excess <= _NEARLY and accuracy.meets:
            # To where all is met, if that is near.
            nearest = functools.partial(_nearest, at, u)
            u, _, excess = _descended(nearest, u, 2 * np.eye(len(u)), *learning)
        if excess <= met:
            break
        radius, penalty = radius / 2, penalty * _HARDER
    return u


def _nearest(at, centre, u) -> Local:
    """What is asked at u, but for the objective: the squared distance from a design."""
    return at(u)._replace(value=float((u - centre) @ (u - centre)), slope=2 * (u - centre))


def _descended(at, u, learnt, limits, curvature, accuracy, radius, penalty):
    """As far down the merit as it goes, the curvature there, and what is unmet."""
    here, steps = at(u), 0
    while steps < accuracy.steps and radius >= accuracy.radius:
        exact = max(_EXACT * accuracy.gain * abs(here.merit(penalty)), _LEAST)
        step, bounds, held = _step(here, limits, u, learnt, radius, penalty, exact)
        expected = here.predict(step, learnt)
        promised = here.merit(penalty) - expected.merit(penalty)
        if held is None or promised <= 0:  # none was found inside the limits
            radius /= 4
            continue
        if promised <= accuracy.gain * abs(here.merit(penalty)):
            break
        there, steps = at(u + step), steps + 1
        ratio = (here.merit(penalty) - there.merit(penalty)) / promised
        if ratio < _POOR and there.excess > expected.excess:
            other, *others = _step(
                here.correct(step, there), limits, u, learnt, radius, penalty, exact
            )
            small = np.abs(other - step).max() <= _CORRECTION * np.abs(step).max()
            if small and others[1] is not None:
                end, steps = at(u + other), steps + 1
                if end.merit(penalty) < min(here.merit(penalty), there.merit(penalty)):
                    step, (bounds, held), there = other, others, end
                    expected = here.predict(step, learnt)
                    ratio = (here.merit(penalty) - there.merit(penalty)) / promised
        learnt = _learnt(here, there, expected, step, bounds, held, learnt, curvature, penalty)
        length = float(np.abs(step).max())
        if ratio <= 0.05:
            radius = min(radius, length) / 2.5
        elif ratio < _POOR:
            radius = max(length, radius / 4) / 2
        elif ratio > 0.6 and length > 0.9 * radius:
            radius = min(2 * radius, _RADIUS_MAX)
        if ratio > 0.05:
            u, here = u + step, there
    return u, learnt, here.excess


def _step(here: Local, limits: Limits, u, curvature, radius, penalty, exact):
    """The best step (v,) by slopes and curvature, its bounds (v, 2), and the slopes of limits.

    These (h, v) are of the limits that hold it; None where it is outside of one.
    """
    v, a, r = len(u), len(here.aimed), len(here.unmet)
    bounds = np.stack([np.maximum(-u, -radius), np.minimum(1 - u, radius)], 1)
    last_limits: dict[bytes, Any] = {}

    def limits_at(step):
        key = step.tobytes()
        if key not in last_limits:
            last_limits.clear()
            last_limits[key] = limits(np.clip(u + step, 0, 1))
        return last_limits[key]

    def merit(z):
        step, largest, excess = z[:v], z[v], z[v + 1]
        bent = curvature @ step
        value = here.slope @ step + step @ bent / 2 + largest + penalty * excess
        return value, np.concatenate([here.slope + bent, [1.0, penalty]])

    def constraints(z):
        step, largest, excess = z[:v], z[v], z[v + 1]
        aimed = largest - here.aimed - here.aimed_slopes @ step
        unmet = excess - here.unmet - here.unmet_slopes @ step
        return np.concatenate([aimed, unmet, -limits_at(step)[0] - _INSIDE])

    def slopes(z):
        of_limits = limits_at(z[:v])[1]
        by_step = -np.concatenate([here.aimed_slopes, here.unmet_slopes, of_limits])
        kinds = np.repeat([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], [a, r, len(of_limits)], axis=0)
        return np.hstack([by_step, kinds])

    largest = (-np.inf, np.inf) if a else (0.0, 0.0)
    start = np.concatenate([np.zeros(v), [here.largest, here.excess]])
    conditions = {"type": "ineq", "fun": constraints, "jac": slopes}
    all_bounds = [*bounds, largest, (0.0, np.inf)]
    end = minimized(merit, start, all_bounds, conditions, _STEP_ITERATIONS, exact)
    step = np.clip(end[:v], *bounds.T)
    residuals, of_limits = limits_at(step)
    inside = residuals.max(initial=-np.inf) <= 0
    return step, bounds, of_limits[residuals >= -_HELD] if inside else None


def _learnt(here, there, expected, step, bounds, held, learnt, curvature, penalty):
    """The curvature (v, v) of the Lagrangian, by the symmetric rank-one formula, kept convex."""
    from scipy.optimize import nnls

    v = len(step)
    aims = expected.aimed >= expected.largest - _HELD
    unmet = expected.unmet >= expected.excess - _HELD
    low, high = step <= bounds[:, 0] + _HELD, step >= bounds[:, 1] - _HELD
    rows = here.aimed_slopes[aims], here.unmet_slopes[unmet], held, -np.eye(v)[low], np.eye(v)[high]
    kinds = np.zeros((sum(map(len, rows)), 2))
    kinds[: aims.sum(), 0] = -1
    kinds[aims.sum() : aims.sum() + unmet.sum(), 1] = -1
    matrix = np.hstack([np.concatenate(rows), kinds])
    if not expected.excess:
        matrix = np.vstack([matrix, np.append(np.zeros(v + 1), -1.0)])
    forces = np.concatenate([expected.slope, [float(aims.any()), penalty]])
    by = nnls(matrix.T, -forces)[0]
    change = there.slope - here.slope
    change = change + by[: aims.sum()] @ (there.aimed_slopes - here.aimed_slopes)[aims]
    by = by[aims.sum() :][: unmet.sum()]
    change = change + by @ (there.unmet_slopes - here.unmet_slopes)[unmet]
    lacking = change - learnt @ step
    if abs(step @ lacking) <= _FLAT * np.linalg.norm(step) * np.linalg.norm(lacking):
        return learnt
    values, vectors = np.linalg.eigh(learnt + np.outer(lacking, lacking) / (step @ lacking))
    return vectors * np.clip(values, curvature, _STEEPEST) @ vectors.T
