"""Where the itinerary of a branch of cycles changes, and how the branch goes on.

An itinerary ends where the duration of a phase or, between switches, a guard falls to zero. There
the branch goes on with the phase left out, or with one put in.
"""

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from .contact_state import STATES, find_state
from .guard import SECTION, GuardNumbers
from .itinerary import Phase, Shooting
from .shooting import after_switch, guards_at

if TYPE_CHECKING:
    from .follow import Follower


class ItineraryChange:
    """The end of an itinerary between z and `reached`, and how the branch may go on there."""

    def __init__(self, branch: "Follower", shooting: Shooting, z, reached):
        self.branch, self.family, self.shooting = branch, branch.family, shooting
        self.inside, self.outside = self._bracket(z, reached)
        p = int(np.argmin(shooting.durations(self.inside)))
        # A phase this short is about to vanish, though rounding may touch one of its guards first.
        vanishes = shooting.durations(self.inside)[p] < 1e-6
        if shooting.durations(self.outside).min() <= 0:
            vanishes, p = True, int(np.argmin(shooting.durations(self.outside)))
        self.vanishing = p if vanishes else None

    def onward(self):
        """Where the branch goes on from here; None if nowhere."""
        p = self.vanishing
        vanishing = () if p is None else self._pass_vanishing_phase(p)
        candidates = itertools.chain(vanishing, self._pass_touching_guard())
        return next((candidate for candidate in candidates if candidate is not None), None)

    def note_grazing(self) -> None:
        """Record the grazing beyond which no cycle goes on."""
        shooting, p, grazing = self.shooting, self.vanishing, None
        if p is None:
            at = self._locate_touch()
            if at is not None:
                grazing = at, ("touch", shooting.lowest(at)[1])
        else:
            at = self._shrink_phase(self.inside, p)
            if at is not None:
                grazing = at, ("vanish", p)
        if grazing is not None:
            self.branch.record(shooting, grazing[0])
            self.branch.note("grazing", shooting, grazing[0], shooting.itinerary(), "", grazing[1])

    def _bracket(self, z, reached) -> tuple[np.ndarray, np.ndarray]:
        """Points inside and outside the itinerary, close to each other where it ends."""
        import scipy.optimize  # imported here because it is slow to import

        shooting, inside, outside = self.shooting, {0.0: z}, {1.0: reached}

        def along(share):
            at = (inside | outside).get(share)
            if at is None:
                at = self.branch.between(shooting, z, reached, share)
            value = -1.0 if at is None else shooting.admissibility(at)
            if share > 0 and at is not None:
                (inside if value > 0 else outside)[share] = at
            return value if share > 0 else max(value, 1e-15)

        narrow = 3e-8  # share of the step within which the end is located
        share: Any = scipy.optimize.brentq(along, 0.0, 1.0, xtol=narrow)
        along(min(share + narrow, 1.0))
        # Rounding may hide the side on which a point is: retreat further and further inside.
        retreat = narrow
        while retreat < share and along(share - retreat) <= 0:
            retreat *= 4
        last = min(outside)
        return inside[max(share for share in inside if share < last)], outside[last]

    def _locate_touch(self) -> np.ndarray | None:
        """The point of the curve at which a guard touches zero."""
        shooting, ends = self.shooting, (self.inside, self.outside)
        return self.branch.root(shooting, *ends, lambda z: shooting.lowest(z)[0])

    def _shrink_phase(self, z, p: int) -> np.ndarray | None:
        """The point of the curve near z at which phase p has no duration."""
        shooting, at = self.shooting, z.copy()
        at[shooting.index(p)] = 0
        corrected = shooting.curves.corrected(at, shooting.index(p))
        return None if corrected is None else corrected[0]

    def _pass_vanishing_phase(self, p: int) -> Iterator[Any]:
        """Continuations where phase p, nearly vanished inside, is left out or changes places."""
        shooting, z = self.shooting, self.inside
        phases, m = shooting.phases, shooting.m
        old, new = phases[p - 1], phases[(p + 1) % m]
        solution, times = shooting.solution(z), shooting.times(z)
        if old.s == new.s:
            # The chain begins where the next phase ends.
            order = [(p + 2 + i) % m for i in range(m - 3)] if m > 2 else []
            begin = times[(p + 1) % m + 1] if m > 2 else times[p]
            if m > 2:
                kept = [phases[i] for i in order] + [Phase(new.s, new.guard)]
                edges = np.concatenate(
                    [[begin], [_first_time_after(times[i + 1], begin, times) for i in order]]
                )
                edges = np.append(edges, begin + times[-1])
            else:
                kept, begin = [Phase(new.s, SECTION)], self.family.maximum(solution, times[-1])
                edges = np.array([begin, begin + times[-1]])
            yield self._merge(shooting.again(solution, kept, edges))
        elif old.guard == phases[p].guard:
            # A slip to and fro before a stick: without it the stick begins at its limit.
            kept, edges = _remove_phase(phases, times, p, old.guard)
            yield self._merge(shooting.again(solution, kept, edges))
        # Otherwise the duration of the phase can be brought to zero.
        at = self._shrink_phase(z, p)
        if at is None:
            return
        solution, times = shooting.solution(at), shooting.times(at)
        condition = ("vanish", p)
        numbers = shooting.family.template.guard_numbers
        if _part(old.guard, numbers) != _part(phases[p].guard, numbers):
            changed = [i for i in range(len(new.s)) if phases[p].s[i] != new.s[i]]
            s = tuple(new.s[i] if i in changed else old.s[i] for i in range(len(new.s)))
            swapped = list(phases)
            swapped[p - 1] = Phase(old.s, phases[p].guard)
            swapped[p] = Phase(s, old.guard)
            yield self._insert_phase(at, swapped, times, p, "order of switches", condition)
        for guard in (old.guard, phases[p].guard):
            kept, edges = _remove_phase(phases, times, p, guard)
            yield self._drop_phase(at, kept, edges, p, condition)

    def _pass_touching_guard(self) -> Iterator[Any]:
        """Continuations where a guard touches zero between two switches, or at one."""
        shooting = self.shooting
        at = self._locate_touch() if shooting.durations(self.outside).min() > 0 else None
        if at is None:
            return
        _, place = shooting.lowest(at)
        solution, times = shooting.solution(at), shooting.times(at)
        chain = solution.chain
        k = int(place.segment)
        p = int(chain.phase[k])
        h = times[p + 1] - times[p]
        since = float(chain.begin[k] + place.theta * chain.share[k]) * h
        phase, moment = shooting.phases[p], times[p] + since
        y = np.asarray(self.family.sampled(solution, np.array([moment]), 1)[0])[:, 0]
        q, guard = solution.u[-1], int(place.guard)
        s = np.array(phase.s, float)
        numbers = shooting.family.template.guard_numbers
        face = numbers.face(guard)
        tried = []
        if since <= 0 or since >= h:
            tried = self._states_before(phase, face, guard) if since <= 0 else []
        else:
            engine = np.asarray(
                after_switch(solution.x, self.family.window, q, y, s, guard)
            ).astype(int)
            tried = [tuple(int(i) for i in engine)]
            if face < len(s):
                # Those of a closed joint, first the one that holds the face.
                closed = [state for state in STATES if state.closed]
                for other in (row.code for row in sorted(closed, key=lambda row: bool(row.force))):
                    tried.append(tuple(other if i == face else j for i, j in enumerate(phase.s)))
        condition = ("touch", place)
        for state in dict.fromkeys(tried):
            if state == phase.s:
                continue
            values = np.abs(guards_at(solution.x, self.family.window, q, y, np.array(state, float)))
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
            yield self._insert_phase(at, phases, edges, new, "grazing", condition)

    def _states_before(self, phase, face, guard):
        """Contact states that may come before a phase whose guard is zero at its very start."""
        if face >= len(phase.s):
            return []
        row, numbers = find_state(phase.s[face]), self.shooting.family.template.guard_numbers
        change = row.lower if guard == numbers.lower(face) else row.upper
        if change is None:
            return []
        state = change.to[0]
        return [tuple(state if i == face else j for i, j in enumerate(phase.s))]

    def _merge(self, new: Shooting):
        """Continuation where an excursion vanishes, at the grazing of the orbit without it."""
        corrected = new.curves.corrected(new.begin)
        if corrected is None or np.linalg.norm(corrected[0] - new.begin) > 0.2:
            return None
        start, tangent = corrected[0], new.curves.tangent(corrected[1])

        def ahead(length):
            point = new.curves.corrected(start + length * tangent)
            return None if point is None else point[0]

        value = new.lowest(start)[0]
        for length in np.outer(4.0 ** np.arange(-8, -1), [1, -1]).ravel():
            at = ahead(length)
            if at is not None and new.lowest(at)[0] * value < 0:
                graze = self.branch.root(new, start, at, lambda z: new.lowest(z)[0])
                if graze is None:
                    continue
                direction = (at - start) * (1 if new.lowest(at)[0] > 0 else -1)
                self._record_change(
                    "grazing", new, graze, self.shooting, new, ("touch", new.lowest(graze)[1])
                )
                tangent = new.curves.tangent(new.equations(graze)[1])
                return new, graze, tangent if tangent @ direction > 0 else -tangent
        return None

    def _insert_phase(self, at, phases, edges, index, kind, condition):
        """Continuation with a new phase, which has no duration at the event itself."""
        shooting = self.shooting
        solution = shooting.solution(at)
        period = edges[-1] - edges[0]
        for share in (1e-3, 1e-4, 1e-2):  # durations of the phase, as shares of the period
            new = shooting.again(solution, phases, edges)
            begin = new.begin.copy()
            begin[new.index(index)] = share * period / new.scale[new.index(index)]
            corrected = new.curves.corrected(begin, new.index(index))
            if corrected is None or np.linalg.norm(corrected[0] - new.begin) > 0.2:
                continue
            if new.admissibility(corrected[0]) <= 0:
                continue
            tangent = new.curves.tangent(corrected[1])
            self._record_change(kind, shooting, at, shooting, new, condition)
            self.branch.record(new, corrected[0])
            forward = tangent[new.index(index)] > 0
            return self.branch.accurate(new, corrected[0], tangent if forward else -tangent)
        return None

    def _drop_phase(self, at, phases, edges, p: int, condition):
        """Continuation without phase p, which has vanished between two others."""
        shooting = self.shooting
        new = shooting.again(shooting.solution(at), phases, edges)
        corrected = new.curves.corrected(new.begin)
        if corrected is None or np.linalg.norm(corrected[0] - new.begin) > 1e-3:
            return None
        tangent = new.curves.tangent(corrected[1])
        for direction in (tangent, -tangent):
            beside = new.curves.corrected(corrected[0] + 1e-4 * direction)
            if beside is None or new.admissibility(beside[0]) <= 0:
                continue
            if self._switches(new, beside[0], p):
                self._record_change("grazing", shooting, at, shooting, new, condition)
                return new, beside[0], direction
        return None

    def _switches(self, shooting: Shooting, z, p: int) -> bool:
        """True if the motion enters phase p by itself where the phase before it ends."""
        p = p % shooting.m
        solution, last = shooting.solution(z), shooting.phases[p - 1]
        moment = np.array([solution.times[p]])
        y = np.asarray(self.family.sampled(solution, moment, 1)[0])[:, 0]
        s = np.array(last.s, float)
        state = after_switch(solution.x, self.family.window, solution.u[-1], y, s, last.guard)
        return tuple(int(i) for i in np.asarray(state)) == shooting.phases[p].s

    def _record_change(self, kind, where, at, old, new, condition) -> None:
        self.branch.record(where, at)
        self.branch.note(kind, where, at, old.itinerary(), new.itinerary(), condition)


def _remove_phase(phases, times, p: int, guard: int):
    """Phases and the times at which they begin without phase p, which has no duration."""
    kept = list(phases)
    kept[p - 1] = Phase(kept[p - 1].s, guard)
    del kept[p]
    return kept, np.delete(times, p)


def _first_time_after(time, begin, times) -> float:
    """A time on a periodic orbit, as the first one after `begin`."""
    return time if time > begin else time + times[-1]


def _part(guard: int, numbers: GuardNumbers) -> int:
    """The face of a guard; for the guard of an opening its own number."""
    return guard if numbers.opens_joint(guard) else numbers.face(guard)
