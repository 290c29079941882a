"""From a start to its attractor: a coarse run by the Poincare map, then a periodic orbit.

The section of the map is u1 = 0, falling: a maximum of x1. Every few returns, if the last ones
nearly repeat, one period is recorded step by step as a candidate orbit, which Newton's method
makes periodic. The orbit is accepted if it is admissible (keeps to its itinerary), is near the
run, and attracts.

Components are the first axis of every array and scenes the last, which compiles to faster loops.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from .events import Cubic, guards_and_rates, step
from .shooting import UNUSED, Segments, estimated_error, flow, next_start, solve_periodic_orbit
from .stick_slip import SECTION, StickSlip

_STEP = 0.3  # of the coarse run, in units of 1/omega; no eigenfrequency exceeds 1
_STEPS_PER_RETURN = 1600
_RETURNS_PER_ROUND = 8
_APPROACHES = 3  # rounds in which the motion must approach an orbit that is not yet near
_LONGEST = 4  # most returns in one period
# On a CPU all scenes of a batch wait for the slowest: how many run together, and how many
# candidate orbits are solved together, which then fit in the caches.
_TOGETHER, _CANDIDATES_TOGETHER = 64, 8

RUNNING, CONVERGED, EQUILIBRIUM, DIVERGED, NOT_PERIODIC, EXHAUSTED = range(6)


class Attractor(eqx.Module):
    """What the run ended in; scenes, where there are many, are the last axis."""

    segments: Segments
    status: Int[Array, "..."]
    returns: Float[Array, "..."]  # of the run
    period_returns: Int[Array, "..."]  # in one period
    error: Float[Array, "..."]  # of the periodic orbit, relative


class _Run(eqx.Module):
    y: Float[Array, "4 ..."]  # at the last return
    s: Float[Array, "2 ..."]
    past: Float[Array, "longest 4 ..."]  # the last returns, newest first
    duration: Float[Array, "..."]  # from the return before to the last
    switches: Float[Array, "..."]  # between the two
    smooth: Float[Array, "..."]  # successive returns without a switch
    size: Float[Array, "..."]  # distance from the equilibrium
    rate: Float[Array, "..."]  # change of its logarithm between the two
    returns: Float[Array, "..."]
    status: Int[Array, "..."]


def _where(condition, new, old):
    def choose(x, y):
        # The scenes are the last axes of every leaf.
        return jnp.where(condition[(None,) * (x.ndim - condition.ndim)], x, y)

    return jax.tree.map(choose, new, old)


def _to_section(system: StickSlip, y, s, h, active):
    """The next return, where `active`: state, contact state, duration, number of switches."""

    def running(carry):
        *_, going, count = carry
        return jnp.any(going) & (count < _STEPS_PER_RETURN)

    def body(carry):
        y, s, duration, switches, going, count = carry
        y_new, s_new, dt, guard = step(system, y, s, h)
        y, s = _where(going, (y_new, s_new), (y, s))
        duration = duration + jnp.where(going, dt, 0)
        switches = switches + jnp.where(going & (guard < SECTION), 1, 0)
        going = going & (guard != SECTION) & (jnp.max(jnp.abs(y), axis=0) < jnp.inf)
        return y, s, duration, switches, going, count + 1

    zero = jnp.zeros_like(y[0])
    start = y, s, zero, zero, active, 0
    y, s, duration, switches, *_ = jax.lax.while_loop(running, body, start)
    return y, s, duration, switches


def _next_return(system: StickSlip, run: _Run, h, equilibrium, growth) -> _Run:
    active = run.status == RUNNING
    y, s, duration, switches = _to_section(system, run.y, run.s, h, active)
    size = jnp.sqrt(jnp.sum((y - equilibrium) ** 2, axis=0))
    rate = jnp.log(size / run.size)
    smooth = jnp.where(switches == 0, run.smooth + 1, 0)
    steady = (smooth > 3) & (jnp.abs(rate - run.rate) < 0.1 * jnp.abs(rate))

    # With a small V, motions of many times V are ordinary.
    diverged = ~(size < 1e6 * (1 + jnp.max(jnp.abs(equilibrium), axis=0)))
    # Small and decaying at the linear rate, or very small.
    linear = steady & (size < 0.5) & (rate < 0.7 * growth * duration)
    decays = (growth < 0) & (linear | ((size < 1e-2) & (smooth > 3) & (rate < 0)))
    status = jnp.where(diverged, DIVERGED, jnp.where(decays, EQUILIBRIUM, RUNNING))

    # Amplitude extrapolation: a slow, steady change without switches skips many returns, but at
    # most half of the change that is left if it slows down geometrically.
    left = jnp.abs(rate * run.rate) / jnp.maximum(jnp.abs(run.rate) - jnp.abs(rate), 1e-300)
    extrapolates = steady & (jnp.abs(rate) < 0.02) & (status == RUNNING)
    ahead = jnp.minimum(jnp.minimum(0.25, left / 2), 200 * jnp.abs(rate))
    factor = jnp.where(extrapolates, jnp.exp(jnp.sign(rate) * ahead), 1)
    y_on = equilibrium + factor[None] * (y - equilibrium)
    y_on = y_on.at[2].set(jnp.where(extrapolates, 0, y[2]))
    size = size * factor
    new = _Run(
        y=y_on,
        s=s,
        past=jnp.concatenate([y_on[None], run.past[:-1]]),
        duration=duration,
        switches=switches,
        smooth=jnp.where(extrapolates, 1, smooth),
        size=size,
        rate=rate,
        returns=run.returns + 1,
        status=status,
    )
    return _where(active, new, run)


def _record(system: StickSlip, y, s, h, returns, length: int) -> tuple[Segments, Array]:
    """The motion over the next `returns` as segments, and whether there were enough segments."""

    def body(carry, _):
        y, s, left = carry
        y_new, s_new, dt, guard = step(system, y, s, h)
        going = left > 0
        out = y, jnp.where(going, dt, 0), s, jnp.where(going, guard, UNUSED)
        left = left - jnp.where(guard == SECTION, 1, 0)
        return (jnp.where(going, y_new, y), jnp.where(going, s_new, s), left), out

    (_, _, left), recorded = jax.lax.scan(body, (y, s, returns), length=length)
    y, duration, s, guard = (jnp.moveaxis(x, 0, -1) for x in recorded)
    return Segments(y, duration, s, guard), left <= 0


def admissible(system: StickSlip, segments: Segments) -> Array:
    """Whether an orbit obeys the friction law along its itinerary.

    No guard is below zero inside a segment, and every switch leads to the next contact state.
    """
    eps = jnp.finfo(segments.y.dtype).eps
    y, s, h, ends = segments.y, segments.s, segments.duration, next_start(segments.y)
    g_0, d_0 = guards_and_rates(system, y, s, h, system.field(y, s))
    g_1, d_1 = guards_and_rates(system, ends, s, h, system.field(ends, s))
    # The cubic through each guard says where it is lowest. There the guard itself is evaluated,
    # of each direction the one that comes lower.
    cubic = Cubic.through(g_0, g_1, d_0, d_1)
    theta, _ = cubic.minimum()
    low = cubic(theta)
    theta = jnp.stack([jnp.where(low[k] < low[k + 1], theta[k], theta[k + 1]) for k in (0, 2)])
    inside = flow(system, y[:, None], theta * h[None], s[:, None])
    within = system.guards(inside, s[:, None])
    lowest = jnp.minimum(within[0:2, 0], within[2:4, 1])
    least = -1e4 * eps * (1 + jnp.max(jnp.abs(y)))
    holds = jnp.all(jnp.minimum(g_0, g_1)[:SECTION] > least) & jnp.all(lowest > least)
    _, after = system.switch(ends, s, segments.guard)
    return holds & jnp.all(after == jnp.roll(s, -1, axis=-1)) & jnp.all(h > least)


def _attracts(return_jacobian) -> Array:
    """Whether no eigenvalue exceeds 1 in modulus by more than 1e-3: by repeated squaring."""

    def square(_, power):
        return power @ power

    power = jax.lax.fori_loop(0, 13, square, return_jacobian)
    return jnp.max(jnp.abs(power)) < 1e3


def _has_shorter_period(orbit: Segments, returns) -> Array:
    """Whether the orbit is back at its start before its last return."""
    start = orbit.y[:, :1]
    away = jnp.max(jnp.abs(next_start(orbit.y) - start), axis=0)
    at_section = orbit.guard == SECTION
    early = at_section & (jnp.cumsum(at_section) < returns)
    return jnp.any(early & (away < 1e-5 * (1 + jnp.max(jnp.abs(start)))))


def _candidate(system: StickSlip, y, s, duration, switches, returns, wanted, *, length: int):
    """An orbit of so many returns near y: segments, returns, error, and whether it is accepted.

    One of a shorter period is not: the same number of segments resolves that period better.
    """
    # Every switch cuts a step, and there may be one switch more than before the last return.
    whole_steps = jnp.maximum(length - 2 - returns * (switches + 2), length // 4)
    h = 1.02 * returns * duration / whole_steps
    segments, enough = _record(system, y, s, h, returns, length)
    found = solve_periodic_orbit(system, segments, wanted & enough)
    orbit = found.segments
    near = jnp.max(jnp.abs(orbit.y[:, 0] - y)) < 0.2 * (1 + jnp.max(jnp.abs(y)))
    moves = jnp.max(jnp.abs(orbit.y[2:])) > 1e-4
    ok = found.converged & near & moves & _attracts(found.return_jacobian)
    ok = ok & admissible(system, orbit) & ~_has_shorter_period(orbit, returns)
    return orbit, returns, estimated_error(system, found), ok


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def _candidates(*arguments, length: int):
    """`_candidate` where the last but one argument asks for it; the last argument elsewhere.

    On a CPU a few scenes at a time: more would not use the vector units any better.
    """
    *given, nothing = arguments
    ready = given[-1]
    function = _batched(functools.partial(_candidate, length=length), ready.ndim)

    def few(arguments):
        given, nothing = arguments
        return jax.lax.cond(jnp.any(given[-1]), lambda: function(*given), lambda: nothing)

    together = _CANDIDATES_TOGETHER if _on_cpu() else ready.size
    if ready.size <= together or ready.size % together:
        return few((given, nothing))

    def split(x):
        return jnp.moveaxis(x.reshape(*x.shape[:-1], -1, together), -2, 0)

    def join(x):
        return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)

    return jax.tree.map(join, jax.lax.map(few, jax.tree.map(split, (given, nothing))))


def _batched(function, batch_axes: int):
    """`function` of one scene, for arrays with that many trailing axes of scenes."""
    if batch_axes == 0:
        return function
    return jax.vmap(_batched(function, batch_axes - 1), in_axes=-1, out_axes=-1)


def _find(system, start, equilibrium, growth, max_returns, length: int) -> Attractor:
    shape = start.shape[1:]
    zero = jnp.zeros(shape, start.dtype)
    # Above zero, also for a run that starts at the equilibrium.
    size = jnp.sqrt(jnp.sum((start - equilibrium) ** 2, axis=0)) + jnp.finfo(start.dtype).tiny
    run = _Run(
        y=start,
        s=system.contact_state(start),
        past=jnp.full((_LONGEST + 1, 4, *shape), jnp.inf, start.dtype),
        duration=zero,
        switches=zero,
        smooth=zero,
        size=size,
        rate=zero,
        returns=zero,
        status=jnp.full(shape, RUNNING),
    )
    empty = Segments(
        y=jnp.zeros((4, length, *shape), start.dtype),
        duration=jnp.zeros((length, *shape), start.dtype),
        s=jnp.ones((2, length, *shape), start.dtype),
        guard=jnp.full((length, *shape), UNUSED),
    )

    def running(carry):
        return jnp.any(carry[0].status == RUNNING)

    def body(carry):
        run, segments, period_returns, error, distance, approach, widest, tried, rounds = carry
        # A run that takes long to settle may be near the boundary of two basins.
        finer = jnp.where(rounds < 4, 1, jnp.where(rounds < 12, 2, 4))
        h = (_STEP / finer).astype(start.dtype)
        run = jax.lax.fori_loop(
            0,
            _RETURNS_PER_ROUND,
            lambda _, run: _next_return(system, run, h, equilibrium, growth),
            run,
        )
        scale = 1 + jnp.max(jnp.abs(run.y), axis=0)

        def distance_from(y):
            return jnp.max(jnp.abs(run.past - y[None]), axis=(0, 1))

        # An earlier orbit is accepted once the motion has approached it in several rounds.
        now = distance_from(segments.y[:, 0])
        closer = (run.status == RUNNING) & (now < distance) & (distance < jnp.inf)
        approach = jnp.where(closer, approach + 1, 0)
        distance = jnp.where(closer, now, jnp.inf)
        ok = approach >= _APPROACHES

        apart = jnp.max(jnp.abs(run.past[1:] - run.past[:1]), axis=1)
        closest = jnp.min(apart, axis=0)
        # Alternately an orbit of one return and the one that the motion seems to repeat.
        repeated = 1 + jnp.argmax(apart <= 2 * closest[None] + 1e-6, axis=0)
        returns = jnp.where(rounds % 2 == 0, 1, repeated)
        gap = jnp.where(returns == 1, apart[0], closest)
        ready = (run.status == RUNNING) & ~closer & (gap < 0.15 * scale)
        # After a failure again, once the returns are closer together or some rounds later.
        ready = ready & ((gap < 0.7 * tried) | (rounds % 8 < 2))

        known = segments, period_returns, error
        wanted = system, run.y, run.s, run.duration, run.switches, returns, ready
        nothing = *known, jnp.zeros(shape, bool)
        *orbit, new = _candidates(*wanted, nothing, length=length)
        new = new & ready
        segments, period_returns, error = _where(new, tuple(orbit), known)
        tried = jnp.where(ready, gap, tried)
        now = distance_from(segments.y[:, 0])
        # This near, the multipliers decide whether it attracts.
        ok = ok | (new & (jnp.max(jnp.abs(run.y - segments.y[:, 0]), axis=0) < 0.03 * scale))
        distance = jnp.where(new & ~ok, now, distance)

        late = run.returns > max_returns / 2
        widest = jnp.where(late, jnp.maximum(widest, closest / scale), widest)
        dying = (run.switches == 0) & (growth < 0)
        over = jnp.where((widest < 0.02) | dying, EXHAUSTED, NOT_PERIODIC)
        over = jnp.where(run.returns >= max_returns, over, RUNNING)
        status = jnp.where(run.status == RUNNING, jnp.where(ok, CONVERGED, over), run.status)
        run = eqx.tree_at(lambda r: r.status, run, status)
        return run, segments, period_returns, error, distance, approach, widest, tried, rounds + 1

    none = jnp.zeros(shape, int)
    far = jnp.full(shape, jnp.inf, start.dtype)
    start_carry = run, empty, none, zero, far, none, zero, far, 0
    run, segments, period_returns, error, *_ = jax.lax.while_loop(running, body, start_carry)
    return Attractor(segments, run.status, run.returns, period_returns, error)


def find(system: StickSlip, start, equilibrium, growth, max_returns, length: int) -> Attractor:
    """The attractor of the motion from `start`, its orbit on `length` segments, in scaled units.

    `start` and `equilibrium` are (4,), and `growth` is the growth rate at the latter. Under
    `jax.vmap` the scenes become the last axis and, on a CPU, run a few at a time.
    """

    @custom_vmap
    def one(arguments):
        return _find(*arguments, length=length)

    @one.def_vmap
    def rule(axis_size, in_batched, arguments):
        arguments = jax.tree.map(
            lambda x, batched: x if batched else jnp.broadcast_to(x, (axis_size, *x.shape)),
            arguments,
            in_batched[0],
        )
        chunks = -(-axis_size // _TOGETHER) if _on_cpu() else 1
        together = -(-axis_size // chunks)
        if chunks > 1:
            together += -together % _CANDIDATES_TOGETHER

        def chunked(x):
            # Copies of the last scene fill the last chunk.
            padding = chunks * together - axis_size
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (padding, *x.shape[1:]))])
            return jnp.moveaxis(x.reshape(chunks, together, *x.shape[1:]), 1, -1)

        found = jax.lax.map(lambda xs: _find(*xs, length=length), jax.tree.map(chunked, arguments))
        found = jax.tree.map(
            lambda x: jnp.moveaxis(x, -1, 1).reshape(-1, *x.shape[1:-1])[:axis_size], found
        )
        return found, jax.tree.map(lambda _: True, found)

    return one((system, start, equilibrium, growth, max_returns))
