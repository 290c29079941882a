"""Assessment of a coarse run after each round of steps: has it ended, and which orbit is near?

After every round of steps the returns to the section, the maxima of t.x of the first face, are
compared. If the last ones nearly repeat, the steps between them are a candidate orbit.

Components are the first axis of every array and scenes the last, which compiles to faster loops.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .contact_state import OPEN
from .hybrid import HybridSystem
from .record import ENDED, RETURNED, TIME, WEIGHT, Record
from .segments import Segments

RUNNING, CONVERGED, EQUILIBRIUM, DIVERGED, NOT_PERIODIC, EXHAUSTED, TOO_LONG, NOT_FINITE = range(8)


@dataclass(frozen=True)
class SearchOptions:
    """Tolerances and patience of the search for an attractor, in scaled units."""

    step: float = 0.3  # of the coarse run; no eigenfrequency exceeds 1
    round_steps: int = 128  # between two comparisons of the returns
    finer_after: tuple[int, int] = (16, 48)  # rounds after which the step is halved
    round_returns: int = 12  # that count as a round of patience, with many degrees of freedom
    longest: int = 16  # most returns in one period
    near: float = 0.15  # gap between returns below which an orbit is tried, relative
    ends_near: float = 0.06  # distance that single returns still have to go, relative
    own_scale: float = 4.0  # largest scale of gaps, in distances from the equilibrium
    patient: int = 4  # rounds in which single returns must be that near
    accepted: float = 0.03  # distance from the orbit at which its multipliers decide, relative
    reach: float = 0.5  # distance from the run beyond which Newton's method gives up, relative
    group: int = 16  # orbits solved together, of the candidates of many searches
    approaches: int = 3  # rounds in which the motion approaches an orbit that is not yet near
    eager: int = 64  # rounds after which orbits are tried less often
    linear: float = 0.5  # size below which a decay at the linear rate ends in equilibrium
    small: float = 1e-2  # size below which any decay without switches does so
    still: float = 1e-6  # size, or rate of change with an open joint, below which it is at rest
    extrapolated: float = 0.02  # growth per return, without switches, that is extrapolated
    nearly: float = 0.02  # gap below which returns nearly repeat, relative
    settles: float = 0.95  # factor by which gaps shrink in a quarter of a run that settles
    repeats: float = 1e-6  # gap between returns of a motion that has settled, relative
    settling: int = 8  # rounds without growth after which the record must hold two returns
    patience: int = 512  # rounds without a maximum
    record: int = 2048  # least number of steps kept; a period takes fewer


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


class Assessment(eqx.Module):
    """Outcome of a round of steps for B lanes, and the candidate orbits that it suggests."""

    progress: Progress  # if no orbit is solved now
    over: Int[Array, " B"]  # the status in that case
    ok: Bool[Array, " B"]  # the motion approaches the previous orbit
    ready: Bool[Array, " B"]  # lanes whose candidates are to be solved
    gap: Float[Array, " B"]  # between the returns that nearly repeat
    candidates: Candidates
    states: Float[Array, "2n k B"]  # states at the last returns
    exists: Bool[Array, "k B"]
    scale: Float[Array, " B"]
    y: Float[Array, "2n B"]  # from which the run continues
    extrapolates: Bool[Array, " B"]


def _distance(states, exists, orbit: Segments) -> Float[Array, " B"]:
    """Distance of the nearest return from the orbit's first state."""
    gap = jnp.max(jnp.abs(states - orbit.y[:, :1]), axis=0)
    return jnp.min(jnp.where(exists, gap, jnp.inf), axis=0)


def passed(system: HybridSystem, rounds, returns, options: SearchOptions):
    """Number of rounds that count: with many degrees of freedom a return takes many."""
    return rounds if system.fastest is None else returns / options.round_returns


def assess(
    system,
    record: Record,
    previous: Progress,
    orbit: Segments,
    rounds,
    equilibrium,
    bound,
    growth,
    max_returns,
    h,
    rtol,
    *,
    options: SearchOptions,
    length: int,
) -> Assessment:
    """Assess all lanes after a round, before any orbit is solved for."""
    lane = jnp.arange(len(previous.status))
    at, exists = record.returns(options.longest + 1)
    states = record.after(at)
    newest = record.length - options.round_steps  # number of the first new step
    active = previous.status == RUNNING
    tiny = jnp.finfo(states.dtype).tiny
    before = record.past(RETURNED, newest - 1, lane)
    returns = previous.returns - before
    idle = jnp.where(before < 0, 0, previous.idle + 1)

    # --- near the equilibrium ---
    amplitudes = jnp.sqrt(jnp.sum((states - equilibrium[:, None]) ** 2, axis=0))
    size = jnp.sqrt(jnp.sum((record.y - equilibrium) ** 2, axis=0)) + tiny
    # The last three returns without a switch between them.
    smooth = exists[3] & (record.past(ENDED, at[3], lane) == -3)
    log = jnp.log(amplitudes[:3] + tiny)
    rate, rate_before = log[0] - log[1], log[1] - log[2]
    time = record.row(TIME, at[:2], lane[None])
    # An excited motion has no equilibrium.
    steady = smooth & (jnp.abs(rate - rate_before) < 0.1 * jnp.abs(rate)) & (not system.excited)
    linear = steady & (amplitudes[0] < options.linear) & (rate < 0.7 * growth * (time[0] - time[1]))
    decays = linear | (smooth & (amplitudes[0] < options.small) & (rate < 0))
    decays = (growth < 0) & (decays | (size < options.still))
    if any(system.opens):
        # With a joint open there is another equilibrium.
        change = jnp.max(jnp.abs(system.field(record.y, record.s)), axis=0)
        decays = decays | (jnp.any(record.s == OPEN, axis=0) & (change < options.still))
    status = jnp.where(decays, EQUILIBRIUM, RUNNING)
    largest = jnp.max(jnp.abs(record.y), axis=0)
    status = jnp.where(largest > bound, DIVERGED, status)
    status = jnp.where(jnp.isnan(largest), NOT_FINITE, status)
    # Amplitude extrapolation: a slow, steady change without switches skips many returns, but at
    # most half of the change that is left if it slows down geometrically.
    slower = jnp.maximum(jnp.abs(rate_before) - jnp.abs(rate), 1e-300)
    left = jnp.abs(rate * rate_before) / slower
    ahead = jnp.minimum(jnp.minimum(0.25, left / 2), 200 * jnp.abs(rate))
    extrapolates = steady & (jnp.abs(rate) < options.extrapolated) & (status == RUNNING) & active
    factor = jnp.where(extrapolates, jnp.exp(jnp.sign(rate) * ahead), 1)
    y_on = jnp.where(
        extrapolates[None], equilibrium + factor[None] * (record.y - equilibrium), record.y
    )

    # --- near a periodic orbit ---
    scale = 1 + jnp.max(jnp.abs(states[:, 0]), axis=0)
    if not system.excited:
        # A motion much smaller than the preload's displacement must not seem to repeat sooner.
        scale = jnp.minimum(scale, options.own_scale * amplitudes[0])
    gaps = jnp.max(jnp.abs(states[:, 1:] - states[:, :1]), axis=0)
    gaps = jnp.where(exists[1:], gaps, jnp.inf)
    closest = jnp.min(gaps, axis=0)

    # An earlier orbit is accepted once the motion has approached it in several rounds.
    now = _distance(states, exists, orbit)
    closer = active & (now < previous.distance) & (previous.distance < jnp.inf)
    approach = jnp.where(closer, previous.approach + 1, 0)
    distance = jnp.where(closer, now, jnp.inf)
    ok = approach >= options.approaches
    # Alternately an orbit of one return and the one that the motion seems to repeat.
    repeated = 1 + jnp.argmax(gaps <= 2 * closest[None] + 1e-6, axis=0)
    period_returns = jnp.where(rounds % 2 == 0, 1, repeated)
    gap = jnp.where(period_returns == 1, gaps[0], closest)
    ready = active & (status == RUNNING) & ~closer & ~extrapolates & (gap < options.near * scale)
    # Without switches an affine motion has no orbit; nor has another that leaves the equilibrium
    # at the linear rate.
    first = jnp.take_along_axis(at, period_returns[None], axis=0)[0]
    if system.affine and not system.excited:
        ended_in_it = record.past(ENDED, at[0], lane) - record.past(ENDED, first, lane)
        ready = ready & (ended_in_it > period_returns)
    elif not system.excited:
        ready = ready & ~(smooth & (growth > 0) & (rate > 0.5 * growth * (time[0] - time[1])))
    # After a failure, try again once the returns are closer together or some rounds later; an
    # aperiodic motion often comes near itself.
    pause = jnp.where(rounds < options.eager, 8, 64)
    ready = ready & ((gap < 0.7 * previous.tried) | (rounds % pause < 2))
    # At first, wait until returns that approach one another geometrically end near enough.
    before = jnp.max(jnp.abs(states[:, 2] - states[:, 1]), axis=0)
    left = gap**2 / jnp.maximum(before - gap, 1e-300)
    ends_near = (left < options.ends_near * scale) | (gap < options.accepted / 8 * scale)
    if system.fastest is not None:
        ready = ready & exists[3]  # with many degrees of freedom an attempt takes long
    patient = passed(system, rounds, returns, options) >= options.patient
    ready = ready & (ends_near | (period_returns > 1) | patient)

    candidates = Candidates(
        y=states[:, 0],
        first=first,
        last=at[0],
        returns=period_returns,
        h=h,
        rtol=rtol,
    )

    # The widest gaps in the third and the last quarter tell whether it settles.
    quarter = jnp.stack([returns < 0.75 * max_returns, returns >= 0.75 * max_returns])
    wider = jnp.maximum(previous.widest, (closest / scale)[None])
    widest = jnp.where(quarter & (returns > max_returns / 2)[None], wider, previous.widest)
    settles = jnp.max(widest, axis=0) < options.nearly
    settles = settles & ((widest[0] == 0) | (widest[1] < options.settles * widest[0]))
    over = jnp.where(settles | (smooth & (growth < 0)), EXHAUSTED, NOT_PERIODIC)
    # A repeating motion has no orbit if segments of length h, plus one per phase, are too many.
    last = jnp.stack([at[0], jnp.take_along_axis(at, repeated[None], axis=0)[0]])
    weight, phases = (record.past(row, last, lane[None]) for row in (WEIGHT, ENDED))
    cramped = (weight[0] - weight[1]) / h + phases[0] - phases[1] > length
    over = jnp.where(cramped & (closest < options.repeats * scale), TOO_LONG, over)
    ended = (returns >= max_returns) | (idle > options.patience)
    over = jnp.where(ended, over, RUNNING)
    # A period longer than the record is never observed to repeat.
    grows = amplitudes[0] > 1.01 * previous.size
    calm = jnp.where(idle > 0, previous.calm, jnp.where(grows, 0, previous.calm + 1))
    short = ~exists[1] & (calm >= options.settling)
    short = short | (ended & ~exists[options.longest // 4])
    too_long = (record.count == record.length) & short
    over = jnp.where(too_long, TOO_LONG, over)
    progress = Progress(
        status=status,
        period_returns=period_returns,
        distance=distance,
        approach=approach,
        widest=widest,
        tried=jnp.where(ready, gap, previous.tried),
        returns=returns,
        idle=idle,
        size=jnp.where(idle > 0, previous.size, amplitudes[0]),
        calm=calm,
    )
    return Assessment(
        progress=progress,
        over=over,
        ok=ok,
        ready=ready,
        gap=gap,
        candidates=candidates,
        states=states,
        exists=exists,
        scale=scale,
        y=y_on,
        extrapolates=extrapolates,
    )


def concluded(
    assessment: Assessment, previous: Progress, orbit: Segments, has_new_orbit, accepted
) -> Progress:
    """Progress of all lanes after the round; `has_new_orbit` marks running lanes with a new one."""
    now = _distance(assessment.states, assessment.exists, orbit)
    # At this distance the multipliers decide whether the orbit attracts.
    ok = assessment.ok | (has_new_orbit & (now < accepted * assessment.scale))
    new = assessment.progress
    status = jnp.where(new.status == RUNNING, jnp.where(ok, CONVERGED, assessment.over), new.status)
    returns = jnp.where(has_new_orbit, new.period_returns, previous.period_returns)
    distance = jnp.where(has_new_orbit & ~ok, now, new.distance)
    new = eqx.tree_at(
        lambda x: (x.status, x.period_returns, x.distance), new, (status, returns, distance)
    )
    active = previous.status == RUNNING
    return jax.tree.map(lambda new, old: jnp.where(active, new, old), new, previous)
