"""The stick-slip limit cycle: amplitude, frequency and share of sticking, with gradients."""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import concrete, number, raise_unless, require_scalar, whole
from .._mechanism.scene import Scene
from .._stability.stability import growth_rate
from . import transient
from .cycle import CycleResult, LimitCycle, Orbit, repels
from .events import Cubic, first_root
from .shooting import UNUSED, Maps, Segments, flow, maps, next_start, orbit
from .stick_slip import (
    StickSlip,
    check_rtol,
    scaled_start,
    sliding_equilibrium,
    start_state,
    stick_slip,
    units,
)

if TYPE_CHECKING:
    from diffrax import AbstractSolver

_REFINEMENTS = 3
_CROSSINGS = 16  # segments in which x2 may change sign

# In the order of the numbers in `transient`.
_RESULTS = (
    CycleResult.exhausted,
    CycleResult.converged,
    CycleResult.equilibrium,
    CycleResult.diverged,
    CycleResult.not_periodic,
    CycleResult.exhausted,
)


def _extremes(system: StickSlip, segments: Segments) -> Float[Array, "2 4"]:
    """Smallest and largest value of each component along the orbit."""
    y, h, s = segments.y, segments.duration, segments.s
    ends = next_start(y)
    sign = jnp.array([1.0, -1.0], y.dtype)[:, None, None]
    d_0, d_1 = (sign * (h[None] * system.field(at, s))[None] for at in (y, ends))
    # Where the cubic through the ends of each segment is lowest.
    cubic = Cubic.through(sign * y[None], sign * ends[None], d_0, d_1)
    theta, inside = cubic.minimum()
    low = cubic(theta)
    k = jnp.argmin(low, axis=-1)
    y, s, h = y[:, k], s[:, k], h[k]
    t = jnp.take_along_axis(theta, k[..., None], axis=-1)[..., 0] * h
    inside = jnp.take_along_axis(inside, k[..., None], axis=-1)[..., 0]
    own = jnp.eye(4, dtype=y.dtype)[:, None]

    def refine(_, t):
        along = flow(system, y, t, s)
        rate, change = jax.jvp(lambda at: system.field(at, s), (along,), (system.field(along, s),))
        rate, change = (jnp.sum(own * x, axis=0) for x in (rate, change))
        step = rate / jnp.where(change == 0, 1, change)
        return jnp.where(inside, jnp.clip(t - step, -0.1 * h, 1.1 * h), t)

    # At an extremum the derivative by time is zero.
    t = jax.lax.stop_gradient(jax.lax.fori_loop(0, _REFINEMENTS, refine, t))
    return jnp.sum(own * flow(system, y, t, s), axis=0)


def _time_below_zero(system: StickSlip, segments: Segments, component: int) -> Float[Array, ""]:
    """How long one component is negative in one period."""
    y, h, s = segments.y, segments.duration, segments.s
    ends = next_start(y)
    whole_segments = jnp.sum(jnp.where(y[component] < 0, h, 0))
    # In a segment with crossings: from its start to the first zero, and from the last to its end.
    sign = jnp.where(y[component] < 0, -1, 1)
    g_0, g_1 = sign * y[component], sign * ends[component]
    d_0, d_1 = (sign * h * system.field(at, s)[component] for at in (y, ends))
    first = first_root(g_0, g_1, d_0, d_1)
    reversed_sign = jnp.where(g_1 < 0, -1, 1)
    last = 1 - first_root(
        reversed_sign * g_1, reversed_sign * g_0, -reversed_sign * d_1, -reversed_sign * d_0
    )
    (k,) = jnp.nonzero(first <= 1, size=_CROSSINGS, fill_value=-1)
    y, s, h, sign = y[:, k], s[:, k], h[k], sign[k]
    t = jnp.stack([first[k], last[k]]) * h[None]
    y, s = y[:, None], s[:, None]

    def refine(_, t):
        at = flow(system, y, t, s)
        rate = system.field(at, s)[component]
        return t - at[component] / jnp.where(rate == 0, 1, rate)

    t = jax.lax.fori_loop(0, _REFINEMENTS, refine, jax.lax.stop_gradient(t))
    t = refine(0, jax.lax.stop_gradient(t))  # carries the derivative
    # With one crossing the rest of the segment has the other sign, else the time between two.
    crossed = jnp.where(jax.lax.stop_gradient(g_1[k]) < 0, h - t[0], t[1] - t[0])
    return whole_segments + jnp.sum(jnp.where(k >= 0, sign * crossed, 0))


def _monodromy(system: StickSlip, segments: Segments, local: Maps) -> Float[Array, "4 4"]:
    """The product of all segments' maps, with the jump of the tangent at every switch."""
    ends, s = next_start(segments.y), segments.s
    before, after = system.field(ends, s), system.field(ends, jnp.roll(s, -1, axis=-1))
    used = segments.guard != UNUSED
    speed = jnp.where(used, jnp.sum(local.c * before, axis=0), 1)
    jump = jnp.where(used[None], (after - before) / speed[None], 0)
    eye = jnp.eye(4, dtype=ends.dtype)
    M = jnp.einsum("ijn,jkn->nik", eye[:, :, None] + jump[:, None] * local.c[None], local.A)
    while len(M) > 1:
        unpaired = M[len(M) & ~1 :]
        M = jnp.concatenate([M[1::2] @ M[: len(M) & ~1 : 2], unpaired])
    return M[0]


@functools.partial(jax.jit, static_argnames=("segments", "rtol"))
def _limit_cycle(scene: Scene, start, max_returns, *, segments: int, rtol: float) -> LimitCycle:
    system = stick_slip(scene)
    frozen, equilibrium, growth = jax.lax.stop_gradient(
        (system, sliding_equilibrium(scene, system), growth_rate(scene) / system.omega)
    )
    y = scaled_start(scene, system, start)
    found = transient.find(frozen, y, equilibrium, growth, max_returns.astype(y.dtype), segments)
    found = jax.lax.stop_gradient(found)

    y, duration = orbit(system, found.segments)
    closed = Segments(y, duration, found.segments.s, found.segments.guard)
    period = jnp.sum(duration)
    _, local = maps(system, closed)
    error = found.error
    status = CycleResult.exhausted
    for outcome, result in enumerate(_RESULTS):
        status = CycleResult.where(found.status == outcome, result, status)
    exists = found.status == transient.CONVERGED
    monodromy = _monodromy(system, closed, local)
    frozen_map, rate = jax.lax.stop_gradient(
        (monodromy, system.field(y[:, 0], found.segments.s[:, 0]))
    )
    unstable = exists & repels(frozen_map, rate, error)
    status = CycleResult.where(unstable, CycleResult.unstable, status)
    status = CycleResult.where(exists & ~(error <= rtol), CycleResult.inaccurate, status)

    def only(value):
        return jnp.where(exists, value, jnp.nan)

    period = only(period)
    scale = units(system)
    low, high = _extremes(system, closed) * scale[None]
    return LimitCycle(
        period=period / system.omega,
        amplitude=only((high - low)[:2]),
        velocity_min=only(low[2:]),
        velocity_max=only(high[2:]),
        stick_fraction=jnp.sum(jnp.where(closed.s == 0, duration, 0), axis=1) / period,
        tension_fraction=_time_below_zero(system, closed, 1) / period,
        state=only(y[:, 0] * scale),
        error=only(error),
        returns=found.period_returns,
        regularisation_error=only(jnp.zeros_like(error)),
        result=status,
        _monodromy=only(monodromy),
        _system=system,
        _orbit=Orbit(closed),
    )


def _segments_for(rtol: float) -> int:
    # 40 resolve one return to some 1e-12 in 64 bits; the method is of order eight.
    return int(np.clip(round(40 * (1e-9 / rtol) ** 0.125), 24, 256))


def _may_need_more_segments(cycle: LimitCycle) -> bool:
    """Known only of one cycle outside of a compiled program."""
    if concrete(cycle.period) is None or cycle.period.ndim:
        return False
    finer = CycleResult.inaccurate, CycleResult.not_periodic, CycleResult.exhausted
    return any(bool(cycle.result == member) for member in finer)


def limit_cycle(
    scene: Scene,
    start: ArrayLike | Sequence[float] | None = None,
    *,
    regularisation: ScalarLike | None = None,
    solver: "AbstractSolver | None" = None,
    rtol: float | None = None,
    max_returns: int = 5000,
    max_steps: int = 4096,
    segments: int | None = None,
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle that the motion from `start` ends in, by the exact law of dry friction.

    A coarse run from `start`, by returns of the Poincare map (from maximum to maximum of x1),
    finds the itinerary. Newton's method then solves for the periodic orbit, and every derivative
    is the implicit one of its equations. A period has at most four returns. Derivatives with
    respect to `start` are zero. An orbit that repels so weakly that the motion does not leave it
    is returned as `unstable`.

    **Arguments:**

    - `scene`: one scene; `jax.vmap` takes many, and a member that fails marks only itself.
    - `start`: (4,), [x1, x2, v1, v2] in m and m/s; by default the sliding equilibrium, with x1
      displaced by V/omega, omega^2 = omega_1^2 + omega_2^2 + (K_n + K_t)/m.
    - `regularisation`: eps [m/s], to replace sgn v by tanh(v/eps). The cycle is then compared
      with the exact law's from the same start: `regularisation_error` is the largest relative
      difference of period and amplitudes, and the result `depends_on_eps` where it is above
      1e-3. Derivatives differ by far more than values do.
    - `solver`: a diffrax solver for the regularised law, Tsit5 by default; an implicit one, such
      as Kvaerno5, for a small eps. `max_steps` bounds its steps in one period.
    - `rtol`: relative tolerance of period and states, 1e-9 by default and at least 9.1e-13; in
      float32 both are 4.9e-4. It sets the number of segments.
    - `max_returns`: returns of the coarse run after which it gives up.
    - `segments`: number of pieces the orbit is cut into, by default as `rtol` needs: 40 at 1e-9.
      A cycle of several returns may need more; outside of compiled programs it then gets them.
    - `throw`: raise unless the result is `converged`. Otherwise `result` says what was found, and
      everything is NaN where there is no cycle.

    **Raises:** `ValueError` for a start of another shape, an rtol above 0.1 or below what the
    precision can hold, less than 16 segments or max_returns below 1; `RuntimeError` if `throw`.
    """
    require_scalar(scene)
    start = None if start is None else start_state(start)
    given = scene if start is None else (scene, start)
    tolerance = check_rtol(rtol, jnp.result_type(*jax.tree.leaves(given)))
    returns = jnp.asarray(whole("max_returns", max_returns, 1), float)
    usual = _segments_for(1e-9 if rtol is None else float(rtol))
    count = usual if segments is None else whole("segments", segments, 16)
    cycle = _limit_cycle(scene, start, returns, segments=count, rtol=tolerance)
    if segments is None and _may_need_more_segments(cycle):
        # A period of several returns needs as many times the segments.
        cycle = _limit_cycle(scene, start, returns, segments=4 * usual, rtol=tolerance)
    if regularisation is not None:
        from .regularised import regularised_cycle

        eps = number("regularisation", regularisation, above=0)
        steps = whole("max_steps", max_steps, 1)
        cycle = regularised_cycle(scene, start, eps, cycle, solver, tolerance, steps)
    return raise_unless(CycleResult.converged, cycle) if throw else cycle
