"""The stick-slip limit cycle: how loud, at which pitch, with how much sticking."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import concrete, number, raise_unless, require_scalar
from ..mechanism.scene import Scene
from ..modes.stability import growth_rate
from . import transient
from .cycle import Closed, CycleResult, LimitCycle, repels
from .events import Cubic, first_root
from .shooting import UNUSED, Segments, flow, maps, next_start, orbit
from .stick_slip import (
    StickSlip,
    check_rtol,
    rest,
    scaled_start,
    start_state,
    stick_slip,
    units,
)

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


def _extremes(system: StickSlip, segments: Segments) -> jax.Array:
    """Smallest and largest value of each component along the orbit, (2, 4)."""
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

    # At an extremum the value does not depend on its time: no derivative by t.
    t = jax.lax.stop_gradient(jax.lax.fori_loop(0, _REFINEMENTS, refine, t))
    return jnp.sum(own * flow(system, y, t, s), axis=0)


def _time_below_zero(system: StickSlip, segments: Segments, component: int) -> jax.Array:
    """How long one component is negative in one period."""
    y, h, s = segments.y, segments.duration, segments.s
    ends = next_start(y)
    whole = jnp.sum(jnp.where(y[component] < 0, h, 0))
    # In segments that it crosses: from the start to the first zero, and from the last to the end.
    sign = jnp.where(y[component] < 0, -1, 1)
    g_0, g_1 = sign * y[component], sign * ends[component]
    d_0, d_1 = (sign * h * system.field(at, s)[component] for at in (y, ends))
    first = first_root(g_0, g_1, d_0, d_1)
    turned = jnp.where(g_1 < 0, -1, 1)
    last = 1 - first_root(turned * g_1, turned * g_0, -turned * d_1, -turned * d_0)
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
    crossed = jnp.where(
        jax.lax.stop_gradient(g_1[k]) < 0,
        # Through: what is left of the segment has the other sign.
        h - t[0],
        t[1] - t[0],
    )
    return whole + jnp.sum(jnp.where(k >= 0, sign * crossed, 0))


def _monodromy(system: StickSlip, segments: Segments, local) -> jax.Array:
    """The product of all segments' maps, with the jump of the tangent at every switch."""
    ends, s = next_start(segments.y), segments.s
    before, after = system.field(ends, s), system.field(ends, jnp.roll(s, -1, axis=-1))
    used = segments.guard != UNUSED
    speed = jnp.where(used, jnp.sum(local.c * before, axis=0), 1)
    jump = jnp.where(used[None], (after - before) / speed[None], 0)
    eye = jnp.eye(4, dtype=ends.dtype)
    M = jnp.einsum("ijn,jkn->nik", eye[:, :, None] + jump[:, None] * local.c[None], local.A)
    while len(M) > 1:
        rest = M[len(M) & ~1 :]
        M = jnp.concatenate([M[1::2] @ M[: len(M) & ~1 : 2], rest])
    return M[0]


@functools.partial(jax.jit, static_argnames=("segments", "rtol"))
def _limit_cycle(scene: Scene, start, max_turns, *, segments: int, rtol: float) -> LimitCycle:
    system = stick_slip(scene)
    frozen, still, growth = jax.lax.stop_gradient(
        (system, rest(scene, system), growth_rate(scene) / system.omega)
    )
    y = scaled_start(scene, system, start)
    found = transient.find(frozen, y, still, growth, max_turns.astype(y.dtype), segments)
    found = jax.lax.stop_gradient(found)

    y, duration = orbit(system, found.segments)
    loop = Segments(y, duration, found.segments.s, found.segments.guard)
    period = jnp.sum(duration)
    _, local = maps(system, loop)
    error = found.error
    status = CycleResult.exhausted
    for outcome, result in enumerate(_RESULTS):
        status = CycleResult.where(found.status == outcome, result, status)
    exists = found.status == transient.CONVERGED
    monodromy = _monodromy(system, loop, local)
    frozen_map, rate = jax.lax.stop_gradient(
        (monodromy, system.field(y[:, 0], found.segments.s[:, 0]))
    )
    leaves = exists & repels(frozen_map, rate, error)
    status = CycleResult.where(leaves, CycleResult.unstable, status)
    fine = error <= rtol
    status = CycleResult.where(exists & ~fine, CycleResult.inaccurate, status)

    def only(value):
        return jnp.where(exists, value, jnp.nan)

    period = only(period)
    scale = units(system)
    low, high = _extremes(system, loop) * scale[None]
    time_pulling = _time_below_zero(system, loop, 1)
    return LimitCycle(
        period=period / system.omega,
        amplitude=only((high - low)[:2]),
        velocity_min=only(low[2:]),
        velocity_max=only(high[2:]),
        stick_fraction=jnp.sum(jnp.where(loop.s == 0, duration, 0), axis=1) / period,
        tension_fraction=time_pulling / period,
        state=only(y[:, 0] * scale),
        error=only(error),
        turns=found.period_turns,
        regularisation_error=only(jnp.zeros_like(error)),
        result=status,
        _monodromy=only(monodromy),
        _system=system,
        _motion=Closed(loop),
    )


def _segments_for(rtol: float) -> int:
    # 40 resolve a turn to some 1e-12 in 64 bits; the method is of order eight.
    return int(np.clip(round(40 * (1e-9 / rtol) ** 0.125), 24, 256))


def _worth_another_try(cycle: LimitCycle) -> bool:
    """Whether more segments may help, where that can be known: not inside a compiled program."""
    result = cycle.result
    if concrete(cycle.period) is None or cycle.period.ndim:
        return False
    finer = CycleResult.inaccurate, CycleResult.not_periodic, CycleResult.exhausted
    return any(bool(result == member) for member in finer)


def limit_cycle(
    scene: Scene,
    start: Any = None,
    *,
    regularisation: Any = None,
    solver: Any = None,
    rtol: float | None = None,
    max_turns: int = 5000,
    max_steps: int = 4096,
    segments: int | None = None,
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle that the motion from `start` ends in, by the exact law of dry friction.

    A coarse run from `start`, turn by turn (from maximum to maximum of x1), finds the itinerary;
    Newton's method closes the orbit; every derivative is that of the closed orbit's equations.
    A cycle of up to four turns counts as one. Derivatives with respect to `start` are zero. An
    orbit that repels, but so little that the motion does not leave it, is given as `unstable`.

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
    - `max_turns`: turns of the coarse run after which it gives up.
    - `segments`: into how many pieces the orbit is cut, if `rtol` is not to say: 40 at 1e-9. A
      cycle of several turns may need more; outside of compiled programs they are then taken.
    - `throw`: raise unless the result is `converged`. Otherwise `result` tells, and everything is
      NaN where there is no cycle.

    **Raises:** `ValueError` for a start of another shape, an rtol above 0.1 or below what the
    precision can hold, less than 16 segments or max_turns below 1; `RuntimeError` as `throw` says.
    """
    require_scalar(scene)
    start = None if start is None else start_state(start)
    given = scene if start is None else (scene, start)
    tolerance = check_rtol(rtol, jnp.result_type(*jax.tree.leaves(given)))
    if segments is not None and (not isinstance(segments, int) or segments < 16):
        raise ValueError(f"segments must be a whole number of at least 16, got {segments!r}")
    turns = number("max_turns", max_turns, at_least=1)
    usual = _segments_for(1e-9 if rtol is None else rtol)
    cycle = _limit_cycle(scene, start, turns, segments=segments or usual, rtol=tolerance)
    if segments is None and _worth_another_try(cycle):
        # A period of several turns needs as many more segments.
        cycle = _limit_cycle(scene, start, turns, segments=4 * usual, rtol=tolerance)
    if regularisation is not None:
        from .regularised import default_solver, regularised_cycle

        eps = number("regularisation", regularisation, above=0)
        solver = default_solver() if solver is None else solver
        cycle = regularised_cycle(scene, start, eps, cycle, solver, tolerance, max_steps)
    return raise_unless(CycleResult.converged, cycle) if throw else cycle
