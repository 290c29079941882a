"""The periodic orbit of a known itinerary, by multiple shooting over short segments.

A segment keeps one contact state. Those of one phase, from one switch to the next, share its
duration equally, and the phase ends where its guard vanishes. So no event is searched for, and the
equations are smooth in states and durations. Newton's method solves them by chaining the affine
maps of all segments.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .hybrid import NONE, UNUSED, HybridSystem
from .runge_kutta import runge_kutta

_ITERATIONS = 16
_PHASES = 256  # most of one contact state in an orbit


class Segments(eqx.Module):
    """A closed chain of N segments; the last one's end is the first one's start."""

    y: Float[Array, "2n N"]  # state at the start of each
    duration: Float[Array, " N"]
    s: Float[Array, "f N"]  # contact state
    guard: Int[Array, " N"]  # which guard ends it: a number, NONE within a phase, or UNUSED

    @property
    def used(self) -> Bool[Array, " N"]:
        """Which segments are not padding of zero duration."""
        return self.guard != UNUSED


class Maps(eqx.Module):
    """Derivatives of each segment's end, and of the guard that ends it."""

    A: Float[Array, "2n 2n N"]  # of the end by the state at its start
    b: Float[Array, "2n N"]  # of the end by its duration
    c: Float[Array, "2n N"]  # of the guard by the state it ends in; 0 where none ends it

    @classmethod
    def zeros(cls, y: Float[Array, "2n N"]) -> "Maps":
        """Of the shapes that belong to the states y."""
        return cls(jnp.zeros((len(y), *y.shape), y.dtype), jnp.zeros_like(y), jnp.zeros_like(y))


def _tableau():
    # Imported late: a question of stability does not wait for diffrax.
    import diffrax

    return diffrax.Dopri8.tableau


def flow(system: HybridSystem, y, duration, s, written_out=False, error=False) -> Any:
    """The state (2n, ...) after `duration` (...) in contact state s (f, ...), by one step.

    With `error`, also an estimate (2n, ...) of its error.
    """
    field = functools.partial(_field, system, s)
    duration = jnp.asarray(duration)[None]
    options = {"written_out": written_out, "error": error}
    return runge_kutta(_tableau(), field, y, duration, **options)


def _field(system: HybridSystem, s, y) -> Array:
    return system.field(y, s)


def next_start(y) -> Array:
    """The states at which segments must end: the starts of the next ones."""
    return jnp.roll(y, -1, axis=-1)


def chosen_guard(system: HybridSystem, y, s, guard) -> Array:
    """The guard that ends each segment, at y; 0 where none does."""
    guards = system.guards(y, s)
    chosen = jnp.arange(len(guards)).reshape(-1, *(1,) * guard.ndim) == guard[None]
    return jnp.sum(jnp.where(chosen, guards, 0), axis=0)


def maps(system: HybridSystem, segments: Segments, written_out=False) -> tuple[Array, Maps]:
    """The ends of the segments and their derivatives."""
    y, s = segments.y, segments.s

    def field(columns):
        # The state and its tangents side by side: one array, one compiled loop a stage.
        along, slope = jax.linearize(lambda y: system.field(y, s), columns[:, 0])
        tangents = jax.vmap(slope, in_axes=1, out_axes=1)(columns[:, 1:])
        return jnp.concatenate([along[:, None], tangents], axis=1)

    units = jnp.broadcast_to(jnp.eye(len(y), dtype=y.dtype)[:, :, None], (len(y), *y.shape))
    columns = jnp.concatenate([y[:, None], units], axis=1)
    duration = segments.duration[None, None]
    ends = runge_kutta(_tableau(), field, columns, duration, written_out=written_out)
    ends, A = ends[:, 0], ends[:, 1:]
    target = next_start(y)
    _, pull = jax.vjp(lambda end: chosen_guard(system, end, s, segments.guard), target)
    (c,) = pull(jnp.ones_like(segments.duration))
    return ends, Maps(A, system.field(ends, s), c)


def _in_phase(phase, values) -> Array:
    """The sum of `values` (N,) over the phase of each segment."""
    return jax.ops.segment_sum(values, phase, len(phase))[phase]


def corrections(local: Maps, segments: Segments, gap, guard, constant: int | None = None):
    """Changes of states and durations that close the gaps and bring the guards to zero.

    They solve dy_next = A dy + b dt + gap on every segment of the chain, with the same dt in a
    phase, and c dy_next = -guard at its end. Of the first state the component `constant`, which
    repeats whatever it is, does not change. Returns them and the product of all maps (2n, 2n), the
    Jacobian of the return map.
    """
    ends = segments.used & (segments.guard != NONE)
    phase = jnp.cumsum(ends) - ends
    share = jnp.where(segments.used, 1 / jnp.maximum(_in_phase(phase, segments.used * 1.0), 1), 0)
    share = share.astype(gap.dtype)
    b = local.b * share[None]

    def chain(before, segment):
        """The affine map from the first state to this end, and what the phase's duration adds."""
        M, q, B = before
        A, b, c, gap, guard, last = segment
        M, q, B = A @ M, A @ q + gap, A @ B + b
        speed = jnp.where(last, c @ B, 1)
        # The duration of the phase is r dy_first + d; it is known at its end.
        r, d = jnp.where(last, -(c @ M) / speed, 0), jnp.where(last, -(guard + c @ q) / speed, 0)
        M, q = M + B[:, None] * r[None], q + B * d
        B = jnp.where(last, 0, B)
        return (M, q, B), (r, d)

    n = len(gap)
    eye, zero = jnp.eye(n, dtype=gap.dtype), jnp.zeros(n, gap.dtype)
    lanes = tuple(jnp.moveaxis(x, -1, 0) for x in (local.A, b, local.c, gap, guard))
    (jacobian, shift, _), (r, d) = jax.lax.scan(chain, (eye, zero, zero), (*lanes, ends))
    # Without segments the equations would be singular.
    jacobian = jnp.where(jnp.any(ends), jacobian, 0)
    matrix = eye - jacobian
    if constant is not None:
        matrix, shift = matrix.at[constant].set(eye[constant]), shift.at[constant].set(0)
    first = jnp.linalg.solve(matrix, shift)
    durations = share * _in_phase(phase, jnp.where(ends, r @ first + d, 0))

    def along(dy, segment):
        A, b, gap, dt = segment
        return A @ dy + b * dt + gap, dy

    moved = tuple(jnp.moveaxis(x, -1, 0) for x in (local.A, local.b, gap))
    _, starts = jax.lax.scan(along, first, (*moved, durations))
    return starts.T, durations, jacobian


def remesh(system: HybridSystem, steps: Segments, h, length: int) -> Segments:
    """The same motion in at most `length` segments, equal within each phase.

    They are no longer than h, if so few suffice, and shorter where friction is stiff.
    """
    weight = jnp.maximum(1, 2 * system.stiffness(steps.y, steps.s)) * steps.duration
    weight = jnp.where(steps.used, weight, 0)
    ends_phase = steps.used & (steps.guard != NONE)
    phase = jnp.cumsum(ends_phase) - ends_phase
    phases = jnp.arange(min(length, _PHASES))
    own = (phase[None] == phases[:, None]) & steps.used[None]
    size = jnp.sum(jnp.where(own, weight[None], 0), axis=1)
    exists = jnp.any(own, axis=1)
    h = jnp.maximum(h, jnp.sum(size) / jnp.maximum(length - jnp.sum(exists), 1))
    count = jnp.where(exists, jnp.ceil(jnp.maximum(size / h - 1e-6, 1)), 0)
    count = count.astype(int)
    after = jnp.cumsum(count)
    first_step = jnp.sum(phase[None] < phases[:, None], axis=1)
    last_step = first_step + jnp.sum(own, axis=1) - 1
    begin = jnp.cumsum(size) - size

    number = jnp.arange(length)
    used = number < after[-1]
    p = jnp.where(used, jnp.sum(after[None] <= number[:, None], axis=1), 0)
    k_in_phase = number - (after - count)[p]
    ends_w, ends_t = jnp.cumsum(weight), jnp.cumsum(steps.duration)

    def at(k_in_phase):
        """Old step, and time since its start, where a part of the phase begins."""
        w = begin[p] + size[p] * k_in_phase / jnp.maximum(count[p], 1)
        k = jnp.searchsorted(ends_w, w, side="right")
        k = jnp.clip(k, first_step[p], last_step[p])
        share = (w - (ends_w - weight)[k]) / jnp.where(weight[k] > 0, weight[k], 1)
        return k, jnp.clip(share, 0, 1) * steps.duration[k]

    k, start = at(k_in_phase)
    k_end, end = at(k_in_phase + 1)
    starts = ends_t - steps.duration
    duration = jnp.where(used, starts[k_end] + end - starts[k] - start, 0)
    moved = flow(system, steps.y[:, k], jnp.where(used, start, 0), steps.s[:, k])
    last = last_step[jnp.sum(count > 0) - 1]
    guard = jnp.where(k_in_phase + 1 == count[p], steps.guard[last_step[p]], NONE)
    return Segments(
        y=jnp.where(used[None], moved, moved[:, :1]),
        duration=duration,
        s=jnp.where(used[None], steps.s[:, k], steps.s[:, last][:, None]),
        guard=jnp.where(used, guard, UNUSED),
    )


class PeriodicOrbit(eqx.Module):
    """The outcome of Newton's method for a periodic orbit."""

    segments: Segments
    converged: Bool[Array, ""]
    local: Maps
    return_jacobian: Float[Array, "2n 2n"]


def solve_periodic_orbit(system: HybridSystem, segments: Segments) -> PeriodicOrbit:
    """The periodic orbit near those segments."""
    y = segments.y
    if system.excited:
        y = y.at[:, 0].set(system.with_excitation(system.own(y[:, 0]), 0.0))
        segments = eqx.tree_at(lambda segments: segments.y, segments, y)
    eps, big = jnp.finfo(y.dtype).eps, jnp.asarray(jnp.finfo(y.dtype).max, y.dtype)
    tolerance = 1e3 * eps * (1 + jnp.max(jnp.abs(y)))

    def running(carry):
        *_, change, count = carry
        return (count < _ITERATIONS) & ~(change <= tolerance) & (change < jnp.inf)

    def body(carry):
        segments, *_, count = carry
        ends, local = maps(system, segments, written_out=True)
        target = next_start(segments.y)
        guard = chosen_guard(system, target, segments.s, segments.guard)
        gap = ends - target
        dy, dt, jacobian = corrections(local, segments, gap, guard, system.constant)
        change = jnp.maximum(jnp.max(jnp.abs(dy)), jnp.max(jnp.abs(dt)))
        # Far from the orbit a full step may leave the region of convergence.
        share = jnp.minimum(1, 1 / change)
        y, duration = segments.y + share * dy, segments.duration + share * dt
        new = Segments(y, duration, segments.s, segments.guard)
        return new, local, jacobian, change, count + 1

    start = segments, Maps.zeros(y), jnp.eye(len(y), dtype=y.dtype), big, 0
    segments, local, jacobian, change, _ = jax.lax.while_loop(running, body, start)
    return PeriodicOrbit(segments, change <= 10 * tolerance, local, jacobian)


def estimated_error(system: HybridSystem, orbit: PeriodicOrbit) -> tuple[Array, Array]:
    """Relative error of period and states, estimated by halving the steps; and the midpoints."""
    segments = orbit.segments
    y, h, s = segments.y, segments.duration, segments.s

    def half(y, _):
        y = flow(system, y, h / 2, s)
        return y, y

    end, (middle, _) = jax.lax.scan(half, y, length=2)
    gap, guard = end - next_start(y), jnp.zeros_like(h)
    dy, dt, _ = corrections(orbit.local, segments, gap, guard, system.constant)
    period = jnp.sum(h)
    error = jnp.maximum(jnp.abs(jnp.sum(dt)) / period, jnp.max(jnp.abs(dy)) / jnp.max(jnp.abs(y)))
    return error, middle


@jax.custom_jvp
def orbit(system: HybridSystem, segments: Segments) -> tuple[Array, Array]:
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
        return corrections(local, segments, gap, off, system.constant)[:2]

    # Linear, hence its own derivative. Older versions of JAX transpose a scan only as a jvp.
    nothing = jax.tree.map(jnp.zeros_like, (gap, off))
    _, (dy, dt) = jax.jvp(solution, nothing, (gap, off))
    return (y, duration), (dy, dt)
