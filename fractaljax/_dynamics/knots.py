"""Speeds at which friction laws are not smooth, and the nodes that segments have there.

A law states them as `knots`. A step of the eighth order across one would be of a low order. The
sliding speed of a face may pass several of them in one segment, and each of them twice. Friction is
continuous there, so that nothing else changes, and a node that is off by d costs an error of d^2 or
less: an orbit that is nearly known tells where its nodes are.

Components are the first axis, segments the next one, lanes may follow.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .contact_state import BACKWARD, FORWARD
from .events import Cubic, quintic, rounding
from .guard import NONE
from .lanes import row_numbers
from .record import first_reached
from .segments import Segments, cumulative, flow, next_start

if TYPE_CHECKING:
    from .hybrid import HybridSystem

# A quintic through a segment is cut where it rises no more or falls no more: in either half.
_PLACES = 5


class _Speeds(NamedTuple):
    """Sliding speeds of the faces along segments, as quintics, and where they turn."""

    values: Float[Array, "3 f ..."]  # at the start, halfway and at the end
    slopes: Float[Array, "3 f ..."]  # by the share of the segment
    places: Float[Array, "5 f ..."]  # shares between which they only rise or only fall
    first: Int[Array, "4 f ..."]  # knots below the speed at the start of each such piece
    rises: Int[Array, "4 f ..."]  # knots that it passes upwards, less those downwards


def _speeds_and_rates(system: "HybridSystem", y, s) -> tuple[Array, Array]:
    """Sliding speeds of the slipping faces (f, ...) and their rates; 0 for the others."""
    n = system.n
    slips = jnp.where((s == FORWARD) | (s == BACKWARD), s, 0)
    rate = system.field(y, s)
    return slips * system.sliding(y[n:]), -slips * system.along(rate[n:])


def _below(system: "HybridSystem", speeds) -> Int[Array, "..."]:
    """How many knots above 0 lie below speeds (..., f, lanes)."""
    assert system.knots is not None
    lanes = speeds.ndim - 1
    knots = system.over_lanes(system.knots, lanes)
    return jnp.sum((knots > 0) & (knots < speeds[:, None]), axis=1)


def _speeds(system: "HybridSystem", y, h, s) -> _Speeds:
    """The sliding speeds along segments that start at y."""
    states = y, flow(system, y, h / 2, s), flow(system, y, h, s)
    values, rates = map(
        jnp.stack, zip(*(_speeds_and_rates(system, y, s) for y in states), strict=True)
    )
    slopes = h[None, None] * rates
    turns = []
    for first in (0, 1):
        last = first + 1
        cubic = Cubic.through(values[first], values[last], slopes[first] / 2, slopes[last] / 2)
        lowest, dips = cubic.minimum()
        highest, peaks = (-cubic).minimum()
        turns.append((first + jnp.where(dips, lowest, jnp.where(peaks, highest, 1))) / 2)
    zero = jnp.zeros_like(turns[0])
    places = jnp.stack([zero, turns[0], zero + 0.5, turns[1], zero + 1])
    at = jax.vmap(lambda x: quintic(values, slopes, x))(places)
    # A speed that starts on a knot has passed it, if it moves on.
    ahead = jnp.sign(at[1:] - at[:-1]) * rounding(y)[None, None]
    first, last = (jnp.stack([_below(system, v) for v in x + ahead]) for x in (at[:-1], at[1:]))
    return _Speeds(values, slopes, places, first, last - first)


def crossings(system: "HybridSystem", segments: Segments) -> Int[Array, "..."]:
    """How many knots the faces pass along the segments."""
    speeds = _speeds(system, segments.y, segments.duration, segments.s)
    passed = jnp.where(segments.used[None, None], jnp.abs(speeds.rises), 0)
    return jnp.sum(passed, axis=(0, 1, 2))


class _Crossings(NamedTuple):
    """Where faces pass knots."""

    exists: Bool[Array, "k ..."]
    segment: Int[Array, "k ..."]
    time: Float[Array, "k ..."]  # since the start of the segment
    y: Float[Array, "2n k ..."]


def _taken(x, places, axis: int = 0) -> Array:
    """Entries of x (..., N, lanes) at `places` (k, lanes) of one axis."""
    places = places.reshape((1,) * axis + places.shape)
    return jnp.take_along_axis(
        x, jnp.broadcast_to(places, x.shape[:axis] + places.shape[axis:]), axis
    )


def _find(system: "HybridSystem", segments: Segments, count: int, each: bool = True) -> _Crossings:
    """The first `count` crossings along segments (N, g), sorted by segment.

    Without `each`, only the first in which a speed rises and the first in which it falls.
    """
    assert system.knots is not None
    y, h, s = segments.y, segments.duration, segments.s
    N, lanes = h.shape
    speeds = _speeds(system, y, h, s)
    pieces = _PLACES - 1
    shape = N * pieces * len(s), lanes

    def flat(x):  # (piece, f, N, g) in the order of segments
        return jnp.moveaxis(x, 2, 0).reshape(shape)

    passed = flat(jnp.where(segments.used[None, None], jnp.abs(speeds.rises), 0))
    passed = passed if each else jnp.minimum(passed, 1)
    until = cumulative(passed.T).T
    number = jnp.arange(count)[:, None]
    exists = number < until[-1:]
    at = first_reached(lambda k: _taken(until, k) > number, (count, lanes), shape[0])
    segment, face = at // (pieces * len(s)), at % len(s)
    # The knot, from the number of those below the speed.
    nth = number - _taken(until - passed, at)
    first, rises = _taken(flat(speeds.first), at), _taken(flat(speeds.rises), at)
    below = jnp.where(rises > 0, first + nth, first - 1 - nth)
    low, high = (_taken(flat(x), at) for x in (speeds.places[:-1], speeds.places[1:]))
    knots = jnp.broadcast_to(
        system.over_lanes(system.knots, 2)[:, :, 0], (*system.knots.shape[:2], lanes)
    )
    # Knots of 0 and less come first, and are not counted.
    below = below + _taken(jnp.sum(knots <= 0, axis=1), face)
    knot = _taken(knots.reshape(-1, lanes), face * knots.shape[1] + below)
    place = face * N + segment
    values, slopes = (
        _taken(x.reshape(3, -1, lanes), place, 1) for x in (speeds.values, speeds.slopes)
    )
    sign = jnp.sign(rises)

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        before = sign * (quintic(values, slopes, middle) - knot) < 0
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    # The quintic is exact to some 1e-8; the flow decides.
    left, right = jax.lax.fori_loop(0, 24, halve, (low, high))
    start, contact, duration = _taken(y, segment, 1), _taken(s, segment, 1), _taken(h, segment)
    of_face = row_numbers(s)[:, :, 0][..., None] == face[None]
    low, high = low * duration, high * duration

    def newton(_, t):
        speed, rate = _speeds_and_rates(system, flow(system, start, t, contact), contact)
        off, rate = (jnp.sum(jnp.where(of_face, x, 0), axis=0) for x in (speed - knot[None], rate))
        return jnp.clip(t - off / jnp.where(rate == 0, jnp.inf, rate), low, high)

    time = jax.lax.fori_loop(0, 5, newton, (left + right) / 2 * duration)
    time = jnp.where(exists, time, 0)
    return _Crossings(exists, segment, time, flow(system, start, time, contact))


def until_knot(system: "HybridSystem", y, s, h) -> Array:
    """The time, at most h, until a face passes a knot in contact state s, for one state (2n,)."""
    one = Segments(*(x[..., None, None] for x in (y, h, s, jnp.full_like(h, NONE, int))))
    found = _find(system, one, (_PLACES - 1) * len(s), each=False)
    # A step of zero length would be repeated forever.
    times = jnp.maximum(found.time, 1e-12 * h)
    return jnp.minimum(jnp.min(jnp.where(found.exists, times, jnp.inf)), h)


def with_nodes(system: "HybridSystem", segments: Segments) -> Segments:
    """Segments (N, g) with further nodes where faces pass knots, as far as there is room."""
    h, used = segments.duration, segments.used
    N = len(h)
    found = _find(system, segments, N)
    # Nodes are dropped rather than segments.
    room = N - jnp.sum(used, axis=0, keepdims=True)
    exists = found.exists & (jnp.arange(N)[:, None] < room)
    parent = jnp.concatenate([jnp.broadcast_to(jnp.arange(N)[:, None], h.shape), found.segment])
    parent = jnp.where(jnp.concatenate([jnp.ones_like(used), exists]), parent, N)
    after = jnp.concatenate([jnp.zeros_like(h), found.time])
    number = jnp.broadcast_to(jnp.arange(2 * N)[:, None], parent.shape)
    parent, after, number = jax.lax.sort((parent, after, number), dimension=0, num_keys=2)
    following, until = parent[1 : N + 1], after[1 : N + 1]
    parent, after, number = parent[:N], after[:N], number[:N]
    last = following != parent
    y = _taken(jnp.concatenate([segments.y, found.y], axis=1), number, 1)
    # Without a barrier XLA (of jaxlib 0.12.0, on a CPU) fuses this into a loop with wrong results.
    ends = jax.lax.optimization_barrier(_taken(h, parent))
    duration = jnp.where(last, ends, until) - after
    guard = _taken(segments.guard, parent)
    guard = jnp.where(last | ~_taken(used, parent), guard, NONE)
    return Segments(y, duration, _taken(segments.s, parent, 1), guard)


def between_knots(system: "HybridSystem", y, h, ends, s) -> "HybridSystem":
    """The system whose laws go on smoothly beyond the knots between which segments from y lie.

    So the derivatives of a segment that ends on a knot are those of its own side. A system without
    knots is left as it is.
    """
    if system.knots is None:
        return system
    n = system.n
    change = system.field(y, s) - system.field(ends, s)
    state = (y + ends) / 2 + h[None] / 12 * change  # its mean in time
    speeds = jnp.abs(system.sliding(state[n:]))
    return within(system, jax.lax.stop_gradient(speeds))


def within(system: "HybridSystem", speeds) -> "HybridSystem":
    """The system whose laws go on smoothly beyond the knots next to these speeds (f, ...)."""
    assert system.knots is not None
    knots = system.over_lanes(system.knots, speeds.ndim - 1)
    inside = knots <= speeds[:, None]
    low = jnp.max(jnp.where(inside & (knots > 0), knots, 0), axis=1)
    high = jnp.min(jnp.where(inside, jnp.inf, knots), axis=1)
    # On a knot itself a law may take either side.
    slack = 4 * np.finfo(speeds.dtype).eps
    below = jnp.where(low > 0, low * (1 + slack), -jnp.inf)
    return replace(system, piece=jax.lax.stop_gradient((below, high * (1 - slack))))


def within_step(system: "HybridSystem", y, h, s) -> "HybridSystem":
    """`between_knots` for a step from one state, which passes none."""
    if system.knots is None:
        return system
    middle = y + h / 2 * system.field(y, s)
    return within(system, jax.lax.stop_gradient(jnp.abs(system.sliding(middle[system.n :]))))


def within_segments(system: "HybridSystem", segments: Segments) -> "HybridSystem":
    """`between_knots` for a closed chain of segments."""
    if system.knots is None:
        return system
    ends = next_start(segments.y)
    return between_knots(system, segments.y, segments.duration, ends, segments.s)
