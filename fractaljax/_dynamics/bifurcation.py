"""Maps of two quantities: where a mechanism is quiet, squeals, or does either by its start."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import Record, flag
from .._continuation import Curve, CurveEnd, passing_steps
from .._mechanism.quantities import value_of
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .._stability.boundary import Boundary, hopf_boundary
from .basin import basin
from .branch import Branch, BranchEvent, continue_cycle
from .event_curve import EventCurve, continue_event
from .shooting import Window

Range = tuple[str, float, float]


class BifurcationMap(Record):
    """All boundaries in a window of two quantities, as `bifurcation_map` finds them."""

    mechanism: Scene | Structure  # with all other quantities
    x: Range = eqx.field(static=True)  # name and range
    y: Range = eqx.field(static=True)  # name and range
    boundary: Boundary  # of stability against small disturbances
    curves: tuple[EventCurve, ...]  # of cycles; their x and y are those of the map
    branches: tuple[Branch, ...]  # in one quantity or the other through `mechanism`
    unfollowed: tuple[BranchEvent, ...]  # events of the branches for which no curve was found

    @property
    def nominal(self) -> tuple[float, float]:
        """Values of the two quantities of the mechanism itself."""
        first, second = (float(value_of(self.mechanism, name)) for name, *_ in (self.x, self.y))
        return first, second

    def __repr__(self) -> str:
        rows = [repr(self.boundary), f"cycles: {len(self.branches)} branches"]
        rows += [f"  {curve!r}" for curve in self.curves]
        rows += [f"  {e.kind} at {float(e.value):.6g} not followed" for e in self.unfollowed]
        return "\n".join(rows)


def bifurcation_map(
    mechanism: Scene | Structure,
    x: Range,
    y: Range,
    *,
    radius: ArrayLike | Sequence[float] = 5.0,
    starts: int = 128,
    seed: int = 0,
    step: float = 1 / 64,
    points: int = 1000,
    lines: int = 49,
    progress: bool = True,
) -> BifurcationMap:
    """Trace the Hopf boundary, and the folds, grazings and changes of stability of the cycles.

    The cycles are those that `basin` finds from a ball of starts, and those that begin at a Hopf
    point. Each is followed through `mechanism` in x and in y, and each event of these branches that
    bounds stable cycles (`Branch.limits`) in both. A cycle that exists only elsewhere in the
    window, connected with none of these, is missed.

    **Arguments:**

    - `mechanism`: a scene, or a structure whose joints all have a V.
    - `x`, `y`: (name, low, high) of two quantities; the ranges hold the values of `mechanism`.
    - `radius`, `starts`, `seed`: as in `basin`.
    - `step`, `points`: as in `continue_cycle`.
    - `lines`: as in `hopf_boundary`.
    - `progress`: shows a bar.

    **Returns:** a `BifurcationMap`.

    **Raises:** what `hopf_boundary` and `continue_cycle` raise.
    """
    from tqdm import tqdm

    progress = flag("progress", progress)
    boundary = hopf_boundary(mechanism, x, y, lines=lines)
    windows, options = {x[0]: x[1:], y[0]: y[1:]}, {"step": step, "points": points}
    for name, (low, high) in windows.items():
        value = float(value_of(mechanism, name))
        if not low <= value <= high:
            raise ValueError(f"the window must hold {name} = {value!r}, that of the mechanism")
    basins = basin(mechanism, radius=radius, starts=starts, seed=seed, progress=progress)
    branches: list[Branch] = []
    curves: list[EventCurve] = []
    unfollowed: list[BranchEvent] = []
    for name, window in windows.items():
        followed: list[Branch] = []
        for start in (*basins.cycles, "hopf"):
            on_branch = (_passes_cycle(mechanism, branch, start) for branch in followed)
            if start != "hopf" and any(on_branch):
                continue
            try:
                branch = continue_cycle(mechanism, name, window, start, **options)
            except ValueError:  # no Hopf point, or one whose cycles cannot be followed
                continue
            if not any(_share_hopf_point(branch, other) for other in followed):
                followed.append(branch)
        branches += followed
        events = [event for branch in followed for event in branch.limits if event.kind != "Hopf"]
        other = y if name == x[0] else x
        for event in tqdm(events, desc=f"events in {name}", disable=not progress):
            at = {name: float(event.value), other[0]: float(value_of(mechanism, other[0]))}
            alike = [curve for curve in curves if curve.kind == event.kind]
            if any(_passes_point(curve, at, (x, y)) for curve in alike):
                continue
            try:
                curve = continue_event(mechanism, event, other[0], other[1:], **options)
            except ValueError:
                unfollowed.append(event)
            else:
                curves.append(curve if name == x[0] else curve.swapped())
    return BifurcationMap(
        mechanism=mechanism,
        x=x,
        y=y,
        boundary=boundary,
        curves=tuple(curves),
        branches=tuple(branches),
        unfollowed=tuple(unfollowed),
    )


def _passes_cycle(mechanism, branch: Branch, cycle: Any) -> bool:
    """True if a branch passes through a cycle of the mechanism."""
    value = float(value_of(mechanism, branch.name))
    crosses = np.flatnonzero(np.diff(np.sign(branch.parameter - value)) != 0)
    for i in crosses:
        share = (value - branch.parameter[i]) / (branch.parameter[i + 1] - branch.parameter[i])
        for one, of_cycle in ((branch.period, cycle.period), (branch.amplitude, cycle.amplitude)):
            between = one[i] + share * (one[i + 1] - one[i])
            size = np.abs(one[i + 1] - one[i]).max() + 1e-6 * np.abs(between).max()
            if np.abs(between - np.asarray(of_cycle)).max() > size:
                break
        else:
            return True
    return False


def _share_hopf_point(branch: Branch, other: Branch) -> bool:
    """True if two branches begin at one Hopf point."""
    values = [float(event.value) for event in other.hopf]
    return any(
        np.isclose(float(e.value), value, rtol=1e-8) for e in branch.hopf for value in values
    )


def _passes_point(curve: EventCurve, at: dict[str, float], ranges) -> bool:
    """True if a curve passes through the point `at` of the map."""
    windows = [Window.over(*each) for each in ranges]
    pairs = zip(windows, (curve.x, curve.y), strict=True)
    places = np.stack([window.place(values) for window, values in pairs], axis=1)
    point = np.array([float(window.place(at[window.name])) for window in windows])
    polyline = Curve(places, CurveEnd.edge, CurveEnd.edge)
    return len(places) > 1 and len(passing_steps(polyline, point, 1e-6)) > 0
