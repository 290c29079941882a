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
from .envelope import Envelope
from .problem import DesignProblem
from .search import Found

VERIFIED = 4000  # starts of the last draw
_TRIED = 64, 256  # of those before
_LIKELY = 8  # conditions of an envelope at which kicks are tried beside the worst ones
_EXCHANGES = 16
_REACH = 0.1  # of a cut at least, in scaled variables; halved where nothing is left
_BEYOND = 0.005  # of the way to an event that a cut goes on
_BISECTIONS, _NEARLY = 6, 0.9  # of the way back, and its first step
_NONE = 1e3  # distance of a plane that is none


@dataclasses.dataclass
class Kicks:
    """Starts about the equilibrium, each time others.

    Their norm is 1 on the ellipsoid of semi-axes `within` (2n,) [m, m/s], or Euclidean in units of
    V/omega and V.
    """

    within: float | list[float]  # asked for
    seed: int
    progress: bool

    @classmethod
    def of(cls, x: Mechanism, within: Any, seed: int, progress: bool) -> "Kicks":
        """Those of `design(quiet_within=)`, checked."""
        n = degrees_of_freedom(x)
        jax.eval_shape(hybrid_system, x)  # refuses a joint without V
        return cls(kick_size("quiet_within", within, n), seed, progress)

    @property
    def size(self) -> float:
        """The norm of the largest kicks asked for."""
        return 1.0 if isinstance(self.within, list) else self.within

    def tried(self, x: Mechanism, radius: float, count: int) -> tuple[float, Basin]:
        """The least of `count` kicks within `radius` that does not come to rest, else `radius`."""
        self.seed += 1
        centre, axes = ellipsoid(compiled_system(x, None), self.within)
        axes = axes / self.size  # of norm 1
        outcome = basin(
            x, radius=radius * axes, starts=count, seed=self.seed, progress=self.progress
        )
        moves = np.linalg.norm((outcome.starts[outcome.labels != 0] - centre) / axes, axis=1)
        return moves.min(initial=radius), outcome

    def worst(self, xs: Sequence[Mechanism], radius: float, count: int) -> tuple[float, int, Basin]:
        """As `tried`, of `count` kicks shared by mechanisms; also which one is kicked so."""
        each = [self.tried(x, radius, -(-count // len(xs))) for x in xs]
        i = int(np.argmin([least for least, _ in each]))
        return each[i][0], i, each[i][1]

    def least(self, xs: Sequence[Mechanism]) -> tuple[float, int, Basin]:
        """As `worst`, of the size asked for, by larger and larger draws until a kick is found."""
        first, *more = _TRIED
        radius, i, outcome = self.worst(xs, self.size, first)
        for count in more:
            if radius == self.size:
                radius, i, outcome = self.worst(xs, self.size, count)
        return radius, i, outcome

    def survived(self, xs: Sequence[Mechanism]) -> float:
        """The largest norm, up to `size`, below which a last draw has no counter-example."""
        if any(float(growth_rate(x)) >= 0 for x in xs):
            return 0.0
        radius = self.size
        for count in (*_TRIED, VERIFIED):
            while (least := self.worst(xs, radius, count)[0]) < radius:
                radius = least
        return float(radius)


def kicked_at(design: Found, envelope: Envelope | None) -> np.ndarray:
    """Where a design is kicked (k, c): the worst conditions of its requirements, a few others."""
    if envelope is None:
        return np.zeros((1, 0))
    places = np.concatenate([design.evaluation.places[0, 1:], envelope.likely(_LIKELY)])
    return envelope.values(np.unique(places, axis=0))


def quiet(
    problem: DesignProblem,
    design: Found,
    solve: Callable[[DesignProblem], Found],
    kicks: Kicks,
    envelope: Envelope | None,
) -> tuple[Found, float]:
    """The best design that survives the kicks, and the largest kick survived.

    `design` solves `problem`. Where no design survives, the one that did best of those tried.
    """
    cuts, failed = Cuts.none(_EXCHANGES, problem.low), []

    def scenes(design: Found):
        u = jnp.asarray(design.path[-1])
        return [problem.mechanism_at(u, jnp.asarray(at)) for at in kicked_at(design, envelope)]

    for _ in range(_EXCHANGES):
        if design.evaluation.worst[0] > 0:
            if not failed or float(cuts.reach.max()) < _REACH / 50:
                break
            cuts = dataclasses.replace(cuts, reach=cuts.reach / 2)
        else:
            radius, i, ends = kicks.least(scenes(design))
            if radius == kicks.size:
                # The last of these is the one that has been found.
                for better in [*_moved_back(problem, failed, design, solve, kicks, scenes), design]:
                    radius, i, ends = kicks.worst(scenes(better), kicks.size, VERIFIED)
                    if radius == kicks.size:
                        return better, radius
            u = design.path[-1]
            normals, gaps = _planes(problem, u, kicked_at(design, envelope)[i], ends)
            reach = max(_REACH, 2 * gaps[gaps < _NONE].max(initial=0))
            cuts = cuts.added(len(failed), u, normals, gaps, reach)
            failed.append((radius, design))
        design = solve(problem.with_fields(cuts=cuts))
    best = max(failed, key=lambda pair: pair[0])[1] if failed else design
    return best, kicks.survived(scenes(best))


def _moved_back(problem, failed, design, solve, kicks, scenes) -> list[Found]:
    """Better designs that seem to survive, the best first: towards the first one that failed."""
    better: list[Found] = []
    if not failed:
        return better
    centre = failed[0][1].path[-1]
    way = design.path[-1] - centre
    length, low, high, share = float(np.linalg.norm(way)), 0.0, 1.0, _NEARLY
    for _ in range(_BISECTIONS):
        plane = np.stack([way / length, np.zeros_like(way)]), np.array([share * length, _NONE])
        cuts = Cuts.none(_EXCHANGES, problem.low).added(0, centre, *plane, _NONE)
        other = solve(problem.with_fields(cuts=cuts))
        if other.evaluation.worst[0] <= 0 and kicks.least(scenes(other))[0] == kicks.size:
            better.insert(0, other)
            high = share
        elif high == 1:  # a tenth of the way is not worth more
            break
        else:
            low = share
        share = (low + high) / 2
    return better


def _planes(problem: DesignProblem, u: np.ndarray, condition: np.ndarray, ends: Basin):
    """Where the cycle of the largest share ends: normals (2, v) and distances (2,) from u (v,)."""
    normals, gaps = np.zeros((2, len(u))), np.full(2, _NONE)
    if ends.cycles and problem.low.dtype == jnp.float64:
        for i in range(len(u)):
            for side, plane in enumerate(_ends(problem, u, condition, i, ends.cycles[0])):
                if plane is not None:
                    normals[side], gaps[side] = plane
            if (gaps < _NONE).any():
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
        planes.append((sign * normal / length, distance + max(_BEYOND * distance, 1e-5)))
    return planes
