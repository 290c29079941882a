"""From a start to its attractor: a coarse run, then a periodic orbit near where it repeats.

The run keeps its last steps. After every round of steps its returns to the section, the maxima of
t.x of the first face, are compared. If the last ones nearly repeat, the steps between them are a
candidate orbit, which Newton's method makes periodic. The orbit is accepted if it is admissible
(keeps to its itinerary), is near the run, and attracts.

Components are the first axis of every array and scenes the last, which compiles to faster loops.
"""

import functools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from .events import Cubic, step
from .hybrid import NONE, SECTION, UNUSED, HybridSystem
from .orbit import (
    PeriodicOrbit,
    Segments,
    cumulative,
    next_start,
    remesh,
    solve_periodic_orbit,
)

_MESHES = 4  # on which a candidate is solved, each finer, until it is accurate

RUNNING, CONVERGED, EQUILIBRIUM, DIVERGED, NOT_PERIODIC, EXHAUSTED, TOO_LONG = range(7)


@dataclass(frozen=True)
class SearchOptions:
    """Tolerances and patience of the search for an attractor, in scaled units."""

    step: float = 0.3  # of the coarse run; no eigenfrequency exceeds 1
    round_steps: int = 128  # between two looks at the returns
    finer_after: tuple[int, int] = (16, 48)  # rounds after which the step is halved
    longest: int = 16  # most returns in one period
    near: float = 0.15  # gap between returns below which an orbit is tried, relative
    accepted: float = 0.03  # distance from the orbit at which its multipliers decide, relative
    approaches: int = 3  # rounds in which the motion approaches an orbit that is not yet near
    eager: int = 64  # rounds after which orbits are tried less often
    linear: float = 0.5  # size below which a decay at the linear rate ends in equilibrium
    small: float = 1e-2  # size below which any decay without switches does
    extrapolated: float = 0.02  # growth in a return, without switches, that is extrapolated
    divergence: float = 1e6  # size at which a motion diverges: with a small V, many V are ordinary
    settling: int = 8  # rounds without growth after which the record must hold two returns
    patience: int = 512  # rounds without a maximum
    record: int = 2048  # steps that are kept, at least; a period takes fewer


class Attractor(eqx.Module):
    """What the run ended in; scenes, where there are many, are the last axis."""

    segments: Segments
    status: Int[Array, "..."]
    period_returns: Int[Array, "..."]  # in one period
    error: Float[Array, "..."]  # of the periodic orbit, relative
    returns: Float[Array, "..."]  # of the run


class _Run(eqx.Module):
    """A coarse run with its last steps, in a ring of rounds, all in one array."""

    y: Float[Array, "2n ..."]
    s: Float[Array, "f ..."]
    guard: Int[Array, "..."]  # that ended the last step
    steps: Float[Array, "2n+f+2 record ..."]  # state, contact state, duration and guard


class _Returns(eqx.Module):
    """The returns of a run, newest first."""

    at: Int[Array, " returns"]  # steps that ended at the section
    y: Float[Array, "2n returns"]
    time: Float[Array, " returns"]
    exists: Array


def _advance(system: HybridSystem, run: _Run, rounds, h, options: SearchOptions) -> _Run:
    record = run.steps.shape[1]
    place = rounds * options.round_steps % record

    def body(k, carry):
        y, s, guard, steps = carry
        y_new, s_new, dt, guard = step(system, y, s, guard, h)
        one = jnp.concatenate([y, s, dt[None], guard.astype(y.dtype)[None]])
        steps = jax.lax.dynamic_update_index_in_dim(steps, one, place + k, 1)
        return y_new, s_new, guard, steps

    carry = run.y, run.s, run.guard, run.steps
    return _Run(*jax.lax.fori_loop(0, options.round_steps, body, carry))


def _segments(run: _Run, order) -> Segments:
    """The last steps of one run as segments, in that order."""
    n, f = len(run.y), len(run.s)
    y, s, duration, guard = jnp.split(run.steps[:, order], [n, n + f, n + f + 1])
    return Segments(y, duration[0], s, guard[0].astype(int))


def _returns(run: _Run, order, guard, count: int) -> _Returns:
    seen = cumulative(guard == SECTION)
    number = seen[-1] - jnp.arange(count)
    at = jnp.where(number > 0, jnp.searchsorted(seen, number), -1)
    # A step ends where the next one starts.
    following = run.steps[: len(run.y), order[(at + 1) % len(order)]]
    y = jnp.where((at == len(order) - 1)[None], run.y[:, None], following)
    return _Returns(at, y, cumulative(run.steps[-2, order])[at], at >= 0)


def _quintic(y, d, x):
    """The quintic with values y (3, ...) and slopes d (3, ...) at 0, 1/2 and 1, at x."""
    u, v, w = x, x - 0.5, x - 1
    # Lagrange weights squared, each with the correction of its own slope.
    at_0, at_m, at_1 = 4 * (v * w) ** 2, 16 * (u * w) ** 2, 4 * (u * v) ** 2
    first, last = y[0] + u * (d[0] + 6 * y[0]), y[2] + w * (d[2] - 6 * y[2])
    return at_0 * first + at_m * (y[1] + v * d[1]) + at_1 * last


def admissible(system: HybridSystem, segments: Segments, middle) -> Array:
    """Whether an orbit obeys the friction law along its itinerary; `middle` are its midpoints.

    No guard is below zero inside a segment, and every switch leads to the next contact state.
    """
    y, s, h, ends = segments.y, segments.s, segments.duration, next_start(segments.y)
    at = jnp.stack([y, middle, ends])
    d = jax.vmap(lambda y: h[None] * system.field(y, s))(at)
    guards = jax.vmap(lambda y: system.guards(y, s)[1:])  # but the section
    scale = 1 + jnp.max(jnp.abs(y))
    # Half a segment each: the cubic through a guard's ends and a point between says where it is
    # lowest. There the guard itself is evaluated.
    places = jnp.arange(7) / 6
    inside = jax.vmap(lambda x: _quintic(at, d, x))(places)
    g = guards(inside)
    cubics = (Cubic.at_thirds(g[:4]), Cubic.at_thirds(g[3:]))
    lowest = []
    for k, cubic in enumerate(cubics):
        theta, _ = cubic.minimum()
        theta = jnp.take_along_axis(theta, jnp.argmin(cubic(theta), axis=0)[None], axis=0)[0]
        lowest.append(_quintic(at, d, (k + theta)[None] / 2))
    g = jnp.concatenate([g, guards(jnp.stack(lowest))])
    # The quintic is this good in a segment of the default length.
    holds = jnp.all(g > -1e-8 * scale) & jnp.all(h > -1e-10)
    _, after = system.switch(ends, s, segments.guard)
    return holds & jnp.all(after == jnp.roll(s, -1, axis=-1))


def attracts(return_jacobian) -> Array:
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
    early = at_section & (cumulative(at_section) < returns)
    return jnp.any(early & (away < 1e-5 * (1 + jnp.max(jnp.abs(start)))))


def _candidate(system, steps: Segments, y, first, last, returns, h, rtol, *, length: int):
    """The orbit near the steps after `first` up to `last`: segments, error, whether accepted.

    One of a shorter period is not: the same number of segments resolves that period better.
    """
    number = jnp.arange(len(steps.duration))
    chosen = (number > first) & (number <= last)
    # The chosen steps come first, as a chain must.
    order = jnp.roll(number, -(first + 1))
    guard = jnp.where(chosen, steps.guard, UNUSED)[order]
    duration = jnp.where(chosen, steps.duration, 0)[order]
    steps = Segments(steps.y[:, order], duration, steps.s[:, order], guard)

    def going(carry):
        _, found, tries = carry
        return (tries == 0) | ((tries < _MESHES) & found.converged & ~(found.error <= rtol))

    def solve(carry):
        steps, _, tries = carry
        found = solve_periodic_orbit(system, remesh(system, steps, h * 0.8**tries, length))
        # The orbit's phases have other lengths than those of the steps: they are cut anew.
        steps = jax.tree.map(lambda x, new: x.at[..., :length].set(new), steps, found.segments)
        used = jnp.where(number < length, steps.guard, UNUSED)
        steps = Segments(steps.y, jnp.where(used == UNUSED, 0, steps.duration), steps.s, used)
        return steps, found, tries + 1

    nothing = PeriodicOrbit.none(jax.tree.map(lambda x: x[..., :length], steps))
    _, found, _ = jax.lax.while_loop(going, solve, (steps, nothing, 0))
    orbit = found.segments
    near = jnp.max(jnp.abs(orbit.y[:, 0] - y)) < 0.2 * (1 + jnp.max(jnp.abs(y)))
    moves = jnp.max(jnp.abs(orbit.y[system.n :])) > 1e-4
    ok = found.converged & near & moves & attracts(found.return_jacobian)
    ok = ok & admissible(system, orbit, found.middle) & ~_has_shorter_period(orbit, returns)
    return orbit, found.error, ok


class _Progress(eqx.Module):
    """What the search knows of one scene besides its run."""

    status: Int[Array, "..."]
    orbit: Segments
    period_returns: Int[Array, "..."]
    error: Float[Array, "..."]
    distance: Float[Array, "..."]  # of the run from that orbit
    approach: Int[Array, "..."]  # rounds in which it fell
    widest: Float[Array, "..."]  # gap between returns, in the later half of the run
    tried: Float[Array, "..."]  # gap at the last attempt
    returns: Float[Array, "..."]
    idle: Int[Array, "..."]  # rounds without a return
    size: Float[Array, "..."]  # distance from the equilibrium at the last return
    calm: Int[Array, "..."]  # rounds with a return in which it did not grow


def _assess(
    system,
    run: _Run,
    known: _Progress,
    rounds,
    equilibrium,
    growth,
    max_returns,
    h,
    rtol,
    *,
    options: SearchOptions,
    length: int,
):
    """One scene after a round: its run, perhaps extrapolated, and what is known of it."""
    record = run.steps.shape[1]
    oldest = (rounds + 1) * options.round_steps
    order = (oldest + jnp.arange(record)) % record
    guard = run.steps[-1, order].astype(int)
    seen = _returns(run, order, guard, options.longest + 1)
    active = known.status == RUNNING
    tiny = jnp.finfo(run.y.dtype).tiny
    new = jnp.arange(record) >= record - options.round_steps
    returns = known.returns + jnp.sum(new & (guard == SECTION))
    idle = jnp.where(seen.at[0] >= record - options.round_steps, 0, known.idle + 1)

    # --- near the equilibrium ---
    away = jnp.sqrt(jnp.sum((seen.y - equilibrium[:, None]) ** 2, axis=0))
    size = jnp.sqrt(jnp.sum((run.y - equilibrium) ** 2)) + tiny
    diverged = ~(size < options.divergence * (1 + jnp.max(jnp.abs(equilibrium))))
    last_switch = jnp.max(jnp.where(guard > 0, jnp.arange(record), -1))
    smooth = seen.exists[3] & (seen.at[3] > last_switch)
    log = jnp.log(away[:3] + tiny)
    rate, before = log[0] - log[1], log[1] - log[2]
    duration = seen.time[0] - seen.time[1]
    # An excited motion has no equilibrium.
    steady = smooth & (jnp.abs(rate - before) < 0.1 * jnp.abs(rate)) & (not system.excited)
    linear = steady & (away[0] < options.linear) & (rate < 0.7 * growth * duration)
    decays = linear | (smooth & (away[0] < options.small) & (rate < 0))
    decays = (growth < 0) & (decays | (size < 1e-6))
    status = jnp.where(diverged, DIVERGED, jnp.where(decays, EQUILIBRIUM, RUNNING))
    # Amplitude extrapolation: a slow, steady change without switches skips many returns, but at
    # most half of the change that is left if it slows down geometrically.
    left = jnp.abs(rate * before) / jnp.maximum(jnp.abs(before) - jnp.abs(rate), 1e-300)
    ahead = jnp.minimum(jnp.minimum(0.25, left / 2), 200 * jnp.abs(rate))
    extrapolates = steady & (jnp.abs(rate) < options.extrapolated) & (status == RUNNING) & active
    factor = jnp.where(extrapolates, jnp.exp(jnp.sign(rate) * ahead), 1)
    y_on = jnp.where(extrapolates, equilibrium + factor * (run.y - equilibrium), run.y)

    # --- near a periodic orbit ---
    scale = 1 + jnp.max(jnp.abs(seen.y[:, 0]))
    apart = jnp.max(jnp.abs(seen.y[:, 1:] - seen.y[:, :1]), axis=0)
    apart = jnp.where(seen.exists[1:], apart, jnp.inf)
    closest = jnp.min(apart)

    def distance_from(orbit):
        gap = jnp.max(jnp.abs(seen.y - orbit.y[:, :1]), axis=0)
        return jnp.min(jnp.where(seen.exists, gap, jnp.inf))

    # An earlier orbit is accepted once the motion has approached it in several rounds.
    now = distance_from(known.orbit)
    closer = active & (now < known.distance) & (known.distance < jnp.inf)
    approach = jnp.where(closer, known.approach + 1, 0)
    distance = jnp.where(closer, now, jnp.inf)
    ok = approach >= options.approaches
    # Alternately an orbit of one return and the one that the motion seems to repeat.
    repeated = 1 + jnp.argmax(apart <= 2 * closest + 1e-6)
    period_returns = jnp.where(rounds % 2 == 0, 1, repeated)
    gap = jnp.where(period_returns == 1, apart[0], closest)
    ready = active & (status == RUNNING) & ~closer & ~extrapolates & (gap < options.near * scale)
    # After a failure again, once the returns are closer together or some rounds later; a motion
    # without a period often comes near itself.
    pause = jnp.where(rounds < options.eager, 8, 64)
    ready = ready & ((gap < 0.7 * known.tried) | (rounds % pause < 2))

    def solve():
        first, last = seen.at[period_returns], seen.at[0]
        steps = _segments(run, order)
        return *_candidate(
            system, steps, seen.y[:, 0], first, last, period_returns, h, rtol, length=length
        ), period_returns

    def keep():
        return known.orbit, known.error, jnp.array(False), known.period_returns

    orbit, error, found, orbit_returns = jax.lax.cond(ready, solve, keep)
    orbit, error, orbit_returns = jax.tree.map(
        lambda new, old: jnp.where(found, new, old),
        (orbit, error, orbit_returns),
        (known.orbit, known.error, known.period_returns),
    )
    now = distance_from(orbit)
    # This near, the multipliers decide whether it attracts.
    ok = ok | (found & (now < options.accepted * scale))
    distance = jnp.where(found & ~ok, now, distance)
    late = returns > max_returns / 2
    widest = jnp.where(late, jnp.maximum(known.widest, closest / scale), known.widest)
    over = jnp.where((widest < 0.02) | (smooth & (growth < 0)), EXHAUSTED, NOT_PERIODIC)
    ended = (returns >= max_returns) | (idle > options.patience)
    over = jnp.where(ended, over, RUNNING)
    # A period that the record does not hold is never seen to repeat.
    grows = away[0] > 1.01 * known.size
    calm = jnp.where(idle > 0, known.calm, jnp.where(grows, 0, known.calm + 1))
    short = ~seen.exists[1] & (calm >= options.settling)
    short = short | (ended & ~seen.exists[options.longest // 4])
    too_long = jnp.all(guard != UNUSED) & short
    over = jnp.where(too_long, TOO_LONG, over)
    status = jnp.where(status == RUNNING, jnp.where(ok, CONVERGED, over), status)
    progress = _Progress(
        status=status,
        orbit=orbit,
        period_returns=orbit_returns,
        error=error,
        distance=distance,
        approach=approach,
        widest=widest,
        tried=jnp.where(ready, gap, known.tried),
        returns=returns,
        idle=idle,
        size=jnp.where(idle > 0, known.size, away[0]),
        calm=calm,
    )
    progress = jax.tree.map(lambda new, old: jnp.where(active, new, old), progress, known)
    return y_on, extrapolates, progress


def _find(
    system, start, equilibrium, growth, max_returns, h, rtol, *, length, options
) -> Attractor:
    shape, n = start.shape[1:], len(start)
    s = system.contact_state(start)
    record = max(32 * length, options.record)
    blank = jnp.zeros((n + len(s) + 2, record, *shape), start.dtype).at[-1].set(UNUSED)
    run = _Run(y=start, s=s, guard=jnp.full(shape, NONE), steps=blank)
    none, far = jnp.zeros(shape, int), jnp.full(shape, jnp.inf, start.dtype)
    zero = jnp.zeros(shape, start.dtype)
    empty = Segments(
        y=jnp.zeros((n, length, *shape), start.dtype),
        duration=jnp.zeros((length, *shape), start.dtype),
        s=jnp.ones((len(s), length, *shape), start.dtype),
        guard=jnp.full((length, *shape), UNUSED),
    )
    known = _Progress(
        none + RUNNING, empty, none, zero, far, none, zero, far, zero, none, zero, none
    )
    assess = functools.partial(_assess, options=options, length=length)

    def running(carry):
        return jnp.any(carry[1].status == RUNNING)

    def body(carry):
        run, known, rounds = carry
        # A run that takes long to settle may be near the boundary of two basins.
        finer = sum(rounds >= after for after in options.finer_after)
        h_run = (options.step / 2.0**finer).astype(start.dtype)
        run = _advance(system, run, rounds, h_run, options)
        arguments = system, run, known, equilibrium, growth, max_returns, h, rtol

        def one(arguments):
            system, run, known, *rest = arguments
            return assess(system, run, known, rounds, *rest)

        if shape:
            # Each scene on its own: it has its own number of iterations.
            first = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), arguments)
            y, moved, known = jax.tree.map(
                lambda x: jnp.moveaxis(x, 0, -1), jax.lax.map(one, first)
            )
        else:
            y, moved, known = one(arguments)
        # Steps from before an extrapolation are not of this motion.
        guards = jnp.where(moved[None], UNUSED, run.steps[-1])
        steps = run.steps.at[-1].set(guards)
        return _Run(y, run.s, run.guard, steps), known, rounds + 1

    _, known, _ = jax.lax.while_loop(running, body, (run, known, 0))
    return Attractor(known.orbit, known.status, known.period_returns, known.error, known.returns)


def find(
    system: HybridSystem,
    start,
    equilibrium,
    growth,
    max_returns,
    h,
    rtol,
    length: int,
    options: SearchOptions = SearchOptions(),
) -> Attractor:
    """The attractor of the motion from `start`, its orbit on `length` segments, in scaled units.

    `start` and `equilibrium` are (2n,), and `growth` is the growth rate at the latter; segments
    are no longer than h, or as short as `rtol` needs, where so few suffice. Under `jax.vmap` the
    scenes become the last axis.
    """
    search = functools.partial(_find, length=length, options=options)

    @custom_vmap
    def one(arguments):
        return search(*arguments)

    @one.def_vmap
    def rule(axis_size, in_batched, arguments):
        arguments = jax.tree.map(
            lambda x, batched: (
                jnp.moveaxis(x, 0, -1)
                if batched
                else jnp.broadcast_to(x[..., None], (*x.shape, axis_size))
            ),
            arguments,
            in_batched[0],
        )
        found = search(*arguments)
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), found), jax.tree.map(
            lambda _: True, found
        )

    return one((system, start, equilibrium, growth, max_returns, h, rtol))
