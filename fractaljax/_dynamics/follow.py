"""Following a branch of cycles through folds and changes of itinerary.

Within one itinerary the equations of `shooting.py` are smooth, and `_continuation.py` follows
their solutions. An itinerary ends where the duration of a phase or, between switches, a guard
falls to zero. There the branch goes on with the phase left out, or with one put in.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._base.quick import quick_jit
from .._continuation import cubic
from .._mechanism.mechanism import Mechanism
from .hybrid import OPEN, SECTION, HybridSystem
from .itinerary import Family, Phase, Shooting, Solution
from .shooting import after_switch, guards_at, largest_friction, linearised, measured, rate_at

_FINER = 8  # attempts at a mesh that is fine enough
_NEW = (1e-3, 1e-4, 1e-2)  # durations of a phase that appears, as a share of the period
SMALL = 0.03  # size of a smooth orbit, in units of V/omega, below which a Hopf point is near
_NARROW = 3e-8  # share of a step within which the end of an itinerary is found
_SHORT = 1e-6  # duration of a phase that vanishes, as a share of the period
_FAST = 10.0  # coefficient of friction over the static one, beyond which no law is one
_SAMPLED = 512  # states of an orbit at which that is looked at
_ROUNDING = 1e-9  # a guard this far below zero is kept to


class BranchEnd(eqx.Enumeration):
    """Why a branch of cycles ends."""

    window = "at the edge of the window"
    closed = "where it began"
    hopf = "at a Hopf point, where the cycle vanishes"
    jump = "where no cycle with another itinerary goes on: a motion jumps from here"
    meets = "where another event meets it"
    lost = "where it could not be followed"
    fast = "where it slides so fast that the friction law has lost its meaning"
    long = "after the largest number of points"


@functools.partial(quick_jit, once=True)
def _system(window, x: Mechanism, q) -> HybridSystem:
    return window.system(x, q)


class Point(NamedTuple):
    """One solution and what is shown of it."""

    place: np.ndarray  # of the quantities that are free, in their windows
    row: dict[str, Any]
    itinerary: str


class Follower:
    """A branch of one mechanism in one quantity: its points and events so far."""

    def __init__(self, family: Family, most: int):
        self.family, self.most, self.n = family, most, family.n
        self.x, self.window = family.x, family.window
        self.points: list[Point] = []
        self.events: list[dict[str, Any]] = []
        self.home: Solution | None = None  # the start

    # --- what is recorded ---

    def record(self, shooting: Shooting, z) -> None:
        solution = shooting.solution(z)
        given = solution.x, self.window, solution.chain, solution.lifted, solution.u
        (low, high, state), second, error = map(np.asarray, measured(*given))
        n, h = self.n, shooting.lengths(z)
        values = shooting.multipliers(z)
        states = np.array([phase.s for phase in shooting.phases])
        row = {
            "period": float(h.sum() * second),
            "amplitude": (high - low)[:n],
            "velocity_min": low[n:],
            "velocity_max": high[n:],
            "stick_fraction": h @ (states == 0) / h.sum(),
            "open_fraction": h @ (states == OPEN) / h.sum(),
            "stable": bool(np.abs(values[:-1]).max() < 1),
            "multipliers": values,
            "state": state,
            "error": float(error),
        }
        self.points.append(Point(z[shooting.quantity :], row, shooting.itinerary()))

    def note(self, kind, shooting: Shooting, z, before, after, condition=None) -> None:
        """An event at the last recorded point; `condition` is what vanishes there."""
        solution = shooting.solution(z)
        self.events.append(
            {
                "kind": kind,
                "index": len(self.points) - 1,
                "before": before,
                "after": after,
                "data": (solution.chain, solution.lifted, jnp.asarray(solution.u)),
                "condition": condition,
                "solution": solution,
            }
        )

    # --- following ---

    def both_ways(self, begun: Callable) -> tuple[BranchEnd, BranchEnd]:
        """Adds the points before and beyond a solution, and says why they end.

        `begun()` makes its equations, and returns them with the unknowns and the tangent there. The
        last point is in the direction in which the last quantity rises.
        """
        shooting, z, tangent = begun()
        tangent = tangent if tangent[-1] > 0 else -tangent
        self.record(shooting, z)
        self.home = shooting.solution(z)
        end = self.follow(shooting, z, tangent)
        if bool(end == BranchEnd.closed):
            return end, end
        self.reverse()
        self.home = None
        start = self.follow(begun()[0], z, -tangent)
        self.reverse()
        return start, end

    def follow(self, shooting: Shooting, z, ahead) -> BranchEnd:
        """Adds the points beyond z in the direction `ahead`, and says why they end."""
        state: Any = shooting, z, ahead
        origin = len(self.points)
        while not isinstance(state, BranchEnd):
            if len(self.points) - origin >= self.most:
                return BranchEnd.long
            state = self._within_itinerary(*state, origin)
        return state

    def _within_itinerary(self, shooting: Shooting, z, ahead, origin):
        """Follows one itinerary on one mesh; returns where to go on, or why not."""
        smooth = shooting.phases[0].guard == SECTION
        for reached, turned, leaves in shooting.curves.steps(z, ahead):
            if smooth and self._shrinks(shooting, reached):
                return self._hopf(shooting, z)
            if shooting.admissibility(reached) < -_ROUNDING:
                return self._leaves_itinerary(shooting, z, reached)
            if self._closes(shooting, z, ahead, reached):
                return BranchEnd.closed
            self._smooth_events(shooting, z, ahead, reached, turned)
            self.record(shooting, reached)
            if leaves:
                return BranchEnd.window
            if len(self.points) - origin >= self.most:
                return BranchEnd.long
            z, ahead = reached, turned
            onward = self._accurate(shooting, z, ahead)
            if isinstance(onward, BranchEnd) or onward[0] is not shooting:
                return onward
            if shooting.stale(z):
                return self._remeshed(shooting, z, ahead)
        if smooth and self._shrinks(shooting, z, 5):
            return self._hopf(shooting, z)
        return self._lost(shooting, z)

    def _lost(self, shooting: Shooting, z) -> BranchEnd:
        """Why Newton's method fails beyond z: perhaps friction that grows without bound."""
        solution = shooting.solution(z)
        times = np.linspace(0, solution.times[-1], _SAMPLED, endpoint=False)
        y, _ = self.family.sampled(solution, times, _SAMPLED)
        given = solution.x, self.window, solution.u[-1], y
        return BranchEnd.fast if float(largest_friction(*given)) > _FAST else BranchEnd.lost

    def reverse(self) -> None:
        """The points in the opposite order."""
        self.points.reverse()
        last = len(self.points) - 1
        for event in self.events:
            event["index"] = last - event["index"]
            event["before"], event["after"] = event["after"], event["before"]

    def _closes(self, shooting, z, ahead, reached) -> bool:
        if self.home is None or self.home.phases != shooting.phases or len(self.points) < 4:
            return False
        start = shooting.located(self.home.u, self.home.r)
        return shooting.curves.passes(start - z, ahead, reached - z)

    def _accurate(self, shooting: Shooting, z, ahead):
        """Where to go on from z, recorded last: on a finer mesh, and recorded anew, if need be."""
        if not self.points[-1].row["error"] > self.family.rtol:
            return shooting, z, ahead
        onward = self._remeshed(shooting, z, ahead)
        if not isinstance(onward, BranchEnd):
            self.points.pop()
            self.record(*onward[:2])
        return onward

    def _remeshed(self, old: Shooting, z, ahead):
        """Where to go on with a new mesh of the same itinerary, finer if that is not enough."""
        times = self._times(old, z)
        for _ in range(_FINER):
            new = old.again(old.solution(z), old.phases, times)
            found = new.curves.corrected(new.begin)
            if found is None:
                return self._lost(old, z)
            solution = new.solution(found[0])
            given = solution.x, self.window, solution.chain, solution.lifted, solution.u
            if float(measured(*given)[2]) <= self.family.rtol / 2:
                break
            self.family.h *= 0.7
        direction = ahead * old.scale / new.scale
        tangent = new.curves.tangent(found[1])
        return new, found[0], tangent if tangent @ direction > 0 else -tangent

    def _between(self, shooting, z, reached, share):
        """The point of the curve near that share of the way, or None."""
        if share in (0.0, 1.0):
            return reached if share else z
        way = reached - z
        ends = (shooting.curves.tangent(shooting.equations(at)[1]) for at in (z, reached))
        first, last = (t if t @ way > 0 else -t for t in ends)
        found = shooting.curves.corrected(cubic(z, first, reached, last, share))
        return None if found is None else found[0]

    def _root(self, shooting, z, reached, test: Callable) -> np.ndarray | None:
        """The point between two at which a test function of z vanishes."""

        def along(share):
            at = self._between(shooting, z, reached, share)
            return np.nan if at is None else test(at)

        import scipy.optimize  # not before it is used: it takes its time

        try:
            share: Any = scipy.optimize.brentq(along, 0.0, 1.0, xtol=1e-13)
        except (ValueError, RuntimeError):
            return None
        return self._between(shooting, z, reached, share)

    def _smooth_events(self, shooting, z, ahead, reached, turned) -> None:
        """Folds and changes of stability between two points of one itinerary."""

        if ahead[-1] * turned[-1] < 0:

            def slope(at):
                t = shooting.curves.tangent(shooting.equations(at)[1])
                return (t if t @ ahead > 0 else -t)[-1]

            at = self._root(shooting, z, reached, slope)
            if at is not None:
                self._noted("fold", shooting, at, ("fold",))

        def doubling(at):
            return float(np.prod(shooting.multipliers(at)[:-1] + 1).real)

        def rotating(at):
            values = shooting.multipliers(at)[:-1]
            turning = np.abs(values[np.abs(np.imag(values)) > 1e-9])
            return float(turning.max() - 1) if len(turning) else -1.0

        for kind, test in (("period doubling", doubling), ("Neimark-Sacker", rotating)):
            if test(z) * test(reached) < 0:
                at = self._root(shooting, z, reached, test)
                if at is not None and abs(test(at)) < 1e-6:
                    self._noted(kind, shooting, at, ("multiplier",))

    def _noted(self, kind, shooting, at, condition) -> None:
        self.record(shooting, at)
        itinerary = shooting.itinerary()
        self.note(kind, shooting, at, itinerary, itinerary, condition)

    # --- the Hopf point ---

    def _shrinks(self, shooting, z, factor=1.0) -> bool:
        """Whether a smooth orbit is about to vanish, or has passed the point where it does."""
        u = shooting.full(z)
        x, y = shooting.mechanism(z), u[: 2 * self.n]
        equilibrium = np.asarray(linearised(x, self.window, u[-1])[0])
        s = np.array(shooting.phases[0].s, float)
        small = np.abs(y - equilibrium).max() < factor * SMALL
        return bool(small or float(rate_at(x, self.window, u[-1], y, s)) >= 0)

    def _hopf(self, shooting, z):
        """The Hopf point near the small orbit z, and the end of the branch."""
        q, period = z[shooting.quantity], float(shooting.lengths(z).sum())
        found = self.family.hopf_near(q, 2 * np.pi / period)
        if found is None:
            return BranchEnd.lost
        self.record_hopf(*found, shooting)
        return BranchEnd.hopf

    def record_hopf(self, q, frequency, shooting: Shooting) -> None:
        y, A = self.family.linearised(q)
        system = _system(self.window, self.x, jnp.asarray(q))
        period, n, units = 2 * np.pi / frequency, self.n, np.asarray(system.units)
        values, flat = np.exp(np.linalg.eigvals(A) * period), np.zeros(len(system.P))
        order = np.argsort(np.abs(values - 1))
        # One of the pair on the unit circle is that of the orbit itself.
        values = np.append(values[np.sort(order[1:])], 1.0)
        state = y * units
        row = {
            "period": float(period / system.omega),
            "amplitude": np.zeros(n),
            "velocity_min": state[n:],
            "velocity_max": state[n:],
            "stick_fraction": flat,
            "open_fraction": flat,
            "stable": np.abs(values[:-1]).max() < 1 + 1e-9,
            "multipliers": values,
            "state": state,
            "error": 0.0,
        }
        itinerary = shooting.itinerary()
        self.points.append(Point(np.array([q]), row, itinerary))
        u = np.concatenate([y, [period], [q]])
        self.events.append(
            {
                "kind": "Hopf",
                "index": len(self.points) - 1,
                "before": itinerary,
                "after": itinerary,
                "data": (None, None, jnp.asarray(u)),
                "condition": ("hopf",),
                "solution": None,
            }
        )

    # --- changes of itinerary ---

    def _leaves_itinerary(self, shooting: Shooting, z, reached):
        """From an admissible z to where the orbit ceases to be, and on from there."""
        inside, outside = self._bracket(shooting, z, reached)
        p = int(np.argmin(shooting.durations(inside)))
        # A phase this short is about to vanish, though rounding may touch one of its guards first.
        vanishes = shooting.durations(inside)[p] < _SHORT
        if shooting.durations(outside).min() <= 0:
            vanishes, p = True, int(np.argmin(shooting.durations(outside)))
        candidates = itertools.chain(
            self._vanishing(shooting, inside, p) if vanishes else (),
            self._touching(shooting, inside, outside),
        )
        for candidate in candidates:
            if candidate is not None:
                return candidate
        return self._ends(shooting, inside, outside, p if vanishes else None)

    def _bracket(self, shooting: Shooting, z, reached) -> tuple[np.ndarray, np.ndarray]:
        """Points inside and outside the itinerary, close to each other where it ends."""
        import scipy.optimize  # not before it is used: it takes its time

        inside, outside = {0.0: z}, {1.0: reached}

        def along(share):
            at = (inside | outside).get(share)
            if at is None:
                at = self._between(shooting, z, reached, share)
            value = -1.0 if at is None else shooting.admissibility(at)
            if share > 0 and at is not None:
                (inside if value > 0 else outside)[share] = at
            return value if share > 0 else max(value, 1e-15)

        share: Any = scipy.optimize.brentq(along, 0.0, 1.0, xtol=_NARROW)
        along(min(share + _NARROW, 1.0))
        # Rounding may hide on which side a point is: further and further inside.
        away = _NARROW
        while away < share and along(share - away) <= 0:
            away *= 4
        last = min(outside)
        return inside[max(share for share in inside if share < last)], outside[last]

    def _ends(self, shooting, inside, outside, p: int | None) -> BranchEnd:
        """Notes the grazing beyond which no cycle goes on, where phase p vanishes if it is one."""
        found = None
        if p is None:
            at = self._root(shooting, inside, outside, lambda z: shooting.lowest(z)[0])
            if at is not None:
                found = at, ("touch", shooting.lowest(at)[1])
        else:
            at = self._without_duration(shooting, inside, p)
            if at is not None:
                found = at, ("vanish", p)
        if found is not None:
            self.record(shooting, found[0])
            self.note("grazing", shooting, found[0], shooting.itinerary(), "", found[1])
        return BranchEnd.jump

    def _without_duration(self, shooting, z, p: int) -> np.ndarray | None:
        """The point of the curve near z at which phase p has none."""
        at = z.copy()
        at[shooting.index(p)] = 0
        found = shooting.curves.corrected(at, shooting.index(p))
        return None if found is None else found[0]

    def _times(self, shooting, z) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(shooting.lengths(z))])

    def _vanishing(self, shooting: Shooting, z, p: int) -> Iterator[Any]:
        """Ways on where phase p, nearly of no duration at z, is left out or changes places."""
        phases, m = shooting.phases, shooting.m
        old, new = phases[p - 1], phases[(p + 1) % m]
        solution, times = shooting.solution(z), self._times(shooting, z)
        if old.s == new.s:
            # The chain begins where the next phase ends.
            order = [(p + 2 + i) % m for i in range(m - 3)] if m > 2 else []
            begin = times[(p + 1) % m + 1] if m > 2 else times[p]
            if m > 2:
                kept = [phases[i] for i in order] + [Phase(new.s, new.guard)]
                edges = np.concatenate(
                    [[begin], [_after(times[i + 1], begin, times) for i in order]]
                )
                edges = np.append(edges, begin + times[-1])
            else:
                kept, begin = [Phase(new.s, SECTION)], self.family.maximum(solution, times[-1])
                edges = np.array([begin, begin + times[-1]])
            yield self._merged(shooting, z, shooting.again(solution, kept, edges))
        elif old.guard == phases[p].guard:
            # A slip to and fro before a stick: without it the stick begins at its limit.
            kept, edges = _without(phases, times, p, old.guard)
            yield self._merged(shooting, z, shooting.again(solution, kept, edges))
        # Otherwise the phase can be brought to no duration at all.
        at = self._without_duration(shooting, z, p)
        if at is None:
            return
        solution, times = shooting.solution(at), self._times(shooting, at)
        condition = ("vanish", p)
        faces = len(new.s)
        if _face(old.guard, faces) != _face(phases[p].guard, faces):
            changed = [i for i in range(faces) if phases[p].s[i] != new.s[i]]
            s = tuple(new.s[i] if i in changed else old.s[i] for i in range(faces))
            swapped = list(phases)
            swapped[p - 1] = Phase(old.s, phases[p].guard)
            swapped[p] = Phase(s, old.guard)
            yield self._inserted(shooting, at, swapped, times, p, "order of switches", condition)
        for guard in (old.guard, phases[p].guard):
            kept, edges = _without(phases, times, p, guard)
            yield self._direct(shooting, at, kept, edges, p, condition)

    def _touching(self, shooting: Shooting, inside, outside) -> Iterator[Any]:
        """Ways on where a guard touches zero between two switches, or at one."""
        at = None
        if shooting.durations(outside).min() > 0:
            at = self._root(shooting, inside, outside, lambda z: shooting.lowest(z)[0])
        if at is None:
            return
        _, place = shooting.lowest(at)
        solution, times = shooting.solution(at), self._times(shooting, at)
        chain = solution.chain
        k = int(place.segment)
        p = int(chain.phase[k])
        h = times[p + 1] - times[p]
        since = float(chain.begin[k] + place.theta * chain.share[k]) * h
        phase, moment = shooting.phases[p], times[p] + since
        y = np.asarray(self.family.sampled(solution, np.array([moment]), 1)[0])[:, 0]
        q, guard = solution.u[-1], int(place.guard)
        s = np.array(phase.s, float)
        face = (guard - 1) // 2
        tried = []
        if since <= 0 or since >= h:
            tried = self._at_switch(phase, face, guard) if since <= 0 else []
        else:
            engine = np.asarray(after_switch(solution.x, self.window, q, y, s, guard)).astype(int)
            tried = [tuple(int(i) for i in engine)]
            if face < len(s):
                for other in (0, 1, -1):
                    tried.append(tuple(other if i == face else j for i, j in enumerate(phase.s)))
        condition = ("touch", place)
        for state in dict.fromkeys(tried):
            if state == phase.s:
                continue
            values = np.abs(guards_at(solution.x, self.window, q, y, np.array(state, float)))
            values = np.asarray(values).copy()
            values[0] = np.inf
            excursion = Phase(state, int(np.argmin(values)))
            phases = list(shooting.phases)
            if since <= 0:
                phases.insert(p, excursion)
                edges, new = np.insert(times, p, times[p]), p
            elif len(phases) == 1:
                phases = [excursion, Phase(phase.s, guard)]
                edges, new = np.array([moment, moment, moment + times[-1]]), 0
            else:
                phases[p : p + 1] = [Phase(phase.s, guard), excursion, phase]
                edges, new = np.insert(times, p + 1, [moment, moment]), p + 1
            yield self._inserted(shooting, at, phases, edges, new, "grazing", condition)

    def _at_switch(self, phase, face, guard):
        """Contact states that may come before a phase whose guard is zero at its very start."""
        if face >= len(phase.s):
            return []
        slip = 1 if guard == 1 + 2 * face else -1
        state = slip if phase.s[face] == 0 else 0
        return [tuple(state if i == face else j for i, j in enumerate(phase.s))]

    def _merged(self, shooting, z, new: Shooting):
        """On from where an excursion vanishes: located as the grazing of the orbit without it."""
        found = new.curves.corrected(new.begin)
        if found is None or np.linalg.norm(found[0] - new.begin) > 0.2:
            return None
        start, tangent = found[0], new.curves.tangent(found[1])

        def ahead(length):
            point = new.curves.corrected(start + length * tangent)
            return None if point is None else point[0]

        value = new.lowest(start)[0]
        for length in np.outer(4.0 ** np.arange(-8, -1), [1, -1]).ravel():
            at = ahead(length)
            if at is not None and new.lowest(at)[0] * value < 0:
                graze = self._root(new, start, at, lambda z: new.lowest(z)[0])
                if graze is None:
                    continue
                direction = (at - start) * (1 if new.lowest(at)[0] > 0 else -1)
                self._change("grazing", new, graze, shooting, new, ("touch", new.lowest(graze)[1]))
                tangent = new.curves.tangent(new.equations(graze)[1])
                return new, graze, tangent if tangent @ direction > 0 else -tangent
        return None

    def _inserted(self, shooting, at, phases, edges, index, kind, condition):
        """On with a new phase of no duration at an event."""
        solution = shooting.solution(at)
        period = edges[-1] - edges[0]
        for share in _NEW:
            new = shooting.again(solution, phases, edges)
            begin = new.begin.copy()
            begin[new.index(index)] = share * period / new.scale[new.index(index)]
            found = new.curves.corrected(begin, new.index(index))
            if found is None or np.linalg.norm(found[0] - new.begin) > 0.2:
                continue
            if new.admissibility(found[0]) <= 0:
                continue
            tangent = new.curves.tangent(found[1])
            self._change(kind, shooting, at, shooting, new, condition)
            self.record(new, found[0])
            forward = tangent[new.index(index)] > 0
            return self._accurate(new, found[0], tangent if forward else -tangent)
        return None

    def _direct(self, shooting, at, phases, edges, p: int, condition):
        """On without phase p, which has vanished between two others."""
        new = shooting.again(shooting.solution(at), phases, edges)
        found = new.curves.corrected(new.begin)
        if found is None or np.linalg.norm(found[0] - new.begin) > 1e-3:
            return None
        tangent = new.curves.tangent(found[1])
        for direction in (tangent, -tangent):
            beside = new.curves.corrected(found[0] + 1e-4 * direction)
            if beside is None or new.admissibility(beside[0]) <= 0:
                continue
            if self._switches(new, beside[0], p):
                self._change("grazing", shooting, at, shooting, new, condition)
                return new, beside[0], direction
        return None

    def _switches(self, shooting: Shooting, z, p: int) -> bool:
        """Whether the motion goes over into phase p by itself where the one before it ends."""
        p = p % shooting.m
        solution, last = shooting.solution(z), shooting.phases[p - 1]
        moment = np.array([solution.times[p]])
        y = np.asarray(self.family.sampled(solution, moment, 1)[0])[:, 0]
        s = np.array(last.s, float)
        state = after_switch(solution.x, self.window, solution.u[-1], y, s, last.guard)
        return tuple(int(i) for i in np.asarray(state)) == shooting.phases[p].s

    def _change(self, kind, where, at, old, new, condition) -> None:
        self.record(where, at)
        self.note(kind, where, at, old.itinerary(), new.itinerary(), condition)


def _without(phases, times, p: int, guard: int):
    """Phases and the times at which they begin without phase p, which has no duration."""
    kept = list(phases)
    kept[p - 1] = Phase(kept[p - 1].s, guard)
    del kept[p]
    return kept, np.delete(times, p)


def _after(time, begin, times) -> float:
    """A time on a periodic orbit, as the first one after `begin`."""
    return time if time > begin else time + times[-1]


def _face(guard: int, faces: int) -> int:
    """The face or, beyond those, the joint of a guard."""
    return (guard - 1) // 2 if guard <= 2 * faces else guard - faces
