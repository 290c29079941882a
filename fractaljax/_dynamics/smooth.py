"""Motion and limit cycles under friction without jumps, by diffrax and optimistix.

The motion is smooth, so that its limit cycle solves y(T) = y, u1 = 0; with an excitation T is
known. A regularised law is another mechanism's, and nothing in its cycle tells how far that is from
the exact one.
"""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from .._base.lapack import solve as solve_linear
from .._mechanism.mechanism import Mechanism
from .contact_state import OPEN, STICK
from .cycle import CycleResult, Fractions, LimitCycle, Ranges, repels
from .events import Cubic
from .hybrid import HybridSystem
from .simulate import SimulationResult, Trajectory
from .smooth_system import SmoothSystem, smooth_system

_SETTLED = 1e-4  # distance after a period, relative to the motion, from which on it is near a cycle
DENSE = diffrax.SaveAt(t0=True, steps=True, dense=True)


def field(t, y, system: SmoothSystem) -> Float[Array, " 2n+s"]:
    """dy/dt of a system, as diffrax asks for it."""
    return system.field(y)


def solve(system: SmoothSystem, y, until, *, solver, rtol, **options) -> Any:
    """diffrax's solution from y over [0, until] in scaled time; differentiable in both modes.

    Bristles are stiff: laws with memory take an implicit solver unless another is given.
    """
    if solver is None and system.eps is not None:
        solver = diffrax.Tsit5()
    elif solver is None:
        # diffrax's own choice, the chord method, takes ten times the steps at a kink.
        newton = diffrax.with_stepsize_controller_tols(optimistix.Newton)()
        solver = diffrax.Kvaerno5(root_finder=newton)
    options = {"adjoint": diffrax.DirectAdjoint(), "throw": False} | options
    options["stepsize_controller"] = diffrax.PIDController(rtol=rtol, atol=rtol)
    term = diffrax.ODETerm(field)
    return diffrax.diffeqsolve(term, solver, 0.0, until, None, y, system, **options)


def nodes(solution) -> tuple[Float[Array, " n"], Float[Array, "n 2n"]]:
    """Times and states of the steps taken; unused ones repeat the last."""
    used = jnp.isfinite(solution.ts)
    last = jnp.maximum(jnp.sum(used) - 1, 0)
    return (
        jnp.where(used, solution.ts, solution.ts[last]),
        jnp.where(used[:, None], solution.ys, solution.ys[last]),
    )


@eqx.filter_jit
def smooth_motion(
    mechanism: Mechanism, excitation, start, t0, t1, saveat, eps, solver, rtol, max_steps: int
) -> Trajectory:
    """The motion from a start, by the arguments of `simulate`; eps is None for laws with memory."""
    system = smooth_system(mechanism, excitation, eps)
    h, y = system.hybrid, system.start(start)
    y = system.with_excitation(system.mechanism_state(y), t0 * h.omega)
    options = {"solver": solver, "rtol": rtol, "max_steps": max_steps, "saveat": DENSE}
    if saveat is not None:
        options["saveat"] = diffrax.SaveAt(ts=(saveat - t0) * h.omega, t1=True)
    solution = solve(system, y, (t1 - t0) * h.omega, **options)
    if saveat is None:
        times, states = nodes(solution)
        last, times = states[-1], t0 + times / h.omega
    else:
        # What was not reached is infinite.
        last = jnp.where(jnp.isfinite(solution.ys), solution.ys, 0)
        times, states = saveat, jnp.where(jnp.isfinite(solution.ys), solution.ys, jnp.nan)[:-1]
    motion, head = states[:, : 2 * h.n], y[: 2 * h.n]
    sliding = h.speed * jax.vmap(lambda y: h.sliding(y[h.n :]))(motion)
    stuck = 0 if eps is None else eps
    contact_states = jnp.where(jnp.abs(sliding) < stuck, STICK, jnp.sign(sliding))
    if any(h.opens):
        contact_states = jnp.where(h.open_faces(motion.T).T, OPEN, contact_states)
    far = jnp.max(jnp.abs(last[..., : 2 * h.n])) > h.bound(head, h.equilibrium())
    reached = solution.result == diffrax.RESULTS.successful
    result = SimulationResult.where(
        reached, SimulationResult.reached, SimulationResult.out_of_steps
    )
    result = SimulationResult.where(far, SimulationResult.diverged, result)
    states = (system.mechanism_state(states.T) * system.units[:, None]).T
    return Trajectory(
        times=times,
        states=states[:, : len(h.units)],
        contact_states=contact_states,
        result=result,
        _system=h if saveat is None else None,
        _solution=solution if saveat is None else None,
        internal=states[:, len(h.units) :],
    )


class SmoothOrbit(eqx.Module):
    """The motion over one period, as diffrax's dense solution, and its numbers."""

    solution: Any
    _ranges: Ranges
    _fractions: Fractions
    _monodromy: Float[Array, "2n 2n"]

    def at(self, system: HybridSystem, times) -> Float[Array, "2n n"]:
        """Scaled states at scaled times (n,) within one period, without those of laws."""
        return jax.vmap(self.solution.evaluate, out_axes=1)(times)[: 2 * system.n]

    def ranges(self, system: HybridSystem) -> Ranges:
        """Extremes of displacements, velocities and normal forces."""
        return self._ranges

    def fractions(self, system: HybridSystem) -> Fractions:
        """Shares of sticking, of being open, and of pulling."""
        return self._fractions

    def monodromy(self, system: HybridSystem) -> Float[Array, "2n 2n"]:
        """The derivative of the state after a period by the state before it."""
        return self._monodromy


def _settle(
    system: SmoothSystem, y, solver, rtol, max_steps, most: int, periods: int = 64, longest: int = 4
):
    """State and period where the motion from y nearly repeats, and the returns in that period.

    The transient takes that many of the slowest `periods`, as often as the motion does not repeat,
    but in all no more than `most` of them; the period has at most `longest` returns. The last
    result is True if all were reached within `max_steps` steps for each.
    """
    h = system.hybrid
    K = jnp.diag(h.K) if h.K.ndim == 1 else h.K
    K = K[:-1, :-1] if h.excited else K
    flexibility = jnp.max(jnp.sum(jnp.abs(jnp.linalg.inv(K)), axis=1))
    slowest = 2 * jnp.pi * jnp.sqrt(flexibility)
    direction = h.section_direction
    run = functools.partial(solve, system, solver=solver, adjoint=diffrax.ForwardMode())
    maximum = diffrax.Event(
        lambda t, y, args, **_: system.section(y), optimistix.Newton(rtol, rtol), False
    )

    def next_return(y, _):
        solution = run(y, 8 * slowest, rtol=rtol, max_steps=max_steps, event=maximum)
        y = solution.ys[0]
        # Exactly on the section, so that it is not crossed again at once.
        y = y.at[h.n : 2 * h.n].add(-system.section(y) * direction / jnp.sum(direction**2))
        return y, (y, solution.ts[0], solution.result != diffrax.RESULTS.max_steps_reached)

    def next_period(y, _):
        solution = run(y, h.excitation_period, rtol=rtol, max_steps=max_steps)
        y = system.with_excitation(system.mechanism_state(solution.ys[0]), 0.0)
        reached = solution.result == diffrax.RESULTS.successful
        return y, (y, h.excitation_period, reached)

    equilibrium = system.equilibrium()
    # Without a belt a friction law with memory has no equilibrium of its own.
    equilibrium = jnp.where(jnp.isnan(equilibrium), 0, equilibrium)
    steps, settling = periods * max_steps, periods * slowest
    if h.excited:
        settling = jnp.ceil(settling / h.excitation_period) * h.excitation_period
        next_return = next_period

    def settle(y):
        settled = run(y, settling, rtol=max(rtol, 1e-7), max_steps=steps)
        y, (ends, times, within) = jax.lax.scan(next_return, settled.ys[0], length=1 + longest)
        gaps = jnp.max(jnp.abs(ends[1:] - ends[:1]), axis=1)
        # States as near to each other as a settled motion's repeat, however near the nearest are.
        near = _SETTLED * jnp.max(jnp.abs(ends[0] - equilibrium))
        returns = 1 + jnp.argmax(gaps <= 2 * jnp.min(gaps) + jnp.maximum(near, 1e-5))
        followed = (settled.result == diffrax.RESULTS.successful) & jnp.all(within)
        guess = ends[0], jnp.cumsum(times[1:])[returns - 1]
        return guess, returns, followed, jnp.min(gaps)

    if most <= periods:
        return settle(y)[:3]

    def again(carry):
        (y, _), _, followed, gap, k = carry
        size = jnp.max(jnp.abs(y - equilibrium))
        # Small beside the motion, which itself is not lost in rounding.
        unsettled = (gap > _SETTLED * size) & ~(size < 1e-6)
        return unsettled & followed & (k * periods < most)

    def once_more(carry):
        (y, _), *_, k = carry
        return *settle(y), k + 1

    none = jnp.asarray(jnp.inf, y.dtype)
    start = (y, jnp.zeros_like(none)), jnp.argmax(y[:1]), jnp.ones((), bool), none, 0
    return jax.lax.while_loop(again, once_more, start)[:3]


def _cubics(h, x, rate) -> Cubic:
    return Cubic.through(x[:-1], x[1:], h * rate[:-1], h * rate[1:])


def extremes(times, states, rates) -> Float[Array, "2 2n"]:
    """Smallest and largest value of each component over the steps of a solution."""
    h = jnp.diff(times)[:, None]
    cubics = _cubics(h, states, rates), _cubics(h, -states, -rates)
    low, high = (jnp.min(c(jax.lax.stop_gradient(c.minimum()[0])), axis=0) for c in cubics)
    return jnp.stack([low, -high])


def share_below_zero(times, values, rates) -> Float[Array, ""]:
    """The share of the time in which a quantity is negative, from its values and rates."""
    h = jnp.diff(times)
    starts, ends = values[:-1] < 0, values[1:] < 0
    sign = jnp.where(starts, -1, 1)
    cubic = jax.tree.map(lambda k: sign * k, _cubics(h, values, rates))
    zero = jax.lax.stop_gradient(cubic.root_before(jnp.ones_like(h)))
    # One Newton step from the zero carries its derivative.
    slope = jax.lax.stop_gradient(cubic.slope(zero))
    zero = zero - cubic(zero) / jnp.where(slope == 0, 1, slope)
    below = jnp.where(starts == ends, starts, jnp.where(starts, zero, 1 - zero))
    return jnp.sum(below * h) / times[-1]


def _further_step(system: SmoothSystem, monodromy, rate, gap, y, period) -> Float[Array, ""]:
    """How far one more step of Newton's method would go, relative to the state and the period."""
    if system.hybrid.excited:
        M = system.mechanism_state(system.mechanism_state(monodromy).T).T
        gap, y = system.mechanism_state(gap), system.mechanism_state(y)
        step, relative = solve_linear(jnp.eye(len(y)) - M, gap), jnp.zeros_like(period)
    else:
        section = jax.grad(system.section)(y)
        top = jnp.concatenate([jnp.eye(len(y)) - monodromy, -rate[:, None]], axis=1)
        bordered = jnp.concatenate([top, jnp.append(section, 0.0)[None]])
        step = solve_linear(bordered, jnp.append(gap, -system.section(y)))
        step, relative = step[:-1], jnp.abs(step[-1]) / period
    return jnp.maximum(jnp.max(jnp.abs(step)) / jnp.max(jnp.abs(y)), relative)


@eqx.filter_jit
def smooth_cycle(
    mechanism: Mechanism,
    start,
    excitation,
    eps,
    exact: LimitCycle | None,
    solver,
    rtol: float,
    max_steps: int,
    max_returns: int,
    of_scene: bool,
) -> LimitCycle:
    """The limit cycle from a start: with memory, or of the regularised law beside the `exact` one.

    The arguments are those of `limit_cycle`, with eps in m/s, None for laws with memory.
    """
    system = smooth_system(mechanism, excitation, eps)
    h = system.hybrid
    looser = 10 * rtol
    if any(h.opens) or eps is None:
        # The field has a kink where a joint opens, and where a bristle or a slider turns round,
        # which makes the gap rougher still.
        looser = 100 * rtol
        rtol = max(rtol / 100, 4096 * float(jnp.finfo(h.F.dtype).eps))
        max_steps *= 4  # by the order 5 of Kvaerno5 2.5 times as many, and more beside a kink
    options = {"solver": solver, "max_steps": max_steps}
    frozen = jax.lax.stop_gradient((system, system.start(start)))
    most = 0 if exact is not None else max_returns
    guess, returns, followed = _settle(*frozen, solver, rtol, max_steps, most)

    def after(system, y, period):
        end = solve(system, y, period, rtol=rtol, **options).ys[0]
        return jnp.where(jnp.isfinite(end), end, y)  # where the steps did not suffice

    def gap(unknown, system):
        y, period = unknown
        return after(system, y, period) - y, system.section(y)

    def excited_gap(y, system):
        full, period = system.with_excitation(y, 0.0), returns * system.hybrid.excitation_period
        return system.mechanism_state(after(system, full, period)) - y

    # Looser than the integration, whose adaptive steps make the gap rough.
    newton = optimistix.Newton(rtol=looser, atol=looser)
    function, unknown = gap, guess
    if h.excited:
        function, unknown = excited_gap, system.mechanism_state(guess[0])

    def root(unknown):
        found = optimistix.root_find(function, newton, unknown, system, max_steps=16, throw=False)
        return found.value

    # From a motion that was not followed Newton's method may go where nothing is finite.
    unknown = jax.lax.cond(followed, root, lambda unknown: unknown, unknown)
    if h.excited:
        y = system.with_excitation(unknown, 0.0)
        period = returns * h.excitation_period
    else:
        y, period = unknown
    near = jnp.max(jnp.abs(y - guess[0])) < 0.2 * (1 + jnp.max(jnp.abs(guess[0])))
    # An equilibrium is periodic as well, with any period.
    moves = jnp.max(jnp.abs(system.field(y))) > 1e-4
    exists = near & (period > 0) & moves

    solution = solve(system, y, period, rtol=rtol, saveat=DENSE, **options)
    followed &= solution.result == diffrax.RESULTS.successful
    exists &= followed
    times, states = nodes(solution)
    rates = jax.vmap(system.field)(states)
    n = h.n
    motion, change_of_motion = states[:, : 2 * n], rates[:, : 2 * n]
    ranges = h.mechanism_state(extremes(times, motion, change_of_motion).T).T * h.units[None]
    w = jax.vmap(lambda y: h.sliding(y[n : 2 * n]))(states)
    change = -jax.vmap(lambda rate: h.along(rate[n : 2 * n]))(rates)
    if eps is None:
        stuck = jnp.full(w.shape[1], jnp.nan)
    else:
        width = eps / h.speed
        stuck = jnp.stack(
            [
                share_below_zero(times, w[:, i] ** 2 - width**2, 2 * w[:, i] * change[:, i])
                for i in range(w.shape[1])
            ]
        )
    moving = (states[:, :n].T,), (rates[:, :n].T,)
    pairs = zip(*jax.jvp(h.closures, *moving), strict=True)
    below = [share_below_zero(times, closure, change) for closure, change in pairs]
    below, opens = jnp.stack(below), np.array(h.opens)
    loads, changes = (x.T for x in jax.jvp(h.loads, *moving))
    forces = extremes(times, loads, changes).T[np.array([f[0] for f in h.faces])]
    forces = jnp.where(opens[:, None], jnp.maximum(forces, 0), forces) * h.force_unit

    def end(y):
        # Tangents are less accurate than states at the same tolerance.
        return solve(system, y, period, rtol=rtol / 10, **options).ys[0]

    monodromy = jax.jacfwd(end)(y)
    amplitude = (ranges[1] - ranges[0])[: ranges.shape[1] // 2]
    numbers = jnp.stack([period / h.omega, *amplitude])
    fixed = jax.lax.stop_gradient((system, monodromy, rates[-1], states[-1] - y, y, period))
    error = jnp.maximum(looser / 10, _further_step(*fixed))
    # Steps of Newton's method that go on much farther than the integration's error lead nowhere.
    exists &= error <= max(looser, _SETTLED)
    unstable = repels(*jax.lax.stop_gradient((monodromy, rates[0])), error)
    status = CycleResult.where(unstable, CycleResult.unstable, CycleResult.converged)
    status = CycleResult.where(error <= looser, status, CycleResult.inaccurate)
    difference = jnp.zeros_like(error)
    lost = CycleResult.not_periodic
    if exact is not None:
        difference = jnp.abs(numbers / jnp.stack([exact.period, *exact.amplitude]) - 1)
        difference = jax.lax.stop_gradient(jnp.max(difference))
        # A tenth of a per cent, more than which nobody measures.
        status = CycleResult.where(difference <= 1e-3, status, CycleResult.depends_on_eps)
    else:
        settled = jnp.max(jnp.abs(system.field(guess[0]))) <= 1e-4
        lost = CycleResult.where(settled, CycleResult.equilibrium, lost)
        lost = CycleResult.where(jnp.isfinite(guess[0]).all(), lost, CycleResult.diverged)
    # The tangential spring of a joint that opens lets go, and the tangents do not see the jump.
    held = [jnp.any(h.L[faces[-1]] != 0) & (len(faces) > 1) for faces in h.faces]
    jumps = jnp.any(opens & jnp.stack(held) & (below > 0))
    lost = CycleResult.where(followed, lost, CycleResult.too_stiff)
    status = CycleResult.where(exists, status, lost)
    status = CycleResult.where(jumps & followed, CycleResult.jumps, status)
    exists = exists & ~jumps

    def only(value):
        return jnp.where(exists, value, jnp.nan)

    state = only(system.mechanism_state(y) * system.units)
    return LimitCycle(
        period=only(numbers[0]),
        state=state[: len(h.units)],
        error=only(error),
        returns=returns,
        regularisation_error=only(difference),
        result=status,
        of_scene=of_scene,
        _system=h,
        _orbit=SmoothOrbit(
            solution,
            Ranges(ranges, forces),
            Fractions(stuck, jnp.where(opens, below, 0), jnp.where(opens, 0, below)),
            system.mechanism_state(system.mechanism_state(monodromy).T).T,
        ),
        internal=state[len(h.units) :],
    )
