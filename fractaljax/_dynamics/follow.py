"""Following a branch of cycles through folds and changes of itinerary.

Within one itinerary the equations of `shooting.py` are smooth, and `_continuation.py` follows
their solutions. `itinerary_change.py` takes the branch from one itinerary to the next.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._base.programs import exported_jit
from .._continuation import cubic
from .._mechanism.mechanism import Mechanism
from .contact_state import OPEN, STICK
from .guard import SECTION
from .hybrid import HybridSystem
from .itinerary import Family, Shooting, Solution
from .itinerary_change import ItineraryChange
from .shooting import largest_friction, linearised, measured, rate_at


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


@exported_jit
def _system(window, x: Mechanism, q) -> HybridSystem:
    return window.system(x, q)


class Point(NamedTuple):
    """One solution and the values that are listed for it."""

    place: np.ndarray  # of the free quantities, in their windows
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
        orbit = solution.x, self.window, solution.chain, solution.lifted, solution.u
        (low, high, state), second, error = map(np.asarray, measured(*orbit))
        n, h = self.n, shooting.lengths(z)
        values = shooting.multipliers(z)
        states = np.array([phase.s for phase in shooting.phases])
        row = {
            "period": float(h.sum() * second),
            "amplitude": (high - low)[:n],
            "velocity_min": low[n:],
            "velocity_max": high[n:],
            "stick_fraction": h @ (states == STICK) / h.sum(),
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

    def follow_both_directions(self, begun: Callable) -> tuple[BranchEnd, BranchEnd]:
        """Add the points on both sides of a solution; return the reason for either end.

        `begun()` builds its equations, and returns them with the unknowns and the tangent there.
        The last point is in the direction in which the last quantity increases.
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
        """Add the points beyond z in the direction `ahead`; return the reason for the end."""
        state: Any = shooting, z, ahead
        origin = len(self.points)
        while not isinstance(state, BranchEnd):
            if len(self.points) - origin >= self.most:
                return BranchEnd.long
            state = self._follow_itinerary(*state, origin)
        return state

    def _follow_itinerary(self, shooting: Shooting, z, ahead, origin):
        """Follow one itinerary on one mesh; return where to go on, or the reason for the end."""
        smooth = shooting.phases[0].guard == SECTION
        for reached, turned, leaves in shooting.curves.steps(z, ahead):
            if smooth and self._shrinks(shooting, reached):
                return self._hopf(shooting, z)
            if shooting.admissibility(reached) < -1e-9:  # below zero by more than rounding
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
            onward = self.accurate(shooting, z, ahead)
            if isinstance(onward, BranchEnd) or onward[0] is not shooting:
                return onward
            if shooting.stale(z):
                return self._remeshed(shooting, z, ahead)
        if smooth and self._shrinks(shooting, z, 5):
            return self._hopf(shooting, z)
        return self._reason_of_failure(shooting, z)

    def _leaves_itinerary(self, shooting: Shooting, z, reached):
        """Go from an admissible z to where the orbit ceases to be admissible, and on from there."""
        change = ItineraryChange(self, shooting, z, reached)
        onward = change.onward()
        return self._jumps(change) if onward is None else onward

    def _jumps(self, change: ItineraryChange) -> BranchEnd:
        """The end where no cycle with another itinerary goes on."""
        change.note_grazing()
        return BranchEnd.jump

    def _reason_of_failure(self, shooting: Shooting, z) -> BranchEnd:
        """Reason why Newton's method fails beyond z, perhaps friction that grows without bound."""
        solution = shooting.solution(z)
        samples = self.family.tracing.samples
        times = np.linspace(0, solution.times[-1], samples, endpoint=False)
        y, _ = self.family.sampled(solution, times, samples)
        friction = float(largest_friction(solution.x, self.window, solution.u[-1], y))
        # Beyond ten times the static coefficient laws are meaningless.
        return BranchEnd.fast if friction > 10 else BranchEnd.lost

    def reverse(self) -> None:
        """Reverse the order of the points and the direction of the events."""
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

    def accurate(self, shooting: Shooting, z, ahead):
        """Where to go on from z, the last point: if inaccurate, that is redone on a finer mesh."""
        if not self.points[-1].row["error"] > self.family.rtol:
            return shooting, z, ahead
        onward = self._remeshed(shooting, z, ahead)
        if not isinstance(onward, BranchEnd):
            self.points.pop()
            self.record(*onward[:2])
        return onward

    def _remeshed(self, old: Shooting, z, ahead):
        """Where to go on with a new mesh of the same itinerary, refined until it is accurate."""
        times = old.times(z)
        for _ in range(self.family.tracing.refinements):
            new = old.again(old.solution(z), old.phases, times)
            corrected = new.curves.corrected(new.begin)
            if corrected is None:
                return self._reason_of_failure(old, z)
            solution = new.solution(corrected[0])
            orbit = solution.x, self.window, solution.chain, solution.lifted, solution.u
            if float(measured(*orbit)[2]) <= self.family.rtol / 2:
                break
            self.family.h *= 0.7
        direction = ahead * old.scale / new.scale
        tangent = new.curves.tangent(corrected[1])
        return new, corrected[0], tangent if tangent @ direction > 0 else -tangent

    def between(self, shooting, z, reached, share):
        """Point of the curve near a `share` of the way from z to `reached`, or None."""
        if share in (0.0, 1.0):
            return reached if share else z
        way = reached - z
        ends = (shooting.curves.tangent(shooting.equations(at)[1]) for at in (z, reached))
        first, last = (t if t @ way > 0 else -t for t in ends)
        corrected = shooting.curves.corrected(cubic(z, first, reached, last, share))
        return None if corrected is None else corrected[0]

    def root(self, shooting, z, reached, test: Callable) -> np.ndarray | None:
        """The point between two at which a test function of z vanishes."""

        def along(share):
            at = self.between(shooting, z, reached, share)
            return np.nan if at is None else test(at)

        import scipy.optimize  # imported only when used: it is slow

        try:
            share: Any = scipy.optimize.brentq(along, 0.0, 1.0, xtol=1e-13)
        except (ValueError, RuntimeError):
            return None
        return self.between(shooting, z, reached, share)

    def _smooth_events(self, shooting, z, ahead, reached, turned) -> None:
        """Folds and changes of stability between two points of one itinerary."""

        if ahead[-1] * turned[-1] < 0:

            def slope(at):
                t = shooting.curves.tangent(shooting.equations(at)[1])
                return (t if t @ ahead > 0 else -t)[-1]

            at = self.root(shooting, z, reached, slope)
            if at is not None:
                self._record_event("fold", shooting, at, ("fold",))

        def doubling(at):
            return float(np.prod(shooting.multipliers(at)[:-1] + 1).real)

        def rotating(at):
            values = shooting.multipliers(at)[:-1]
            turning = np.abs(values[np.abs(np.imag(values)) > 1e-9])
            return float(turning.max() - 1) if len(turning) else -1.0

        for kind, test in (("period doubling", doubling), ("Neimark-Sacker", rotating)):
            if test(z) * test(reached) < 0:
                at = self.root(shooting, z, reached, test)
                if at is not None and abs(test(at)) < 1e-6:
                    self._record_event(kind, shooting, at, ("multiplier",))

    def _record_event(self, kind, shooting, at, condition) -> None:
        self.record(shooting, at)
        itinerary = shooting.itinerary()
        self.note(kind, shooting, at, itinerary, itinerary, condition)

    # --- the Hopf point ---

    def _shrinks(self, shooting, z, factor=1.0) -> bool:
        """True if a smooth orbit is about to vanish, or has passed the point where it does."""
        u = shooting.full(z)
        x, y = shooting.mechanism(z), u[: 2 * self.n]
        equilibrium = np.asarray(linearised(x, self.window, u[-1])[0])
        s = np.array(shooting.phases[0].s, float)
        small = np.abs(y - equilibrium).max() < factor * self.family.tracing.small
        return bool(small or float(rate_at(x, self.window, u[-1], y, s)) >= 0)

    def _hopf(self, shooting, z):
        """The Hopf point near the small orbit z, and the end of the branch."""
        q, period = z[shooting.quantity], float(shooting.lengths(z).sum())
        hopf_point = self.family.hopf_near(q, 2 * np.pi / period)
        if hopf_point is None:
            return BranchEnd.lost
        self.record_hopf(*hopf_point, shooting)
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
