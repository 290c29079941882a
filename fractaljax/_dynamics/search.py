"""From a start to its attractor: a coarse run, then a periodic orbit near where it repeats.

The run keeps its last steps. After every round of them it is assessed. A candidate orbit, where its
returns nearly repeat, is made periodic by Newton's method, and is accepted if it is admissible
(keeps to its itinerary), is near the run, and attracts.

Components are the first axis of every array and scenes the last, which compiles to faster loops.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from .acceptance import admissible, growth_of, has_shorter_period
from .assessment import Candidates, Problem, Progress, assess, conclude_round, count_rounds
from .cycle_search import CycleSearch
from .guard import UNUSED
from .hybrid import HybridSystem
from .knots import crossings, with_nodes
from .lanes import chosen
from .orbit import PeriodicOrbit, solve_periodic_orbits
from .record import Record, Steps, Stretch, cut
from .segments import Segments
from .status import Status


class Attractor(eqx.Module):
    """What the run ended in; scenes, if there are many, are the last axis."""

    segments: Segments
    status: Int[Array, "..."]
    period_returns: Int[Array, "..."]  # in one period
    error: Float[Array, "..."]  # of the periodic orbit, relative
    growth: Float[Array, "..."]  # ln of its largest multiplier
    returns: Float[Array, "..."]  # of the run


def _no_segments(y, faces: int, length: int) -> Segments:
    """Unused segments, for orbits in the lanes of states y (2n, B)."""
    shape = (length, y.shape[1])
    return Segments(
        y=jnp.zeros((len(y), *shape), y.dtype),
        duration=jnp.zeros(shape, y.dtype),
        s=jnp.ones((faces, *shape), y.dtype),
        guard=jnp.full(shape, UNUSED),
    )


def _solve_candidates(
    system, record, lane, active, candidates: Candidates, *, length, search: CycleSearch
):
    """The orbits near the steps of lanes (g,): segments, error and growth, and if accepted.

    An orbit of a shorter period is not: the same segments resolve that period better alone.
    """
    scale = 1 + jnp.max(jnp.abs(candidates.y), axis=0)

    def unsettled(orbits):
        return orbits.converged & ~(orbits.error <= candidates.rtol)

    def going(carry):
        orbits, _, tries = carry
        return (tries == 0) | ((tries < search.meshes) & jnp.any(unsettled(orbits)))

    def mesh(orbit, h, of_run):
        # The orbit's phases have other lengths and weights than those of the run.
        steps = Stretch(record, lane, Steps.along(system, orbit, h), of_run)
        first = jnp.where(of_run, candidates.first, 0)
        last = jnp.where(of_run, candidates.last, jnp.sum(orbit.used, axis=0))
        if system.knots is None:
            return cut(system, steps, first, last, h, length)

        def with_room(_, segments):
            room = jnp.minimum(crossings(system, segments), length // 2)
            return cut(system, steps, first, last, h, length, reserved=room)

        # Where knots are passed is seen on a first mesh.
        none = _no_segments(candidates.y, len(record.s), length)
        return with_nodes(system, jax.lax.fori_loop(0, 2, with_room, none))

    def solve(carry):
        orbits, h, tries = carry
        of_run = tries == 0
        segments = mesh(orbits.segments, h, of_run)
        pending = active & (of_run | unsettled(orbits))
        new = solve_periodic_orbits(
            system, segments, pending, search.reach * scale, candidates.rtol
        )
        # The method is of order 8; where the motion is less smooth, halving is enough.
        has_error = new.error > 0  # False for NaN
        finer = 0.9 * (candidates.rtol / jnp.where(has_error, new.error, 1)) ** 0.125
        finer = jnp.where(has_error, finer, 0.8)
        return new.where(pending, orbits), h * jnp.clip(finer, 0.5, 0.8), tries + 1

    no_orbits = PeriodicOrbit.none(_no_segments(candidates.y, len(record.s), length))
    orbits, *_ = jax.lax.while_loop(going, solve, (no_orbits, candidates.h, 0))
    orbit, n = orbits.segments, system.n
    near = jnp.max(jnp.abs(orbit.y[:, 0] - candidates.y), axis=0) < 0.2 * scale
    moves = jnp.max(jnp.abs(orbit.y[n:]), axis=(0, 1)) > 1e-4
    growth = growth_of(system, orbits)
    ok = active & orbits.converged & near & moves & (growth < search.repelling)
    ok = ok & admissible(system, orbit, orbits.middle)
    ok = ok & ~has_shorter_period(orbit, candidates.returns)
    return orbit, jnp.stack([orbits.error, growth]), ok


def _solve_in_groups(problem: Problem, record, ready, gap, candidates, orbit, error):
    """The orbits of all lanes, new where accepted; lanes that are ready are solved in groups."""
    system, lanes = problem.system, len(ready)
    size = min(lanes, problem.search.group)

    def solve_lanes(lane, active, candidates):
        # The systems of several lanes, each for all of its segments.
        batched = system.omega.ndim > 0
        lane_system = jax.tree.map(lambda x: x[..., None, lane], system) if batched else system
        options = {"length": problem.length, "search": problem.search}
        return _solve_candidates(lane_system, record, lane, active, candidates, **options)

    if size == lanes:
        *new, ok = solve_lanes(jnp.arange(lanes), ready, candidates)
        return *chosen(ok, tuple(new), (orbit, error)), ok

    # Similar lanes together, so that few wait for others.
    order = jnp.argsort(jnp.where(ready, gap, jnp.inf))
    order = jnp.pad(order, (0, -lanes % size), constant_values=lanes)

    def going(carry):
        return carry[-1] < jnp.sum(ready)

    def solve(carry):
        orbit, error, accepted, start = carry
        lane = jax.lax.dynamic_slice(order, (start,), (size,))
        members = jnp.minimum(lane, lanes - 1)
        active = ready[members] & (lane < lanes)
        *new, ok = solve_lanes(members, active, jax.tree.map(lambda x: x[..., members], candidates))
        lane = jnp.where(ok, lane, lanes)  # beyond the last one nothing is written

        def written(new, old):
            return old.at[..., lane].set(new, mode="drop")

        orbit, error = jax.tree.map(written, tuple(new), (orbit, error))
        return orbit, error, accepted.at[lane].set(True, mode="drop"), start + size

    carry = orbit, error, jnp.zeros(lanes, bool), 0
    return jax.lax.while_loop(going, solve, carry)[:3]


def _kept_steps(length: int, search: CycleSearch) -> int:
    """Number of steps that the record of a run keeps: whole rounds, and more than one of them.

    A segment is about a step long, and a run may take long to come near its orbit.
    """
    rounds = -(-max(32 * length, search.kept_steps) // search.round_steps)
    return max(rounds, 2) * search.round_steps


def _search_lanes(
    system, start, equilibrium, growth, max_returns, h, rtol, *, length: int, search: CycleSearch
) -> Attractor:
    lanes = start.shape[1]
    record = Record.begin(system, start, _kept_steps(length, search))
    bound = system.bound(start, equilibrium)
    problem = Problem(
        system, equilibrium, growth, bound, max_returns, h, rtol, length=length, search=search
    )
    none, far = jnp.zeros(lanes, int), jnp.full(lanes, jnp.inf, start.dtype)
    zero = jnp.zeros(lanes, start.dtype)
    progress = Progress(
        status=none + Status.RUNNING,
        period_returns=none,
        distance=far,
        approach=none,
        widest=jnp.stack([zero, zero]),
        tried=far,
        returns=zero,
        idle=none,
        size=zero,
        calm=none,
    )

    orbit, error = _no_segments(start, len(record.s), length), jnp.stack([zero, zero])

    def running(carry):
        return jnp.any(carry[1].status == Status.RUNNING)

    def body(carry):
        record, progress, orbit, error, rounds = carry
        # A run that takes long to settle may be near the boundary of two basins.
        counted = count_rounds(problem, rounds, jnp.max(progress.returns))
        halve_after = search.finer_after, 3 * search.finer_after
        halvings: Any = sum(counted >= after for after in halve_after)
        h_run = (search.step / 2.0**halvings).astype(start.dtype)
        record = record.advance(system, h_run, search.round_steps)
        assessment = assess(problem, record, progress, orbit, rounds)
        near, rest = assessment.near, assessment.rest

        def solve_ready():
            candidates = assessment.candidates
            return _solve_in_groups(problem, record, near.ready, near.gap, candidates, orbit, error)

        # XLA moves loop-invariant work out of a loop, where it is done even if the loop is not.
        none = orbit, error, jnp.zeros_like(near.ready)
        orbit, error, accepted = jax.lax.cond(jnp.any(near.ready), solve_ready, lambda: none)
        progress = conclude_round(assessment, progress, orbit, accepted, search.accepted)
        return record.continue_from(rest.y, rest.extrapolates), progress, orbit, error, rounds + 1

    _, progress, orbit, error, _ = jax.lax.while_loop(
        running, body, (record, progress, orbit, error, 0)
    )
    error, growth = error
    return Attractor(
        orbit, progress.status, progress.period_returns, error, growth, progress.returns
    )


def find_attractor(
    system: HybridSystem,
    start,
    equilibrium,
    growth,
    max_returns,
    h,
    rtol,
    length: int,
    search: CycleSearch,
) -> Attractor:
    """The attractor of the motion from `start`, its orbit on `length` segments, in scaled units.

    `start` and `equilibrium` are (2n,), and `growth` is the growth rate at the latter; segments
    are no longer than h, or as short as `rtol` needs, where so few suffice. Under `jax.vmap` the
    scenes become the last axis.
    """
    search_lanes = functools.partial(_search_lanes, length=length, search=search)

    def lanes_first(attractors):
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), attractors)

    @custom_vmap
    def one(arguments):
        system, *rest = arguments
        attractor = search_lanes(system, *(x[..., None] for x in rest))
        return jax.tree.map(lambda x: x[0], lanes_first(attractor))

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
        attractors = lanes_first(search_lanes(*arguments))
        return attractors, jax.tree.map(lambda _: True, attractors)

    return one((system, start, equilibrium, growth, max_returns, h, rtol))
