"""The motion from a start: stick and slip by the exact law, every switch resolved.

A first pass finds the steps: their lengths and contact states. A second pass repeats them. There
the length of a step that ends in a switch is a function of its start, by one Newton step from the
known length. So derivatives pass through switches, and no search is differentiated.
"""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, ScalarLike

from .._base.parts import (
    Record,
    brief,
    concrete,
    nan_where,
    number,
    raise_unless,
    refused,
    scalar,
    whole,
)
from .._base.programs import exported_jit
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import has_memory
from .exact_step import step_to_switch
from .excitation import Excitation, excited_system
from .guard import NONE
from .hybrid import HybridSystem
from .knots import within_step
from .scaled import (
    check_rtol,
    degrees_of_freedom,
    displaced_equilibrium,
    hybrid_system,
    moves_without_drive,
    require_drive,
    smoothing,
    start_state,
)
from .segments import chosen_guard, flow
from .transition import first_contact_state, switch

if TYPE_CHECKING:
    from diffrax import AbstractSolver


class SimulationResult(eqx.Enumeration):
    """How a simulation ended."""

    reached = "the end time was reached"
    out_of_steps = "max_steps were used up before the end time"
    diverged = "the motion grew beyond all bounds"
    not_finite = (
        "the motion is not a number, as some number of the mechanism or of the start is not"
    )


class Trajectory(Record):
    """The motion of a mechanism, as `simulate` returns it; unused steps repeat the last state.

    With `saveat` everything is at those times only; what was not reached is NaN.
    """

    times: Float[Array, " n"]  # at the ends of the steps, from t0 on [s]
    states: Float[Array, "n 2n"]  # [x, v] [m, m/s]
    contact_states: Float[
        Array, "n f"
    ]  # from each time on: +1, -1 slip forward, backward, 0 stick, 2 open
    result: SimulationResult  # a member of SimulationResult
    _system: HybridSystem | None = eqx.field(repr=False)  # None with `saveat`
    _solution: Any = eqx.field(repr=False)  # diffrax's, without an exact law
    # The states of laws with memory at the times, law by law and face by face; else None
    internal: Float[Array, "n s"] | None = eqx.field(default=None, repr=False)

    @property
    def end(self) -> Float[Array, " 2n"]:
        """The last state [m, m/s]."""
        return self.states[-1]

    def at(self, times: ArrayLike | Sequence[float]) -> Float[Array, "k 2n"]:
        """States at `times` (k,) [s] from `t0` to the end of the simulation.

        NaN at times outside that are traced.

        **Raises:** `ValueError` for times of another shape or outside, and for a simulation with
        `saveat`.
        """
        self._continuous()
        return _states(self, self._inside(number("times", jnp.asarray(times))))

    def _continuous(self) -> HybridSystem:
        """The system of a simulation that holds its states between the times.

        **Raises:** `ValueError` for a simulation with `saveat`.
        """
        if self._system is None:
            raise ValueError("a simulation with saveat has no states between: leave saveat out")
        return self._system

    def _at(self, system: HybridSystem, times) -> Array:
        scale = system.units
        if self._solution is not None:
            y = jax.vmap(self._solution.evaluate, out_axes=1)(
                (times - self.times[0]) * system.omega
            )
            return (system.mechanism_state(y[: 2 * system.n]) * scale[:, None]).T
        k = self._step(times)
        after = (times - self.times[k]) * system.omega
        start = (self.states[k] / scale[None]).T
        start = system.with_excitation(start, self.times[k] * system.omega)
        y = flow(system, start, after, self.contact_states[k].T)
        return (system.mechanism_state(y) * scale[:, None]).T

    def _step(self, times) -> Int[Array, " k"]:
        """The steps that contain these times."""
        frozen = jax.lax.stop_gradient((self.times, times))
        return jnp.clip(jnp.searchsorted(*frozen, side="right") - 1, 0, len(self.times) - 1)

    def _inside(self, times) -> Array:
        if times.ndim != 1:
            raise ValueError(f"times must have shape (k,), got {times.shape}")
        first, last = self.times[0], self.times[-1]
        # The end is exact up to rounding: t1 itself is inside.
        rounding = 8 * jnp.finfo(last.dtype).eps * jnp.maximum(jnp.abs(first), jnp.abs(last))
        outside = (times < first) | (times > last + rounding)
        is_outside, requested = concrete(outside), concrete(times)
        if is_outside is None or requested is None:
            return nan_where(outside, times)
        if is_outside.any():
            message = f"times must be from t0 to the end of the simulation, {float(last)!r}"
            raise ValueError(f"{message}, got {requested[is_outside][0].item()!r}")
        return times

    def switches(self) -> list[tuple[float, int, int, int]]:
        """Every switch: time [s], face (from 1), contact state before, contact state after.

        The faces of a scene are its directions; those of a structure come joint by joint, along
        t and, where there is a normal, along n.

        **Raises:** `ValueError` for a simulation with `saveat`.
        """
        if self._system is None:
            raise ValueError("a simulation with saveat does not hold its switches")
        states, times = np.asarray(self.contact_states), np.asarray(self.times)
        return [
            (float(times[k + 1]), int(i) + 1, int(states[k, i]), int(states[k + 1, i]))
            for k, i in np.argwhere(states[1:] != states[:-1])
        ]


class _Steps(eqx.Module):
    """The steps of the first pass."""

    duration: Float[Array, " n"]
    s: Float[Array, "f n"]
    guard: Int[Array, " n"]
    count: Int[Array, ""]
    result: SimulationResult


@functools.partial(jax.jit, static_argnames="max_steps")
def _find_steps(system: HybridSystem, y, end, h, rtol, *, max_steps: int) -> _Steps:
    limit = system.bound(y, system.equilibrium())

    def running(carry):
        y, _, t, k, *_ = carry
        return (t < end) & (k < max_steps) & (jnp.max(jnp.abs(y)) <= limit)

    def body(carry):
        y, s, t, k, duration, states, guards = carry
        y, s_new, dt, guard = step_to_switch(system, y, s, h, end - t, rtol)
        # Otherwise rounding could leave some time after the last step.
        t = jnp.where((guard == NONE) & (dt >= end - t), end, t + dt)
        recorded = duration.at[k].set(dt), states.at[:, k].set(s), guards.at[k].set(guard)
        return y, s_new, t, k + 1, *recorded

    n = max_steps
    s = first_contact_state(system, y)
    empty = jnp.zeros(n, y.dtype), jnp.ones((len(s), n), y.dtype), jnp.full(n, NONE)
    start = y, s, jnp.zeros((), y.dtype), 0, *empty
    y, s, t, count, duration, states, guards = jax.lax.while_loop(running, body, start)
    result = SimulationResult.where(
        jnp.max(jnp.abs(y)) > limit, SimulationResult.diverged, SimulationResult.not_finite
    )
    result = SimulationResult.where(count >= n, SimulationResult.out_of_steps, result)
    result = SimulationResult.where(t >= end, SimulationResult.reached, result)
    # Unused steps keep the last contact state.
    states = jnp.where(jnp.arange(n)[None] < count, states, s[:, None])
    return _Steps(duration, states, guards, jnp.asarray(count), result)


@jax.jit
def _repeat(system: HybridSystem, y, t0, end, steps: _Steps) -> Trajectory:
    """The steps once more, differentiably."""
    last = jnp.where(steps.result == SimulationResult.reached, steps.count - 1, -1)

    def body(carry, step):
        y, t = carry
        k, dt, s, s_new, guard = step
        # The last step ends at the end, wherever the switches before it move.
        dt = jnp.where(k == last, end - t, dt)
        y_1 = flow(within_step(system, y, dt, s), y, dt, s)
        rate = system.field(y_1, s)
        value, slope = jax.jvp(lambda y: chosen_guard(system, y, s, guard), (y_1,), (rate,))
        # Zero, with minus the derivative of the time at which the guard is zero.
        off = value - jax.lax.stop_gradient(value)
        late = off / jax.lax.stop_gradient(jnp.where(slope == 0, 1, slope))
        y_2, _ = switch(system, y_1 - late * rate, s, guard)
        return (y_2, t + dt - late), (y_2, t + dt - late, s_new)

    following = jnp.concatenate([steps.s[:, 1:], steps.s[:, -1:]], axis=1)
    moves = jnp.arange(len(steps.duration)), steps.duration, steps.s.T, following.T, steps.guard
    _, (states, times, after) = jax.lax.scan(body, (y, jnp.zeros_like(end)), moves)
    states = jnp.concatenate([y[None], states]).T
    return Trajectory(
        times=t0 + jnp.concatenate([jnp.zeros(1, y.dtype), times]) / system.omega,
        states=(system.mechanism_state(states) * system.units[:, None]).T,
        contact_states=jnp.concatenate([steps.s[:, :1].T, after]),
        result=steps.result,
        _system=system,
        _solution=None,
    )


@eqx.filter_jit
def _states(trajectory: Trajectory, times) -> Array:
    """`Trajectory.at` for checked times."""
    return trajectory._at(trajectory._continuous(), times)


@jax.jit
def _sampled(trajectory: Trajectory, saveat) -> Trajectory:
    """The motion at the times `saveat` alone."""
    states = trajectory._at(trajectory._continuous(), saveat)
    contact_states = trajectory.contact_states[trajectory._step(saveat)]
    reached = trajectory.result == SimulationResult.reached
    missing = ((saveat > trajectory.times[-1]) & ~reached)[:, None]
    return Trajectory(
        times=saveat,
        states=jnp.where(missing, jnp.nan, states),
        contact_states=jnp.where(missing, jnp.nan, contact_states),
        result=trajectory.result,
        _system=None,
        _solution=None,
    )


def simulate(
    mechanism: Mechanism,
    start: ArrayLike | Sequence[float] | None = None,
    t1: ScalarLike | None = None,
    *,
    excitation: Excitation | None = None,
    t0: ScalarLike = 0.0,
    saveat: ArrayLike | Sequence[float] | None = None,
    regularisation: ScalarLike | None = None,
    solver: "AbstractSolver | None" = None,
    rtol: float | None = None,
    max_steps: int = 4096,
    throw: bool = True,
) -> Trajectory:
    """The motion from `start` at `t0` until `t1`, by the exact law of dry friction.

    Eighth-order steps of equal length, each cut where the contact state changes. Derivatives with
    respect to the mechanism, the excitation, `start`, `t0` and `t1` are those of the motion with
    its switches; a start or an end by default depends on the mechanism.

    **Arguments:**

    - `mechanism`: a scene, or a structure of n degrees of freedom whose joints all have a V;
      `jax.vmap` takes many. With the exact law V may be 0 without an excitation: the motion from a
      `start`, which is then needed, decays until the joints stick.
    - `start`: (2n,), [x, v] in m and m/s; by default as in `limit_cycle`, near the sliding
      equilibrium. With friction that has memory its states are those of steady sliding, or follow
      as (2n + s,), as `internal` has them.
    - `t1`: end time [s], above `t0`; by default 50 periods 2 pi/omega later, omega as there.
    - `excitation`: a harmonic force, whose phase refers to the time 0.
    - `t0`: start time [s].
    - `saveat`: (k,), times [s] in order from `t0` to `t1`, at which alone states are returned. The
      memory that the regularised law takes then does not grow with the steps.
    - `regularisation`: eps [m/s], to replace sgn v by tanh(v/eps); a contact state is then 0 where
      abs(v) < eps. The motion depends on eps: `limit_cycle` compares with the exact law.
    - `solver`: a diffrax solver for the regularised law, Tsit5 by default; an implicit one, such
      as Kvaerno5, for a small eps. Friction with memory takes Kvaerno5 by default; with soft
      bristles Tsit5 is quicker.
    - `rtol`: relative tolerance of a step, 1e-9 by default and at least 9.1e-13; in float32 both
      are 4.9e-4. Errors grow with the distance between nearby motions.
    - `max_steps`: most steps; one oscillation takes about 30, with memory some hundreds, for a
      spring in series with a slider has a kink at each end of slip.
    - `throw`: raise unless the end is reached; otherwise `result` says why.

    **Raises:** `ValueError` for a start of another shape, an argument outside its domain or an
    rtol that the precision cannot hold; `RuntimeError` if `throw`. Under a trace (`jit`, `vmap`)
    everything is NaN instead.
    """
    memory = has_memory(mechanism)
    n = degrees_of_freedom(mechanism)
    start = None if start is None else start_state(start, n, memory)
    exact = not memory and regularisation is None
    decays = excitation is None and exact and moves_without_drive(mechanism, start)
    if not decays:
        require_drive(mechanism, excitation)
    t0, t1 = _times(t0, t1)
    if t1 is None:
        t1 = _default_end(mechanism, excitation, t0, memory)
    saveat = None if saveat is None else _checked(saveat, t0, t1)
    n = whole("max_steps", max_steps, 1)
    rtol = check_rtol(rtol, jnp.result_type(*jax.tree.leaves((mechanism, start, excitation))))
    if memory or regularisation is not None:
        from .smooth import smooth_motion
        from .smooth_system import without_jump

        eps = smoothing(regularisation, memory)
        mechanism = mechanism if memory else without_jump(mechanism)
        times, options = (t0, t1, saveat), (eps, solver, rtol, n)
        trajectory = smooth_motion(mechanism, excitation, start, *times, *options)
    else:
        system, y, t0, end = _scaled(mechanism, excitation, start, t0, t1, decays=decays)
        h = jnp.asarray(min(0.25 * (rtol / 1e-9) ** 0.125, 0.5), y.dtype)
        frozen = jax.lax.stop_gradient((system, y, end))
        steps = _find_steps(*frozen, h, rtol, max_steps=n)
        if concrete(steps.count) is not None:
            # The second pass has one of few lengths, so that little is compiled.
            used = min(n, 1 << max(int(steps.count) - 1, 15).bit_length())
            shorter = steps.duration[:used], steps.s[:, :used], steps.guard[:used]
            steps = eqx.tree_at(lambda x: (x.duration, x.s, x.guard), steps, shorter)
        trajectory = _repeat(system, y, t0, end, steps)
        trajectory = trajectory if saveat is None else _sampled(trajectory, saveat)
    if (bad := refused((mechanism, excitation, start, t0, t1, saveat))) is not None:
        trajectory = nan_where(bad, trajectory)  # contact states as well
    return raise_unless(SimulationResult.reached, trajectory) if throw else trajectory


@functools.partial(exported_jit, static_argnames="memory")
def _default_end(mechanism, excitation, t0, memory):
    """A time 50 periods after t0, so few that max_steps allows far more than the 30 of each."""
    return t0 + 100 * jnp.pi / excited_system(mechanism, excitation, memory).omega


def _unit_of_decay(mechanism, start, V, omega):
    """V, or where it is 0 the velocity that the start or the constant force may lead to."""
    by_force = hybrid_system(mechanism, lambda V, _: jnp.ones_like(V)).largest_force
    x, v = jnp.split(jnp.abs(start), 2)
    largest = jnp.max(jnp.append(jnp.maximum(omega * x, v), by_force))
    largest = jnp.where(largest > 0, largest, 1)
    return jax.lax.stop_gradient(jnp.where(V > 0, V, largest))


@functools.partial(exported_jit, static_argnames="decays")
def _scaled(mechanism, excitation, start, t0, t1, *, decays):
    """The system, its state at t0, t0, and the duration in scaled time.

    Where the motion `decays`, as joints have V = 0, its start and the constant force are its unit.
    """
    if decays:
        system = hybrid_system(mechanism, functools.partial(_unit_of_decay, mechanism, start))
    else:
        system = excited_system(mechanism, excitation)
    y = displaced_equilibrium(system) if start is None else start / system.units
    y = system.with_excitation(y, t0 * system.omega)
    return system, y, *(jnp.asarray(t, y.dtype) for t in (t0, (t1 - t0) * system.omega))


def _times(t0, t1) -> tuple[Float[Array, ""], Float[Array, ""] | None]:
    """t0 and t1, if it is stated, as numbers, t1 above t0."""
    t0 = scalar("t0", t0)
    if t1 is None:
        return t0, None
    start = concrete(t0)
    if start is not None:
        return t0, scalar("t1", t1, above=float(start))
    t1 = scalar("t1", t1)
    return t0, nan_where(~(t1 > t0), t1)


def _checked(saveat, t0, t1) -> Float[Array, " k"]:
    """The times of `saveat`, if they are in order from t0 to t1."""
    saveat = number("saveat", jnp.asarray(saveat))
    if saveat.ndim != 1 or not len(saveat):
        raise ValueError(f"saveat must have shape (k,) with k at least 1, got {saveat.shape}")
    ends = jnp.concatenate([t0[None], saveat, t1[None]])
    bad = jnp.any(ends[1:] < ends[:-1])
    unordered = concrete(bad)
    if unordered is None:
        return nan_where(bad, saveat)
    if unordered:
        raise ValueError(f"saveat must be in order from t0 to t1, got {brief(np.asarray(saveat))}")
    return saveat
