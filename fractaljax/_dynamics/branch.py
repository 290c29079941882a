"""A branch of limit cycles, stable or unstable, in one quantity of the mechanism."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._base.parts import Record, brief, concrete, number, require_kind, scalar, whole
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    require_inside,
    require_one,
    require_quantity,
    value_of,
    with_optional,
)
from .contact_state import FORWARD
from .cycle import LimitCycle, Orbit
from .follow import BranchEnd, Follower
from .guard import NONE, SECTION
from .itinerary import Family, Phase, Shooting, Solution, build_solution
from .limit_cycle import limit_cycle
from .scaled import check_rtol, degrees_of_freedom, require_drive
from .sensitivity import event_value
from .shooting import Chain, Lifted, Window, linearised


class BranchEvent(Record):
    """A point of a branch at which the cycle or its stability changes."""

    name: str = eqx.field(static=True)  # of the branch's quantity
    kind: str = eqx.field(static=True)  # "fold", "period doubling", "Neimark-Sacker", "grazing",
    # "order of switches", or "Hopf"
    value: Float[jax.Array, ""]  # of the quantity
    index: int = eqx.field(static=True)  # of the branch's point
    before: str = eqx.field(static=True)  # itinerary
    after: str = eqx.field(static=True)  # none where the branch ends with a jump
    side: int = eqx.field(static=True)  # 1: stable cycles beside it are at larger values of the
    # quantity, -1: at smaller ones, 0: on both sides or on none
    _data: Any = eqx.field(default=None, repr=False)  # the vanishing condition and its equations
    _cycle: Any = eqx.field(default=None, repr=False)
    _rtol: float = eqx.field(static=True, default=0.0, repr=False)

    def value_at(self, x: Mechanism) -> Float[jax.Array, ""]:
        """`value` as a function of the mechanism `x`, whose other quantities are as on the branch.

        It serves for derivatives at that mechanism: the event is not followed to another one.
        """
        return event_value(self._data[0], x, self._data[1:])


class Branch(Record):
    """A branch of periodic orbits with k points, as `continue_cycle` returns it."""

    name: str = eqx.field(static=True)  # of the quantity that is followed
    parameter: Float[np.ndarray, " k"]  # the quantity
    period: Float[np.ndarray, " k"]  # [s]
    amplitude: Float[np.ndarray, "k n"]  # peak to peak [m]
    velocity_min: Float[np.ndarray, "k n"]  # [m/s]
    velocity_max: Float[np.ndarray, "k n"]  # [m/s]
    stick_fraction: Float[np.ndarray, "k m"]  # of the period, as in `limit_cycle`
    open_fraction: Float[np.ndarray, "k m"]  # of the period, as in `limit_cycle`
    stable: Bool[np.ndarray, " k"]  # True where small deviations from the cycle die out
    multipliers: Complex[np.ndarray, "k 2n"]  # the one that is 1 comes last
    state: Float[np.ndarray, "k 2n"]  # [x, v] where t.x of the first joint is largest [m, m/s]
    error: Float[np.ndarray, " k"]  # estimated, of the states, relative
    itinerary: tuple[str, ...] = eqx.field(static=True)  # phases of the cycle at each point
    events: tuple[BranchEvent, ...]  # in the order of the branch
    start: BranchEnd  # what it begins at
    end: BranchEnd  # what it ends at

    def of_kind(self, kind: str) -> list[BranchEvent]:
        """The events of one `kind`, such as "fold" or "Hopf"."""
        return [event for event in self.events if event.kind == kind]

    @property
    def folds(self) -> list[BranchEvent]:
        """Where the branch turns back in the quantity."""
        return self.of_kind("fold")

    @property
    def grazings(self) -> list[BranchEvent]:
        """Where slip, stick or lift-off appears in the cycle or vanishes from it."""
        return self.of_kind("grazing")

    @property
    def hopf(self) -> list[BranchEvent]:
        """Where the cycle shrinks to the equilibrium."""
        return self.of_kind("Hopf")

    @property
    def limits(self) -> list[BranchEvent]:
        """The events at which stable cycles begin or end."""
        return [event for event in self.events if event.side]

    def __repr__(self) -> str:
        low, high = self.parameter.min(), self.parameter.max()
        rows = [
            f"branch of cycles, {len(self.parameter)} points, {self.name} from {low:.6g} to "
            f"{high:.6g}: begins {BranchEnd[self.start]}, ends {BranchEnd[self.end]}"
        ]
        for event in self.events:
            change = f"  {event.before or 'none'} -> {event.after or 'none'}"
            change = "" if event.before == event.after else change
            rows.append(f"  {event.kind} at {self.name} = {float(event.value):.9g}{change}")
        return "\n".join(rows)


def continue_cycle(
    x: Mechanism,
    name: str,
    window: tuple[float, float],
    start: LimitCycle | BranchEvent | str | None = None,
    *,
    step: float = 1 / 64,
    points: int = 1000,
    rtol: float | None = None,
) -> Branch:
    """Follow a periodic orbit, stable or unstable, as a quantity of its mechanism changes.

    Pseudo-arclength continuation of the exact orbit with all its switches passes through folds,
    period doublings, grazings and every other change of itinerary. The branch goes from one end
    to the other, through the start.

    **Arguments:**

    - `x`: a scene, or a structure whose joints all have a V. Its other quantities stay fixed.
    - `name`: a quantity; for a structure also one such as "left.D".
    - `window`: (low, high) of it; logarithmic over a decade or more.
    - `start`: a limit cycle of `x`, as `limit_cycle` finds it by default; or "hopf": the Hopf
      point of `x` in the window that is nearest to its own value, where a cycle of zero amplitude
      begins; or an event of another branch of `x`, whose quantity then has its value there.
    - `step`: the longest step between two points, with the window, the orbit's period and its
      largest state scaled to 1.
    - `points`: most points from the start each way.
    - `rtol`: sets the length of the segments, as in `limit_cycle`.

    **Returns:** a `Branch`. The `value` of each event is differentiable with respect to every
    quantity of `x` but the one that is followed, in forward and in reverse mode. Nothing else is.

    **Raises:** `ValueError` for an unknown name, a window that is empty, outside the domain or
    does not hold the start, a cycle that is excited, regularised or none, and where there is no
    Hopf point; `TypeError` under `jit` or `vmap`, and for single precision.
    """
    require_one("x", x)
    degrees_of_freedom(x)
    require_drive(x, None)
    if isinstance(start, BranchEvent):
        x = x.replace(**{start.name: start.value})
    low, high = checked_window(x, name, window)
    frozen = with_optional(jax.lax.stop_gradient(x), (name,))
    if any(concrete(leaf) is None for leaf in jax.tree.leaves(frozen)):
        raise TypeError("continue_cycle follows one branch and cannot be compiled or batched")
    points = whole("points", points, 2)
    step = float(number("step", step, above=0))
    interval = Window.over(name, low, high)
    dtype = jnp.result_type(*jax.tree.leaves(frozen))
    if dtype != jnp.float64:
        raise TypeError(f"continue_cycle needs double precision, got numbers in {dtype}")
    tolerance = check_rtol(rtol, dtype)
    follower = Follower(Family(frozen, interval, step, tolerance), points)
    if isinstance(start, str):
        if start != "hopf":
            raise ValueError(f'start must be a LimitCycle or "hopf", got {start!r}')
        ended = _follow_hopf(follower, float(interval.place(value_of(frozen, name))))
    elif isinstance(start, BranchEvent):
        ended = _follow_event(follower, start)
    else:
        ended = _follow_cycle(follower, start)
    return _build_branch(follower, x, name, *ended)


def checked_window(x: Mechanism, name: str, window) -> tuple[float, float]:
    """The ends of a window of a quantity of x."""
    require_quantity(x, name)
    if not (isinstance(window, (tuple, list)) and len(window) == 2):
        raise ValueError(f"window must be (low, high), got {brief(window)}")
    low, high = (float(scalar(f"window of {name}", end)) for end in window)
    if not low < high:
        raise ValueError(f"window must go from a lower to a higher {name}, got {window!r}")
    require_inside(x, {name: np.array([low, high])})
    return low, high


def _follow_cycle(follower: Follower, cycle):
    """Follow both ways from a limit cycle; return the reason for either end."""
    if cycle is None:
        cycle = limit_cycle(follower.x)
    require_kind("start", cycle, LimitCycle)
    if cycle.period.ndim or not bool(jnp.isfinite(cycle.period)):
        raise ValueError("start must be one limit cycle that exists")
    if cycle._system.excited or not isinstance(cycle._orbit, Orbit):
        raise ValueError("start must be a cycle without excitation and regularisation")
    solution = build_solution(cycle, follower.x, starting_position(follower.x, follower.window))
    return follower.follow_both_directions(lambda: _start_shooting(follower, solution, held=True))


def _follow_event(follower: Follower, event: BranchEvent):
    """Follow both ways from a cycle beside an event; from a Hopf point, along its cycles."""
    q = starting_position(follower.x, follower.window)
    solution = event._cycle
    if solution is None:
        return _follow_hopf(follower, q)
    solution = solution._replace(x=follower.x, u=np.append(solution.u[:-1], q))

    def begun():
        shooting, at, tangent = _start_shooting(follower, solution)
        for length in (1e-3, 1e-4, 1e-2):  # steps to a regular cycle
            for offset in (length * tangent, -length * tangent):
                corrected = shooting.curves.corrected(at + offset)
                if corrected is not None and shooting.admissibility(corrected[0]) > 0:
                    return shooting, corrected[0], shooting.curves.tangent(corrected[1])
        raise ValueError("no cycle beside start was found")

    return follower.follow_both_directions(begun)


def starting_position(x: Mechanism, window: Window) -> float:
    """Place in the window of the mechanism's value of the quantity."""
    value = float(value_of(x, window.name))
    q = float(window.place(value))
    if not -1e-9 <= q <= 1 + 1e-9:
        raise ValueError(f"the window must hold {window.name} = {value!r}, that of the start")
    return min(max(q, 0.0), 1.0)


def _start_shooting(follower: Follower, solution: Solution, held=False):
    """Equations, unknowns and tangent at a known orbit; if `held`, at exactly its quantity."""
    shooting = Shooting(follower.family, solution, solution.phases, solution.times)
    corrected = shooting.curves.corrected(shooting.begin, shooting.quantity if held else None)
    if corrected is None or np.linalg.norm(corrected[0] - shooting.begin) > 0.1:
        raise ValueError("start must be a limit cycle of x itself")
    return shooting, corrected[0], shooting.curves.tangent(corrected[1])


def _follow_hopf(follower: Follower, q: float):
    """Follow the cycles that begin at the Hopf point nearest to q."""
    scanned = np.linspace(0, 1, 129)
    matrices = jax.vmap(lambda q: linearised(follower.x, follower.window, q)[1])(
        jnp.asarray(scanned)
    )
    values = np.linalg.eigvals(np.asarray(matrices))
    growth, frequency = np.real(values), np.imag(values)
    last = np.argmax(np.where(frequency > 1e-9, growth, -np.inf), axis=1)
    growth, frequency = (x[np.arange(len(scanned)), last] for x in (growth, frequency))
    crossings = np.flatnonzero(np.diff(np.sign(growth)) != 0)
    hopf_points = [follower.family.hopf_near(scanned[i], frequency[i]) for i in crossings]
    hopf_points = [point for point in hopf_points if point is not None and 0 <= point[0] <= 1]
    if not hopf_points:
        raise ValueError(f"there is no Hopf point of {follower.window.name} in the window")
    at, frequency = min(hopf_points, key=lambda point: abs(point[0] - q))
    y, A = follower.family.linearised(at)
    eigenvalues, vectors = np.linalg.eig(A)
    vector = vectors[:, np.argmin(np.abs(eigenvalues - 1j * frequency))]
    # The phase at which t.u falls through zero, at the size of a small orbit.
    t = np.asarray(follower.family.template.section_direction)
    n = follower.n
    vector = vector * np.exp(-1j * np.angle(t @ vector[:n]))
    vector = vector / np.abs(vector).max()
    period = 2 * np.pi / frequency
    blank = _harmonic_orbit(follower, y, vector, frequency, at)
    shooting = Shooting(follower.family, blank, blank.phases, [0, period])
    begin = shooting.begin
    held = int(np.argmax(np.abs(vector.real[:n])))
    corrected = shooting.curves.corrected(begin, held)
    if corrected is None:
        raise ValueError("the cycles at the Hopf point could not be followed")
    follower.record_hopf(at, frequency, shooting)
    follower.record(shooting, corrected[0])
    tangent = shooting.curves.tangent(corrected[1])
    outward = tangent[: 2 * n] @ (begin[: 2 * n] * shooting.scale[: 2 * n] - y)
    end = follower.follow(shooting, corrected[0], tangent if outward > 0 else -tangent)
    return BranchEnd.hopf, end


def _harmonic_orbit(follower, y, vector, frequency, q) -> Solution:
    """A small harmonic orbit about the equilibrium y as one phase of slip."""
    N, size = 64, 1.5 * follower.family.tracing.small
    angle = 2 * np.pi * np.arange(N) / N
    states = y[:, None] + size * (vector[:, None] * np.exp(1j * angle)).real
    slips = (FORWARD,) * len(follower.family.template.P)
    u = np.concatenate([states[:, 0], [2 * np.pi / frequency], np.zeros(7), [q]])
    chain = Chain(
        s=jnp.ones((len(slips), N)),
        guard=jnp.asarray([NONE] * (N - 1) + [SECTION]),
        phase=jnp.zeros(N, int),
        begin=jnp.arange(N) / N,
        share=jnp.full(N, 1 / N),
        used=jnp.asarray(np.arange(8) < 1, float),
    )
    lifted = Lifted(jnp.asarray(u), jnp.asarray(states), jnp.zeros((len(y), len(u), N)))
    return Solution(follower.x, (Phase(slips, SECTION),), chain, lifted, u)


def _side(places, stable, i: int) -> int:
    """Side of point i of a branch on which its neighbour is stable; 0 if both or none are."""
    beside = [k for k in (i - 1, i + 1) if 0 <= k < len(places) and stable[k]]
    return int(np.sign(sum(np.sign(places[k] - places[i]) for k in beside)))


def _build_branch(follower: Follower, x, name: str, start, end) -> Branch:
    """The `Branch`, with values of the events that depend on x."""
    points, window = follower.points, follower.window
    rows = {key: np.array([point.row[key] for point in points]) for key in points[0].row}
    places = np.array([point.place[0] for point in points])
    events = []
    for event in follower.events:
        kind, *details = event["condition"]
        data = kind, window, *event["data"], details[0] if details else None
        events.append(
            BranchEvent(
                name=name,
                kind=event["kind"],
                value=event_value(kind, x, data[1:]),
                index=event["index"],
                before=event["before"],
                after=event["after"],
                side=_side(places, rows["stable"], event["index"]),
                _data=data,
                _cycle=event["solution"],
                _rtol=follower.family.rtol,
            )
        )
    # At a Hopf point a multiplier is 1: its stability is that of the cycle beside it.
    for event in events:
        if event.kind == "Hopf":
            beside = event.index - 1 if event.index else 1
            rows["stable"][event.index] = rows["stable"][beside]
    joints = [faces[0] for faces in follower.family.template.joints]
    if x.sole_joint is None:
        rows["stick_fraction"] = rows["stick_fraction"][:, joints]
    rows["open_fraction"] = rows["open_fraction"][:, joints]
    return Branch(
        name=name,
        parameter=np.array([float(window.value(point.place[0])) for point in points]),
        itinerary=tuple(point.itinerary for point in points),
        events=tuple(sorted(events, key=lambda event: event.index)),
        start=start,
        end=end,
        **rows,
    )
