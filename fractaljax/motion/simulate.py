"""The motion from a start: stick and slip by the exact law, every switch resolved.

A first pass finds the steps: where they end, in which mode. A second one repeats them, and there
the length of a step that ends in a switch is a function of its start, one Newton step from the
known length: so derivatives pass through switches without a search to differentiate.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import Record, concrete, number, raise_unless, require_scalar
from ..mechanism.scene import Scene
from .events import NONE, Cubic, guards_and_rates, without_start
from .shooting import flow
from .stick_slip import SECTION, StickSlip, check_rtol, start_state, stick_slip, units

_REJECTIONS = 20  # of a step whose error is above rtol
_MOST_GUESSES = 60  # of the time of an event; some four are enough as a rule


class SimulationResult(eqx.Enumeration):
    """How a simulation ended."""

    reached = "the end time was reached"
    out_of_steps = "max_steps were used up before the end time"
    diverged = "the motion grew beyond all bounds"


class Trajectory(Record):
    """The motion of a scene, as `simulate` returns it; unused steps repeat the last state."""

    times: jax.Array  # (n,) at the ends of the steps [s]
    states: jax.Array  # (n, 4) [x1, x2, v1, v2] [m, m/s]
    modes: jax.Array  # (n, 2) from each time on: +1, -1 slip forward, backward, 0 stick
    result: SimulationResult
    _system: StickSlip = eqx.field(repr=False)
    _solution: Any = eqx.field(repr=False)  # diffrax's, of the regularised law

    @property
    def end(self) -> jax.Array:
        """The last state (4,) [m, m/s]."""
        return self.states[-1]

    def at(self, times) -> jax.Array:
        """States (k, 4) at `times` (k,) [s] from 0 to the end of the simulation.

        **Raises:** `ValueError` for times of another shape or outside; `RuntimeError` inside a
        compiled program.
        """
        times = self._inside(number("times", jnp.asarray(times)))
        if self._solution is not None:
            states = jax.vmap(self._solution.evaluate)(times * self._system.omega)
            return states * units(self._system)[None]
        k = jnp.searchsorted(
            jax.lax.stop_gradient(self.times), jax.lax.stop_gradient(times), side="right"
        )
        k = jnp.clip(k - 1, 0, len(self.times) - 1)
        scale = units(self._system)
        after = (times - self.times[k]) * self._system.omega
        y = flow(self._system, (self.states[k] / scale[None]).T, after, self.modes[k].T)
        return (y * scale[:, None]).T

    def _inside(self, times) -> jax.Array:
        if times.ndim != 1:
            raise ValueError(f"times must have shape (k,), got {times.shape}")
        last = self.times[-1]
        # The end is known to rounding only: t1 itself is inside.
        outside = (times < 0) | (times > last * (1 + 8 * jnp.finfo(last.dtype).eps))
        wanted = "times must be from 0 to the end of the simulation"
        found, given = concrete(outside), concrete(times)
        if found is None or given is None:
            return eqx.error_if(times, outside, wanted)
        if found.any():
            raise ValueError(f"{wanted}, {float(last)!r}, got {given[found][0].item()!r}")
        return times

    def switches(self) -> list[tuple[float, int, int, int]]:
        """Every change of mode: time [s], direction (1 or 2), mode before, mode after."""
        modes, times = np.asarray(self.modes), np.asarray(self.times)
        return [
            (float(times[k + 1]), int(i) + 1, int(modes[k, i]), int(modes[k + 1, i]))
            for k, i in np.argwhere(modes[1:] != modes[:-1])
        ]


def _event(system: StickSlip, y, s, h, y_1):
    """When the first switch falls in a step that ends in y_1, and which: its length and guard.

    A cubic through the ends of the step says where to look; the eighth-order flow decides, also
    whether a guard that dips towards zero and rises again gets there.
    """
    g_0, d_0 = guards_and_rates(system, y, s, h, system.field(y, s))
    g_1, d_1 = guards_and_rates(system, y_1, s, h, system.field(y_1, s))
    guards = jnp.arange(SECTION)
    lanes = jnp.broadcast_to(y[:, None], (4, SECTION)), jnp.broadcast_to(s[:, None], (2, SECTION))
    own = jnp.eye(SECTION, dtype=bool)

    def at(t):
        along = flow(system, lanes[0], t, lanes[1])
        rate = system.field(along, lanes[1])

        def pick(values):
            return jnp.sum(jnp.where(own, values[:SECTION], 0), axis=0)

        def curve():
            change = jax.jvp(lambda y: system.field(y, lanes[1]), (along,), (rate,))[1]
            return pick(system.guards(change, lanes[1], 0.0))

        value, slope = system.guards(along, lanes[1]), system.guards(rate, lanes[1], 0.0)
        return pick(value), pick(slope), curve

    g_0, g_1, d_0, d_1 = (x[:SECTION] for x in (g_0, g_1, d_0, d_1))
    # The mode says that every guard starts above zero; what rounding makes of it does not count.
    rounding = 16 * jnp.finfo(y.dtype).eps * (1 + jnp.max(jnp.abs(y)) + jnp.abs(system.f))
    late = g_0 < -rounding
    g_0 = jnp.maximum(g_0, 0)
    d_0 = jnp.where((g_0 <= rounding) & (d_0 >= -rounding), jnp.maximum(d_0, 0), d_0)
    rising = d_0 >= 0
    cubic = Cubic.through(g_0, g_1, d_0, d_1)
    theta, inside = cubic.minimum()

    def lower(_, t):
        _, rate, curve = at(t)
        bend = curve()
        return jnp.clip(t - rate / jnp.where(bend == 0, 1, bend), 0, h)

    bottom = jnp.where(inside, jax.lax.fori_loop(0, 3, lower, theta * h), 0)
    depth, _, curve = at(bottom)
    bend = curve()
    dips = inside & (depth < -rounding)
    end = jnp.where(dips, bottom, h)
    falls = dips | (g_1 < 0)
    t = without_start(cubic, rising).root_before(end / h) * h
    # A shallow dip is a parabola, with two roots that Newton's method cannot tell apart from afar.
    half = jnp.sqrt(2 * jnp.maximum(-depth, 0) / jnp.where(bend > 0, bend, 1))
    shallow = dips & (bend > 0) & (depth > -1e-2)
    t = jnp.where(shallow, jnp.clip(bottom - half, 0, bottom), t)
    t = jnp.where(dips & (t >= bottom), bottom / 2, t)

    def searching(carry):
        *_, found, count = carry
        return ~jnp.all(found) & (count < _MOST_GUESSES)

    def refine(carry):
        t, low, high, found, count = carry
        value, rate, _ = at(t)
        low, high = jnp.where(value > 0, t, low), jnp.where(value > 0, high, t)
        # Of a guard that rises first the quotient by t is what must vanish: the root behind it,
        # where it came from, is none of this step's.
        slope = jnp.where(rising, rate - value / jnp.where(t == 0, 1, t), rate)
        guess = t - value / jnp.where(slope == 0, 1, slope)
        between = (guess >= low) & (guess <= high)
        guess = jnp.where(between, guess, (low + high) / 2)
        near = (jnp.abs(guess - t) <= close) | (jnp.abs(value) <= close)
        return jnp.where(found, t, guess), low, high, found | near, count + 1

    close = 2 * jnp.finfo(y.dtype).eps
    start = t, jnp.zeros_like(t), end, ~falls | late, 0
    t, *_ = jax.lax.while_loop(searching, refine, start)
    # A step of no length would be tried for ever.
    t = jnp.where(rising, jnp.maximum(t, 1e-12 * h), t)
    t = jnp.where(late, 0, jnp.where(falls, t, jnp.inf))
    first = jnp.min(t)
    hit = first <= h
    return jnp.where(hit, first, h), jnp.where(hit, guards[jnp.argmin(t)], NONE)


def _smooth_step(system: StickSlip, y, s, longest, left, rtol):
    """A step in mode s, as long as may be: the state that it ends in, and its length."""
    h = jnp.minimum(longest / jnp.maximum(1, 2 * system.stiffness(y)), left)
    allowed = rtol * (1 + jnp.max(jnp.abs(y)))

    def attempt(h):
        y_1, error = flow(system, y, h, s, error=True)
        return y_1, h, jnp.max(jnp.abs(error)) / allowed

    def rejected(carry):
        (*_, error), count = carry
        return ~(error <= 1) & (count < _REJECTIONS)

    def shorter(carry):
        (_, h, error), count = carry
        return attempt(h * jnp.where(error < 1e5, 0.9 * error ** (-1 / 8), 0.2)), count + 1

    (y_1, h, _), _ = jax.lax.while_loop(rejected, shorter, (attempt(h), 0))
    return y_1, h


def _step(system: StickSlip, y, s, longest, left, rtol):
    """That step, or less: state, mode, length, and the guard that ended it."""
    y_1, h = _smooth_step(system, y, s, longest, left, rtol)
    g_0, d_0 = guards_and_rates(system, y, s, h, system.field(y, s))
    g_1, d_1 = guards_and_rates(system, y_1, s, h, system.field(y_1, s))
    cubic = Cubic.through(g_0, g_1, d_0, d_1)
    # Where the cubic keeps well away from zero, there is nothing to look for.
    lowest = jnp.minimum(cubic(cubic.minimum()[0]), g_1)[:SECTION]
    near = (lowest < 0.05) & (cubic.minimum()[1] | (g_1 < 0.05))[:SECTION]
    dt, guard = jax.lax.cond(
        jnp.any(near | (g_0[:SECTION] < 0)),
        lambda: _event(system, y, s, h, y_1),
        lambda: (h, jnp.array(NONE)),
    )
    end = jnp.where(guard == NONE, y_1, flow(system, y, dt, s))
    return *system.switch(end, s, guard), dt, guard


class _Steps(eqx.Module):
    """What the first pass finds: lengths, modes and guards of the steps, and how it ended."""

    duration: jax.Array  # (n,)
    s: jax.Array  # (2, n)
    guard: jax.Array  # (n,)
    count: jax.Array
    status: jax.Array  # a number of `_RESULTS`


_RESULTS = (
    SimulationResult.reached,
    SimulationResult.out_of_steps,
    SimulationResult.diverged,
)


@functools.partial(jax.jit, static_argnames="max_steps")
def _run(system: StickSlip, y, end, h, rtol, *, max_steps: int) -> _Steps:
    limit = 1e3 * (1 + jnp.max(jnp.abs(y)))

    def running(carry):
        y, _, t, k, *_ = carry
        return (t < end) & (k < max_steps) & (jnp.max(jnp.abs(y)) < limit)

    def body(carry):
        y, s, t, k, duration, modes, guards = carry
        y, s_new, dt, guard = _step(system, y, s, h, end - t, rtol)
        # What is left of the time after rounding is no step.
        t = jnp.where((guard == NONE) & (dt >= end - t), end, t + dt)
        return (
            y,
            s_new,
            t,
            k + 1,
            duration.at[k].set(dt),
            modes.at[:, k].set(s),
            guards.at[k].set(guard),
        )

    zeros = jnp.zeros(max_steps, y.dtype)
    start = (
        y,
        system.mode(y),
        jnp.zeros((), y.dtype),
        0,
        zeros,
        jnp.ones((2, max_steps), y.dtype),
        jnp.full(max_steps, NONE),
    )
    y, s, t, count, duration, modes, guards = jax.lax.while_loop(running, body, start)
    status = jnp.where(t >= end, 0, jnp.where(count >= max_steps, 1, 2))
    # The steps that were not needed keep the last mode.
    modes = jnp.where(jnp.arange(max_steps)[None] < count, modes, s[:, None])
    return _Steps(duration, modes, guards, jnp.asarray(count), status)


@jax.jit
def _repeat(system: StickSlip, y, end, steps: _Steps) -> Trajectory:
    """The steps once more, differentiably."""
    last = steps.count - 1

    def body(carry, step):
        y, t = carry
        k, dt, s, s_new, guard = step
        # The last step goes to the end, whatever the switches before it do.
        dt = jnp.where((k == last) & (steps.status == 0), end - t, dt)
        y_1 = flow(system, y, dt, s)
        rate = system.field(y_1, s)
        own = jnp.arange(SECTION + 1) == guard
        value = jnp.sum(jnp.where(own, system.guards(y_1, s), 0))
        slope = jnp.sum(jnp.where(own, system.guards(rate, s, 0.0), 0))
        # Zero, with the derivative of the time at which the guard is zero.
        off = value - jax.lax.stop_gradient(value)
        late = off / jax.lax.stop_gradient(jnp.where(slope == 0, 1, slope))
        y_2, _ = system.switch(y_1 - late * rate, s, guard)
        return (y_2, t + dt - late), (y_2, t + dt - late, s_new)

    following = jnp.concatenate([steps.s[:, 1:], steps.s[:, -1:]], axis=1)
    moves = jnp.arange(len(steps.duration)), steps.duration, steps.s.T, following.T, steps.guard
    _, (states, times, modes) = jax.lax.scan(body, (y, jnp.zeros_like(end)), moves)
    scale = units(system)
    result = SimulationResult.out_of_steps
    for outcome, member in enumerate(_RESULTS):
        result = SimulationResult.where(steps.status == outcome, member, result)
    return Trajectory(
        times=jnp.concatenate([jnp.zeros(1, y.dtype), times]) / system.omega,
        states=jnp.concatenate([y[None], states]) * scale[None],
        modes=jnp.concatenate([steps.s[:, :1].T, modes]),
        result=result,
        _system=system,
        _solution=None,
    )


@eqx.filter_jit
def _regularised(system: StickSlip, y, end, eps, solver, rtol, max_steps: int) -> Trajectory:
    from diffrax import RESULTS

    from . import regularised

    solution = regularised.solve(
        system, eps, y, end, solver, rtol, max_steps, t0=True, steps=True, dense=True
    )
    times, states = regularised.nodes(solution)
    sliding = system.V * (1 - states[:, 2:])
    far = jnp.max(jnp.abs(states[-1])) > 1e3 * (1 + jnp.max(jnp.abs(y)))
    result = SimulationResult.where(
        solution.result == RESULTS.successful,
        SimulationResult.reached,
        SimulationResult.out_of_steps,
    )
    result = SimulationResult.where(far, SimulationResult.diverged, result)
    return Trajectory(
        times=times / system.omega,
        states=states * units(system)[None],
        modes=jnp.where(jnp.abs(sliding) < eps, 0, jnp.sign(sliding)),
        result=result,
        _system=system,
        _solution=solution,
    )


def simulate(
    scene: Scene,
    start: Any,
    t1: Any,
    *,
    regularisation: Any = None,
    solver: Any = None,
    rtol: float | None = None,
    max_steps: int = 4096,
    throw: bool = True,
) -> Trajectory:
    """The motion from `start` over the time `t1`, by the exact law of dry friction.

    Eighth-order steps of equal length, each cut where the mode changes. Derivatives with respect
    to the scene, `start` and `t1` are those of the motion with its switches.

    **Arguments:**

    - `scene`: one scene; `jax.vmap` takes many.
    - `start`: (4,), [x1, x2, v1, v2] in m and m/s.
    - `t1`: end time [s], above 0.
    - `regularisation`: eps [m/s], to replace sgn v by tanh(v/eps); a mode is then 0 where
      abs(v) < eps. What it finds depends on eps: `limit_cycle` compares with the exact law.
    - `solver`: a diffrax solver for the regularised law, Tsit5 by default; an implicit one, such
      as Kvaerno5, for a small eps.
    - `rtol`: relative tolerance of a step, 1e-9 by default and at least 9.1e-13; in float32 both
      are 4.9e-4. Where nearby motions part, errors grow with them.
    - `max_steps`: most steps; one oscillation takes about 30.
    - `throw`: raise unless the end is reached; otherwise `result` tells how far it came.

    **Raises:** `ValueError` for a start of another shape, an argument outside its domain or an
    rtol that the precision cannot hold; `RuntimeError` as `throw` says.
    """
    require_scalar(scene)
    start = start_state(start)
    t1 = number("t1", t1, above=0)
    if t1.ndim:
        raise ValueError(f"t1 must be a scalar, got shape {t1.shape}; use jax.vmap for many")
    if not isinstance(max_steps, int) or max_steps < 1:
        raise ValueError(f"max_steps must be a whole number of at least 1, got {max_steps!r}")
    system = stick_slip(scene)
    y, end = start / units(system), t1 * system.omega
    rtol = check_rtol(rtol, y.dtype)
    if regularisation is not None:
        from .regularised import default_solver

        eps = number("regularisation", regularisation, above=0)
        solver = default_solver() if solver is None else solver
        return _checked(_regularised(system, y, end, eps, solver, rtol, max_steps), throw)
    h = jnp.asarray(min(0.25 * (rtol / 1e-9) ** 0.125, 0.5), y.dtype)
    frozen, y_0, end_0 = jax.lax.stop_gradient((system, y, end))
    steps = _run(frozen, y_0, end_0, h, rtol, max_steps=max_steps)
    if concrete(steps.count) is not None:
        # As few shapes as may be, each compiled once.
        used = min(max_steps, 1 << max(int(steps.count) - 1, 15).bit_length())
        steps = eqx.tree_at(
            lambda x: (x.duration, x.s, x.guard),
            steps,
            (steps.duration[:used], steps.s[:, :used], steps.guard[:used]),
        )
    return _checked(_repeat(system, y, end, steps), throw)


def _checked(trajectory: Trajectory, throw: bool) -> Trajectory:
    return raise_unless(SimulationResult.reached, trajectory) if throw else trajectory
