"""Closing an orbit whose itinerary is known: multiple shooting over short segments.

Each segment keeps one mode and ends on a plane: where a guard vanishes, or, inside a phase,
orthogonally to the motion at the present guess. Its duration is an unknown of its own, fixed by
that plane, so that no event is searched for, and everything is smooth in states and durations.
Newton's equations then chain affine maps of the four components, all segments at once.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .events import NONE
from .runge_kutta import runge_kutta
from .stick_slip import StickSlip

UNUSED = NONE + 1  # in place of a guard's number: padding, a segment of no duration

_ITERATIONS = 8


class Segments(eqx.Module):
    """A closed chain of N segments; the last one's end is the first one's start."""

    y: jax.Array  # (4, N) state at the start of each
    duration: jax.Array  # (N,)
    s: jax.Array  # (2, N) mode
    guard: jax.Array  # (N,) which guard ends it: a number, NONE inside a phase, or UNUSED


class Maps(eqx.Module):
    """What a small change of states and durations does to each segment's end."""

    A: jax.Array  # (4, 4, N) by the state at its start
    b: jax.Array  # (4, N) by its duration
    c: jax.Array  # (4, N) normal of the plane it ends on


def _tableau(name: str):
    # Loaded when used: a scene without a cycle does not wait for diffrax.
    import diffrax

    return getattr(diffrax, name).tableau


def flow(system: StickSlip, y, duration, s, written_out=False, error=False) -> Any:
    """The state (4, ...) after `duration` (...) in mode s (2, ...), by one eighth-order step.

    With `error`, an estimate (4, ...) of its error beside it.
    """
    field = functools.partial(_field, system, s)
    duration = jnp.asarray(duration)[None]
    options = {"written_out": written_out, "error": error}
    return runge_kutta(_tableau("Dopri8"), field, y, duration, **options)


def _field(system: StickSlip, s, y) -> jax.Array:
    return system.field(y, s)


def next_start(y) -> jax.Array:
    """The states at which segments must end: the starts of those that follow."""
    return jnp.roll(y, -1, axis=-1)


def chosen_guard(system: StickSlip, y, s, guard, one=1.0) -> jax.Array:
    """The guard that ends each segment, at y; 0 where none does."""
    guards = system.guards(y, s, one)
    return sum(
        (jnp.where(guard == k, guards[k], 0) for k in range(NONE)), start=jnp.zeros_like(y[0])
    )


def jacobian(system: StickSlip, segments: Segments, tableau: str, written_out: bool):
    """End states (4, N) and their derivatives (4, 4, N) by the start states."""

    def field(columns):
        # The state and its four tangents side by side: one array, one compiled loop a stage.
        along, slope = jax.linearize(lambda y: system.field(y, segments.s), columns[:, 0])
        tangents = jax.vmap(slope, in_axes=1, out_axes=1)(columns[:, 1:])
        return jnp.concatenate([along[:, None], tangents], axis=1)

    y = segments.y
    units = jnp.broadcast_to(jnp.eye(4, dtype=y.dtype)[:, :, None], (4, *y.shape))
    columns = jnp.concatenate([y[:, None], units], axis=1)
    duration = segments.duration[None, None]
    ends = runge_kutta(_tableau(tableau), field, columns, duration, written_out=written_out)
    return ends[:, 0], ends[:, 1:]


def maps(
    system: StickSlip, segments: Segments, tableau="Dopri8", written_out=False
) -> tuple[jax.Array, Maps]:
    """The ends of the segments and what they depend on."""
    ends, A = jacobian(system, segments, tableau, written_out)
    b = system.field(ends, segments.s)
    units = jnp.broadcast_to(jnp.eye(4, dtype=b.dtype)[:, :, None], A.shape)
    c = jax.vmap(lambda e: chosen_guard(system, e, segments.s, segments.guard, 0.0))(
        jnp.moveaxis(units, 1, 0)
    )
    along = system.field(next_start(segments.y), segments.s)
    return ends, Maps(A, b, jnp.where(segments.guard[None] == NONE, along, c))


def corrections(local: Maps, used, gap, guard):
    """Changes of states and durations that close the gaps and bring the guards to zero.

    dy_next = A dy + b dt + gap with c dy_next = -guard on every segment, round the whole chain.
    Returns them and the product of all maps once round, (4, 4).
    """
    A, c = local.A, local.c
    speed = jnp.where(used, jnp.sum(c * local.b, axis=0), 1)
    b = jnp.where(used[None], local.b, 0) / speed[None]  # no duration to change where unused
    # Along b onto the plane: M dy + q of every segment, then chained from the first.
    M = A - b[:, None] * jnp.sum(c[:, None] * A, axis=0)[None]
    q = gap - b * (jnp.sum(c * gap, axis=0) + guard)[None]

    def chain(before, segment):
        # Two arrays: only q is linear in the arguments, which reverse mode needs to see.
        (M_1, q_1), (M_2, q_2) = before, segment
        after = (
            jnp.sum(M_2[:, :, None] * M_1[None], axis=1),
            jnp.sum(M_2 * q_1[None], axis=1) + q_2,
        )
        return after, after

    eye = jnp.eye(4, dtype=b.dtype)
    segments = jnp.moveaxis(M, -1, 0), jnp.moveaxis(q, -1, 0)
    (once_round, shift), (M, q) = jax.lax.scan(chain, (eye, jnp.zeros_like(q[:, 0])), segments)
    # Without any segment there is nothing to solve for.
    once_round = jnp.where(jnp.any(used), once_round, 0)
    first = jnp.linalg.solve(eye - once_round, shift)
    ends = jnp.moveaxis(jnp.sum(M * first[None, None], axis=2) + q, 0, -1)
    starts = jnp.roll(ends, 1, axis=-1)
    moved = jnp.sum(A * starts[None], axis=1) + gap
    durations = -jnp.where(used, guard + jnp.sum(c * moved, axis=0), 0) / speed
    return starts, durations, once_round


def newton_step(system: StickSlip, segments: Segments, local: Maps):
    """Segments after one step of Newton's method with those maps, old or rough as they may be.

    Returns the largest change as well, and the projected monodromy matrix.
    """
    ends = flow(system, segments.y, segments.duration, segments.s, written_out=True)
    target = next_start(segments.y)
    guard = chosen_guard(system, target, segments.s, segments.guard)
    used = segments.guard != UNUSED
    dy, dt, once_round = corrections(local, used, ends - target, guard)
    change = jnp.maximum(jnp.max(jnp.abs(dy)), jnp.max(jnp.abs(dt)))
    # Far from the orbit a whole step may leave the range of the model.
    share = jnp.minimum(1, 1 / change)
    new = Segments(
        segments.y + share * dy, segments.duration + share * dt, segments.s, segments.guard
    )
    return new, change, once_round


def equalise(system: StickSlip, segments: Segments) -> Segments:
    """The same motion with segments of equal duration in every phase."""
    s, guard, h = segments.s, segments.guard, segments.duration
    used = guard != UNUSED
    ends_phase = used & (guard != NONE)
    phase = jnp.cumsum(ends_phase) - ends_phase
    together = (phase[:, None] == phase[None]) & used[:, None] & used[None]
    count = jnp.sum(together, axis=1)
    length = jnp.sum(jnp.where(together, h[None], 0), axis=1)
    equal = jnp.where(used, length / jnp.maximum(count, 1), 0)
    old, new = jnp.cumsum(h) - h, jnp.cumsum(equal) - equal
    # From the nearest known state in the same phase.
    before = jnp.sum(together & ((old + h / 2)[None] <= new[:, None]), axis=1)
    k = jnp.sum(phase[None] < phase[:, None], axis=1) + jnp.minimum(before, count - 1)
    k = jnp.where(used, k, 0)
    after = jnp.where(used, new - old[k], 0)
    moved = flow(system, segments.y[:, k], after, s, written_out=True)
    y = jnp.where(used[None], moved, segments.y)
    return Segments(y, equal, s, guard)


class Closing(eqx.Module):
    """A closed orbit, where Newton's method reached one."""

    segments: Segments
    converged: jax.Array
    local: Maps
    once_round: jax.Array  # (4, 4), the projected monodromy matrix


def close(system: StickSlip, segments: Segments, wanted: jax.Array) -> Closing:
    """The closed orbit near those segments.

    Nothing is done where not `wanted`: in a batch, a member without an orbit costs no iterations.
    """
    dtype = segments.y.dtype
    eps = jnp.finfo(dtype).eps
    big = jnp.asarray(jnp.finfo(dtype).max, dtype)
    scale = 1 + jnp.max(jnp.abs(segments.y))

    def stage(k, carry):
        # Switches move away from the planes about them: the rough orbit is divided anew.
        found, going = carry.segments, carry.converged
        found = equalise(system, found)
        tolerance = jnp.where(k == 0, 1e-4, 1e3 * eps * scale)

        def running(carry):
            *_, change, count = carry
            return (count < _ITERATIONS) & ~(change <= tolerance) & (change < jnp.inf)

        def body(carry):
            segments, *_, count = carry
            # To get near, tangents of fifth order are enough, for less than half the price.
            local = jax.lax.cond(
                k == 0,
                lambda: maps(system, segments, "Tsit5", written_out=True)[1],
                lambda: maps(system, segments, written_out=True)[1],
            )

            def step(_, carry):
                return newton_step(system, carry[0], local)

            # A second step with the same maps costs half as much and gains as many digits.
            segments, change, once_round = jax.lax.fori_loop(0, 2, step, (segments, big, eye))
            return segments, local, once_round, change, count + 1

        start = found, carry.local, carry.once_round, jnp.where(going, big, 0), 0
        found, local, once_round, change, _ = jax.lax.while_loop(running, body, start)
        enough = jnp.where(k == 0, 1e-2, 10 * tolerance)
        return Closing(found, going & (change <= enough), local, once_round)

    N = segments.duration.shape[-1]
    eye = jnp.eye(4, dtype=dtype)
    nothing = Maps(*(jnp.zeros((*shape, N), dtype) for shape in ((4, 4), (4,), (4,))))
    return jax.lax.fori_loop(0, 2, stage, Closing(segments, wanted, nothing, eye))


def estimated_error(system: StickSlip, closed: Closing) -> jax.Array:
    """Relative error of period and states, from the difference that half the steps make."""
    y, h, s = closed.segments.y, closed.segments.duration, closed.segments.s
    fine = jax.lax.fori_loop(0, 2, lambda _, y: flow(system, y, h / 2, s), y)
    used = closed.segments.guard != UNUSED
    dy, dt, _ = corrections(closed.local, used, fine - next_start(y), jnp.zeros_like(h))
    period = jnp.sum(h)
    return jnp.maximum(jnp.abs(jnp.sum(dt)) / period, jnp.max(jnp.abs(dy)) / jnp.max(jnp.abs(y)))


@jax.custom_jvp
def orbit(system: StickSlip, segments: Segments) -> tuple[jax.Array, jax.Array]:
    """States and durations of a closed orbit as functions of the system.

    The derivatives, of every order, are those of the equations that the orbit solves.
    """
    return segments.y, segments.duration


@orbit.defjvp
def _orbit_jvp(primals, tangents):
    system, segments = primals
    y, duration = orbit(system, segments)
    s, guard = segments.s, segments.guard

    def equations(system):
        end = next_start(y)
        return flow(system, y, duration, s), chosen_guard(system, end, s, guard)

    _, (gap, off) = jax.jvp(equations, (system,), (tangents[0],))
    _, local = maps(system, Segments(y, duration, s, guard))

    def closing(gap, off):
        return corrections(local, guard != UNUSED, gap, off)[:2]

    # Linear, so its own derivative: older versions of jax transpose a scan only in that form.
    nothing = jax.tree.map(jnp.zeros_like, (gap, off))
    _, (dy, dt) = jax.jvp(closing, nothing, (gap, off))
    return (y, duration), (dy, dt)
