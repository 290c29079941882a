"""The limit cycle of a design, followed from one design to the next.

Newton's method makes the cycle of a design nearby periodic again, which takes a hundredth of the
time of a search. Where that fails, since the itinerary changes or the cycle ends, the motion itself
is followed from a state of the last cycle to whatever attracts it.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._base.programs import exported_jit
from .._dynamics.acceptance import HARDLY, admissible, growth_of
from .._dynamics.cycle import CycleResult
from .._dynamics.extremes import extreme_values
from .._dynamics.limit_cycle import limit_cycle
from .._dynamics.orbit import orbit, solve_periodic_orbits
from .._dynamics.scaled import check_rtol, hybrid_system
from .._dynamics.segments import Segments, mean_square
from .._stability.stability import growth_rate
from .constraints import CycleConstraint

_REACH = 0.05, 0.01  # longest step between designs, in scaled variables, and the shortest
_NEAR = 0.2  # relative distance of states beyond which an orbit is another one


class _Known(NamedTuple):
    """What is known of one design: no segments where nothing moves."""

    u: np.ndarray
    segments: Segments | None
    start: np.ndarray  # a state [m, m/s] of the cycle
    measures: np.ndarray  # (2, n): amplitudes [m], velocities [m/s]; NaN where none was found
    slopes: np.ndarray  # (2, n, v)


@dataclasses.dataclass(eq=False)  # hashable: a problem holds it beside its numbers
class FollowedCycles:
    """The cycles of the designs of one problem, as far as they have been asked for."""

    objective: CycleConstraint | None
    known: dict[bytes, _Known] = dataclasses.field(default_factory=dict)

    def fill(self, problem, us: np.ndarray, rows: np.ndarray, jacobians: np.ndarray) -> None:
        """Write what is asked of the cycles into rows (n, 1 + k) and Jacobians (n, 1 + k, v)."""
        columns = [
            (column, asked, (lambda asked, value: asked.above(value)) if column else _itself)
            for column, asked in self.columns(problem)
        ]
        for i, u in enumerate(np.asarray(us, float)):
            found = self.at(problem, u)
            for column, asked, residual in columns:
                given = jnp.asarray(found.measures[:, asked.dof])
                rows[i, column], slope = jax.value_and_grad(
                    lambda pair, asked=asked, residual=residual: residual(asked, asked.of(*pair))
                )(given)
                jacobians[i, column] = np.asarray(slope) @ found.slopes[:, asked.dof]

    def columns(self, problem) -> list[tuple[int, CycleConstraint]]:
        """Which columns of a row are of cycles: requirements, and perhaps the objective."""
        first = 1 + problem.requirements - len(problem.constraints)
        first -= 0 if problem.cuts is None else len(problem.cuts.reach)
        columns = [
            (first + i, asked)
            for i, asked in enumerate(problem.constraints)
            if isinstance(asked, CycleConstraint)
        ]
        return columns if self.objective is None else [*columns, (0, self.objective)]

    def ends(self, problem, u: np.ndarray) -> dict[str, tuple[float, float]]:
        """What is asked of the cycles, of the given design and of u (v,), by name and unit."""
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

    def at(self, problem, u: np.ndarray) -> _Known:
        """What is known of the cycle at u (v,), by way of the nearest design with one."""
        if u.tobytes() in self.known:
            return self.known[u.tobytes()]
        if not self.known:
            own = np.asarray(problem.start, float)
            self._searched(problem, own, None)
            return self.at(problem, u)
        cycles = [known for known in self.known.values() if known.segments is not None]
        if not cycles:
            return self._searched(problem, u, None)
        last = min(cycles, key=lambda known: np.abs(u - known.u).max())
        reach, shortest = _REACH
        while True:
            away = float(np.abs(u - last.u).max())
            arrives = away <= reach
            next_u = u if arrives else last.u + reach / away * (u - last.u)
            found = self._newton(problem, next_u, last.segments)
            if found is None and reach > shortest:
                reach = min(away, reach) / 2
                continue
            if found is None:
                found = self._searched(problem, next_u, last.start)
                if found.segments is None and not arrives:
                    found = self._beyond(problem, u, found, last.start)
            self.known[found.u.tobytes()] = found
            if np.array_equal(found.u, u):
                return found
            last = found

    def _beyond(self, problem, u, found: _Known, start) -> _Known:
        """What is at u if the cycle has ended before it, where `found` was."""
        x = _mechanism(problem, u)
        at_rest = not found.measures.any()
        if at_rest and float(growth_rate(x)) < 0:
            return found._replace(u=u)
        return self._searched(problem, u, None if at_rest else start)

    def _newton(self, problem, u, segments) -> _Known | None:
        """The orbit near that of another design; None unless it is a cycle that attracts."""
        (segments, start, ok), measures, slopes = _followed(
            problem.with_fields(cycles=None, cuts=None, constraints=(), grid=None),
            jnp.asarray(u, problem.low.dtype),
            segments,
        )
        if not bool(ok):
            return None
        return _Known(u, segments, *(np.asarray(x, float) for x in (start, measures, slopes)))

    def _searched(self, problem, u, start) -> _Known:
        """What the motion from a start ends in."""
        x = _mechanism(problem, u)
        cycle = limit_cycle(x, start, throw=False)
        n = len(cycle.amplitude)
        found = None
        if bool(jnp.isfinite(cycle.period)):  # or one that repels hardly
            found = self._newton(problem, u, cycle._orbit.segments)
        if found is None:
            at_rest = bool(cycle.result == CycleResult.equilibrium)
            measures = np.full((2, n), 0.0 if at_rest else np.nan)
            none = np.zeros((2, n, len(u)))
            found = _Known(u, None, np.full(2 * n, np.nan), measures, none)
        self.known[u.tobytes()] = found
        return found


def _itself(asked: CycleConstraint, value: jax.Array) -> jax.Array:
    return value


def _mechanism(problem, u):
    return problem.moved(jnp.asarray(u, problem.low.dtype), problem.own_condition)


@exported_jit
def _followed(problem, u, segments: Segments):
    """The orbit of the design u near those segments, what is measured of it, and by u."""
    rtol = check_rtol(None, u.dtype)

    def measured(u):
        system = hybrid_system(problem.moved(u, problem.own_condition))
        frozen = jax.lax.stop_gradient(system)
        lane = jax.tree.map(lambda x: x[..., None], segments)  # the only one
        wanted, reach = jnp.array([True]), jnp.array([jnp.inf], u.dtype)
        found = jax.lax.stop_gradient(solve_periodic_orbits(frozen, lane, wanted, reach))
        y, duration = orbit(system, jax.tree.map(lambda x: x[..., 0], found.segments))
        closed = Segments(y, duration, segments.s, segments.guard)
        rows = jnp.eye(len(y) // 2, len(y), dtype=y.dtype)
        low, high = extreme_values(system, closed, rows)
        n, units = len(rows), system.units
        velocity = jnp.sqrt(mean_square(system, closed)[n:])
        measures = jnp.stack([(high - low) * units[:n], velocity * units[n:]])
        moved = jnp.max(jnp.abs(y - segments.y)) < _NEAR * (1 + jnp.max(jnp.abs(y)))
        ok = found.converged & (found.error <= rtol) & (growth_of(frozen, found) < HARDLY)
        ok = jnp.all(ok & admissible(frozen, found.segments, found.middle))
        ok = ok & moved & jnp.all(jnp.isfinite(measures))
        return measures, (measures, (closed, y[:, 0] * units, ok))

    slopes, (measures, orbit_of) = jax.jacfwd(measured, has_aux=True)(u)
    return orbit_of, measures, slopes
