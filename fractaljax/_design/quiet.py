"""Designs that come to rest after every kick up to a size.

A design is solved for, and kicked. The first one that does not come to rest adds a cut, and it is
solved again: exchange, as in `search.py`. A cut keeps away from the design that failed: beyond the
fold or grazing at which the cycle ends that the kick led to, which moves with the other quantities
as its derivatives say, or out of its neighbourhood. A cycle that exists may be out of reach of
every kick, so the design that comes to rest is then moved back by bisection. What is answered has
been verified by a draw of its own. Under an envelope a design is kicked at the conditions that are
worst for its requirements, and at the middle and corners.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._dynamics.basin import Basin, basin
from .._dynamics.branch import BranchEvent, continue_cycle
from .._dynamics.cycle import LimitCycle
from .._dynamics.excitation import compiled_system
from .._dynamics.scaled import degrees_of_freedom, hybrid_system
from .._dynamics.starts import ellipsoid, kick_size
from .._mechanism.mechanism import Mechanism
from .._stability.stability import growth_rate
from .cuts import Cuts
from .design_search import DesignSearch
from .envelope import Envelope
from .problem import DesignProblem
from .search import SearchResult


@dataclasses.dataclass
class Kicks:
    """Starts about the equilibrium, each time others.

    Their norm is 1 on the ellipsoid of semi-axes `within` (2n,) [m, m/s], or Euclidean in units of
    V/omega and V.
    """

    within: float | list[float]
    seed: int
    progress: bool
    draws: Sequence[int] = DesignSearch.kick_starts  # how many starts; the last one verifies

    @classmethod
    def of(
        cls,
        x: Mechanism,
        within: Any,
        seed: int,
        progress: bool,
        draws: Sequence[int] = DesignSearch.kick_starts,
    ) -> "Kicks":
        """Those of `design(quiet_within=)`, checked."""
        n = degrees_of_freedom(x)
        jax.eval_shape(hybrid_system, x)  # refuses a joint without V
        return cls(kick_size("quiet_within", within, n), seed, progress, draws)

    @property
    def size(self) -> float:
        """The norm of the largest kicks."""
        return 1.0 if isinstance(self.within, list) else self.within

    def try_one(self, x: Mechanism, radius: float, count: int) -> tuple[float, Basin]:
        """The least of `count` kicks within `radius` that does not come to rest, else `radius`."""
        self.seed += 1
        centre, axes = ellipsoid(compiled_system(x, None), self.within)
        axes = axes / self.size  # of norm 1
        outcome = basin(
            x, radius=radius * axes, starts=count, seed=self.seed, progress=self.progress
        )
        moves = np.linalg.norm((outcome.starts[outcome.labels != 0] - centre) / axes, axis=1)
        return moves.min(initial=radius), outcome

    def try_all(
        self, xs: Sequence[Mechanism], radius: float, count: int
    ) -> tuple[float, int, Basin]:
        """As `try_one`, of `count` kicks shared by mechanisms; also which one is kicked so."""
        each = [self.try_one(x, radius, -(-count // len(xs))) for x in xs]
        i = int(np.argmin([least for least, _ in each]))
        return each[i][0], i, each[i][1]

    def try_quickly(self, xs: Sequence[Mechanism]) -> tuple[float, int, Basin]:
        """As `try_all`, of the full size, by larger and larger draws until a kick fails.

        The last draw is left out, if there are others.
        """
        first, *more = self.draws[:-1] or self.draws
        radius, i, outcome = self.try_all(xs, self.size, first)
        for count in more:
            if radius == self.size:
                radius, i, outcome = self.try_all(xs, self.size, count)
        return radius, i, outcome

    def survived(self, xs: Sequence[Mechanism]) -> float:
        """The largest norm, up to `size`, below which a last draw has no counter-example."""
        if any(float(growth_rate(x)) >= 0 for x in xs):
            return 0.0
        radius = self.size
        for count in self.draws:
            while (least := self.try_all(xs, radius, count)[0]) < radius:
                radius = least
        return float(radius)


def kick_conditions(design: SearchResult, envelope: Envelope | None) -> np.ndarray:
    """The conditions (k, c) at which a design is kicked: the worst ones, middle and corners."""
    if envelope is None:
        return np.zeros((1, 0))
    places = np.concatenate([design.evaluation.places[0, 1:], envelope.likely(8)])
    return envelope.values(np.unique(places, axis=0))


def quiet(
    problem: DesignProblem,
    design: SearchResult,
    solve: Callable[[DesignProblem], SearchResult],
    kicks: Kicks,
    envelope: Envelope | None,
    options: DesignSearch = DesignSearch(),
) -> tuple[SearchResult, float]:
    """The best design that survives the kicks, and the largest kick survived.

    `design` solves `problem`. Where no design survives, the one that did best of those tried.
    """
    cuts, failed = Cuts.none(options.kick_rounds, problem.low), []

    def scenes(design: SearchResult):
        u, conditions = jnp.asarray(design.path[-1]), kick_conditions(design, envelope)
        return [problem.mechanism_at(u, jnp.asarray(condition)) for condition in conditions]

    for _ in range(options.kick_rounds):
        if design.evaluation.worst[0] > 0:
            if not failed or float(cuts.reach.max()) < options.kick_exclusion / 50:
                break
            cuts = dataclasses.replace(cuts, reach=cuts.reach / 2)
        else:
            radius, i, ends = kicks.try_quickly(scenes(design))
            if radius == kicks.size:
                better = []
                if failed:
                    centre = failed[0][1].path[-1]
                    better = _bisect(problem, centre, design, solve, kicks, scenes, options)
                for each in [*better, design]:
                    radius, i, ends = kicks.try_all(scenes(each), kicks.size, kicks.draws[-1])
                    if radius == kicks.size:
                        return each, radius
            u = design.path[-1]
            normals, gaps = _planes(problem, u, kick_conditions(design, envelope)[i], ends)
            reach = max(options.kick_exclusion, 2 * gaps[np.isfinite(gaps)].max(initial=0))
            cuts = cuts.added(len(failed), u, normals, gaps, reach)
            failed.append((radius, design))
        design = solve(problem.with_fields(cuts=cuts))
    best = max(failed, key=lambda pair: pair[0])[1] if failed else design
    return best, kicks.survived(scenes(best))


def _bisect(problem, centre, design, solve, kicks, scenes, options) -> list[SearchResult]:
    """Better designs that seem to survive, the best first: between `design` and one that failed.

    That one is at `centre` (v,).
    """
    better: list[SearchResult] = []
    offset = design.path[-1] - centre
    length, low, high, share = float(np.linalg.norm(offset)), 0.0, 1.0, 0.9
    for _ in range(options.kick_bisections):
        normals = np.stack([offset / length, np.zeros_like(offset)])
        gaps = np.array([share * length, np.inf])
        cuts = Cuts.none(options.kick_rounds, problem.low).added(0, centre, normals, gaps, np.inf)
        other = solve(problem.with_fields(cuts=cuts))
        if other.evaluation.worst[0] <= 0 and kicks.try_quickly(scenes(other))[0] == kicks.size:
            better.insert(0, other)
            high = share
        elif high == 1:  # a tenth of the distance is not worth more
            break
        else:
            low = share
        share = (low + high) / 2
    return better


def _planes(problem: DesignProblem, u: np.ndarray, condition: np.ndarray, ends: Basin):
    """Where the cycle of the largest share ends: normals (2, v) and distances (2,) from u (v,)."""
    normals, gaps = np.zeros((2, len(u))), np.full(2, np.inf)
    if ends.cycles and problem.low.dtype == jnp.float64:
        for i in range(len(u)):
            for side, plane in enumerate(_ends(problem, u, condition, i, ends.cycles[0])):
                if plane is not None:
                    normals[side], gaps[side] = plane
            if np.isfinite(gaps).any():
                break
    return normals, gaps


def _ends(
    problem: DesignProblem, u: np.ndarray, condition: np.ndarray, i: int, cycle: LimitCycle
) -> list[tuple[np.ndarray, float] | None]:
    """Tangent planes at both ends of a cycle in quantity i, None where it goes on."""
    name, logarithmic = problem.names[i], problem.logarithmic[i]
    low, high = float(problem.low[i]), float(problem.high[i])

    def quantity(place) -> float:
        at = jnp.asarray(u).at[i].set(place)
        return float(problem.quantities(at)[name])

    at = quantity(u[i])
    window = min(quantity(0), at), max(quantity(1), at)  # rounding may put it outside
    x = problem.mechanism_at(jnp.asarray(u), jnp.asarray(condition))
    try:
        branch = continue_cycle(x, name, window, cycle)
    except ValueError:  # the cycle cannot be followed
        return [None, None]
    parameter, period, stable = branch.parameter, branch.period, branch.stable
    gap = abs(parameter - at) / (window[1] - window[0])
    index = int(np.argmin(gap + abs(period / float(cycle.period) - 1)))
    if not stable[index]:
        return [None, None]
    # With the points at which it ceases to attract.
    unlike = np.flatnonzero(~stable)
    first = unlike[unlike < index].max(initial=0)
    run = np.arange(first, 1 + unlike[unlike > index].min(initial=len(stable) - 1))

    def value(u, event: BranchEvent):
        return event.value_at(problem.mechanism_at(u, jnp.asarray(condition)))

    planes: list[tuple[np.ndarray, float] | None] = []
    for sign, edge in ((-1, window[0]), (1, window[1])):
        last = run[np.argmax(sign * parameter[run])]
        end = parameter[last]
        if abs(end - edge) < 1e-9 * abs(window[1] - window[0]):
            planes.append(None)
            continue
        place = ((np.log(end) if logarithmic else end) - low) / (high - low)
        normal = np.eye(len(u))[i]
        if branch.events:
            nearest = min(branch.events, key=lambda event: abs(event.index - last))
            slope = jax.grad(value)(jnp.asarray(u), nearest)
            normal = normal - np.asarray(slope) / ((end if logarithmic else 1) * (high - low))
        length = np.linalg.norm(normal)
        distance = sign * (place - u[i]) / length
        # A little beyond, where the cycle has ended.
        planes.append((sign * normal / length, distance + max(0.005 * distance, 1e-5)))
    return planes
