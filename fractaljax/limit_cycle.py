"""The stick-slip limit cycle: how loud, at which pitch, with how much sticking."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from . import transient
from .events import Cubic, first_root
from .parts import Record, concrete, number, require_scalar
from .scene import Scene
from .shooting import (
    UNUSED,
    Segments,
    flow,
    maps,
    next_start,
    orbit,
)
from .stability import growth_rate
from .stick_slip import StickSlip, check_rtol, rest, start_state, stick_slip, units

_REFINEMENTS = 3
REGULARISATION_TOLERANCE = 1e-3
_CROSSINGS = 16  # segments in which x2 may change sign


class CycleResult(eqx.Enumeration):
    """What became of the search for a limit cycle."""

    converged = "a limit cycle was found"
    depends_on_eps = (
        "a limit cycle of the regularised law, which still differs from the exact law's: "
        "choose a smaller regularisation"
    )
    inaccurate = "a limit cycle was found, but not to rtol: ask for more segments"
    equilibrium = "the motion dies out: the sliding equilibrium attracts it"
    diverged = "the motion grows beyond all bounds"
    not_periodic = "the motion does not repeat within four turns (a longer period, or none)"
    too_stiff = (
        "the regularised law takes more than max_steps steps: allow more, choose a solver such as "
        "diffrax.Kvaerno5, or leave the regularisation out"
    )
    exhausted = (
        "the motion nearly repeats, but has not settled within max_turns: allow more of them"
    )


# In the order of the numbers in `transient`.
_RESULTS = (
    CycleResult.exhausted,
    CycleResult.converged,
    CycleResult.equilibrium,
    CycleResult.diverged,
    CycleResult.not_periodic,
    CycleResult.exhausted,
)


class Switch(Record):
    """One change of mode, as `LimitCycle.switches` lists them."""

    time: float  # after `state` [s]
    direction: int  # which one switches, 1 or 2
    before: str  # "+", "-" or "stick"
    after: str


class Closed(eqx.Module):
    """The motion along closed segments."""

    segments: Segments

    def at(self, system: StickSlip, times) -> jax.Array:
        """Scaled states (4, n) at scaled times (n,) within one period."""
        segments = self.segments
        ends = jnp.cumsum(segments.duration)
        k = jnp.searchsorted(
            jax.lax.stop_gradient(ends), jax.lax.stop_gradient(times), side="right"
        )
        k = jnp.minimum(k, len(ends) - 1)
        after = times - (ends - segments.duration)[k]
        return flow(system, segments.y[:, k], after, segments.s[:, k])


class Smooth(eqx.Module):
    """The motion as diffrax's dense solution over one period."""

    solution: Any

    def at(self, system: StickSlip, times) -> jax.Array:
        """Scaled states (4, n) at scaled times (n,) within one period."""
        return jax.vmap(self.solution.evaluate, out_axes=1)(times)


class LimitCycle(Record):
    """A limit cycle, as `limit_cycle` returns it. NaN throughout where there is none."""

    period: jax.Array  # [s]
    amplitude: jax.Array  # (2,) peak to peak, one value a direction [m]
    velocity_min: jax.Array  # (2,) of dx/dt [m/s]
    velocity_max: jax.Array  # (2,) [m/s]
    stick_fraction: jax.Array  # (2,) share of the period in stick (regularised: abs(v) < eps)
    tension_fraction: jax.Array  # share of the period with K_n x2 < 0: the contact pulls
    state: jax.Array  # (4,) [x1, x2, v1, v2] on the cycle, where x1 is largest [m, m/s]
    error: jax.Array  # estimated relative error of period and states
    turns: jax.Array  # maxima of x1 in one period
    regularisation_error: jax.Array  # largest relative difference from the exact law's cycle
    result: CycleResult
    _monodromy: jax.Array = eqx.field(repr=False)  # (4, 4)
    _system: StickSlip = eqx.field(repr=False)
    _motion: Any = eqx.field(repr=False)  # Closed, or Smooth if regularised

    @property
    def multipliers(self) -> jax.Array:
        """(4,) complex: the Floquet multipliers, largest modulus first; one of them is 1."""
        # Worked out when asked for: eigenvalues have no second derivative in JAX.
        values = jnp.linalg.eigvals(self._monodromy)
        order = jnp.argsort(-jnp.abs(jax.lax.stop_gradient(values)), axis=-1)
        return jnp.take_along_axis(values, order, axis=-1)

    @property
    def frequency(self) -> jax.Array:
        """1/period [Hz]."""
        return 1 / self.period

    def orbit(self, n: int = 512) -> tuple[jax.Array, jax.Array]:
        """Times (n,) [s] and states (n, 4) [m, m/s], evenly over one period from `state`."""
        system = self._system
        share = jnp.arange(n) / n
        y = self._motion.at(system, share * self.period * system.omega)
        y = jnp.where(jnp.isfinite(self.period), y, jnp.nan)
        return share * self.period, (y * units(system)[:, None]).T

    def spectrum(self, n: int = 512) -> tuple[jax.Array, jax.Array]:
        """Harmonics: frequencies (n//2,) [Hz] and peak amplitudes (n//2, 2) [m] of x1 and x2.

        The Fourier coefficients of n samples of the orbit, without the mean.
        """
        _, states = self.orbit(n)
        lines = jnp.abs(jnp.fft.rfft(states[:, :2], axis=0)) / n * 2
        harmonics = jnp.arange(1, n // 2 + 1)
        return harmonics / self.period, lines[1 : n // 2 + 1]

    def switches(self) -> list[Switch]:
        """Every change of mode in one period, in order, with its time.

        **Raises:** `ValueError` for a batch of cycles, inside a compiled program, and for the
        regularised law, which has none.
        """
        if concrete(self.period) is None or self.period.ndim:
            raise ValueError("switches() needs one cycle, outside of jit: index the batch first")
        if not isinstance(self._motion, Closed):
            raise ValueError("a regularised cycle has no switches")
        segments, names = self._motion.segments, {1: "+", -1: "-", 0: "stick"}
        used = np.asarray(segments.guard) != UNUSED
        modes = np.asarray(segments.s)[:, used].astype(int)
        times = np.cumsum(np.asarray(segments.duration)[used]) / float(self._system.omega)
        found = []
        for k, time in enumerate(times):
            before, after = modes[:, k], np.roll(modes, -1, axis=1)[:, k]
            for i in np.flatnonzero(before != after):
                found.append(Switch(float(time), int(i) + 1, names[before[i]], names[after[i]]))
        return found


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


def _start(scene: Scene, system: StickSlip, start) -> jax.Array:
    """The start (4,) in scaled units, constant: by default the equilibrium with x1 displaced."""
    y = rest(scene, system).at[0].add(1.0) if start is None else start / units(system)
    return jax.lax.stop_gradient(y)


@functools.partial(jax.jit, static_argnames=("segments", "rtol"))
def _limit_cycle(scene: Scene, start, max_turns, *, segments: int, rtol: float) -> LimitCycle:
    system = stick_slip(scene)
    frozen, still, growth = jax.lax.stop_gradient(
        (system, rest(scene, system), growth_rate(scene) / system.omega)
    )
    y = _start(scene, system, start)
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
    tolerance = max(rtol, 1e4 * float(jnp.finfo(y.dtype).eps))
    fine = error <= tolerance
    exists = found.status == transient.CONVERGED
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
        _monodromy=only(_monodromy(system, loop, local)),
        _system=system,
        _motion=Closed(loop),
    )


@eqx.filter_jit
def _regularised_cycle(
    scene: Scene, start, eps, exact: LimitCycle, solver, rtol: float, max_steps: int
) -> LimitCycle:
    from . import regularised

    system = stick_slip(scene)
    y = _start(scene, system, start)
    closed = regularised.close(system, eps, y, solver, rtol, max_steps)
    solution = regularised.solve(
        system,
        eps,
        closed.y,
        closed.period,
        solver,
        rtol,
        max_steps,
        t0=True,
        steps=True,
        dense=True,
    )
    times, states = regularised.nodes(solution)
    rates = jax.vmap(lambda y: regularised.field(0.0, y, (system, eps)))(states)
    low, high = regularised.extremes(times, states, rates) * units(system)[None]

    def end(y):
        # Tangents are less accurate than states at the same tolerance.
        tight = rtol / 10, max_steps
        return regularised.solve(system, eps, y, closed.period, solver, *tight, t1=True).ys[0]

    def share(values, slopes):
        return regularised.share(times, values, slopes)

    width = eps / system.V
    stuck = [
        share((1 - u) ** 2 - width**2, 2 * (u - 1) * a)
        for u, a in zip(states.T[2:], rates.T[2:], strict=True)
    ]
    period = closed.period / system.omega
    amplitude = (high - low)[:2]
    differences = jnp.abs(
        jnp.stack([period / exact.period - 1, *(amplitude / exact.amplitude - 1)])
    )
    error = jax.lax.stop_gradient(jnp.max(differences))
    status = CycleResult.where(
        error <= REGULARISATION_TOLERANCE, CycleResult.converged, CycleResult.depends_on_eps
    )
    lost = CycleResult.where(closed.followed, CycleResult.not_periodic, CycleResult.too_stiff)
    status = CycleResult.where(closed.found, status, lost)

    def only(value):
        return jnp.where(closed.found, value, jnp.nan)

    return LimitCycle(
        period=only(period),
        amplitude=only(amplitude),
        velocity_min=only(low[2:]),
        velocity_max=only(high[2:]),
        stick_fraction=only(jnp.stack(stuck)),
        tension_fraction=only(share(states[:, 1], rates[:, 1])),
        state=only(closed.y * units(system)),
        error=only(jnp.asarray(rtol, y.dtype)),
        turns=closed.turns,
        regularisation_error=only(error),
        result=status,
        _monodromy=only(jax.jacfwd(end)(closed.y)),
        _system=system,
        _motion=Smooth(solution),
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
    rtol: float = 1e-9,
    max_turns: int = 5000,
    max_steps: int = 4096,
    segments: int | None = None,
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle that the motion from `start` ends in, by the exact law of dry friction.

    A coarse run from `start`, turn by turn (from maximum to maximum of x1), finds the itinerary;
    Newton's method closes the orbit; every derivative is that of the closed orbit's equations.
    A cycle of up to four turns counts as one. Derivatives with respect to `start` are zero.

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
    - `rtol`: relative tolerance of period and states; sets the number of segments.
    - `max_turns`: turns of the coarse run after which it gives up.
    - `segments`: into how many pieces the orbit is cut, if `rtol` is not to say: 40 at 1e-9. A
      cycle of several turns may need more; outside of compiled programs they are then taken.
    - `throw`: raise unless the result is `converged`. Otherwise `result` tells, and everything is
      NaN where there is no cycle.

    **Raises:** `ValueError` for a start of another shape, rtol outside (0, 0.1], less than 16
    segments or max_turns below 1; `RuntimeError` as `throw` says.
    """
    require_scalar(scene)
    start = None if start is None else start_state(start)
    check_rtol(rtol)
    if segments is not None and (not isinstance(segments, int) or segments < 16):
        raise ValueError(f"segments must be a whole number of at least 16, got {segments!r}")
    turns = number("max_turns", max_turns, at_least=1)
    cycle = _limit_cycle(scene, start, turns, segments=segments or _segments_for(rtol), rtol=rtol)
    if segments is None and _worth_another_try(cycle):
        # A period of several turns needs as many more segments.
        cycle = _limit_cycle(scene, start, turns, segments=4 * _segments_for(rtol), rtol=rtol)
    if regularisation is not None:
        from .regularised import default_solver

        eps = number("regularisation", regularisation, above=0)
        solver = default_solver() if solver is None else solver
        cycle = _regularised_cycle(scene, start, eps, cycle, solver, rtol, max_steps)
    if throw:
        failed = cycle.result != CycleResult.converged
        cycle = cycle.result.error_if(cycle, failed)
    return cycle


def attractors(
    scene: Scene, starts: Any = None, *, rtol: float = 1e-9, max_turns: int = 5000
) -> list[LimitCycle]:
    """Every distinct motion that the starts end in, those without a cycle among them.

    Two cycles are one if their periods and amplitudes agree to 1e-6. `starts` is (k, 4), [x1, x2,
    v1, v2] in m and m/s; by default 32 spread evenly in both directions about the equilibrium, up
    to velocities of 2 V. The first start that led to each motion decides the order.

    **Raises:** `ValueError` for starts of another shape, and what `limit_cycle` raises.
    """
    require_scalar(scene)
    if starts is None:
        starts = _spread(scene)
    starts = number("starts", jnp.asarray(starts, dtype=float))
    if starts.ndim != 2 or starts.shape[1] != 4:
        raise ValueError(f"starts must have shape (k, 4), got {starts.shape}")
    cycles = jax.vmap(
        lambda start: limit_cycle(scene, start, rtol=rtol, max_turns=max_turns, throw=False)
    )(starts)
    distinct: list[LimitCycle] = []
    for i in range(len(starts)):
        cycle = jax.tree.map(lambda x, i=i: x[i], cycles)
        if not any(_same(cycle, other) for other in distinct):
            if bool(cycle.result == CycleResult.inaccurate):
                # On its own it gets the segments it needs, and may turn out to be known.
                cycle = limit_cycle(scene, cycle.state, rtol=rtol, throw=False)
            if not any(_same(cycle, other) for other in distinct):
                distinct.append(cycle)
    return distinct


@jax.jit
def _spread(scene: Scene) -> jax.Array:
    system = stick_slip(scene)
    still = rest(scene, system)
    # Phases of the two directions at unrelated steps, three sizes in turn.
    k = jnp.arange(32)
    first, second = 2 * jnp.pi * k / 32, 2 * jnp.pi * ((k * 0.618034) % 1)
    size = jnp.array([0.5, 1.0, 2.0])[k % 3]
    away = jnp.stack([jnp.cos(first), jnp.cos(second), jnp.sin(first), jnp.sin(second)], axis=1)
    return (still[None] + size[:, None] * away) * units(system)[None]


def _same(one: LimitCycle, other: LimitCycle) -> bool:
    numbers = [np.array([c.period, *c.amplitude]) for c in (one, other)]
    if np.isnan(numbers[0]).any() or np.isnan(numbers[1]).any():
        return bool(np.isnan(numbers).all()) and bool(one.result == other.result)
    return bool(np.allclose(*numbers, rtol=1e-6, atol=0))
