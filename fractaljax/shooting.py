"""Closing an orbit whose itinerary is known: multiple shooting over short segments.

Each segment keeps one mode and ends on a plane: where a guard vanishes, or, inside a phase,
orthogonally to the motion at the present guess. Its duration is an unknown of its own, fixed by
that plane, so that no event is searched for, and everything is smooth in states and durations.
Newton's equations then chain affine maps of the four components, all segments at once.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from .events import NONE
from .runge_kutta import runge_kutta
from .stick_slip import StickSlip

UNUSED = NONE + 1  # in place of a guard's number: padding, a segment of no duration

_ITERATIONS = 12


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


def _tableau():
    # Loaded when used: a scene without a cycle does not wait for diffrax.
    from diffrax import Dopri8

    return Dopri8.tableau


def flow(system: StickSlip, y, duration, s) -> jax.Array:
    """The state (4, ...) after `duration` (...) in mode s (2, ...), by one eighth-order step."""
    return runge_kutta(_tableau(), lambda y: system.field(y, s), y, jnp.asarray(duration)[None])


def next_start(y) -> jax.Array:
    """The states at which segments must end: the starts of those that follow."""
    return jnp.roll(y, -1, axis=-1)


def chosen_guard(system: StickSlip, y, s, guard, one=1.0) -> jax.Array:
    """The guard that ends each segment, at y; 0 where none does."""
    guards = system.guards(y, s, one)
    return sum(
        (jnp.where(guard == k, guards[k], 0) for k in range(NONE)), start=jnp.zeros_like(y[0])
    )


def jacobian(system: StickSlip, segments: Segments, written_out: bool):
    """End states (4, N) and their derivatives (4, 4, N) by the start states."""

    def field(columns):
        # The state and its four tangents side by side: one array, one compiled loop a stage.
        along, slope = jax.linearize(lambda y: system.field(y, segments.s), columns[:, 0])
        tangents = jax.vmap(slope, in_axes=1, out_axes=1)(columns[:, 1:])
        return jnp.concatenate([along[:, None], tangents], axis=1)

    y = segments.y
    units = jnp.broadcast_to(jnp.eye(4, dtype=y.dtype)[:, :, None], (4, *y.shape))
    columns = jnp.concatenate([y[:, None], units], axis=1)
    ends = runge_kutta(_tableau(), field, columns, segments.duration, written_out=written_out)
    return ends[:, 0], ends[:, 1:]


def maps(system: StickSlip, segments: Segments, written_out=False) -> tuple[jax.Array, Maps]:
    """The ends of the segments and what they depend on."""
    ends, A = jacobian(system, segments, written_out)
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
    """
    speed = jnp.where(used, jnp.sum(local.c * local.b, axis=0), 1)
    b = jnp.where(used[None], local.b, 0) / speed[None]  # no duration to change where unused
    P = jnp.eye(4, dtype=b.dtype)[:, :, None] - b[:, None] * local.c[None]
    # M dy + q of every segment, then chained from the first. Apart, as only q is linear in the
    # arguments, which reverse mode needs to see.
    M = jnp.einsum("ijn,jkn->ikn", P, local.A)
    q = (jnp.einsum("ijn,jn->in", P, gap) - b * guard[None])[:, None]

    def chain(first, second):
        (M_1, q_1), (M_2, q_2) = first, second
        return (
            jnp.sum(M_2[:, :, None] * M_1[None], axis=1),
            jnp.sum(M_2[:, :, None] * q_1[None], axis=1) + q_2,
        )

    M, q = jax.lax.associative_scan(chain, (M, q), axis=2)
    q = q[:, 0]
    # Without any segment there is nothing to solve for.
    once_round = jnp.where(jnp.any(used), M[:, :, -1], 0)
    first = jnp.linalg.solve(jnp.eye(4, dtype=b.dtype) - once_round, q[:, -1])
    ends = jnp.einsum("ijn,j->in", M, first) + q
    starts = jnp.roll(ends, 1, axis=-1)
    moved = jnp.einsum("ijn,jn->in", local.A, starts) + gap
    durations = -jnp.where(used, guard + jnp.sum(local.c * moved, axis=0), 0) / speed
    return starts, durations, once_round


def newton_step(system: StickSlip, segments: Segments):
    """Segments after one Newton step, the largest change, and the projected monodromy matrix."""
    # The one place where a search spends its time.
    ends, local = maps(system, segments, written_out=True)
    target = next_start(segments.y)
    used = segments.guard != UNUSED
    guard = chosen_guard(system, target, segments.s, segments.guard)
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
    count = jnp.maximum(jnp.sum(together, axis=1), 1)
    equal = jnp.where(used, jnp.sum(jnp.where(together, h[None], 0), axis=1) / count, 0)
    old, new = jnp.cumsum(h) - h, jnp.cumsum(equal) - equal
    # From the nearest known state in the same phase.
    away = new[:, None] - old[None]
    k = jnp.argmin(jnp.where(together, jnp.abs(away), jnp.inf), axis=1)
    after = jnp.where(used, jnp.take_along_axis(away, k[:, None], axis=1)[:, 0], 0)
    y = jnp.where(used[None], flow(system, segments.y[:, k], after, s), segments.y)
    return Segments(y, equal, s, guard)


def close(
    system: StickSlip, segments: Segments, wanted: jax.Array
) -> tuple[Segments, jax.Array, jax.Array]:
    """The closed orbit, whether Newton's method reached it, and its projected monodromy matrix.

    Nothing is done where not `wanted`: in a batch, a member without an orbit costs no iterations.
    """
    dtype = segments.y.dtype
    eps = jnp.finfo(dtype).eps
    big = jnp.asarray(jnp.finfo(dtype).max, dtype)
    scale = 1 + jnp.max(jnp.abs(segments.y))

    def stage(k, carry):
        # Switches move away from the planes about them: the rough orbit is divided anew.
        segments, going, once_round = carry
        segments = equalise(system, segments)
        tolerance = jnp.where(k == 0, 1e-4, 1e3 * eps * scale)

        def running(carry):
            _, change, _, count = carry
            return (count < _ITERATIONS) & ~(change <= tolerance) & (change < jnp.inf)

        def body(carry):
            segments, _, _, count = carry
            return *newton_step(system, segments), count + 1

        start = segments, jnp.where(going, big, 0), once_round, 0
        segments, change, once_round, _ = jax.lax.while_loop(running, body, start)
        return segments, going & (change <= 10 * tolerance), once_round

    start = segments, wanted, jnp.zeros((4, 4), dtype)
    return jax.lax.fori_loop(0, 2, stage, start)


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
    dy, dt, _ = corrections(local, guard != UNUSED, gap, off)
    return (y, duration), (dy, dt)
