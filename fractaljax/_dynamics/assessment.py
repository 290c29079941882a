"""What a round of a coarse run tells: whether it has ended, and near which orbit it may be.

After every round of steps the returns to the section, the maxima of t.x of the first face, are
compared. If the last ones nearly repeat, the steps between them are a candidate orbit.

Components are the first axis of every array and scenes the last, which compiles to faster loops.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .hybrid import OPEN, HybridSystem
from .record import ENDED, RETURNED, TIME, WEIGHT, Record
from .segments import Segments

RUNNING, CONVERGED, EQUILIBRIUM, DIVERGED, NOT_PERIODIC, EXHAUSTED, TOO_LONG, NOT_FINITE = range(8)


@dataclass(frozen=True)
class SearchOptions:
    """Tolerances and patience of the search for an attractor, in scaled units."""

    step: float = 0.3  # of the coarse run; no eigenfrequency exceeds 1
    round_steps: int = 128  # between two looks at the returns
    finer_after: tuple[int, int] = (16, 48)  # rounds after which the step is halved
    round_returns: int = 12  # of many degrees of freedom, that count as a round of patience
    longest: int = 16  # most returns in one period
    near: float = 0.15  # gap between returns below which an orbit is tried, relative
    ends_near: float = 0.06  # distance that single returns have left, relative
    own_scale: float = 4.0  # most that gaps are relative to, in distances from the equilibrium
    patient: int = 4  # rounds in which that is asked of them
    accepted: float = 0.03  # distance from the orbit at which its multipliers decide, relative
    reach: float = 0.5  # distance from the run beyond which Newton's method gives up, relative
    group: int = 16  # orbits that are solved together, of those that many searches have at a time
    approaches: int = 3  # rounds in which the motion approaches an orbit that is not yet near
    eager: int = 64  # rounds after which orbits are tried less often
    linear: float = 0.5  # size below which a decay at the linear rate ends in equilibrium
    small: float = 1e-2  # size below which any decay without switches does
    still: float = 1e-6  # size, or with a joint open rate of change, below which it is at rest
    extrapolated: float = 0.02  # growth in a return, without switches, that is extrapolated
    nearly: float = 0.02  # gap below which returns nearly repeat, relative
    settles: float = 0.95  # factor by which gaps shrink in a quarter of a run that does
    repeats: float = 1e-6  # gap between returns of a motion that has settled, relative
    settling: int = 8  # rounds without growth after which the record must hold two returns
    patience: int = 512  # rounds without a maximum
    record: int = 2048  # steps that are kept, at least; a period takes fewer


class Candidates(eqx.Module):
    """Steps of g lanes whose orbits are solved for, and what is found."""

    y: Float[Array, "2n g"]  # state after them
    first: Int[Array, " g"]  # the step before them
    last: Int[Array, " g"]
    returns: Int[Array, " g"]  # of one period
    h: Float[Array, " g"]
    rtol: Float[Array, " g"]


class Progress(eqx.Module):
    """What the search knows of B lanes besides their record and the orbits that were found."""

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
    """What a round of steps tells of B lanes, and the orbits that it suggests."""

    progress: Progress  # if no orbit is found now
    over: Int[Array, " B"]  # the status then
    ok: Bool[Array, " B"]  # the motion approaches the orbit found before
    ready: Bool[Array, " B"]  # to be solved
    gap: Float[Array, " B"]  # between the returns that nearly repeat
    given: Candidates
    seen: Float[Array, "2n k B"]  # states at the last returns
    exists: Bool[Array, "k B"]
    scale: Float[Array, " B"]
    y: Float[Array, "2n B"]  # where the run goes on
    extrapolates: Bool[Array, " B"]


def _distance(seen, exists, orbit: Segments) -> Float[Array, " B"]:
    """How far the nearest return is from the orbit's first state."""
    gap = jnp.max(jnp.abs(seen - orbit.y[:, :1]), axis=0)
    return jnp.min(jnp.where(exists, gap, jnp.inf), axis=0)


def passed(system: HybridSystem, rounds, returns, options: SearchOptions):
    """The rounds that count: of many degrees of freedom a return takes many."""
    return rounds if system.fastest is None else returns / options.round_returns


def assess(
    system,
    record: Record,
    known: Progress,
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
    """All lanes after a round, before any orbit is solved for."""
    lane = jnp.arange(len(known.status))
    at, exists = record.returns(options.longest + 1)
    seen = record.after(at)
    newest = record.length - options.round_steps  # number of the first new step
    active = known.status == RUNNING
    tiny = jnp.finfo(seen.dtype).tiny
    before = record.past(RETURNED, newest - 1, lane)
    returns = known.returns - before
    idle = jnp.where(before < 0, 0, known.idle + 1)

    # --- near the equilibrium ---
    away = jnp.sqrt(jnp.sum((seen - equilibrium[:, None]) ** 2, axis=0))
    size = jnp.sqrt(jnp.sum((record.y - equilibrium) ** 2, axis=0)) + tiny
    # The last three returns without a switch between them.
    smooth = exists[3] & (record.past(ENDED, at[3], lane) == -3)
    log = jnp.log(away[:3] + tiny)
    rate, rate_before = log[0] - log[1], log[1] - log[2]
    time = record.row(TIME, at[:2], lane[None])
    # An excited motion has no equilibrium.
    steady = smooth & (jnp.abs(rate - rate_before) < 0.1 * jnp.abs(rate)) & (not system.excited)
    linear = steady & (away[0] < options.linear) & (rate < 0.7 * growth * (time[0] - time[1]))
    decays = linear | (smooth & (away[0] < options.small) & (rate < 0))
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
    scale = 1 + jnp.max(jnp.abs(seen[:, 0]), axis=0)
    if not system.excited:
        # A motion that is much smaller than the preload's displacement repeats no sooner.
        scale = jnp.minimum(scale, options.own_scale * away[0])
    apart = jnp.max(jnp.abs(seen[:, 1:] - seen[:, :1]), axis=0)
    apart = jnp.where(exists[1:], apart, jnp.inf)
    closest = jnp.min(apart, axis=0)

    # An earlier orbit is accepted once the motion has approached it in several rounds.
    now = _distance(seen, exists, orbit)
    closer = active & (now < known.distance) & (known.distance < jnp.inf)
    approach = jnp.where(closer, known.approach + 1, 0)
    distance = jnp.where(closer, now, jnp.inf)
    ok = approach >= options.approaches
    # Alternately an orbit of one return and the one that the motion seems to repeat.
    repeated = 1 + jnp.argmax(apart <= 2 * closest[None] + 1e-6, axis=0)
    period_returns = jnp.where(rounds % 2 == 0, 1, repeated)
    gap = jnp.where(period_returns == 1, apart[0], closest)
    ready = active & (status == RUNNING) & ~closer & ~extrapolates & (gap < options.near * scale)
    # Without switches an affine motion has no orbit; nor has another that leaves the equilibrium
    # at the linear rate.
    first = jnp.take_along_axis(at, period_returns[None], axis=0)[0]
    if system.affine and not system.excited:
        ended_in_it = record.past(ENDED, at[0], lane) - record.past(ENDED, first, lane)
        ready = ready & (ended_in_it > period_returns)
    elif not system.excited:
        ready = ready & ~(smooth & (growth > 0) & (rate > 0.5 * growth * (time[0] - time[1])))
    # After a failure again, once the returns are closer together or some rounds later; a motion
    # without a period often comes near itself.
    pause = jnp.where(rounds < options.eager, 8, 64)
    ready = ready & ((gap < 0.7 * known.tried) | (rounds % pause < 2))
    # At first not before returns that approach one another geometrically end near enough.
    before = jnp.max(jnp.abs(seen[:, 2] - seen[:, 1]), axis=0)
    left = gap**2 / jnp.maximum(before - gap, 1e-300)
    ends_near = (left < options.ends_near * scale) | (gap < options.accepted / 8 * scale)
    if system.fastest is not None:
        ready = ready & exists[3]  # of many degrees of freedom an attempt takes long
    patient = passed(system, rounds, returns, options) >= options.patient
    ready = ready & (ends_near | (period_returns > 1) | patient)

    given = Candidates(
        y=seen[:, 0],
        first=first,
        last=at[0],
        returns=period_returns,
        h=h,
        rtol=rtol,
    )

    # The widest gaps of the third and the last quarter say whether it settles.
    quarter = jnp.stack([returns < 0.75 * max_returns, returns >= 0.75 * max_returns])
    wider = jnp.maximum(known.widest, (closest / scale)[None])
    widest = jnp.where(quarter & (returns > max_returns / 2)[None], wider, known.widest)
    settles = jnp.max(widest, axis=0) < options.nearly
    settles = settles & ((widest[0] == 0) | (widest[1] < options.settles * widest[0]))
    over = jnp.where(settles | (smooth & (growth < 0)), EXHAUSTED, NOT_PERIODIC)
    # A motion that repeats was no orbit if segments of length h, and one a phase, are too many.
    last = jnp.stack([at[0], jnp.take_along_axis(at, repeated[None], axis=0)[0]])
    weight, phases = (record.past(row, last, lane[None]) for row in (WEIGHT, ENDED))
    cramped = (weight[0] - weight[1]) / h + phases[0] - phases[1] > length
    over = jnp.where(cramped & (closest < options.repeats * scale), TOO_LONG, over)
    ended = (returns >= max_returns) | (idle > options.patience)
    over = jnp.where(ended, over, RUNNING)
    # A period that the record does not hold is never seen to repeat.
    grows = away[0] > 1.01 * known.size
    calm = jnp.where(idle > 0, known.calm, jnp.where(grows, 0, known.calm + 1))
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
        tried=jnp.where(ready, gap, known.tried),
        returns=returns,
        idle=idle,
        size=jnp.where(idle > 0, known.size, away[0]),
        calm=calm,
    )
    return Assessment(
        progress=progress,
        over=over,
        ok=ok,
        ready=ready,
        gap=gap,
        given=given,
        seen=seen,
        exists=exists,
        scale=scale,
        y=y_on,
        extrapolates=extrapolates,
    )


def concluded(told: Assessment, known: Progress, orbit: Segments, found, accepted) -> Progress:
    """What is known of all lanes after orbits were `found` of some, which all were running."""
    now = _distance(told.seen, told.exists, orbit)
    # This near, the multipliers decide whether it attracts.
    ok = told.ok | (found & (now < accepted * told.scale))
    new = told.progress
    status = jnp.where(new.status == RUNNING, jnp.where(ok, CONVERGED, told.over), new.status)
    returns = jnp.where(found, new.period_returns, known.period_returns)
    distance = jnp.where(found & ~ok, now, new.distance)
    new = eqx.tree_at(
        lambda x: (x.status, x.period_returns, x.distance), new, (status, returns, distance)
    )
    active = known.status == RUNNING
    return jax.tree.map(lambda new, old: jnp.where(active, new, old), new, known)
