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
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .hybrid import NONE, UNUSED, HybridSystem
from .lanes import row_numbers
from .runge_kutta import runge_kutta

_ITERATIONS = 16
_PHASES = 256  # most of one contact state in an orbit
_BLOCK = 32  # of sums
_SMALL = 8  # states up to which products of matrices are sums


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


def tableau():
    """The coefficients of the segments' steps."""
    # Imported late: a question of stability does not wait for diffrax.
    import diffrax

    return diffrax.Dopri8.tableau


def flow(system: HybridSystem, y, duration, s, error=False) -> Any:
    """The state (2n, ...) after `duration` (...) in contact state s (f, ...), by one step.

    With `error`, also an estimate (2n, ...) of its error.
    """
    field = functools.partial(_field, system, s)
    duration = jnp.asarray(duration)[None]
    return runge_kutta(tableau(), field, y, duration, error=error)


def _field(system: HybridSystem, s, y) -> Array:
    return system.field(y, s)


def next_start(y) -> Array:
    """The states at which segments must end: the starts of the next ones."""
    return jnp.roll(y, -1, axis=-1)


def chosen_guard(system: HybridSystem, y, s, guard) -> Array:
    """The guard that ends each segment, at y; 0 where none does."""
    guards = system.guards(y, s)
    return jnp.sum(jnp.where(row_numbers(guards) == guard[None], guards, 0), axis=0)


def maps(system: HybridSystem, segments: Segments) -> tuple[Array, Maps]:
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
    ends = runge_kutta(tableau(), field, columns, duration)
    ends, A = ends[:, 0], ends[:, 1:]
    target = next_start(y)
    _, pull = jax.vjp(lambda end: chosen_guard(system, end, s, segments.guard), target)
    (c,) = pull(jnp.ones_like(segments.duration))
    return ends, Maps(A, system.field(ends, s), c)


def cumulative(x) -> Array:
    """The sums of x (..., k) up to each place, which compile faster than those of jnp.cumsum."""
    k = x.shape[-1]
    if k <= _BLOCK or k % _BLOCK:
        at = jnp.arange(k)
        return jnp.sum(jnp.where(at[None] <= at[:, None], x[..., None, :], 0), axis=-1)
    inside = cumulative(x.reshape(*x.shape[:-1], k // _BLOCK, _BLOCK))
    before = cumulative(inside[..., -1]) - inside[..., -1]
    return (inside + before[..., None]).reshape(x.shape)


def _product(A, B) -> Array:
    """A @ B; a small one as a sum, which compiles into one loop with what surrounds it."""
    return jnp.sum(A[:, :, None] * B[None], axis=1) if len(A) <= _SMALL else A @ B


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
    phase = cumulative(ends) - ends
    share = jnp.where(segments.used, 1 / jnp.maximum(_in_phase(phase, segments.used * 1.0), 1), 0)
    share = share.astype(gap.dtype)
    b = local.b * share[None]

    def chain(W, segment):
        """The affine map from the first state to this end, and what the phase's duration adds.

        The columns of W are the derivatives by the first state, the shift, and those by the
        duration of the phase so far, which is known at its end: r dy_first + d.
        """
        A, added, c, guard, last = segment
        W = _product(A, W) + added
        off = jnp.sum(c[:, None] * W, axis=0).at[n].add(guard)
        off = jnp.where(last, off / jnp.where(last, -off[-1], 1), 0)
        return W + W[:, -1:] * off[None], off[:-1]

    n = len(gap)
    eye, none = jnp.eye(n, dtype=gap.dtype), jnp.zeros((n, 2), gap.dtype)
    A, c = jnp.moveaxis(local.A, -1, 0), local.c.T
    added = jnp.stack([gap.T, b.T], axis=-1)
    added = jnp.concatenate([jnp.zeros_like(A), added], axis=-1)
    W, durations = jax.lax.scan(
        chain, jnp.concatenate([eye, none], axis=1), (A, added, c, guard, ends)
    )
    jacobian, shift = W[:, :n], W[:, n]
    # Without segments the equations would be singular.
    jacobian = jnp.where(jnp.any(ends), jacobian, 0)
    matrix = eye - jacobian
    if constant is not None:
        matrix, shift = matrix.at[constant].set(eye[constant]), shift.at[constant].set(0)
    first = jnp.linalg.solve(matrix, shift)
    durations = share * _in_phase(phase, durations[:, :n] @ first + durations[:, n])

    def along(dy, segment):
        A, b, gap, dt = segment
        return _product(A, dy[:, None])[:, 0] + b * dt + gap, dy

    _, starts = jax.lax.scan(along, first, (A, local.b.T, gap.T, durations))
    return starts.T, durations, jacobian


def remesh(system: HybridSystem, steps: Segments, h, length: int) -> Segments:
    """The same motion in at most `length` segments, equal within each phase.

    They are no longer than h, if so few suffice, and shorter where friction is stiff.
    """
    weight = jnp.maximum(1, 2 * system.stiffness(steps.y, steps.s, 1 / 4)) * steps.duration
    weight = jnp.where(steps.used, weight, 0)
    ends_w, ends_t = cumulative(jnp.stack([weight, steps.duration]))
    # The first and last step of each phase, and its weight.
    ended = cumulative(steps.used & (steps.guard != NONE))
    phases = jnp.arange(min(length, _PHASES))
    exists = phases < ended[-1]
    last_step = jnp.searchsorted(ended, phases, side="right")
    last_step = jnp.where(exists, last_step, 0)
    first_step = jnp.where(phases > 0, jnp.roll(last_step, 1) + 1, 0)
    begin = (ends_w - weight)[first_step]
    size = jnp.where(exists, ends_w[last_step] - begin, 0)
    h = jnp.maximum(h, jnp.sum(size) / jnp.maximum(length - jnp.sum(exists), 1))
    count = jnp.where(exists, jnp.ceil(jnp.maximum(size / h - 1e-6, 1)), 0)
    count = count.astype(int)
    until = cumulative(count)

    number = jnp.arange(length)
    used = number < until[-1]
    p = jnp.where(used, jnp.sum(until[None] <= number[:, None], axis=1), 0)
    # Gathered together: each gather is compiled on its own.
    count, before, low, high = jnp.stack([count, until - count, first_step, last_step])[:, p]
    begin, size = jnp.stack([begin, size])[:, p][:, None]
    place = number - before
    # Both ends of each new segment: the old step they lie in, and the time since its start.
    w = begin + size * jnp.stack([place, place + 1]) / jnp.maximum(count, 1)[None]
    step = jnp.clip(jnp.searchsorted(ends_w, w, side="right"), low[None], high[None])
    old = jnp.stack([ends_w - weight, weight, steps.duration, ends_t - steps.duration])
    start_w, weight, duration, start_t = old[:, step]
    share = (w - start_w) / jnp.where(weight > 0, weight, 1)
    after = jnp.clip(share, 0, 1) * duration
    duration = jnp.where(used, jnp.diff(start_t + after, axis=0)[0], 0)
    states = jnp.concatenate([steps.y, steps.s])[:, step[0]]
    y, s = states[: len(steps.y)], states[len(steps.y) :]
    moved = flow(system, y, jnp.where(used, after[0], 0), s)
    guard = jnp.where(place + 1 == count, steps.guard[high], NONE)
    last = jnp.argmax(jnp.where(used, number, -1))
    return Segments(
        y=jnp.where(used[None], moved, moved[:, :1]),
        duration=duration,
        s=jnp.where(used[None], s, s[:, last][:, None]),
        guard=jnp.where(used, guard, UNUSED),
    )


def mean_square(system: HybridSystem, segments: Segments) -> Float[Array, " 2n"]:
    """The mean of each component squared over a period, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    share = jnp.asarray((nodes + 1) / 2, segments.y.dtype)
    y, h, s = segments.y, segments.duration, segments.s
    inside = jax.vmap(lambda share: flow(system, y, share * h, s))(share)
    weights = jnp.asarray(weights / 2, y.dtype)
    return jnp.einsum("g,gin,n->i", weights, inside**2, h) / jnp.sum(h)


class PeriodicOrbit(eqx.Module):
    """The outcome of Newton's method for a periodic orbit."""

    segments: Segments
    converged: Bool[Array, ""]
    return_jacobian: Float[Array, "2n 2n"]
    error: Float[Array, ""]  # of period and states, relative, estimated by halving the steps
    middle: Float[Array, "2n N"]  # states halfway through the segments

    @classmethod
    def none(cls, segments: Segments) -> "PeriodicOrbit":
        """None yet; of the shapes that belong to those segments."""
        y = segments.y
        eye, far = jnp.eye(len(y), dtype=y.dtype), jnp.asarray(jnp.inf, y.dtype)
        return cls(segments, jnp.array(False), eye, far, jnp.zeros_like(y))


def solve_periodic_orbit(system: HybridSystem, segments: Segments) -> PeriodicOrbit:
    """The periodic orbit near those segments."""
    y, s = segments.y, segments.s
    if system.excited:
        y = y.at[:, 0].set(system.with_excitation(system.own(y[:, 0]), 0.0))
        segments = eqx.tree_at(lambda segments: segments.y, segments, y)
    eps, big = jnp.finfo(y.dtype).eps, jnp.asarray(jnp.finfo(y.dtype).max, y.dtype)
    tolerance = 1e3 * eps * (1 + jnp.max(jnp.abs(y)))

    def settled(change, count):
        limit = jnp.where(count < _ITERATIONS, tolerance, 10 * tolerance)
        return change <= limit

    def running(carry):
        found, change, count = carry
        going = (count < _ITERATIONS) | settled(change, count)
        return going & ~found.converged & (change < jnp.inf)

    def body(carry):
        found, change, count = carry
        segments, last = found.segments, settled(change, count)
        y, h = segments.y, segments.duration
        ends, local = maps(system, segments)
        target = next_start(y)
        guard = chosen_guard(system, target, s, segments.guard)

        def halved():
            end, starts = jax.lax.scan(lambda y, _: (flow(system, y, h / 2, s), y), y, length=2)
            return end, starts[1]

        # The last iteration is for the error: what half the steps would change.
        ends, middle = jax.lax.cond(last, halved, lambda: (ends, found.middle))
        gap, guard = ends - target, jnp.where(last, 0, guard)
        dy, dt, jacobian = corrections(local, segments, gap, guard, system.constant)
        period, size = jnp.sum(h), jnp.max(jnp.abs(y))
        error = jnp.maximum(jnp.abs(jnp.sum(dt)) / period, jnp.max(jnp.abs(dy)) / size)
        new = jnp.maximum(jnp.max(jnp.abs(dy)), jnp.max(jnp.abs(dt)))
        # Far from the orbit a full step may leave the region of convergence.
        share = jnp.where(last, 0, jnp.minimum(1, 1 / new))
        moved = Segments(y + share * dy, h + share * dt, s, segments.guard)
        error = jnp.where(last, error, found.error)
        change = jnp.where(last, change, new)
        return PeriodicOrbit(moved, last, jacobian, error, middle), change, count + 1

    found, *_ = jax.lax.while_loop(running, body, (PeriodicOrbit.none(segments), big, 0))
    return found


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
