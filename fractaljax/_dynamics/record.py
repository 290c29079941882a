"""The last steps of many coarse runs, and how a stretch of them is cut into segments."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .events import step
from .hybrid import NONE, SECTION, UNUSED, HybridSystem
from .orbit import Segments, cumulative, flow

_PHASES = 256  # most of one contact state in an orbit
# The last rows of a record: the guard that ended a step, and sums over the steps up to its end,
# less those of the whole run: time, weight, switches with returns, and returns.
_ROWS = GUARD, TIME, WEIGHT, ENDED, RETURNED = range(-5, 0)


def first_reached(reaches: Callable[[Array], Array], shape: tuple[int, ...], count: int) -> Array:
    """The first of `count` numbers that `reaches` accepts, as it does all after it; the last else.

    `reaches` takes numbers of that shape.
    """

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) // 2
        ok = reaches(middle)
        return jnp.where(ok, low, middle + 1), jnp.where(ok, middle, high)

    bounds = jnp.zeros(shape, int), jnp.full(shape, count - 1)
    return jax.lax.fori_loop(0, (count - 1).bit_length(), halve, bounds)[0]


class Record(eqx.Module):
    """The last steps of coarse runs in B lanes, numbered from the oldest.

    What changes the array anywhere but in the loop that steps would copy it, which takes longer
    than the steps.
    """

    y: Float[Array, "2n B"]  # state after the last step
    s: Float[Array, "f B"]
    guard: Int[Array, " B"]  # that ended it
    sums: Float[Array, "4 B"]
    steps: Float[Array, "2n+f+5 record B"]  # a ring: state and contact state before, and `_ROWS`
    oldest: Int[Array, ""]  # place of the oldest
    count: Int[Array, " B"]  # steps that are known to be of one motion

    @classmethod
    def begin(cls, system: HybridSystem, y, length: int) -> "Record":
        """Of runs from y, with room for so many steps."""
        s, lanes = system.contact_state(y), y.shape[1]
        steps = jnp.zeros((len(y) + len(s) + len(_ROWS), length, lanes), y.dtype)
        none = jnp.zeros(lanes, int)
        return cls(y, s, none + NONE, jnp.zeros_like(steps[TIME:, 0]), steps, none[0], none)

    @property
    def length(self) -> int:
        """How many steps it holds."""
        return self.steps.shape[1]

    def row(self, row, number, lane) -> Array:
        """A row of the steps of those numbers in those lanes, or of `slice` several."""
        return self.steps[row, (self.oldest + number) % self.length, lane]

    def past(self, row, number, lane) -> Array:
        """A row of sums as of now, which are zero after the last step."""
        return self.row(row, number, lane) - self.sums[row - TIME, lane]

    def advance(self, system: HybridSystem, h, count: int) -> "Record":
        """After `count` more steps, no longer than h; the length is a multiple of `count`."""

        def body(k, carry):
            y, s, guard, sums, steps = carry
            y_new, s_new, dt, guard = step(system, y, s, guard, h)
            weight = jnp.maximum(1, 2 * system.stiffness(y, s, 1 / 4)) * dt
            ended = guard != NONE, guard == SECTION
            sums = sums + jnp.stack([dt, weight, *(x.astype(dt.dtype) for x in ended)])
            one = jnp.concatenate([y, s, guard.astype(y.dtype)[None], sums])
            steps = jax.lax.dynamic_update_index_in_dim(steps, one, self.oldest + k, 1)
            return y_new, s_new, guard, sums, steps

        carry = self.y, self.s, self.guard, self.sums, self.steps
        carry = jax.lax.fori_loop(0, count, body, carry)
        known = jnp.minimum(self.count + count, self.length)
        return Record(*carry, (self.oldest + count) % self.length, known)

    def moved(self, y, where) -> "Record":
        """With the states y, where steps from before are not of the same motion."""
        known = jnp.where(where, 0, self.count)
        return eqx.tree_at(lambda record: (record.y, record.count), self, (y, known))

    def returns(self, count: int) -> tuple[Array, Array]:
        """The steps (count, B) that ended at the last returns, newest first, and which exist."""
        k, lane = jnp.arange(count)[:, None], jnp.arange(len(self.guard))[None]
        at = first_reached(
            lambda number: self.past(RETURNED, number, lane) >= -k,
            (count, len(self.guard)),
            self.length,
        )
        exists = (self.row(GUARD, at, lane) == SECTION) & (self.past(RETURNED, at, lane) == -k)
        return at, exists & (at >= self.length - self.count[None])

    def after(self, number) -> Array:
        """The states (2n, k, B) after steps (k, B)."""
        lane = jnp.arange(len(self.guard))[None]
        following = self.row(slice(len(self.y)), number + 1, lane)
        return jnp.where((number == self.length - 1)[None], self.y[:, None], following)


class Mesh(eqx.Module):
    """How many segments of N each of p phases has."""

    count: Int[Array, "g p"]
    until: Int[Array, "g p"]  # with those of earlier phases
    phase: Int[Array, "g N"]  # of each segment
    place: Int[Array, "g N"]  # in its phase
    used: Bool[Array, "g N"]

    @classmethod
    def of(cls, size, exists, h, length: int) -> "Mesh":
        """At most `length`, each of weight h (g,) where so few suffice; `size` is the phases'."""
        size = jnp.where(exists, size, 0)
        free = jnp.maximum(length - jnp.sum(exists, axis=-1), 1)
        h = jnp.maximum(h, jnp.sum(size, axis=-1) / free)[:, None]
        count = jnp.where(exists, jnp.ceil(jnp.maximum(size / h - 1e-6, 1)), 0).astype(int)
        until = cumulative(count)
        number = jnp.arange(length)
        used = number[None] < until[:, -1:]
        phase = jnp.sum(until[:, None] <= number[None, :, None], axis=-1)
        phase = jnp.where(used, phase, 0)
        return cls(count, until, phase, number[None] - _take(until - count, phase), used)

    def share(self, dtype) -> Float[Array, "g N"]:
        """Where in its phase each segment starts, from 0 to 1."""
        count = jnp.maximum(_take(self.count, self.phase), 1)
        return self.place.astype(dtype) / count.astype(dtype)

    def durations(self, segments: Segments) -> Float[Array, "g p"]:
        """Of the phases of segments on this mesh."""
        ends = cumulative(segments.duration)
        ends = jnp.concatenate([jnp.zeros_like(ends[:, :1]), ends], axis=1)
        return _take(ends, self.until) - _take(ends, self.until - self.count)


class Starts(eqx.Module):
    """Where the segments of a mesh start in a known motion."""

    state: Float[Array, "2n+f g N"]  # and contact state, earlier in that motion
    after: Float[Array, "g N"]  # time from there to the start
    time: Float[Array, "g N"]  # of the start
    end: Float[Array, "g 1"]  # of the last segment


class Stretch(eqx.Module):
    """Steps of a record in g lanes, from one return to another, in phases."""

    record: Record
    lane: Int[Array, "g 1"]
    exists: Bool[Array, "g p"]
    first: Int[Array, "g p"]  # step of each phase
    last: Int[Array, "g p"]
    rate: Float[Array, "g p"]  # weight by duration
    duration: Float[Array, "g p"]

    @classmethod
    def between(cls, record: Record, lane, first, last, length: int) -> "Stretch":
        """From after step `first` (g,) to step `last` (g,) of lanes (g,)."""
        lane, first, last = lane[:, None], first[:, None], last[:, None]
        p = jnp.arange(min(length, _PHASES))[None]
        before = record.row(ENDED, first, lane)
        exists = p < record.row(ENDED, last, lane) - before
        ends = first_reached(
            lambda number: record.row(ENDED, number, lane) > before + p, exists.shape, record.length
        )
        ends = jnp.where(exists, ends, first)
        starts = jnp.concatenate([first, ends[:, :-1]], axis=1)
        both = slice(TIME, ENDED)
        duration, weight = record.row(both, ends, lane) - record.row(both, starts, lane)
        rate = jnp.where(duration > 0, weight / jnp.where(duration > 0, duration, 1), 1)
        return cls(record, lane, exists, starts + 1, ends, rate, duration)

    def guards(self, mesh: Mesh) -> Int[Array, "g N"]:
        """Those that end the segments of a mesh."""
        guard = self.record.row(GUARD, self.last, self.lane).astype(int)
        ends = mesh.place + 1 == _take(mesh.count, mesh.phase)
        guard = jnp.where(ends, _take(guard, mesh.phase), NONE)
        return jnp.where(mesh.used, guard, UNUSED)

    def starts(self, mesh: Mesh) -> Starts:
        """Of segments of equal weight in a phase."""
        record, lane, both = self.record, self.lane, slice(TIME, ENDED)
        low, high, size = (
            _take(x, mesh.phase) for x in (self.first, self.last, self.rate * self.duration)
        )
        weight = record.row(WEIGHT, low - 1, lane) + size * mesh.share(size.dtype)
        number = first_reached(
            lambda number: record.row(WEIGHT, number, lane) > weight, low.shape, record.length
        )
        number = jnp.clip(number, low, high)
        time, begin = record.row(both, number - 1, lane)
        duration, own = record.row(both, number, lane) - jnp.stack([time, begin])
        after = jnp.clip((weight - begin) / jnp.where(own > 0, own, 1), 0, 1) * duration
        end = record.row(TIME, jnp.max(self.last, axis=1, keepdims=True), lane)
        return Starts(record.row(slice(GUARD), number, lane), after, time + after, end)


def starts_along(segments: Segments, old: Mesh, new: Mesh) -> Starts:
    """Of segments on a new mesh in the motion along those on an old one."""
    count, until = _take(old.count, new.phase), _take(old.until, new.phase)
    number = new.share(segments.y.dtype) * count
    whole = jnp.clip(number.astype(int), 0, jnp.maximum(count - 1, 0))
    at = until - count + whole
    ends = cumulative(segments.duration)
    after = (number - whole) * _take(segments.duration, at)
    state = _take(jnp.concatenate([segments.y, segments.s]), at[None])
    return Starts(state, after, _take(ends - segments.duration, at) + after, ends[:, -1:])


def cut(system: HybridSystem, stretch: Stretch, mesh: Mesh, starts: Starts) -> Segments:
    """The segments of a mesh, the unused ones without a duration."""
    used, n = mesh.used, 2 * system.n
    s = starts.state[n:]
    y = flow(system, starts.state[:n], jnp.where(used, starts.after, 0), s)
    time = jnp.where(used, starts.time, starts.end)
    last = jnp.maximum(mesh.until[:, -1:] - 1, 0)
    return Segments(
        y=jnp.where(used[None], y, y[..., :1]),
        duration=jnp.diff(time, axis=-1, append=starts.end),
        s=jnp.where(used[None], s, _take(s, last[None])),
        guard=stretch.guards(mesh),
    )


def _take(x, number) -> Array:
    return jnp.take_along_axis(x, number, axis=-1)
