"""The limit cycle of a design, followed from one design to the next.

Newton's method makes the cycle of a nearby design periodic again, which takes a hundredth of the
time of a search. Where that fails, since the itinerary changes or the cycle ends, the motion itself
is followed from a state of the last cycle to its attractor.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._base.programs import exported_jit
from .._dynamics.acceptance import admissible, growth_of
from .._dynamics.cycle import CycleResult
from .._dynamics.cycle_search import CycleSearch
from .._dynamics.extremes import extreme_values
from .._dynamics.limit_cycle import limit_cycle
from .._dynamics.orbit import orbit, solve_periodic_orbits
from .._dynamics.scaled import check_rtol, hybrid_system
from .._dynamics.segments import Segments, mean_square
from .._stability.stability import growth_rate
from .constraints import CycleConstraint


class _StoredCycle(NamedTuple):
    """The cycle of one design; its segments are None where there is none."""

    u: np.ndarray
    segments: Segments | None
    start: np.ndarray  # a state [m, m/s] of the cycle
    measures: np.ndarray  # (2, n): amplitudes [m], velocities [m/s]; NaN where none was found
    slopes: np.ndarray  # (2, n, v)


@dataclasses.dataclass(eq=False)  # hashable: a problem holds it beside its numbers
class FollowedCycles:
    """The cycles of the designs of one problem, each computed on demand and stored."""

    objective: CycleConstraint | None
    stored: dict[bytes, _StoredCycle] = dataclasses.field(default_factory=dict)

    def fill(self, problem, us: np.ndarray, rows: np.ndarray, jacobians: np.ndarray) -> None:
        """Write the columns of cycles into rows (n, 1 + k) and Jacobians (n, 1 + k, v)."""
        columns = [
            (column, constraint, (lambda c, value: c.above(value)) if column else _measure)
            for column, constraint in self.columns(problem)
        ]
        for i, u in enumerate(np.asarray(us, float)):
            cycle = self.at(problem, u)
            for column, constraint, residual in columns:
                measures = jnp.asarray(cycle.measures[:, constraint.dof])
                rows[i, column], slope = jax.value_and_grad(
                    lambda pair, c=constraint, residual=residual: residual(c, c.of(*pair))
                )(measures)
                jacobians[i, column] = np.asarray(slope) @ cycle.slopes[:, constraint.dof]

    def columns(self, problem) -> list[tuple[int, CycleConstraint]]:
        """The columns of a row that depend on cycles: requirements, perhaps the objective."""
        first = problem.growth_columns.stop + len(problem.contacts)
        columns = [
            (first + i, constraint)
            for i, constraint in enumerate(problem.constraints)
            if isinstance(constraint, CycleConstraint)
        ]
        return columns if self.objective is None else [*columns, (0, self.objective)]

    def ends(self, problem, u: np.ndarray) -> dict[str, tuple[float, float]]:
        """The measures of the cycles of the initial design and of u (v,), by name and unit."""
        before = self.at(problem, np.asarray(problem.start, float)).measures
        after = self.at(problem, u).measures
        return {
            f"{each.symbol} of dof {each.dof} [{each.unit}]": (
                float(each.of(*before[:, each.dof])),
                float(each.of(*after[:, each.dof])),
            )
            for each in (self.objective, *problem.constraints)
            if isinstance(each, CycleConstraint)
        }

    def at(self, problem, u: np.ndarray) -> _StoredCycle:
        """The cycle at u (v,), followed from the nearest design with one."""
        if u.tobytes() in self.stored:
            return self.stored[u.tobytes()]
        if not self.stored:
            first = np.asarray(problem.start, float)
            self._search(problem, first, None)
            return self.at(problem, u)
        cycles = [other for other in self.stored.values() if other.segments is not None]
        if not cycles:
            return self._search(problem, u, None)
        last = min(cycles, key=lambda other: np.abs(u - other.u).max())
        reach, shortest = 0.05, 0.01  # longest and shortest step, in scaled variables
        while True:
            distance = float(np.abs(u - last.u).max())
            arrives = distance <= reach
            next_u = u if arrives else last.u + reach / distance * (u - last.u)
            cycle = self._correct(problem, next_u, last.segments)
            if cycle is None and reach > shortest:
                reach = min(distance, reach) / 2
                continue
            if cycle is None:
                cycle = self._search(problem, next_u, last.start)
                if cycle.segments is None and not arrives:
                    cycle = self._continue_beyond(problem, u, cycle, last.start)
            self.stored[cycle.u.tobytes()] = cycle
            if np.array_equal(cycle.u, u):
                return cycle
            last = cycle

    def _continue_beyond(self, problem, u, ended: _StoredCycle, start) -> _StoredCycle:
        """The cycle at u if its branch has ended on the way there, with the one in `ended`."""
        x = _mechanism(problem, u)
        at_rest = not ended.measures.any()
        if at_rest and float(growth_rate(x)) < 0:
            return ended._replace(u=u)
        return self._search(problem, u, None if at_rest else start)

    def _correct(self, problem, u, segments) -> _StoredCycle | None:
        """The orbit near another design's segments; None unless it is an attracting cycle."""
        (segments, start, ok), measures, slopes = _follow_orbit(
            problem.with_fields(cycles=None, cuts=None, constraints=(), grid=None),
            jnp.asarray(u, problem.low.dtype),
            segments,
        )
        if not bool(ok):
            return None
        return _StoredCycle(u, segments, *(np.asarray(x, float) for x in (start, measures, slopes)))

    def _search(self, problem, u, start) -> _StoredCycle:
        """The cycle, if any, to which the motion from a start settles."""
        x = _mechanism(problem, u)
        cycle = limit_cycle(x, start, throw=False)
        n = len(cycle.amplitude)
        stored = None
        if bool(jnp.isfinite(cycle.period)):  # or one that hardly repels
            stored = self._correct(problem, u, cycle._orbit.segments)
        if stored is None:
            at_rest = bool(cycle.result == CycleResult.equilibrium)
            measures = np.full((2, n), 0.0 if at_rest else np.nan)
            none = np.zeros((2, n, len(u)))
            stored = _StoredCycle(u, None, np.full(2 * n, np.nan), measures, none)
        self.stored[u.tobytes()] = stored
        return stored


def _measure(constraint: CycleConstraint, value: jax.Array) -> jax.Array:
    return value


def _mechanism(problem, u):
    return problem.mechanism_at(jnp.asarray(u, problem.low.dtype), problem.nominal_condition)


@exported_jit
def _follow_orbit(problem, u, segments: Segments):
    """The orbit of the design u near these segments, its measures, and their slopes by u."""
    rtol = check_rtol(None, u.dtype)

    def measured(u):
        system = hybrid_system(problem.mechanism_at(u, problem.nominal_condition))
        frozen = jax.lax.stop_gradient(system)
        lane = jax.tree.map(lambda x: x[..., None], segments)  # the only one
        active, reach = jnp.array([True]), jnp.array([jnp.inf], u.dtype)
        solution = jax.lax.stop_gradient(solve_periodic_orbits(frozen, lane, active, reach))
        y, duration = orbit(system, jax.tree.map(lambda x: x[..., 0], solution.segments))
        closed = Segments(y, duration, segments.s, segments.guard)
        rows = jnp.eye(len(y) // 2, len(y), dtype=y.dtype)
        low, high = extreme_values(system, closed, rows)
        n, units = len(rows), system.units
        velocity = jnp.sqrt(mean_square(system, closed)[n:])
        measures = jnp.stack([(high - low) * units[:n], velocity * units[n:]])
        # A farther orbit is another one.
        near = jnp.max(jnp.abs(y - segments.y)) < 0.2 * (1 + jnp.max(jnp.abs(y)))
        ok = solution.converged & (solution.error <= rtol)
        ok = ok & (growth_of(frozen, solution) < CycleSearch().repelling)
        ok = jnp.all(ok & admissible(frozen, solution.segments, solution.middle))
        ok = ok & near & jnp.all(jnp.isfinite(measures))
        return measures, (measures, (closed, y[:, 0] * units, ok))

    slopes, (measures, orbit_of) = jax.jacfwd(measured, has_aux=True)(u)
    return orbit_of, measures, slopes
