"""The last steps of many coarse runs, and the cutting of a stretch of them into segments."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .events import MOST, step
from .guard import NONE, SECTION, UNUSED
from .hybrid import HybridSystem
from .lanes import together
from .segments import Segments, cumulative, flow
from .step_length import crowding, density
from .transition import first_contact_state

# The last rows of a record: the guard that ended a step, and sums over the steps up to its end,
# less the sums of the whole run: time, weight, switches with returns, and returns.
_ROWS = GUARD, TIME, WEIGHT, ENDED, RETURNED = range(-5, 0)


def first_reached(reaches: Callable[[Array], Array], shape: tuple[int, ...], count: int) -> Array:
    """The first of `count` numbers that `reaches` accepts, with all after it; the last if none.

    `reaches` takes arrays of numbers of that shape.
    """

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) // 2
        ok = reaches(middle)
        return jnp.where(ok, low, middle + 1), jnp.where(ok, middle, high)

    bounds = jnp.zeros(shape, int), jnp.full(shape, count - 1)
    return jax.lax.fori_loop(0, (count - 1).bit_length(), halve, bounds)[0]


class Steps(eqx.Module):
    """Steps of motions in B lanes, numbered from the oldest, in a ring."""

    steps: Float[Array, "2n+f+5 length B"]  # state and contact state before, and `_ROWS`
    oldest: Int[Array, ""]  # place of the oldest

    @classmethod
    def along(cls, system: HybridSystem, segments: Segments, h) -> "Steps":
        """The segments of orbits as steps 1, 2, ...; step 0 is all zero.

        If the system's steps follow the motion, weights follow the errors, and are h on average.
        """
        used = segments.used
        time = jnp.where(used, segments.duration, 0)
        ended = used & (segments.guard != NONE), used & (segments.guard == SECTION)
        if system.fastest is None:
            longest = jnp.broadcast_to(h[None], time.shape)
            weight = density(system, segments.y, segments.s, longest) * time
        else:
            _, error = flow(system, segments.y, time, segments.s, error=True)
            weight = jnp.max(jnp.abs(error), axis=0) ** 0.125
            weight = jnp.where(used, weight, 0)
            mean = jnp.sum(weight, axis=0) / jnp.sum(used, axis=0)
            mean = jnp.where(mean > 0, mean, 1)
            weight = h[None] * jnp.maximum(weight / mean[None], 0.1)
            weight = jnp.where(used, jnp.maximum(weight, time * system.fastest / MOST), 0)
        sums = [time, weight]
        sums = jnp.stack([*sums, *(x.astype(time.dtype) for x in ended)])
        sums = jnp.swapaxes(cumulative(jnp.swapaxes(sums, 1, 2)), 1, 2)
        guard = segments.guard[None].astype(time.dtype)
        steps = jnp.concatenate([segments.y, segments.s, guard, sums])
        return cls(jnp.pad(steps, ((0, 0), (1, 0), (0, 0))), jnp.asarray(0))

    @property
    def length(self) -> int:
        """How many steps it holds."""
        return self.steps.shape[1]

    def row(self, row, number, lane) -> Array:
        """A row, or a `slice` of rows, of the steps of those numbers in those lanes."""
        place = jax.lax.rem(self.oldest + number + self.length, self.length)
        row = row if isinstance(row, slice) else row % len(self.steps)
        kept = self.steps.at[row, place, lane]
        return kept.get(mode="promise_in_bounds", wrap_negative_indices=False)


class Record(Steps):
    """The last steps of coarse runs in B lanes, numbered from the oldest.

    A change of the array outside the stepping loop would copy it, which takes longer than the
    steps.
    """

    y: Float[Array, "2n B"]  # state after the last step
    s: Float[Array, "f B"]
    guard: Int[Array, " B"]  # that ended it
    sums: Float[Array, "4 B"]
    reach: Float[Array, " B"] | None  # of the next step, where steps follow the motion
    count: Int[Array, " B"]  # steps that are known to be of one motion

    @classmethod
    def begin(cls, system: HybridSystem, y, length: int) -> "Record":
        """The record of runs from y, with room for `length` steps."""
        s, lanes = first_contact_state(system, y), y.shape[1]
        steps = jnp.zeros((len(y) + len(s) + len(_ROWS), length, lanes), y.dtype)
        none = jnp.zeros(lanes, int)
        sums = jnp.zeros_like(steps[TIME:, 0])
        reach = None if system.fastest is None else jnp.zeros_like(y[0]) + 0.1 / system.fastest
        return cls(steps, none[0], y, s, none + NONE, sums, reach, none)

    def past(self, row, number, lane) -> Array:
        """A row of the sums relative to now: zero after the last step."""
        return self.row(row, number, lane) - self.sums[row - TIME, lane]

    def advance(self, system: HybridSystem, h, count: int) -> "Record":
        """The record after `count` more steps, at most h long; `count` divides its length."""

        rows, _, lanes = self.steps.shape
        block = together(rows * lanes * self.steps.dtype.itemsize, count)

        def one(k, carry):
            y, s, guard, sums, reach, some = carry
            y_new, s_new, dt, guard, shorter, reach = step(system, y, s, guard, h, reach)
            least = jnp.maximum(1 if reach is None else h / reach, shorter)
            weight = jnp.maximum(least, crowding(system, y, s)) * dt
            ended = guard != NONE, guard == SECTION
            sums = sums + jnp.stack([dt, weight, *(x.astype(dt.dtype) for x in ended)])
            row = jnp.concatenate([y, s, guard.astype(y.dtype)[None], sums])
            some = jax.lax.dynamic_update_index_in_dim(some, row, k, 1)
            return y_new, s_new, guard, sums, reach, some

        def body(k, carry):
            motion, steps = carry
            motion = jax.lax.fori_loop(0, block, one, motion)
            at = self.oldest + k * block
            return motion, jax.lax.dynamic_update_slice_in_dim(steps, motion[-1], at, 1)

        some = jnp.zeros((rows, block, lanes), self.steps.dtype)
        motion = self.y, self.s, self.guard, self.sums, self.reach, some
        motion, steps = jax.lax.fori_loop(0, count // block, body, (motion, self.steps))
        y, s, guard, sums, reach, _ = motion
        valid = jnp.minimum(self.count + count, self.length)
        oldest = (self.oldest + count) % self.length
        return Record(steps, oldest, y, s, guard, sums, reach, valid)

    def continue_from(self, y, where) -> "Record":
        """The record with states y; no earlier step is valid `where` these are another motion."""
        valid = jnp.where(where, 0, self.count)
        return eqx.tree_at(lambda record: (record.y, record.count), self, (y, valid))

    def returns(self, count: int) -> tuple[Array, Array]:
        """The steps (count, B) that ended at the last returns, newest first, and if they exist."""
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


class Stretch(eqx.Module):
    """Steps of g lanes: of their coarse runs, or of orbits near these."""

    run: Record
    lane: Int[Array, " g"]  # of the run
    orbit: Steps
    of_run: Bool[Array, ""]

    @property
    def length(self) -> int:
        """How many steps it holds at most."""
        return self.run.length

    def row(self, row, number) -> Array:
        """A row, or a `slice` of rows, of the steps of those numbers (g, k)."""
        # Both are looked up: the use of a row compiles once, not once for each.
        of_run = self.run.row(row, number, self.lane[:, None])
        number = jnp.minimum(number, self.orbit.length - 1)
        of_orbit = self.orbit.row(row, number, jnp.arange(len(number))[:, None])
        return jnp.where(self.of_run, of_run, of_orbit)


class Phases(eqx.Module):
    """Phases of motions in g lanes: steps of one contact state, from one return to another."""

    exists: Bool[Array, "g p"]
    first: Int[Array, "g p"]  # step of each phase
    last: Int[Array, "g p"]
    weight: Float[Array, "g p"]

    @classmethod
    def between(cls, steps: Stretch, first, last, most: int) -> "Phases":
        """At most `most` phases, from after step `first` (g,) to step `last` (g,)."""
        first, last = first[:, None], last[:, None]
        p = jnp.arange(most)[None]
        before = steps.row(ENDED, first)
        exists = p < steps.row(ENDED, last) - before
        ends = first_reached(
            lambda number: steps.row(ENDED, number) > before + p, exists.shape, steps.length
        )
        ends = jnp.where(exists, ends, first)
        starts = jnp.concatenate([first, ends[:, :-1]], axis=1)
        weight = steps.row(WEIGHT, ends) - steps.row(WEIGHT, starts)
        return cls(exists, starts + 1, ends, jnp.where(exists, weight, 0))


def cut(
    system: HybridSystem,
    steps: Stretch,
    first,
    last,
    h,
    length: int,
    most_phases: int = 256,
    reserved: Int[Array, " g"] | None = None,
) -> Segments:
    """The steps after `first` (g,) up to `last` (g,) in `length` segments less `reserved` (g,).

    Segments of a phase have equal weight, at most h (g,) where so few suffice. Unused segments have
    no duration. Phases beyond `most_phases` are left out, so that no orbit closes.
    """
    n = 2 * system.n
    phases = Phases.between(steps, first, last, min(length, most_phases))
    # The number of segments of each phase.
    free = length - jnp.sum(phases.exists, axis=-1)
    free = jnp.maximum(free if reserved is None else free - reserved, 1)
    h = jnp.maximum(h, jnp.sum(phases.weight, axis=-1) / free)[:, None]
    count = jnp.ceil(jnp.maximum(phases.weight / h - 1e-6, 1))
    count = jnp.where(phases.exists, count, 0).astype(int)
    until = cumulative(count)
    number = jnp.arange(length)
    used = number[None] < until[:, -1:]
    phase = jnp.sum(until[:, None] <= number[None, :, None], axis=-1)
    phase = jnp.where(used, phase, 0)
    count, before, low, high = (
        _take(x, phase) for x in (count, until - count, phases.first, phases.last)
    )
    place = number[None] - before
    # The step in which each segment starts, and the time since then.
    begin = steps.row(WEIGHT, low - 1)
    share = place.astype(h.dtype) / jnp.maximum(count, 1).astype(h.dtype)
    weight = begin + _take(phases.weight, phase) * share
    at = first_reached(lambda number: steps.row(WEIGHT, number) > weight, low.shape, steps.length)
    at = jnp.clip(at, low, high)
    both = slice(TIME, ENDED)
    time, begin = steps.row(both, at - 1)
    duration, step_weight = steps.row(both, at) - jnp.stack([time, begin])
    after = jnp.clip((weight - begin) / jnp.where(step_weight > 0, step_weight, 1), 0, 1) * duration
    end = steps.row(TIME, last[:, None])
    duration = jnp.diff(jnp.where(used, time + after, end), axis=-1, append=end)
    guard = steps.row(GUARD, high).astype(int)
    guard = jnp.where(used, jnp.where(place + 1 == count, guard, NONE), UNUSED)
    states = steps.row(slice(GUARD), at)
    # An unused segment stays in the last contact state, at the first state.
    final = _take(states, jnp.maximum(until[:, -1:] - 1, 0)[None])
    states = jnp.where(used[None], states, final)
    states, duration, guard, used, after = (
        jnp.swapaxes(x, -1, -2) for x in (states, duration, guard, used, after)
    )
    y, s = jnp.split(states, [n])
    y = flow(system, y, jnp.where(used, after, 0), s)
    return Segments(jnp.where(used[None], y, y[:, :1]), duration, s, guard)


def _take(x, number) -> Array:
    return jnp.take_along_axis(x, number, axis=-1)
