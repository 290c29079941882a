"""Curves in two quantities along which a cycle stays at an event of its branch."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._base.parts import Record, number, require_kind, whole
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    require_independent,
    with_optional,
)
from .branch import BranchEvent, checked_window, starting_position
from .follow import BranchEnd, Follower
from .itinerary import Family
from .pinned import Event, Pinned
from .shooting import Window


class EventCurve(Record):
    """Curve in two quantities along which cycles fold, graze, or change stability.

    It has k points; `continue_event` returns it.
    """

    kind: str = eqx.field(static=True)  # kind of the event, never "Hopf"
    names: tuple[str, str] = eqx.field(static=True)  # of the quantities
    x: Float[np.ndarray, " k"]  # the first quantity, which the branch follows
    y: Float[np.ndarray, " k"]  # the second one
    period: Float[np.ndarray, " k"]  # of the cycle at the event [s]
    amplitude: Float[np.ndarray, "k n"]  # peak to peak [m]
    itinerary: tuple[str, ...] = eqx.field(static=True)  # phases of the cycle at each point
    side: int = eqx.field(static=True)  # 1: stable cycles are on its left from first to last point,
    # -1: on its right, 0: on both sides or on none
    start: BranchEnd
    end: BranchEnd  # what it ends at

    def swapped(self) -> "EventCurve":
        """The same curve with the quantities in the other order."""
        turned = {"names": self.names[::-1], "x": self.y, "y": self.x, "side": -self.side}
        return dataclasses.replace(self, **turned)

    def __repr__(self) -> str:
        first, second = (
            f"{name} from {values.min():.6g} to {values.max():.6g}"
            for name, values in zip(self.names, (self.x, self.y), strict=True)
        )
        ends = f"begins {BranchEnd[self.start]}, ends {BranchEnd[self.end]}"
        return f"{self.kind}, {len(self.x)} points, {first}, {second}: {ends}"


class _CurveFollower(Follower):
    """Follows a cycle at an event; only the ends of the curve are noted."""

    def note(self, *_) -> None:
        pass

    def _smooth_events(self, *_) -> None:
        pass

    def _hopf(self, *_) -> BranchEnd:
        return BranchEnd.hopf

    def _leaves_itinerary(self, shooting, z, reached):
        """Go on where the curve stays smooth; elsewhere another event takes over and it ends."""
        count = len(self.points)
        onward = super()._leaves_itinerary(shooting, z, reached)
        if isinstance(onward, BranchEnd):
            return onward
        new, begin, ahead = onward
        gap, came = begin[new.quantity :] - z[shooting.quantity :], reached - z
        before, after = came[shooting.quantity :], ahead[new.quantity :]
        # It may turn by 18 degrees at a change of itinerary.
        straight = before @ after > 0.95 * np.linalg.norm(before) * np.linalg.norm(after)
        if straight and np.linalg.norm(gap) < 2 * np.linalg.norm(came):
            return onward
        del self.points[count:]
        return BranchEnd.meets

    def _jumps(self, *_) -> BranchEnd:
        return BranchEnd.meets


def continue_event(
    x: Mechanism,
    event: BranchEvent,
    name: str,
    window: tuple[float, float],
    *,
    step: float = 1 / 64,
    points: int = 1000,
) -> EventCurve:
    """Follow a fold, grazing, order of switches or change of stability in a second quantity.

    Pseudo-arclength continuation of the exact orbit together with the condition that vanishes at
    the event passes through extremes of either quantity, and through changes of the itinerary
    elsewhere on the cycle. The curve goes both ways from the event.

    **Arguments:**

    - `x`: the scene or structure whose branch has the event.
    - `event`: one of `Branch.events`; the first quantity is that of the branch, in its window.
    - `name`, `window`: the second quantity and its (low, high), which holds the value of `x`.
    - `step`, `points`: as in `continue_cycle`.

    **Returns:** an `EventCurve`.

    **Raises:** `ValueError` for a Hopf point (`hopf_boundary` follows it), and for names and
    windows as `continue_cycle` does.
    """
    require_kind("event", event, BranchEvent)
    (condition, first, *_, detail), solution = event._data, event._cycle
    if condition == "hopf":
        raise ValueError("event must not be a Hopf point: hopf_boundary follows those")
    low, high = checked_window(x, name, window)
    require_independent(x, (first.name, name))
    frozen = with_optional(jax.lax.stop_gradient(x), (first.name, name))
    second = Window.over(name, low, high)
    step, points = float(number("step", step, above=0)), whole("points", points, 2)
    family = Family(frozen, first, step, event._rtol)
    follower = _CurveFollower(family, points)
    held = Event.of(condition, detail, solution)
    solution = solution._replace(x=frozen, r=starting_position(frozen, second))

    def start_curve():
        pinned = Pinned(family, second, held, solution, solution.phases, solution.times)
        corrected = pinned.curves.corrected(pinned.begin, pinned.quantity + 1)
        if corrected is None or np.linalg.norm(corrected[0] - pinned.begin) > 0.1:
            raise ValueError("event must be one of a branch of x itself")
        return pinned, corrected[0], pinned.curves.tangent(corrected[1])

    start, end = follower.follow_both_directions(start_curve)
    places = np.array([point.place for point in follower.points])
    rows: dict[str, Any] = {
        key: np.array([point.row[key] for point in follower.points])
        for key in ("period", "amplitude")
    }
    return EventCurve(
        kind=event.kind,
        names=(first.name, name),
        x=np.array([float(first.value(q)) for q in places[:, 0]]),
        y=np.array([float(second.value(r)) for r in places[:, 1]]),
        itinerary=tuple(point.itinerary for point in follower.points),
        # To the left of an upward curve are the smaller values.
        side=-event.side,
        start=start,
        end=end,
        **rows,
    )
