"""The periodic orbit of a known itinerary, by multiple shooting over short segments.

A segment keeps one contact state. The segments of one phase, from one switch to the next, have
fixed shares of its duration, and the phase ends where its guard vanishes. No event is searched for,
and the equations are smooth in states and durations. Newton's method solves them by chaining the
affine maps of all segments.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from .guard import NONE
from .hybrid import HybridSystem
from .knots import within_segments
from .lanes import chosen, product, solve
from .maps import Maps, axis_of, coarse_maps, exact_maps, in_blocks, segments_together
from .segments import Segments, chosen_guard, flow, next_start


def _chain(body: Callable, carry, arrays: tuple, lanes: int, count=None) -> tuple[Any, Array]:
    """`jax.lax.scan` over segments.

    With `count`, over the first `count` only: quicker, but without reverse mode.
    """
    front = [jnp.moveaxis(x, axis_of(x, lanes), 0) for x in arrays]
    if count is None:
        carry, stacked = jax.lax.scan(body, carry, tuple(front))
        return carry, jnp.moveaxis(stacked, 0, stacked.ndim - 1 - lanes)

    def at(k):
        return tuple(jax.lax.dynamic_index_in_dim(x, k, keepdims=False) for x in front)

    def step(k, so_far):
        carry, stacked = so_far
        carry, one = body(carry, at(k))
        return carry, jax.lax.dynamic_update_index_in_dim(stacked, one, k, 0)

    one = jax.eval_shape(body, carry, at(0))[1]
    blank = jnp.zeros((len(front[0]), *one.shape), one.dtype)
    carry, stacked = jax.lax.fori_loop(0, count, step, (carry, blank))
    return carry, jnp.moveaxis(stacked, 0, stacked.ndim - 1 - lanes)


@functools.partial(jax.jit, static_argnames="constant")  # traced once for all places of a program
def corrections(
    local: Maps,
    segments: Segments,
    gap,
    guard,
    constant: int | None = None,
    count=None,
    resting=None,
):
    """Changes of states and durations that close the gaps and bring the guards to zero.

    They solve dy_next = A dy + b dt + gap on every segment of the chain, with the same stretch
    dt/duration in a phase, and c dy_next = -guard at its end. The component `constant` of the first
    state, which repeats whatever it is, does not change; nor does what `resting` (n, n, ...)
    projects on, displacements and velocities of faces that stick throughout. Returns them and the
    product of all maps (2n, 2n), the Jacobian of the return map. No segment from `count` on is
    used.
    """
    n, used, lanes = len(gap), segments.used, segments.duration.ndim - 1
    ends = used & (segments.guard != NONE)

    def through(W, segment):
        """The affine map from the first state to this end, and what the phase's stretch adds.

        The columns of W are the derivatives by the first state, the shift, and the derivatives by
        the stretch of the phase so far, which is known at its end: r dy_first + d.
        """
        A, gap, b, c, guard, last = segment
        W = product(A, W) + shifts[None] * gap[:, None] + stretches[None] * b[:, None]
        off = jnp.sum(c[:, None] * W, axis=0) + shifts * guard[None]
        off = jnp.where(last[None], off / jnp.where(last, -off[-1], 1)[None], 0)
        return W + W[:, -1:] * off[None], off[:-1]

    # With one dt for all, short segments of a phase that becomes shorter would be negative. A
    # phase without duration still gets its share.
    duration = jnp.maximum(jnp.abs(segments.duration), 1e-12)
    b = jnp.where(used[None], local.b * duration[None], 0)
    columns = np.eye(n + 2, dtype=gap.dtype).reshape(n + 2, n + 2, *(1,) * lanes)
    shifts, stretches = columns[n], columns[n + 1]
    eye = np.eye(n, n + 2, dtype=gap.dtype).reshape(n, n + 2, *(1,) * lanes)
    W = jnp.broadcast_to(eye, (n, n + 2, *gap.shape[2:]))
    W, stretch = _chain(through, W, (local.A, gap, b, local.c, guard, ends), lanes, count)
    jacobian, shift = W[:, :n], W[:, n]
    # Without segments the equations would be singular.
    jacobian = jnp.where(jnp.any(ends, axis=0)[None, None], jacobian, 0)
    matrix = jnp.asarray(eye[:, :n]) - jacobian
    if constant is not None:
        matrix = matrix.at[constant].set(jnp.broadcast_to(eye[constant, :n], shift.shape))
        shift = shift.at[constant].set(0)
    if resting is not None:
        # Such a displacement repeats whatever it is.
        matrix = matrix + block_diagonal(resting, resting)
    first = solve(matrix, shift)
    stretch = jnp.sum(stretch[:n] * first[:, None], axis=0) + stretch[n]

    def backwards(after, segment):
        stretch, last = segment
        after = jnp.where(last, stretch, after)
        return after, after

    # A gather would become a scatter in reverse mode.
    none = jnp.zeros_like(stretch[0])
    _, stretch = jax.lax.scan(backwards, none, (stretch, ends), reverse=True)
    dt = jnp.where(used, stretch * duration, 0)

    def along(dy, segment):
        A, added = segment
        return product(A, dy[:, None])[:, 0] + added, dy

    _, dy = _chain(along, first, (local.A, local.b * dt[None] + gap), lanes, count)
    return dy, dt, jacobian


def block_diagonal(A, B) -> Array:
    """[[A, 0], [0, B]] of matrices (n, n, ...) of one shape."""
    none = jnp.zeros_like(A)
    rows = [jnp.concatenate([A, none], axis=1), jnp.concatenate([none, B], axis=1)]
    return jnp.concatenate(rows)


class PeriodicOrbit(eqx.Module):
    """The outcome of Newton's method for the periodic orbits of g lanes."""

    segments: Segments
    converged: Bool[Array, " g"]
    error: Float[Array, " g"]  # of period and states, relative, estimated by halving the steps
    middle: Float[Array, "2n N g"]  # states halfway through the segments
    jacobian: Float[Array, "2n 2n g"]  # of the return map

    @classmethod
    def none(cls, segments: Segments) -> "PeriodicOrbit":
        """No orbit yet, in the shapes of those segments."""
        y = segments.y
        zero = jnp.zeros_like(y[0, 0])
        jacobian = jnp.zeros((len(y), *y[:, 0].shape), y.dtype)
        return cls(segments, zero > 0, zero + jnp.inf, jnp.zeros_like(y), jacobian)

    def where(self, lanes: Bool[Array, " g"], other: "PeriodicOrbit") -> "PeriodicOrbit":
        """This orbit in these lanes, `other` elsewhere."""
        return chosen(lanes, self, other)


def solve_periodic_orbits(
    system: HybridSystem,
    segments: Segments,
    active,
    reach,
    rtol: ArrayLike = 0,
    iterations: int = 20,
) -> PeriodicOrbit:
    """The periodic orbits near the segments of g lanes, in the lanes that are `active` (g,).

    They are solved together: a lane that has converged waits for the others. A lane gives up if
    its first state would move further than `reach` (g,). A relative error of less than `rtol` (g,)
    may be left, and where the error is below `rtol` it is corrected. It is estimated after at most
    that many `iterations`.
    """
    y, s, guard, used = segments.y, segments.s, segments.guard, segments.used
    # Durations in other lanes may be anything.
    duration = jnp.where(active[None], segments.duration, 0)
    if system.excited:
        y = y.at[:, :1].set(system.with_excitation(system.mechanism_state(y[:, :1]), 0.0))
    start = y[:, 0]
    many = jnp.max(jnp.sum(used & active[None], axis=0))
    eps, big = jnp.finfo(y.dtype).eps, jnp.finfo(y.dtype).max
    size = 1 + jnp.max(jnp.abs(y), axis=(0, 1))
    longest_step = jnp.ones_like(size)
    if system.fastest is not None:
        # The motion of many degrees of freedom may be far slower than 1.
        extent = jnp.max(jnp.max(y, axis=1) - jnp.min(y, axis=1), axis=0)
        longest_step = jnp.maximum(longest_step, extent / 8)
    tolerance = jnp.maximum(1e3 * eps, 1e-2 * rtol) * size
    together = segments_together(segments)
    resting = system.resting(s, used) if system.excited else None
    A = jnp.zeros((y.shape[1], len(y), *y[:, 0].shape), y.dtype)
    no_maps = Maps(A, jnp.zeros_like(y), jnp.zeros_like(y))
    far = jnp.where(active, big, jnp.inf).astype(y.dtype)

    def running(carry):
        return carry[-1] <= iterations

    def body(carry):
        orbits, local, change, before, count = carry
        y, h = orbits.segments.y, orbits.segments.duration
        # Each step is this much shorter than the last one, and the next one may be.
        left = change * jnp.clip(change / before, 1e-3, 1)
        going = (left > tolerance) & (change < jnp.inf)
        # The last iteration has steps of half the length: the change is the error.
        ends_here = ~jnp.any(going) | (count == iterations)
        # Near the orbit the maps serve again, while they do well.
        slow = change > before / 8
        stale = going & ((change > 1e-3 * size) | slow)
        # Where a law bends much within a segment, rough maps converge slowly or not at all.
        exact = ends_here | jnp.any(going & slow)
        renewals = [lambda: local, lambda: coarse_maps(system, orbits.segments)]
        if not system.affine:  # where coarse ones are exact
            renewals.append(lambda: exact_maps(system, orbits.segments))
        last = len(renewals) - 1
        renewal = jnp.where(exact, last, jnp.where(jnp.any(stale), 1, 0))
        local = jax.lax.switch(renewal, renewals)
        parts = jnp.where(ends_here, 2, 1)

        def flows(some):
            def half(_, x):
                return flow(system, x[0], some.duration / parts, some.s), x[0]

            return jax.lax.fori_loop(0, parts, half, (some.y, some.y))

        ends, middle = in_blocks(flows, lambda none: (none.y, none.y), together, orbits.segments)
        target = next_start(y)
        off = chosen_guard(system, target, s, guard)
        dy, dt, jacobian = corrections(
            local, orbits.segments, ends - target, off, system.constant, many, resting
        )
        largest, longest = jnp.max(jnp.abs(dy), axis=(0, 1)), jnp.max(jnp.abs(dt), axis=0)
        error = jnp.maximum(
            jnp.abs(jnp.sum(dt, axis=0)) / jnp.sum(h, axis=0),
            largest / jnp.max(jnp.abs(y), axis=(0, 1)),
        )
        new = jnp.maximum(largest, longest)
        displacement = jnp.max(jnp.abs(y[:, 0] + dy[:, 0] - start), axis=0)
        # Steps that are still large after eight iterations hardly ever converge.
        hopeless = (count >= 8) & (new > 1e-2 * size)
        new = jnp.where((displacement <= reach) & (new < big) & ~hopeless, new, jnp.inf)
        converged = left <= 10 * tolerance
        accurate = converged & (error <= rtol)
        moves = jnp.where(ends_here, accurate, going) & (new < jnp.inf)
        # Far from the orbit a full step may leave the region of convergence.
        share = jnp.minimum(1, longest_step / new)[None]
        y = jnp.where(moves[None, None], y + share[None] * dy, y)
        y = jnp.where(used[None], y, y[:, :1])
        h = jnp.where(moves[None], h + share * dt, h)
        middle = jnp.where(used[None], middle, y)
        orbits = PeriodicOrbit(Segments(y, h, s, guard), converged, error, middle, jacobian)
        change, before = jnp.where(going, jnp.stack([new, change]), jnp.stack([change, before]))
        return orbits, local, change, before, jnp.where(ends_here, iterations, count) + 1

    none = PeriodicOrbit.none(Segments(y, duration, s, guard))
    orbits, *_ = jax.lax.while_loop(running, body, (none, no_maps, far, far, 0))
    return orbits


@jax.custom_jvp
def orbit(system: HybridSystem, segments: Segments) -> tuple[Array, Array]:
    """States and durations of a periodic orbit as functions of the system.

    Derivatives of every order are implicit, from the equations that the orbit solves.
    """
    return segments.y, segments.duration


@orbit.defjvp
def _orbit_jvp(primals, tangents):
    system, segments = primals
    y, duration = orbit(system, segments)
    point = system, Segments(y, duration, segments.s, segments.guard)
    return (y, duration), _orbit_tangent(point, tangents[0])


def _orbit_tangent(
    point: tuple[HybridSystem, Segments], tangent: HybridSystem
) -> tuple[Array, Array]:
    """Changes of an orbit's states and durations with a change of its system."""
    system, segments = point

    def equations(system):
        end = next_start(segments.y)
        system = within_segments(system, segments)
        ends = flow(system, segments.y, segments.duration, segments.s)
        return ends, chosen_guard(system, end, segments.s, segments.guard)

    gap, off = jax.jvp(equations, (system,), (tangent,))[1]
    local = exact_maps(system, segments)
    resting = system.resting(segments.s, segments.used) if system.excited else None

    def solution(gap, off):
        return corrections(local, segments, gap, off, system.constant, resting=resting)[:2]

    # Linear, hence its own derivative, without the constant parts that no scan can transpose.
    return jax.jvp(solution, (jnp.zeros_like(gap), jnp.zeros_like(off)), (gap, off))[1]
