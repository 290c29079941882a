"""The periodic orbit of a known itinerary, by multiple shooting over short segments.

A segment keeps one contact state and ends on a plane: where a guard vanishes, or, within a phase
of one contact state, orthogonally to the motion at the present guess. The plane fixes the
segment's duration, which is an unknown. So no event is searched for, and the equations are smooth
in states and durations. Newton's method solves them by chaining the affine maps of all segments.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .events import NONE
from .runge_kutta import runge_kutta
from .stick_slip import StickSlip

UNUSED = NONE + 1  # as a guard's number: padding, a segment of zero duration

_ITERATIONS = 8


class Segments(eqx.Module):
    """A closed chain of N segments; the last one's end is the first one's start."""

    y: Float[Array, "4 N"]  # state at the start of each
    duration: Float[Array, " N"]
    s: Float[Array, "2 N"]  # contact state
    guard: Int[Array, " N"]  # which guard ends it: a number, NONE within a phase, or UNUSED


class Maps(eqx.Module):
    """Derivatives of each segment's end, and the plane it ends on."""

    A: Float[Array, "4 4 N"]  # by the state at its start
    b: Float[Array, "4 N"]  # by its duration
    c: Float[Array, "4 N"]  # normal of the plane


def _tableau(name: str):
    # Imported late: a question of stability does not wait for diffrax.
    import diffrax

    return getattr(diffrax, name).tableau


def flow(system: StickSlip, y, duration, s, written_out=False, error=False) -> Any:
    """The state (4, ...) after `duration` (...) in contact state s (2, ...), by one step.

    With `error`, also an estimate (4, ...) of its error.
    """
    field = functools.partial(_field, system, s)
    duration = jnp.asarray(duration)[None]
    options = {"written_out": written_out, "error": error}
    return runge_kutta(_tableau("Dopri8"), field, y, duration, **options)


def _field(system: StickSlip, s, y) -> Array:
    return system.field(y, s)


def next_start(y) -> Array:
    """The states at which segments must end: the starts of the next ones."""
    return jnp.roll(y, -1, axis=-1)


def chosen_guard(system: StickSlip, y, s, guard, one=1.0) -> Array:
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
) -> tuple[Array, Maps]:
    """The ends of the segments and their derivatives."""
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

    They solve dy_next = A dy + b dt + gap with c dy_next = -guard on every segment of the chain.
    Returns them and the product of all maps (4, 4), the Jacobian of the return map.
    """
    A, c = local.A, local.c
    speed = jnp.where(used, jnp.sum(c * local.b, axis=0), 1)
    b = jnp.where(used[None], local.b, 0) / speed[None]  # unused segments keep their duration
    # Every segment maps dy to M dy + q, projected along b onto its plane.
    M = A - b[:, None] * jnp.sum(c[:, None] * A, axis=0)[None]
    q = gap - b * (jnp.sum(c * gap, axis=0) + guard)[None]

    def chain(before, segment):
        # Two arrays: reverse mode must see that only q is linear in the arguments.
        (M_1, q_1), (M_2, q_2) = before, segment
        after = (
            jnp.sum(M_2[:, :, None] * M_1[None], axis=1),
            jnp.sum(M_2 * q_1[None], axis=1) + q_2,
        )
        return after, after

    eye = jnp.eye(4, dtype=b.dtype)
    segments = jnp.moveaxis(M, -1, 0), jnp.moveaxis(q, -1, 0)
    (return_jacobian, shift), (M, q) = jax.lax.scan(chain, (eye, jnp.zeros_like(q[:, 0])), segments)
    # Without segments the equations would be singular.
    return_jacobian = jnp.where(jnp.any(used), return_jacobian, 0)
    first = jnp.linalg.solve(eye - return_jacobian, shift)
    ends = jnp.moveaxis(jnp.sum(M * first[None, None], axis=2) + q, 0, -1)
    starts = jnp.roll(ends, 1, axis=-1)
    moved = jnp.sum(A * starts[None], axis=1) + gap
    durations = -jnp.where(used, guard + jnp.sum(c * moved, axis=0), 0) / speed
    return starts, durations, return_jacobian


def newton_step(system: StickSlip, segments: Segments, local: Maps):
    """Segments after one step of Newton's method with these maps, which may be approximate.

    Also returns the largest change and the Jacobian of the return map.
    """
    ends = flow(system, segments.y, segments.duration, segments.s, written_out=True)
    target = next_start(segments.y)
    guard = chosen_guard(system, target, segments.s, segments.guard)
    used = segments.guard != UNUSED
    dy, dt, return_jacobian = corrections(local, used, ends - target, guard)
    change = jnp.maximum(jnp.max(jnp.abs(dy)), jnp.max(jnp.abs(dt)))
    # Far from the orbit a full step may leave the region of convergence.
    share = jnp.minimum(1, 1 / change)
    new = Segments(
        segments.y + share * dy, segments.duration + share * dt, segments.s, segments.guard
    )
    return new, change, return_jacobian


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


class PeriodicOrbit(eqx.Module):
    """The outcome of Newton's method for a periodic orbit."""

    segments: Segments
    converged: Bool[Array, ""]
    local: Maps
    return_jacobian: Float[Array, "4 4"]


def solve_periodic_orbit(
    system: StickSlip, segments: Segments, wanted: Bool[Array, ""]
) -> PeriodicOrbit:
    """The periodic orbit near those segments.

    Where it is not `wanted` there are no iterations, so that members of a batch can be left out.
    """
    dtype = segments.y.dtype
    eps = jnp.finfo(dtype).eps
    big = jnp.asarray(jnp.finfo(dtype).max, dtype)
    scale = 1 + jnp.max(jnp.abs(segments.y))

    def stage(k, carry):
        # Once the switches have moved, segments of equal duration are more accurate.
        found, going = carry.segments, carry.converged
        found = equalise(system, found)
        tolerance = jnp.where(k == 0, 1e-4, 1e3 * eps * scale)

        def running(carry):
            *_, change, count = carry
            return (count < _ITERATIONS) & ~(change <= tolerance) & (change < jnp.inf)

        def body(carry):
            segments, *_, count = carry
            # Far from the orbit fifth-order tangents suffice, at less than half the cost.
            local = jax.lax.cond(
                k == 0,
                lambda: maps(system, segments, "Tsit5", written_out=True)[1],
                lambda: maps(system, segments, written_out=True)[1],
            )

            def step(_, carry):
                return newton_step(system, carry[0], local)

            # A second step with the same maps gains as many digits for half the cost.
            segments, change, return_jacobian = jax.lax.fori_loop(0, 2, step, (segments, big, eye))
            return segments, local, return_jacobian, change, count + 1

        start = found, carry.local, carry.return_jacobian, jnp.where(going, big, 0), 0
        found, local, return_jacobian, change, _ = jax.lax.while_loop(running, body, start)
        enough = jnp.where(k == 0, 1e-2, 10 * tolerance)
        return PeriodicOrbit(found, going & (change <= enough), local, return_jacobian)

    N = segments.duration.shape[-1]
    eye = jnp.eye(4, dtype=dtype)
    nothing = Maps(*(jnp.zeros((*shape, N), dtype) for shape in ((4, 4), (4,), (4,))))
    return jax.lax.fori_loop(0, 2, stage, PeriodicOrbit(segments, wanted, nothing, eye))


def estimated_error(system: StickSlip, orbit: PeriodicOrbit) -> Array:
    """Relative error of period and states, estimated by halving the steps."""
    y, h, s = orbit.segments.y, orbit.segments.duration, orbit.segments.s
    fine = jax.lax.fori_loop(0, 2, lambda _, y: flow(system, y, h / 2, s), y)
    used = orbit.segments.guard != UNUSED
    dy, dt, _ = corrections(orbit.local, used, fine - next_start(y), jnp.zeros_like(h))
    period = jnp.sum(h)
    return jnp.maximum(jnp.abs(jnp.sum(dt)) / period, jnp.max(jnp.abs(dy)) / jnp.max(jnp.abs(y)))


@jax.custom_jvp
def orbit(system: StickSlip, segments: Segments) -> tuple[Array, Array]:
    """States and durations of a periodic orbit as functions of the system.

    Derivatives of every order are implicit: those of the equations that the orbit solves.
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

    def solution(gap, off):
        return corrections(local, guard != UNUSED, gap, off)[:2]

    # Linear, hence its own derivative. Older versions of JAX transpose a scan only as a jvp.
    nothing = jax.tree.map(jnp.zeros_like, (gap, off))
    _, (dy, dt) = jax.jvp(solution, nothing, (gap, off))
    return (y, duration), (dy, dt)
