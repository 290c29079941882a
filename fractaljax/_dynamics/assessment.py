"""Assessment of a coarse run after each round of steps: has it ended, and which orbit is near?

After every round of steps the returns to the section, the maxima of t.x of the first face, are
compared. Three rules follow from them: `near_equilibrium`, `near_orbit` and `patience`.

Components are the first axis of every array and scenes the last, which compiles to faster loops.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .contact_state import OPEN
from .cycle_search import CycleSearch
from .hybrid import HybridSystem
from .record import ENDED, RETURNED, TIME, WEIGHT, Record
from .segments import Segments
from .status import Status


class Problem(eqx.Module):
    """What is searched in B lanes, in scaled units."""

    system: HybridSystem
    equilibrium: Float[Array, "2n B"]
    growth: Float[Array, " B"]  # growth rate there
    bound: Float[Array, " B"]  # largest component of a state, beyond which the motion diverges
    max_returns: Float[Array, " B"]  # after which the search gives up
    h: Float[Array, " B"]  # longest segment of an orbit
    rtol: Float[Array, " B"]  # relative tolerance of an orbit
    length: int = eqx.field(static=True)  # most segments of an orbit
    search: CycleSearch = eqx.field(static=True)


class Candidates(eqx.Module):
    """Stretches of the runs of g lanes from which periodic orbits are solved for."""

    y: Float[Array, "2n g"]  # state at their end
    first: Int[Array, " g"]  # the step before them
    last: Int[Array, " g"]
    returns: Int[Array, " g"]  # of one period
    h: Float[Array, " g"]
    rtol: Float[Array, " g"]


class Progress(eqx.Module):
    """State of the search in B lanes, besides their records and their orbits."""

    status: Int[Array, " B"]
    period_returns: Int[Array, " B"]
    distance: Float[Array, " B"]  # of the run from the orbit
    approach: Int[Array, " B"]  # rounds in which it fell
    widest: Float[Array, "2 B"]  # gap between returns, in the last two quarters of the run
    tried: Float[Array, " B"]  # gap at the last attempt
    returns: Float[Array, " B"]
    idle: Int[Array, " B"]  # rounds without a return
    size: Float[Array, " B"]  # distance from the equilibrium at the last return
    calm: Int[Array, " B"]  # rounds with a return in which it did not grow


class Returns(eqx.Module):
    """The last k returns to the section in B lanes, newest first, as a round has left them."""

    record: Record
    lane: Int[Array, " B"]  # numbers of the lanes
    rounds: Int[Array, ""]  # before this one
    at: Int[Array, "k B"]  # steps that ended in the returns
    exists: Bool[Array, "k B"]
    states: Float[Array, "2n k B"]
    running: Bool[Array, " B"]  # lanes whose search goes on
    count: Float[Array, " B"]  # returns of the whole run
    idle: Int[Array, " B"]  # rounds since the last one
    amplitudes: Float[Array, "k B"]  # distances from the equilibrium at the returns
    size: Float[Array, " B"]  # distance from the equilibrium at the end of the round
    smooth: Bool[Array, " B"]  # True without a switch within the last three returns
    rate: Float[Array, " B"]  # growth of ln of the amplitude up to the last return
    rate_before: Float[Array, " B"]  # and up to the one before
    times: Float[Array, "2 B"]  # of the last two

    @classmethod
    def from_record(cls, record: Record, rounds, previous: Progress, problem: Problem) -> "Returns":
        """The returns that a record holds after a round of steps."""
        search, equilibrium = problem.search, problem.equilibrium
        lane = jnp.arange(len(previous.status))
        at, exists = record.returns(search.longest_period + 1)
        states = record.after(at)
        newest = record.length - search.round_steps  # number of the first new step
        running = previous.status == Status.RUNNING
        tiny = jnp.finfo(states.dtype).tiny
        before = record.past(RETURNED, newest - 1, lane)
        count = previous.returns - before
        idle = jnp.where(before < 0, 0, previous.idle + 1)
        amplitudes = jnp.sqrt(jnp.sum((states - equilibrium[:, None]) ** 2, axis=0))
        size = jnp.sqrt(jnp.sum((record.y - equilibrium) ** 2, axis=0)) + tiny
        smooth = exists[3] & (record.past(ENDED, at[3], lane) == -3)
        log = jnp.log(amplitudes[:3] + tiny)
        rate, rate_before = log[0] - log[1], log[1] - log[2]
        times = record.row(TIME, at[:2], lane[None])
        return cls(
            record=record,
            lane=lane,
            rounds=rounds,
            at=at,
            exists=exists,
            states=states,
            running=running,
            count=count,
            idle=idle,
            amplitudes=amplitudes,
            size=size,
            smooth=smooth,
            rate=rate,
            rate_before=rate_before,
            times=times,
        )

    def distance(self, orbit: Segments) -> Float[Array, " B"]:
        """Distance of the nearest return from the orbit's first state."""
        gap = jnp.max(jnp.abs(self.states - orbit.y[:, :1]), axis=0)
        return jnp.min(jnp.where(self.exists, gap, jnp.inf), axis=0)


class NearEquilibrium(eqx.Module):
    """What `near_equilibrium` concludes for B lanes."""

    status: Int[Array, " B"]  # running, or how the motion has ended
    extrapolates: Bool[Array, " B"]
    y: Float[Array, "2n B"]  # from which the run continues


class NearOrbit(eqx.Module):
    """What `near_orbit` concludes for B lanes."""

    scale: Float[Array, " B"]  # to which distances between returns are relative
    closest: Float[Array, " B"]  # least distance of an earlier return from the last one
    repeated: Int[Array, " B"]  # number of the first return about as near as that
    period_returns: Int[Array, " B"]  # of the candidate
    gap: Float[Array, " B"]  # distance of its ends
    first: Int[Array, " B"]  # step before it
    ready: Bool[Array, " B"]  # lanes whose candidate is to be solved
    distance: Float[Array, " B"]  # from the previous orbit, infinite unless that fell
    approach: Int[Array, " B"]  # rounds in which it fell
    ok: Bool[Array, " B"]  # True where that is enough to accept the previous orbit


class Patience(eqx.Module):
    """What `patience` concludes for B lanes."""

    over: Int[Array, " B"]  # running, or the outcome with which the search gives up
    widest: Float[Array, "2 B"]
    calm: Int[Array, " B"]


class Assessment(eqx.Module):
    """Outcome of a round of steps for B lanes, and the candidate orbits that it suggests."""

    progress: Progress  # if no orbit is solved now
    over: Int[Array, " B"]  # the status in that case
    returns: Returns
    near: NearOrbit
    candidates: Candidates
    rest: NearEquilibrium


def count_rounds(problem: Problem, rounds, returns):
    """Number of rounds that count: with many degrees of freedom a return takes many."""
    if problem.system.fastest is None:
        return rounds
    return returns / problem.search.round_returns


def near_equilibrium(problem: Problem, returns: Returns) -> NearEquilibrium:
    """Decide which motions have ended without an orbit, and where a slow one continues.

    A motion dies out only where the equilibrium attracts: near one that repels, a motion that
    starts at rest is small, but grows. It dies out once it is at rest, or decays without a switch
    close to the equilibrium, or decays further out at a steady rate of at least 0.7 of the linear
    one, which a slow approach to an orbit does not reach. With a joint open there is another
    equilibrium, at which nothing changes. A motion diverges beyond the bound of the problem.

    A slow, steady change without switches would take many returns. It is extrapolated along the
    line through the equilibrium, but by at most half of the change that is left if it slows down
    geometrically, so that an orbit at its end is not passed.
    """
    system, search, record = problem.system, problem.search, returns.record
    rate, rate_before, growth = returns.rate, returns.rate_before, problem.growth
    # An excited motion has no equilibrium.
    is_steady = jnp.abs(rate - rate_before) < 0.1 * jnp.abs(rate)
    steady = returns.smooth & is_steady & (not system.excited)
    linear = steady & (returns.amplitudes[0] < search.linear_size)
    linear = linear & (rate < 0.7 * growth * (returns.times[0] - returns.times[1]))
    small = returns.smooth & (returns.amplitudes[0] < search.small_size)
    decays = linear | (small & (rate < 0))
    decays = (growth < 0) & (decays | (returns.size < search.rest_size))
    if any(system.opens):
        change = jnp.max(jnp.abs(system.field(record.y, record.s)), axis=0)
        decays = decays | (jnp.any(record.s == OPEN, axis=0) & (change < search.rest_size))
    status = jnp.where(decays, Status.EQUILIBRIUM, Status.RUNNING)
    largest = jnp.max(jnp.abs(record.y), axis=0)
    status = jnp.where(largest > problem.bound, Status.DIVERGED, status)
    status = jnp.where(jnp.isnan(largest), Status.NOT_FINITE, status)

    slower = jnp.maximum(jnp.abs(rate_before) - jnp.abs(rate), 1e-300)
    left = jnp.abs(rate * rate_before) / slower
    # A quarter of the amplitude, or what 200 returns would do, is the most.
    ahead = jnp.minimum(jnp.minimum(0.25, left / 2), 200 * jnp.abs(rate))
    extrapolates = steady & (jnp.abs(rate) < 0.02) & (status == Status.RUNNING) & returns.running
    factor = jnp.where(extrapolates, jnp.exp(jnp.sign(rate) * ahead), 1)
    y = jnp.where(
        extrapolates[None],
        problem.equilibrium + factor[None] * (record.y - problem.equilibrium),
        record.y,
    )
    return NearEquilibrium(status, extrapolates, y)


def near_orbit(
    problem: Problem, returns: Returns, previous: Progress, orbit: Segments, rest: NearEquilibrium
) -> NearOrbit:
    """Find which returns nearly repeat, and decide where their orbit is to be solved for.

    A candidate has one return, or, in every other round, as many as the motion seems to repeat
    after. It is ready where its ends are near each other, unless the motion already approaches an
    orbit that was solved for earlier, is extrapolated, or passes no switch that could make it
    periodic. After a failure it is ready again once its ends are closer together, or some rounds
    later, as an aperiodic motion often comes near itself. At first, returns that approach one
    another geometrically also have to end near enough: an orbit that is solved for too early
    often repels.
    """
    system, search = problem.system, problem.search
    states, exists, rounds = returns.states, returns.exists, returns.rounds
    scale = 1 + jnp.max(jnp.abs(states[:, 0]), axis=0)
    if not system.excited:
        # A motion much smaller than the preload's displacement must not seem to repeat sooner.
        scale = jnp.minimum(scale, 4.0 * returns.amplitudes[0])
    gaps = jnp.max(jnp.abs(states[:, 1:] - states[:, :1]), axis=0)
    gaps = jnp.where(exists[1:], gaps, jnp.inf)
    closest = jnp.min(gaps, axis=0)

    now = returns.distance(orbit)
    closer = returns.running & (now < previous.distance) & (previous.distance < jnp.inf)
    approach = jnp.where(closer, previous.approach + 1, 0)
    distance = jnp.where(closer, now, jnp.inf)
    ok = approach >= search.approaches

    repeated = 1 + jnp.argmax(gaps <= 2 * closest[None] + 1e-6, axis=0)
    period_returns = jnp.where(rounds % 2 == 0, 1, repeated)
    gap = jnp.where(period_returns == 1, gaps[0], closest)
    ready = returns.running & (rest.status == Status.RUNNING) & ~closer & ~rest.extrapolates
    ready = ready & (gap < search.near * scale)
    first = jnp.take_along_axis(returns.at, period_returns[None], axis=0)[0]
    ready = _without_linear_motion(problem, returns, first, period_returns, ready)
    pause = jnp.where(rounds < 64, 8, 64)
    ready = ready & ((gap < 0.7 * previous.tried) | (rounds % pause < 2))
    before = jnp.max(jnp.abs(states[:, 2] - states[:, 1]), axis=0)
    left = gap**2 / jnp.maximum(before - gap, 1e-300)
    ends_near = left < search.single_near * scale
    ends_near = ends_near | (gap < search.accepted / 8 * scale)
    if system.fastest is not None:
        ready = ready & exists[3]  # with many degrees of freedom an attempt takes long
    late = count_rounds(problem, rounds, returns.count) >= search.single_after
    ready = ready & (ends_near | (period_returns > 1) | late)
    return NearOrbit(
        scale=scale,
        closest=closest,
        repeated=repeated,
        period_returns=period_returns,
        gap=gap,
        first=first,
        ready=ready,
        distance=distance,
        approach=approach,
        ok=ok,
    )


def _without_linear_motion(problem: Problem, returns: Returns, first, period_returns, ready):
    """`ready` without the lanes whose motion since step `first` follows a linear field.

    Without switches an affine motion has no orbit; nor has another that leaves the equilibrium at
    the linear rate.
    """
    record, system = returns.record, problem.system
    if system.excited:
        return ready
    if system.affine:
        lane = returns.lane
        switches = record.past(ENDED, returns.at[0], lane) - record.past(ENDED, first, lane)
        return ready & (switches > period_returns)
    leaves = returns.smooth & (problem.growth > 0)
    leaves = leaves & (returns.rate > 0.5 * problem.growth * (returns.times[0] - returns.times[1]))
    return ready & ~leaves


def patience(problem: Problem, returns: Returns, previous: Progress, near: NearOrbit) -> Patience:
    """Decide where the search gives up, and with which outcome.

    It ends after `max_returns`, or after many rounds without a return. The motion is then
    `exhausted` if it was still settling: its widest gaps were small, and smaller in the last
    quarter of the returns than in the third, or it decays to the equilibrium without a switch.
    Otherwise it is `not_periodic`. It is `too_long` if it repeats, but takes more segments than an
    orbit may have. The search ends at once, as `too_long`, where a motion that no longer grows has
    less than two returns in a full record: its period would never be seen to repeat.
    """
    search, record = problem.search, returns.record
    count, idle, max_returns = returns.count, returns.idle, problem.max_returns
    quarter = jnp.stack([count < 0.75 * max_returns, count >= 0.75 * max_returns])
    wider = jnp.maximum(previous.widest, (near.closest / near.scale)[None])
    widest = jnp.where(quarter & (count > max_returns / 2)[None], wider, previous.widest)
    settles = jnp.max(widest, axis=0) < search.nearly_repeats
    settles = settles & ((widest[0] == 0) | (widest[1] < 0.95 * widest[0]))
    dies_out = returns.smooth & (problem.growth < 0)
    over = jnp.where(settles | dies_out, Status.EXHAUSTED, Status.NOT_PERIODIC)

    # Segments of length h, plus one per phase.
    at = returns.at
    ends = jnp.stack([at[0], jnp.take_along_axis(at, near.repeated[None], axis=0)[0]])
    weight, phases = (record.past(row, ends, returns.lane[None]) for row in (WEIGHT, ENDED))
    cramped = (weight[0] - weight[1]) / problem.h + phases[0] - phases[1] > problem.length
    over = jnp.where(cramped & (near.closest < search.repeats * near.scale), Status.TOO_LONG, over)
    ended = (count >= max_returns) | (idle > search.idle_rounds)
    over = jnp.where(ended, over, Status.RUNNING)

    grows = returns.amplitudes[0] > 1.01 * previous.size
    calm = jnp.where(idle > 0, previous.calm, jnp.where(grows, 0, previous.calm + 1))
    short = ~returns.exists[1] & (calm >= 8)
    short = short | (ended & ~returns.exists[search.longest_period // 4])
    too_long = (record.count == record.length) & short
    return Patience(jnp.where(too_long, Status.TOO_LONG, over), widest, calm)


def assess(
    problem: Problem, record: Record, previous: Progress, orbit: Segments, rounds
) -> Assessment:
    """Assess all lanes after a round, before any orbit is solved for."""
    returns = Returns.from_record(record, rounds, previous, problem)
    rest = near_equilibrium(problem, returns)
    near = near_orbit(problem, returns, previous, orbit, rest)
    candidates = Candidates(
        y=returns.states[:, 0],
        first=near.first,
        last=returns.at[0],
        returns=near.period_returns,
        h=problem.h,
        rtol=problem.rtol,
    )
    giving_up = patience(problem, returns, previous, near)
    progress = Progress(
        status=rest.status,
        period_returns=near.period_returns,
        distance=near.distance,
        approach=near.approach,
        widest=giving_up.widest,
        tried=jnp.where(near.ready, near.gap, previous.tried),
        returns=returns.count,
        idle=returns.idle,
        size=jnp.where(returns.idle > 0, previous.size, returns.amplitudes[0]),
        calm=giving_up.calm,
    )
    return Assessment(progress, giving_up.over, returns, near, candidates, rest)


def conclude_round(
    assessment: Assessment, previous: Progress, orbit: Segments, has_new_orbit, accepted: float
) -> Progress:
    """Progress of all lanes after the round; `has_new_orbit` marks running lanes with a new one."""
    near, new = assessment.near, assessment.progress
    now = assessment.returns.distance(orbit)
    # At this distance the multipliers decide whether the orbit attracts.
    ok = near.ok | (has_new_orbit & (now < accepted * near.scale))
    status = jnp.where(
        new.status == Status.RUNNING, jnp.where(ok, Status.CONVERGED, assessment.over), new.status
    )
    returns = jnp.where(has_new_orbit, new.period_returns, previous.period_returns)
    distance = jnp.where(has_new_orbit & ~ok, now, new.distance)
    new = eqx.tree_at(
        lambda x: (x.status, x.period_returns, x.distance), new, (status, returns, distance)
    )
    active = previous.status == Status.RUNNING
    return jax.tree.map(lambda new, old: jnp.where(active, new, old), new, previous)
