"""The solver of designs over many joints: steps in a trust region, with the limits of joints exact.

Growth rates cost eigenvalues and are linear in a step; what joints alone require costs next to
nothing and is curved, so that steps keep to it as it is. What a step leaves unmet is penalised by
its largest. Near coalescing modes growth rates bend sharply: a step that fails by that is corrected
to second order. (R. Fletcher, "Practical methods of optimization", 1987, sections 12.4 and 14.4.)
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .solvers import minimise

Limits = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class TrustRegion:
    """Where steps in a trust region begin and end, and how they are chosen.

    **Fields:**

    - `radius`: radius of the first step, in scaled variables.
    - `least_radius`: the radius below which no step is tried.
    - `gain`: share of the merit below which a step is not worth it.
    - `steps`: most evaluations of each descent.
    - `enforces`: whether what a descent leaves unmet is penalised harder in another one.
    - `descents`: how many there are then.
    - `penalty_factor`: by how much the penalty grows for the next.
    - `restorable`: violation up to which the nearest design that meets all is tried before.
    - `largest_radius`: the largest radius.
    - `largest_curvature`: the largest curvature that is taken from slopes.
    - `acceptance`: share of the promised gain above which a step is taken.
    - `poor`: share below which a step is corrected, and the next is shorter.
    - `agreement`: share above which the next step may be longer.
    - `largest_correction`: share of a step above which its correction is not tried.
    - `iterations`: most iterations to a step.
    - `margin`: by how much steps stay inside limits.
    - `active`: residuals within this of their largest, or of their limit, are active.
    """

    radius: float
    least_radius: float
    gain: float
    steps: int
    enforces: bool = False
    descents: int = 2
    penalty_factor: float = 100.0
    restorable: float = 0.1
    largest_radius: float = 0.25
    largest_curvature: float = 1e3
    acceptance: float = 0.05
    poor: float = 0.25
    agreement: float = 0.6
    largest_correction: float = 0.5
    iterations: int = 40
    margin: float = 1e-7
    active: float = 1e-6


@dataclasses.dataclass(frozen=True)
class Stages:
    """The steps at each stage of a search, which continues fewer and fewer paths.

    **Fields:**

    - `rough`: from the starts.
    - `near`: from new starts near the best design.
    - `settled`: from the best ends of both.
    - `fine`: to the end.
    """

    rough: TrustRegion = TrustRegion(0.1, 3e-3, 1e-2, 40)
    near: TrustRegion = TrustRegion(0.03, 1e-3, 1e-3, 40)
    settled: TrustRegion = TrustRegion(0.02, 1e-5, 1e-4, 60, enforces=True)
    fine: TrustRegion = TrustRegion(0.02, 1e-7, 1e-7, 100, enforces=True)


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


def minimise_in_trust_region(
    at: Callable[[np.ndarray], Local],
    limits: Limits,
    start: np.ndarray,
    curvature: float,
    options: TrustRegion,
    penalty: float,
    met: float = 0.0,
) -> np.ndarray:
    """A design (v,) in [0, 1]^v with the least objective that meets all, from `start`.

    `limits` gives residuals (l,) that every step keeps to, and their slopes (l, v); `curvature` is
    that of the objective at least. `penalty` is that of what is unmet at first, above `met`.
    """
    u, radius = start, options.radius
    hessian = curvature * np.eye(len(start))
    for _ in range(options.descents if options.enforces else 1):
        settings = limits, curvature, options, radius, penalty
        u, hessian, excess = _descend(at, u, hessian, *settings)
        if met < excess <= options.restorable and options.enforces:
            # To where all is met, if that is near.
            distance = functools.partial(_with_distance, at, u)
            u, _, excess = _descend(distance, u, 2 * np.eye(len(u)), *settings)
        if excess <= met:
            break
        radius, penalty = radius / 2, penalty * options.penalty_factor
    return u


def _with_distance(at, centre, u) -> Local:
    """The requirements at u, with the squared distance from a design as the objective."""
    return at(u)._replace(value=float((u - centre) @ (u - centre)), slope=2 * (u - centre))


def _descend(at, u, hessian, limits, curvature, options, radius, penalty):
    """As far down the merit as it goes, the curvature there, and what is unmet."""
    here, steps = at(u), 0
    while steps < options.steps and radius >= options.least_radius:
        # A hundredth of the gain that counts may be lost by a step.
        exact = max(0.01 * options.gain * abs(here.merit(penalty)), 1e-12)
        settings = radius, penalty, exact, options
        step, bounds, holding = _solve_step(here, limits, u, hessian, *settings)
        expected = here.predict(step, hessian)
        promised = here.merit(penalty) - expected.merit(penalty)
        if holding is None or promised <= 0:  # no step was found inside the limits
            radius /= 4
            continue
        if promised <= options.gain * abs(here.merit(penalty)):
            break
        there, steps = at(u + step), steps + 1
        ratio = (here.merit(penalty) - there.merit(penalty)) / promised
        if ratio < options.poor and there.excess > expected.excess:
            corrected, *others = _solve_step(
                here.correct(step, there), limits, u, hessian, *settings
            )
            small = (
                np.abs(corrected - step).max() <= options.largest_correction * np.abs(step).max()
            )
            if small and others[1] is not None:
                end, steps = at(u + corrected), steps + 1
                if end.merit(penalty) < min(here.merit(penalty), there.merit(penalty)):
                    step, (bounds, holding), there = corrected, others, end
                    expected = here.predict(step, hessian)
                    ratio = (here.merit(penalty) - there.merit(penalty)) / promised
        hessian = _update_curvature(
            here, there, expected, step, bounds, holding, hessian, curvature, penalty, options
        )
        length = float(np.abs(step).max())
        if ratio <= options.acceptance:
            radius = min(radius, length) / 2.5
        elif ratio < options.poor:
            radius = max(length, radius / 4) / 2
        elif ratio > options.agreement and length > 0.9 * radius:
            radius = min(2 * radius, options.largest_radius)
        if ratio > options.acceptance:
            u, here = u + step, there
    return u, hessian, here.excess


def _solve_step(here: Local, limits: Limits, u, curvature, radius, penalty, exact, options):
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
        return np.concatenate([aimed, unmet, -limits_at(step)[0] - options.margin])

    def slopes(z):
        limit_slopes = limits_at(z[:v])[1]
        by_step = -np.concatenate([here.aimed_slopes, here.unmet_slopes, limit_slopes])
        kinds = np.repeat([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], [a, r, len(limit_slopes)], axis=0)
        return np.hstack([by_step, kinds])

    largest = (-np.inf, np.inf) if a else (0.0, 0.0)
    start = np.concatenate([np.zeros(v), [here.largest, here.excess]])
    conditions = {"type": "ineq", "fun": constraints, "jac": slopes}
    all_bounds = [*bounds, largest, (0.0, np.inf)]
    end = minimise(merit, start, all_bounds, conditions, options.iterations, exact)
    step = np.clip(end[:v], *bounds.T)
    residuals, limit_slopes = limits_at(step)
    inside = residuals.max(initial=-np.inf) <= 0
    return step, bounds, limit_slopes[residuals >= -options.active] if inside else None


def _update_curvature(
    here, there, expected, step, bounds, holding, hessian, curvature, penalty, options
):
    """The curvature (v, v) of the Lagrangian, by the symmetric rank-one formula, kept convex."""
    from scipy.optimize import nnls

    v, near = len(step), options.active
    aims = expected.aimed >= expected.largest - near
    unmet = expected.unmet >= expected.excess - near
    low, high = step <= bounds[:, 0] + near, step >= bounds[:, 1] - near
    rows = (
        here.aimed_slopes[aims],
        here.unmet_slopes[unmet],
        holding,
        -np.eye(v)[low],
        np.eye(v)[high],
    )
    kinds = np.zeros((sum(map(len, rows)), 2))
    kinds[: aims.sum(), 0] = -1
    kinds[aims.sum() : aims.sum() + unmet.sum(), 1] = -1
    matrix = np.hstack([np.concatenate(rows), kinds])
    if not expected.excess:
        matrix = np.vstack([matrix, np.append(np.zeros(v + 1), -1.0)])
    forces = np.concatenate([expected.slope, [float(aims.any()), penalty]])
    multipliers = nnls(matrix.T, -forces)[0]
    change = there.slope - here.slope
    change = change + multipliers[: aims.sum()] @ (there.aimed_slopes - here.aimed_slopes)[aims]
    multipliers = multipliers[aims.sum() :][: unmet.sum()]
    change = change + multipliers @ (there.unmet_slopes - here.unmet_slopes)[unmet]
    error = change - hessian @ step
    if abs(step @ error) <= 1e-8 * np.linalg.norm(step) * np.linalg.norm(error):
        return hessian  # the correction would be too large
    values, vectors = np.linalg.eigh(hessian + np.outer(error, error) / (step @ error))
    return vectors * np.clip(values, curvature, options.largest_curvature) @ vectors.T
