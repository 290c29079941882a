"""From a start to the attractor: a short, coarse run that ends in a closed orbit, or says why not.

The run goes from turn to turn, a turn ending where direction 1 comes to rest with respect to the
ground (u1 falls through 0). Every few turns, where the last ones nearly repeat, one period is
recorded step by step and closed by Newton's method; the orbit counts if it keeps to its itinerary,
lies where the run was, and attracts.

Components come first and scenes last in every array, which is how compiled loops like it.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from .events import Cubic, guards_and_rates, step
from .shooting import UNUSED, Segments, close, estimated_error, flow, next_start
from .stick_slip import SECTION, StickSlip

_STEP = 0.3  # of the coarse run, in units of 1/omega; no eigenfrequency exceeds 1
_STEPS_A_TURN = 1600
_TURNS_A_ROUND = 8
_APPROACHES = 3  # rounds in which the motion must come closer to an orbit that is not at hand
_LONGEST = 4  # turns that one period may have
# Scenes that run together on a CPU, where all wait for the slowest, and of those that are closed
# together, which keeps within the caches.
_TOGETHER, _ATTEMPTS_TOGETHER = 64, 8

RUNNING, CONVERGED, EQUILIBRIUM, DIVERGED, NOT_PERIODIC, EXHAUSTED = range(6)


class Found(eqx.Module):
    """What the run ended in."""

    segments: Segments
    status: jax.Array
    turns: jax.Array  # of the run
    period_turns: jax.Array  # of one period
    error: jax.Array  # of the closed orbit, relative


class _Run(eqx.Module):
    y: jax.Array  # (4, ...) at the end of the last turn
    s: jax.Array  # (2, ...)
    past: jax.Array  # (_LONGEST + 1, 4, ...) ends of the last turns, newest first
    duration: jax.Array  # of the last turn
    switches: jax.Array  # in the last turn
    smooth: jax.Array  # turns without a switch up to now
    size: jax.Array  # distance from the equilibrium
    rate: jax.Array  # change of its logarithm in the last turn
    turns: jax.Array
    status: jax.Array


def _where(condition, new, old):
    def choose(x, y):
        # The scenes are the last axes of every leaf.
        return jnp.where(condition[(None,) * (x.ndim - condition.ndim)], x, y)

    return jax.tree.map(choose, new, old)


def _turn(system: StickSlip, y, s, h, active):
    """To the end of the turn, where `active`: state, mode, duration, number of switches."""

    def running(carry):
        *_, going, count = carry
        return jnp.any(going) & (count < _STEPS_A_TURN)

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


def _next_turn(system: StickSlip, run: _Run, h, rest, growth) -> _Run:
    active = run.status == RUNNING
    y, s, duration, switches = _turn(system, run.y, run.s, h, active)
    size = jnp.sqrt(jnp.sum((y - rest) ** 2, axis=0))
    rate = jnp.log(size / run.size)
    smooth = jnp.where(switches == 0, run.smooth + 1, 0)
    steady = (smooth > 3) & (jnp.abs(rate - run.rate) < 0.1 * jnp.abs(rate))

    # Where V is small, motions of many times V are ordinary.
    diverged = ~(size < 1e6 * (1 + jnp.max(jnp.abs(rest), axis=0)))
    # Small and dying out as the linear system says, or very small.
    linear = steady & (size < 0.5) & (rate < 0.7 * growth * duration)
    equilibrium = (growth < 0) & (linear | ((size < 1e-2) & (smooth > 3) & (rate < 0)))
    status = jnp.where(diverged, DIVERGED, jnp.where(equilibrium, EQUILIBRIUM, RUNNING))

    # A slow, steady change of a motion without switches goes on: many turns in one, but no more
    # than half of what is left to go if it slows down geometrically.
    left = jnp.abs(rate * run.rate) / jnp.maximum(jnp.abs(run.rate) - jnp.abs(rate), 1e-300)
    leap = steady & (jnp.abs(rate) < 0.02) & (status == RUNNING)
    ahead = jnp.minimum(jnp.minimum(0.25, left / 2), 200 * jnp.abs(rate))
    factor = jnp.where(leap, jnp.exp(jnp.sign(rate) * ahead), 1)
    y_on = rest + factor[None] * (y - rest)
    y_on = y_on.at[2].set(jnp.where(leap, 0, y[2]))
    size = size * factor
    new = _Run(
        y=y_on,
        s=s,
        past=jnp.concatenate([y_on[None], run.past[:-1]]),
        duration=duration,
        switches=switches,
        smooth=jnp.where(leap, 1, smooth),
        size=size,
        rate=rate,
        turns=run.turns + 1,
        status=status,
    )
    return _where(active, new, run)


def _record(system: StickSlip, y, s, h, turns, length: int) -> tuple[Segments, jax.Array]:
    """The next `turns` turns as segments, and whether there were enough of them."""

    def body(carry, _):
        y, s, left = carry
        y_new, s_new, dt, guard = step(system, y, s, h)
        going = left > 0
        out = y, jnp.where(going, dt, 0), s, jnp.where(going, guard, UNUSED)
        left = left - jnp.where(guard == SECTION, 1, 0)
        return (jnp.where(going, y_new, y), jnp.where(going, s_new, s), left), out

    (_, _, left), recorded = jax.lax.scan(body, (y, s, turns), length=length)
    y, duration, s, guard = (jnp.moveaxis(x, 0, -1) for x in recorded)
    return Segments(y, duration, s, guard), left <= 0


def keeps_itinerary(system: StickSlip, segments: Segments) -> jax.Array:
    """Whether no guard falls below zero inside a segment, and every switch goes where it must."""
    eps = jnp.finfo(segments.y.dtype).eps
    y, s, h, ends = segments.y, segments.s, segments.duration, next_start(segments.y)
    g_0, d_0 = guards_and_rates(system, y, s, h, system.field(y, s))
    g_1, d_1 = guards_and_rates(system, ends, s, h, system.field(ends, s))
    # The lowest point of the cubic through each guard, then the guards themselves there: of the
    # two of each direction, the one that comes lower.
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


def _attracts(once_round) -> jax.Array:
    """Whether no eigenvalue is above 1 in modulus, but for a part in a thousand: by squaring."""

    def square(_, power):
        return power @ power

    power = jax.lax.fori_loop(0, 13, square, once_round)
    return jnp.max(jnp.abs(power)) < 1e3


def _closes_early(closed: Segments, turns) -> jax.Array:
    """Whether the orbit is back at its start before its last turn: it has a shorter period."""
    start = closed.y[:, :1]
    away = jnp.max(jnp.abs(next_start(closed.y) - start), axis=0)
    ends_turn = closed.guard == SECTION
    early = ends_turn & (jnp.cumsum(ends_turn) < turns)
    return jnp.any(early & (away < 1e-5 * (1 + jnp.max(jnp.abs(start)))))


def _attempt(system: StickSlip, y, s, duration, switches, turns, wanted, *, length: int):
    """An orbit of so many turns near y: its segments, turns and error, and whether it may stand.

    One of a shorter period may not: cut into as many pieces, it is had more exactly.
    """
    # Every switch cuts a step; one turn may have a switch more than the last.
    whole_steps = jnp.maximum(length - 2 - turns * (switches + 2), length // 4)
    segments, enough = _record(system, y, s, 1.02 * turns * duration / whole_steps, turns, length)
    closing = close(system, segments, wanted & enough)
    closed = closing.segments
    near = jnp.max(jnp.abs(closed.y[:, 0] - y)) < 0.2 * (1 + jnp.max(jnp.abs(y)))
    moves = jnp.max(jnp.abs(closed.y[2:])) > 1e-4
    ok = closing.converged & near & moves & _attracts(closing.once_round)
    ok = ok & keeps_itinerary(system, closed) & ~_closes_early(closed, turns)
    return closed, turns, estimated_error(system, closing), ok


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def _attempts(*arguments, length: int):
    """`_attempt` where the last but one argument asks for it; the last argument elsewhere.

    On a CPU a few scenes at a time: more fill the vector units no better.
    """
    *given, nothing = arguments
    ready = given[-1]
    function = _many(functools.partial(_attempt, length=length), ready.ndim)

    def few(arguments):
        given, nothing = arguments
        return jax.lax.cond(jnp.any(given[-1]), lambda: function(*given), lambda: nothing)

    together = _ATTEMPTS_TOGETHER if _on_cpu() else ready.size
    if ready.size <= together or ready.size % together:
        return few((given, nothing))

    def split(x):
        return jnp.moveaxis(x.reshape(*x.shape[:-1], -1, together), -2, 0)

    def join(x):
        return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)

    return jax.tree.map(join, jax.lax.map(few, jax.tree.map(split, (given, nothing))))


def _many(function, batch_axes: int):
    """`function` of one scene, for arrays with that many trailing axes of scenes."""
    if batch_axes == 0:
        return function
    return jax.vmap(_many(function, batch_axes - 1), in_axes=-1, out_axes=-1)


def _find(system: StickSlip, start, rest, growth, max_turns, length: int) -> Found:
    shape = start.shape[1:]
    zero = jnp.zeros(shape, start.dtype)
    # A run that starts at rest has a size to compare with all the same.
    size = jnp.sqrt(jnp.sum((start - rest) ** 2, axis=0)) + jnp.finfo(start.dtype).tiny
    run = _Run(
        y=start,
        s=system.mode(start),
        past=jnp.full((_LONGEST + 1, 4, *shape), jnp.inf, start.dtype),
        duration=zero,
        switches=zero,
        smooth=zero,
        size=size,
        rate=zero,
        turns=zero,
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
        run, segments, period_turns, error, distance, approach, widest, tried, rounds = carry
        # Who has not settled by then may be choosing between attractors.
        finer = jnp.where(rounds < 4, 1, jnp.where(rounds < 12, 2, 4))
        h = (_STEP / finer).astype(start.dtype)
        run = jax.lax.fori_loop(
            0, _TURNS_A_ROUND, lambda _, run: _next_turn(system, run, h, rest, growth), run
        )
        scale = 1 + jnp.max(jnp.abs(run.y), axis=0)

        def distance_from(y):
            return jnp.max(jnp.abs(run.past - y[None]), axis=(0, 1))

        # An orbit found some rounds ago stands if the motion has come closer to it in each.
        now = distance_from(segments.y[:, 0])
        closer = (run.status == RUNNING) & (now < distance) & (distance < jnp.inf)
        approach = jnp.where(closer, approach + 1, 0)
        distance = jnp.where(closer, now, jnp.inf)
        ok = approach >= _APPROACHES

        apart = jnp.max(jnp.abs(run.past[1:] - run.past[:1]), axis=1)
        closest = jnp.min(apart, axis=0)
        # By turns the simplest orbit and the one that the motion seems to repeat.
        repeated = 1 + jnp.argmax(apart <= 2 * closest[None] + 1e-6, axis=0)
        turns = jnp.where(rounds % 2 == 0, 1, repeated)
        gap = jnp.where(turns == 1, apart[0], closest)
        ready = (run.status == RUNNING) & ~closer & (gap < 0.15 * scale)
        # After a failure, again when the motion has come closer, or after a while.
        ready = ready & ((gap < 0.7 * tried) | (rounds % 8 < 2))

        known = segments, period_turns, error
        wanted = system, run.y, run.s, run.duration, run.switches, turns, ready
        nothing = *known, jnp.zeros(shape, bool)
        *closed, new = _attempts(*wanted, nothing, length=length)
        new = new & ready
        segments, period_turns, error = _where(new, tuple(closed), known)
        tried = jnp.where(ready, gap, tried)
        now = distance_from(segments.y[:, 0])
        # This close, whether it attracts is decided by its multipliers.
        ok = ok | (new & (jnp.max(jnp.abs(run.y - segments.y[:, 0]), axis=0) < 0.03 * scale))
        distance = jnp.where(new & ~ok, now, distance)

        late = run.turns > max_turns / 2
        widest = jnp.where(late, jnp.maximum(widest, closest / scale), widest)
        dying = (run.switches == 0) & (growth < 0)
        over = jnp.where((widest < 0.02) | dying, EXHAUSTED, NOT_PERIODIC)
        over = jnp.where(run.turns >= max_turns, over, RUNNING)
        status = jnp.where(run.status == RUNNING, jnp.where(ok, CONVERGED, over), run.status)
        run = eqx.tree_at(lambda r: r.status, run, status)
        return run, segments, period_turns, error, distance, approach, widest, tried, rounds + 1

    none = jnp.zeros(shape, int)
    far = jnp.full(shape, jnp.inf, start.dtype)
    start_carry = run, empty, none, zero, far, none, zero, far, 0
    run, segments, period_turns, error, *_ = jax.lax.while_loop(running, body, start_carry)
    return Found(segments, run.status, run.turns, period_turns, error)


def find(system: StickSlip, start, rest, growth, max_turns, length: int) -> Found:
    """The attractor that the motion from `start` ends in, on `length` segments.

    `rest` (4,) is the equilibrium and `growth` its growth rate, in scaled units. Under `jax.vmap`
    the scenes go to the last axis and, on a CPU, through the machine a few at a time.
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
            together += -together % _ATTEMPTS_TOGETHER

        def chunked(x):
            # The last chunk is filled up with copies of the last scene.
            rest = chunks * together - axis_size
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (rest, *x.shape[1:]))])
            return jnp.moveaxis(x.reshape(chunks, together, *x.shape[1:]), 1, -1)

        found = jax.lax.map(lambda xs: _find(*xs, length=length), jax.tree.map(chunked, arguments))
        found = jax.tree.map(
            lambda x: jnp.moveaxis(x, -1, 1).reshape(-1, *x.shape[1:-1])[:axis_size], found
        )
        return found, jax.tree.map(lambda _: True, found)

    return one((system, start, rest, growth, max_turns))
