"""The periodic orbit of a known itinerary, by multiple shooting over short segments.

A segment keeps one contact state. Those of one phase, from one switch to the next, share its
duration equally, and the phase ends where its guard vanishes. So no event is searched for, and the
equations are smooth in states and durations. Newton's method solves them by chaining the affine
maps of all segments.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .hybrid import NONE, UNUSED, HybridSystem
from .lanes import product, row_numbers, solve
from .runge_kutta import runge_kutta, stability_polynomial

_ITERATIONS = 20
_HOPELESS = 8  # iterations after which steps must be small, relative to the orbit
_POWERS = 4  # of a matrix in a polynomial of it
_BLOCK = 32  # of sums
_FEW = 512  # segments of all lanes that Newton's method takes at once
_TOGETHER, _LEAST = 128, 8  # of more, how many of all lanes, and of each at least, at a time


class Segments(eqx.Module):
    """A closed chain of N segments, of one orbit or of several lanes.

    The end of the last one is the start of the first.
    """

    y: Float[Array, "2n N ..."]  # state at the start of each
    duration: Float[Array, "N ..."]
    s: Float[Array, "f N ..."]  # contact state
    guard: Int[Array, "N ..."]  # which guard ends it: a number, NONE within a phase, or UNUSED

    @property
    def used(self) -> Bool[Array, "N ..."]:
        """Which segments are not padding of zero duration."""
        return self.guard != UNUSED


class Maps(eqx.Module):
    """Derivatives of each segment's end, and of the guard that ends it."""

    A: Float[Array, "N 2n 2n ..."]  # of the end by the state at its start
    b: Float[Array, "2n N ..."]  # of the end by its duration
    c: Float[Array, "2n N ..."]  # of the guard by the state it ends in; 0 where none ends it


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
    return jnp.roll(y, -1, axis=1)


def chosen_guard(system: HybridSystem, y, s, guard) -> Array:
    """The guard that ends each segment, at y; 0 where none does."""
    guards = system.guards(y, s)
    return jnp.sum(jnp.where(row_numbers(guards) == guard[None], guards, 0), axis=0)


def maps(system: HybridSystem, segments: Segments) -> tuple[Array, Maps]:
    """The ends of the segments and their derivatives."""
    # The stages of many degrees of freedom fill the cache: one segment at a time.
    size = len(segments.duration) if system.fastest is None else 1
    ends, A, b = _in_blocks(functools.partial(_maps, system), _still, size, segments)
    return ends, Maps(A, b, _guard_slopes(system, segments))


def coarse_maps(system: HybridSystem, segments: Segments) -> Maps:
    """Derivatives less exact, which Newton's method converges with as well.

    They take a tenth of the time.
    """
    given = functools.partial(_polynomial_maps, system)
    size = _together(segments) if system.fastest is None else 1
    _, A, b = _in_blocks(given, _still, size, segments, next_start(segments.y))
    return Maps(A, b, _guard_slopes(system, segments))


def _together(segments: Segments) -> int:
    """How many segments of each lane Newton's method takes at a time: all if they are few."""
    length, lanes = len(segments.duration), segments.duration[0].size
    return length if length * lanes <= _FEW else max(_TOGETHER // lanes, _LEAST)


def _still(segments: Segments, *_) -> tuple[Array, Array, Array]:
    """Ends, A and b of segments that are not used."""
    y = segments.y
    return y, jnp.moveaxis(_identity(y), 2, 0), jnp.zeros_like(y)


def _in_blocks(function: Callable, unused: Callable, size: int, segments: Segments, *more) -> Any:
    """function(segments, ...) in blocks of that size; of those without a used segment `unused`."""
    length, lanes = len(segments.duration), segments.duration.ndim - 1
    if size >= length:
        return function(segments, *more)

    def split(x):
        x = jnp.moveaxis(x, _axis(x, lanes), 0)
        x = jnp.pad(x, [(0, -length % size), *[(0, 0)] * (x.ndim - 1)], constant_values=UNUSED)
        return x.reshape(-1, size, *x.shape[1:])

    def block(given):
        given = jax.tree.map(lambda x: jnp.moveaxis(x, 0, _axis(x, lanes)), given)
        return jax.lax.cond(
            jnp.any(given[0].used), lambda: function(*given), lambda: unused(*given)
        )

    def joined(x):
        axis = _axis(x[0], lanes)
        x = jnp.moveaxis(x, axis + 1, 1)
        return jnp.moveaxis(x.reshape(-1, *x.shape[2:])[:length], 0, axis)

    return jax.tree.map(joined, jax.lax.map(block, jax.tree.map(split, (segments, *more))))


def _maps(system: HybridSystem, segments: Segments) -> tuple[Array, Array, Array]:
    """The ends of segments that need not be neighbours, and their derivatives A and b."""
    y, s = segments.y, segments.s

    def field(columns):
        # The state and its tangents side by side: one array, one compiled loop a stage.
        along, slope = jax.linearize(lambda y: system.field(y, s), columns[:, 0])
        tangents = jax.vmap(slope, in_axes=1, out_axes=1)(columns[:, 1:])
        return jnp.concatenate([along[:, None], tangents], axis=1)

    columns = jnp.concatenate([y[:, None], _identity(y)], axis=1)
    columns = runge_kutta(tableau(), field, columns, segments.duration[None, None])
    ends, A = columns[:, 0], columns[:, 1:]
    return ends, jnp.moveaxis(A, 2, 0), system.field(ends, s)


def _polynomial_maps(system: HybridSystem, segments: Segments, ends):
    """As `_maps`, of segments with known ends: A is the stability polynomial of the mean Jacobian.

    Exact if the field is affine. (In powers of its fourth power, by Paterson and Stockmeyer.)
    """
    y, h, s = segments.y, segments.duration, segments.s
    b = system.field(ends, s)
    state = (y + ends) / 2 + h[None] / 12 * (system.field(y, s) - b)  # its mean in time
    _, slope = jax.linearize(lambda y: system.field(y, s), state)
    mean = jax.vmap(slope, in_axes=1, out_axes=1)(_identity(y)) * h[None, None]
    eye, mean = (jnp.moveaxis(x, 2, 0) for x in (_identity(y), mean))
    powers, times = [eye, mean], jax.vmap(functools.partial(product, written_out=True))
    for _ in range(_POWERS - 1):
        powers.append(times(powers[-1], mean))
    coefficients = stability_polynomial(tableau()).tolist()
    A = None
    for first in reversed(range(0, len(coefficients), _POWERS)):
        block = coefficients[first : first + _POWERS]
        own = sum(c * power for c, power in zip(block, powers, strict=False))
        A = own if A is None else times(A, powers[-1]) + own
    return ends, A, b


def _identity(y) -> Array:
    """The tangents (2n, 2n, ...) at states y (2n, ...)."""
    eye = jnp.eye(len(y), dtype=y.dtype).reshape(len(y), len(y), *(1,) * (y.ndim - 1))
    return jnp.broadcast_to(eye, (len(y), *y.shape))


def _guard_slopes(system: HybridSystem, segments: Segments) -> Array:
    """Derivatives (2n, N, ...) of the guards that end segments by the states they end in."""
    _, pull = jax.vjp(
        lambda end: chosen_guard(system, end, segments.s, segments.guard), next_start(segments.y)
    )
    return pull(jnp.ones_like(segments.duration))[0]


def _axis(x, lanes: int) -> int:
    """The axis of segments in x (..., N, ...) of so many axes of lanes; of matrices the first."""
    before = x.ndim - 1 - lanes
    return before if before < 2 else 0


def cumulative(x) -> Array:
    """The sums of x (..., k) up to each place, which compile faster than those of jnp.cumsum."""
    k = x.shape[-1]
    if k <= _BLOCK or k % _BLOCK:
        at = jnp.arange(k)
        return jnp.sum(jnp.where(at[None] <= at[:, None], x[..., None, :], 0), axis=-1)
    inside = cumulative(x.reshape(*x.shape[:-1], k // _BLOCK, _BLOCK))
    before = cumulative(inside[..., -1]) - inside[..., -1]
    return (inside + before[..., None]).reshape(x.shape)


def last_of_phase(segments: Segments) -> Int[Array, "N ..."]:
    """For each segment the last one of its phase."""
    ends = (segments.used & (segments.guard != NONE)).T
    ended = cumulative(ends)
    phase = ended - ends
    last = jnp.sum(ended[..., None, :] <= phase[..., None], axis=-1)
    return jnp.minimum(last, ends.shape[-1] - 1).T


def _chain(body: Callable, carry, arrays: tuple, lanes: int, count=None) -> tuple[Any, Array]:
    """`jax.lax.scan` over segments.

    With `count` over so many: that takes no longer than it must, but has no reverse mode.
    """
    front = [jnp.moveaxis(x, _axis(x, lanes), 0) for x in arrays]
    if count is None:
        carry, found = jax.lax.scan(body, carry, tuple(front))
        return carry, jnp.moveaxis(found, 0, found.ndim - 1 - lanes)

    def at(k):
        return tuple(jax.lax.dynamic_index_in_dim(x, k, keepdims=False) for x in front)

    one = jax.eval_shape(body, carry, at(0))[1]
    blank = jnp.zeros((len(front[0]), *one.shape), one.dtype)

    def step(k, so_far):
        carry, found = so_far
        carry, one = body(carry, at(k))
        return carry, jax.lax.dynamic_update_index_in_dim(found, one, k, 0)

    carry, found = jax.lax.fori_loop(0, count, step, (carry, blank))
    return carry, jnp.moveaxis(found, 0, found.ndim - 1 - lanes)


def corrections(
    local: Maps, segments: Segments, last, gap, guard, constant: int | None = None, count=None
):
    """Changes of states and durations that close the gaps and bring the guards to zero.

    They solve dy_next = A dy + b dt + gap on every segment of the chain, with the same dt in a
    phase, which ends with the segment `last`, and c dy_next = -guard at its end. Of the first state
    the component `constant`, which repeats whatever it is, does not change. Returns them and the
    product of all maps (2n, 2n), the Jacobian of the return map. No segment from `count` on is
    used.
    """
    n, used, lanes = len(gap), segments.used, segments.duration.ndim - 1
    ends = used & (segments.guard != NONE)

    def through(W, segment):
        """The affine map from the first state to this end, and what the phase's dt adds.

        The columns of W are the derivatives by the first state, the shift, and those by the
        dt of the phase so far, which is known at its end: r dy_first + d.
        """
        A, gap, b, c, guard, last = segment
        W = product(A, W) + shifts[None] * gap[:, None] + durations[None] * b[:, None]
        off = jnp.sum(c[:, None] * W, axis=0) + shifts * guard[None]
        off = jnp.where(last[None], off / jnp.where(last, -off[-1], 1)[None], 0)
        return W + W[:, -1:] * off[None], off[:-1]

    b = jnp.where(used[None], local.b, 0)
    columns = jnp.eye(n + 2, dtype=gap.dtype).reshape(n + 2, n + 2, *(1,) * lanes)
    shifts, durations = columns[n], columns[n + 1]
    eye = jnp.eye(n, n + 2, dtype=gap.dtype).reshape(n, n + 2, *(1,) * lanes)
    W = jnp.broadcast_to(eye, (n, n + 2, *gap.shape[2:]))
    W, dt = _chain(through, W, (local.A, gap, b, local.c, guard, ends), lanes, count)
    jacobian, shift = W[:, :n], W[:, n]
    # Without segments the equations would be singular.
    jacobian = jnp.where(jnp.any(ends, axis=0)[None, None], jacobian, 0)
    matrix = eye[:, :n] - jacobian
    if constant is not None:
        matrix = matrix.at[constant].set(jnp.broadcast_to(eye[constant, :n], shift.shape))
        shift = shift.at[constant].set(0)
    first = solve(matrix, shift)
    dt = jnp.sum(dt[:n] * first[:, None], axis=0) + dt[n]
    dt = jnp.where(used, jnp.take_along_axis(dt, last, axis=0), 0)

    def along(dy, segment):
        A, added = segment
        return product(A, dy[:, None])[:, 0] + added, dy

    _, dy = _chain(along, first, (local.A, local.b * dt[None] + gap), lanes, count)
    return dy, dt, jacobian


def mean_square(system: HybridSystem, segments: Segments) -> Float[Array, " 2n"]:
    """The mean of each component squared over a period, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    share = jnp.asarray((nodes + 1) / 2, segments.y.dtype)
    y, h, s = segments.y, segments.duration, segments.s
    inside = jax.vmap(lambda share: flow(system, y, share * h, s))(share)
    weights = jnp.asarray(weights / 2, y.dtype)
    return jnp.einsum("g,gin,n->i", weights, inside**2, h) / jnp.sum(h)


class PeriodicOrbit(eqx.Module):
    """The outcome of Newton's method for the periodic orbits of g lanes."""

    segments: Segments
    converged: Bool[Array, " g"]
    return_jacobian: Float[Array, "2n 2n g"]
    error: Float[Array, " g"]  # of period and states, relative, estimated by halving the steps
    middle: Float[Array, "2n N g"]  # states halfway through the segments

    @classmethod
    def none(cls, segments: Segments) -> "PeriodicOrbit":
        """None yet; of the shapes that belong to those segments."""
        y = segments.y
        zero = jnp.zeros_like(y[0, 0])
        jacobian = jnp.zeros((len(y), len(y), *zero.shape), y.dtype)
        return cls(segments, zero > 0, jacobian, zero + jnp.inf, jnp.zeros_like(y))

    def where(self, lanes: Bool[Array, " g"], other: "PeriodicOrbit") -> "PeriodicOrbit":
        """Itself in these lanes, in others the other."""

        def chosen(new, old):
            return jnp.where(lanes.reshape((1,) * (new.ndim - 1) + (-1,)), new, old)

        return jax.tree.map(chosen, self, other)


def solve_periodic_orbits(
    system: HybridSystem, segments: Segments, wanted, reach, rtol: ArrayLike = 0
) -> PeriodicOrbit:
    """The periodic orbits near the segments of g lanes, of those that are `wanted` (g,).

    They are solved together: a lane that has converged waits for the others. One gives up where
    its first state would move further than `reach` (g,). A relative error of less than `rtol` (g,)
    may be left, and where the error is below `rtol` it is corrected.
    """
    y, s, guard, used = segments.y, segments.s, segments.guard, segments.used
    # Those of other lanes may be anything.
    duration = jnp.where(wanted[None], segments.duration, 0)
    if system.excited:
        y = y.at[:, :1].set(system.with_excitation(system.own(y[:, :1]), 0.0))
    start, last = y[:, 0], last_of_phase(segments)
    many = jnp.max(jnp.sum(used & wanted[None], axis=0))
    eps, big = jnp.finfo(y.dtype).eps, jnp.finfo(y.dtype).max
    size = 1 + jnp.max(jnp.abs(y), axis=(0, 1))
    longest_step = jnp.ones_like(size)
    if system.fastest is not None:
        # The motion of many degrees of freedom may be far slower than 1.
        extent = jnp.max(jnp.max(y, axis=1) - jnp.min(y, axis=1), axis=0)
        longest_step = jnp.maximum(longest_step, extent / 8)
    tolerance = jnp.maximum(1e3 * eps, 1e-2 * rtol) * size
    together = _together(segments)
    A = jnp.zeros((y.shape[1], len(y), *y[:, 0].shape), y.dtype)
    nothing = Maps(A, jnp.zeros_like(y), jnp.zeros_like(y))
    far = jnp.where(wanted, big, jnp.inf).astype(y.dtype)

    def running(carry):
        return carry[-1] <= _ITERATIONS

    def body(carry):
        found, local, change, before, count = carry
        y, h = found.segments.y, found.segments.duration
        # Each step is this much shorter than the last one, and the next one may be.
        left = change * jnp.clip(change / before, 1e-3, 1)
        going = (left > tolerance) & (change < jnp.inf)
        # The last iteration is with half the steps: what these change is the error.
        ends_here = ~jnp.any(going) | (count == _ITERATIONS)
        # Near the orbit the maps serve again, while they do well.
        stale = going & ((change > 1e-3 * size) | (change > before / 8))
        local = jax.lax.cond(
            jnp.any(stale) & ~ends_here,
            lambda: coarse_maps(system, found.segments),
            lambda: local,
        )
        parts = jnp.where(ends_here, 2, 1)

        def flows(some):
            def half(_, x):
                return flow(system, x[0], some.duration / parts, some.s), x[0]

            return jax.lax.fori_loop(0, parts, half, (some.y, some.y))

        ends, middle = _in_blocks(flows, lambda none: (none.y, none.y), together, found.segments)
        target = next_start(y)
        off = chosen_guard(system, target, s, guard)
        dy, dt, jacobian = corrections(
            local, found.segments, last, ends - target, off, system.constant, many
        )
        largest, longest = jnp.max(jnp.abs(dy), axis=(0, 1)), jnp.max(jnp.abs(dt), axis=0)
        error = jnp.maximum(
            jnp.abs(jnp.sum(dt, axis=0)) / jnp.sum(h, axis=0),
            largest / jnp.max(jnp.abs(y), axis=(0, 1)),
        )
        new = jnp.maximum(largest, longest)
        moved = jnp.max(jnp.abs(y[:, 0] + dy[:, 0] - start), axis=0)
        hopeless = (count >= _HOPELESS) & (new > 1e-2 * size)
        new = jnp.where((moved <= reach) & (new < big) & ~hopeless, new, jnp.inf)
        converged = left <= 10 * tolerance
        accurate = converged & (error <= rtol)
        moves = jnp.where(ends_here, accurate, going) & (new < jnp.inf)
        # Far from the orbit a full step may leave the region of convergence.
        share = jnp.minimum(1, longest_step / new)[None]
        y = jnp.where(moves[None, None], y + share[None] * dy, y)
        y = jnp.where(used[None], y, y[:, :1])
        h = jnp.where(moves[None], h + share * dt, h)
        middle = jnp.where(used[None], middle, y)
        found = PeriodicOrbit(Segments(y, h, s, guard), converged, jacobian, error, middle)
        change, before = jnp.where(going, jnp.stack([new, change]), jnp.stack([change, before]))
        return found, local, change, before, jnp.where(ends_here, _ITERATIONS, count) + 1

    none = PeriodicOrbit.none(Segments(y, duration, s, guard))
    found, *_ = jax.lax.while_loop(running, body, (none, nothing, far, far, 0))
    return found


def accurate_return_jacobian(system: HybridSystem, segments: Segments) -> Float[Array, "2n 2n g"]:
    """The Jacobian of the return map of periodic orbits, as exact as they are."""
    ends, local = maps(system, segments)
    nothing = jnp.zeros_like(segments.duration)
    return corrections(local, segments, last_of_phase(segments), 0 * ends, nothing)[2]


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

    last = last_of_phase(segments)

    def solution(gap, off):
        return corrections(local, segments, last, gap, off, system.constant)[:2]

    # Linear, hence its own derivative. Older versions of JAX transpose a scan only as a jvp.
    nothing = jax.tree.map(jnp.zeros_like, (gap, off))
    _, (dy, dt) = jax.jvp(solution, nothing, (gap, off))
    return (y, duration), (dy, dt)
