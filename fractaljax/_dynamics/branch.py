"""A branch of limit cycles, stable or unstable, in one quantity of the mechanism."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._base.parts import Record, brief, concrete, number, require_kind, scalar, whole
from .._base.ranges import is_logarithmic
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    require_inside,
    require_known,
    require_one,
    value_of,
    with_optional,
)
from .._mechanism.scene import Scene
from .cycle import LimitCycle, Orbit
from .follow import SMALL, BranchEnd, Follower
from .hybrid import NONE, SECTION, check_rtol, degrees_of_freedom
from .itinerary import Family, Phase, Shooting, Solution, solution_of
from .limit_cycle import limit_cycle
from .sensitivity import event_value
from .shooting import Chain, Lifted, Window, linearised

_SCANNED = 129  # places in the window at which Hopf points are looked for


class BranchEvent(Record):
    """A point of a branch at which the cycle or its stability changes."""

    kind: str = eqx.field(static=True)  # "fold", "period doubling", "Neimark-Sacker", "grazing",
    # "order of switches", or "Hopf"
    value: Float[jax.Array, ""]  # of the quantity
    index: int = eqx.field(static=True)  # of the branch's point
    before: str = eqx.field(static=True)  # itinerary
    after: str = eqx.field(static=True)


class Branch(Record):
    """A branch of periodic orbits of k points, as `continue_cycle` returns it."""

    name: str = eqx.field(static=True)
    parameter: Float[np.ndarray, " k"]  # the quantity
    period: Float[np.ndarray, " k"]  # [s]
    amplitude: Float[np.ndarray, "k n"]  # peak to peak [m]
    velocity_min: Float[np.ndarray, "k n"]  # [m/s]
    velocity_max: Float[np.ndarray, "k n"]  # [m/s]
    stick_fraction: Float[np.ndarray, "k m"]  # of the period, as in `limit_cycle`
    open_fraction: Float[np.ndarray, "k m"]
    stable: Bool[np.ndarray, " k"]  # whether small deviations from the cycle die out
    multipliers: Complex[np.ndarray, "k 2n"]  # the one that is 1 comes last
    state: Float[np.ndarray, "k 2n"]  # [x, v] where t.x of the first joint is largest [m, m/s]
    error: Float[np.ndarray, " k"]  # estimated, of the states, relative
    itinerary: tuple[str, ...] = eqx.field(static=True)
    events: tuple[BranchEvent, ...]
    start: BranchEnd
    end: BranchEnd

    def of_kind(self, kind: str) -> list[BranchEvent]:
        """The events of one kind."""
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

    def __repr__(self) -> str:
        low, high = self.parameter.min(), self.parameter.max()
        rows = [
            f"branch of cycles, {len(self.parameter)} points, {self.name} from {low:.6g} to "
            f"{high:.6g}: begins {BranchEnd[self.start]}, ends {BranchEnd[self.end]}"
        ]
        for event in self.events:
            change = "" if event.before == event.after else f"  {event.before} -> {event.after}"
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

    By pseudo-arclength continuation of the exact orbit with all its switches, so through folds,
    period doublings, grazings and every other change of itinerary. The branch goes from one end
    to the other, through the start.

    **Arguments:**

    - `x`: a scene, or a structure whose joints all have a V. The other quantities are its own.
    - `name`: a quantity, of a structure also "left.D".
    - `window`: (low, high) of it; logarithmic over a decade or more.
    - `start`: a limit cycle of `x`, as `limit_cycle` finds it by default; or "hopf": the Hopf
      point of `x` in the window that is nearest to its own value, where a cycle of no amplitude
      begins.
    - `step`: the longest step between two points, where the window is of length 1 and so are the
      orbit's period and its largest state.
    - `points`: most points from the start each way.
    - `rtol`: sets the length of the segments, as in `limit_cycle`.

    **Returns:** a `Branch`. The `value` of each event is differentiable with respect to every
    quantity of `x` but the one that is followed, in forward and in reverse mode. Nothing else is.

    **Raises:** `ValueError` for an unknown name, a window that is empty, outside the domain or
    does not hold the start, a cycle that is excited, regularised or none, and where there is no
    Hopf point; `TypeError` under `jit` or `vmap`, and for single precision.
    """
    follower, *ends = followed(x, name, window, start, step=step, points=points, rtol=rtol)
    return _branch(follower, x, name, *ends)


def followed(x, name, window, start, *, step=1 / 64, points=1000, rtol=None):
    """A follower that has been along the branch of `continue_cycle`, and why either end is one."""
    require_one("x", x)
    degrees_of_freedom(x)
    require_known(x, name)
    low, high = (float(scalar(f"window of {name}", end)) for end in _pair(window))
    if not low < high:
        raise ValueError(f"window must go from a lower to a higher {name}, got {window!r}")
    require_inside(x, {name: np.array([low, high])})
    frozen = with_optional(jax.lax.stop_gradient(x), (name,))
    if any(concrete(leaf) is None for leaf in jax.tree.leaves(frozen)):
        raise TypeError("continue_cycle follows one branch and cannot be compiled or batched")
    points = whole("points", points, 2)
    step = float(number("step", step, above=0))
    scale = is_logarithmic(low, high)
    edges = jnp.log(jnp.array([low, high])) if scale else jnp.array([low, high])
    interval = Window(edges[0], edges[1], name, scale)
    dtype = jnp.result_type(*jax.tree.leaves(frozen))
    if dtype != jnp.float64:
        raise TypeError(f"continue_cycle needs double precision, got numbers in {dtype}")
    tolerance = check_rtol(rtol, dtype)
    follower = Follower(Family(frozen, interval, step, tolerance), points)
    if isinstance(start, str):
        if start != "hopf":
            raise ValueError(f'start must be a LimitCycle or "hopf", got {start!r}')
        ends = _from_hopf(follower, float(interval.place(value_of(frozen, name))))
    else:
        ends = _from_cycle(follower, name, start)
    return follower, *ends


def value_at(event, x, window: Window):
    """The quantity at an event of a follower, differentiable by x."""
    kind, *details = event["condition"]
    return event_value(kind, x, (window, *event["data"], details[0] if details else None))


def _pair(window):
    if not (isinstance(window, (tuple, list)) and len(window) == 2):
        raise ValueError(f"window must be (low, high), got {brief(window)}")
    return window


def _from_cycle(follower: Follower, name: str, cycle):
    """Both ways from a limit cycle; returns why the branch ends at either end."""
    value = float(value_of(follower.x, name))
    q = float(follower.window.place(value))
    if not 0 <= q <= 1:
        raise ValueError(f"the window must hold {name} = {value!r}, that of the start")
    if cycle is None:
        cycle = limit_cycle(follower.x)
    require_kind("start", cycle, LimitCycle)
    if cycle.period.ndim or not bool(jnp.isfinite(cycle.period)):
        raise ValueError("start must be one limit cycle that exists")
    if cycle._system.excited or not isinstance(cycle._orbit, Orbit):
        raise ValueError("start must be a cycle without excitation and regularisation")
    solution = solution_of(cycle, q)
    h = solution.u[2 * follower.n : -1][: len(solution.phases)]

    def begun():
        edges = np.concatenate([[0], np.cumsum(h)])
        shooting = Shooting(follower.family, solution, solution.phases, edges)
        return shooting, shooting.curves.corrected(shooting.begin, len(shooting.begin) - 1)

    shooting, found = begun()
    if found is None or np.linalg.norm(found[0] - shooting.begin) > 0.1:
        raise ValueError("start must be a limit cycle of x itself")
    z = found[0]
    tangent = shooting.curves.tangent(found[1])
    tangent = tangent if tangent[-1] > 0 else -tangent
    follower.record(shooting, z)
    follower.home = shooting.phases, shooting.full(z)
    end = follower.follow(shooting, z, tangent)
    if bool(end == BranchEnd.closed):
        return end, end
    follower.reverse()
    follower.home = None
    start = follower.follow(begun()[0], z, -tangent)
    follower.reverse()
    return start, end


def _from_hopf(follower: Follower, q: float):
    """Along the cycles that begin at the Hopf point nearest to q."""
    scanned = np.linspace(0, 1, _SCANNED)
    matrices = jax.vmap(lambda q: linearised(follower.x, follower.window, q)[1])(
        jnp.asarray(scanned)
    )
    values = np.linalg.eigvals(np.asarray(matrices))
    growth, frequency = np.real(values), np.imag(values)
    last = np.argmax(np.where(frequency > 1e-9, growth, -np.inf), axis=1)
    growth, frequency = (x[np.arange(_SCANNED), last] for x in (growth, frequency))
    crossings = np.flatnonzero(np.diff(np.sign(growth)) != 0)
    found = [follower.family.hopf_near(scanned[i], frequency[i]) for i in crossings]
    found = [point for point in found if point is not None and 0 <= point[0] <= 1]
    if not found:
        raise ValueError(f"there is no Hopf point of {follower.window.name} in the window")
    at, frequency = min(found, key=lambda point: abs(point[0] - q))
    y, A = follower.family.linearised(at)
    eigenvalues, vectors = np.linalg.eig(A)
    vector = vectors[:, np.argmin(np.abs(eigenvalues - 1j * frequency))]
    # The phase at which t.u falls through zero, at the size of a small orbit.
    t = np.asarray(follower.family.template.section_direction)
    n = follower.n
    vector = vector * np.exp(-1j * np.angle(t @ vector[:n]))
    vector = vector / np.abs(vector).max()
    period = 2 * np.pi / frequency
    blank = _smooth(follower, y, vector, frequency, at)
    shooting = Shooting(follower.family, blank, blank.phases, [0, period])
    begin = shooting.begin
    held = int(np.argmax(np.abs(vector.real[:n])))
    found = shooting.curves.corrected(begin, held)
    if found is None:
        raise ValueError("the cycles at the Hopf point could not be followed")
    follower.record_hopf(at, frequency, shooting)
    follower.record(shooting, found[0])
    tangent = shooting.curves.tangent(found[1])
    outward = tangent[: 2 * n] @ (begin[: 2 * n] * shooting.scale[: 2 * n] - y)
    end = follower.follow(shooting, found[0], tangent if outward > 0 else -tangent)
    return BranchEnd.hopf, end


def _smooth(follower, y, vector, frequency, q) -> Solution:
    """A small harmonic orbit about the equilibrium y as one phase of slip."""
    N, size = 64, 1.5 * SMALL
    angle = 2 * np.pi * np.arange(N) / N
    states = y[:, None] + size * (vector[:, None] * np.exp(1j * angle)).real
    slips = (1,) * len(follower.family.template.P)
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
    return Solution((Phase(slips, SECTION),), chain, lifted, u)


def _branch(follower: Follower, x, name: str, start, end) -> Branch:
    """The result, with values of the events that depend on x."""
    points, window = follower.points, follower.window
    events = []
    for event in follower.events:
        events.append(
            BranchEvent(
                kind=event["kind"],
                value=value_at(event, x, window),
                index=event["index"],
                before=event["before"],
                after=event["after"],
            )
        )
    rows = {key: np.array([point.row[key] for point in points]) for key in points[0].row}
    # At a Hopf point a multiplier is 1: it is shown as the cycles beside it are.
    for event in events:
        if event.kind == "Hopf":
            beside = event.index - 1 if event.index else 1
            rows["stable"][event.index] = rows["stable"][beside]
    joints = [faces[0] for faces in follower.family.template.faces]
    if not isinstance(x, Scene):
        rows["stick_fraction"] = rows["stick_fraction"][:, joints]
    rows["open_fraction"] = rows["open_fraction"][:, joints]
    return Branch(
        name=name,
        parameter=np.array([float(window.value(point.q)) for point in points]),
        itinerary=tuple(point.itinerary for point in points),
        events=tuple(sorted(events, key=lambda event: event.index)),
        start=start,
        end=end,
        **rows,
    )
