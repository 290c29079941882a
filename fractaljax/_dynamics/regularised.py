"""The regularised friction law, tanh(v/eps) in place of sgn v, by diffrax and optimistix.

Its motion is smooth, so its limit cycle solves y(T) = y, u1 = 0; with an excitation T is known. But
it is the cycle of another mechanism, and nothing in it tells how far that is from the exact one.
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

from .._base.parts import concrete, nan_where
from .._mechanism.mechanism import Mechanism
from .cycle import CycleResult, Fractions, LimitCycle, Ranges, repels
from .events import Cubic
from .excitation import excited_system
from .hybrid import HybridSystem
from .scaled import scaled_start

DENSE = diffrax.SaveAt(t0=True, steps=True, dense=True)


def field(t, y, args) -> Float[Array, " 2n"]:
    """dy/dt of the regularised system in scaled units; `args` is (system, eps) with eps in m/s."""
    system, eps = args
    signs = jnp.tanh(system.speed * system.sliding(y[system.n :]) / eps)
    return system.regularised_field(y, signs)


def solve(system: HybridSystem, eps, y, until, *, solver, rtol, **options) -> Any:
    """diffrax's solution from y over [0, until] in scaled time; differentiable in both modes."""
    solver = diffrax.Tsit5() if solver is None else solver
    options = {"adjoint": diffrax.DirectAdjoint(), "throw": False} | options
    options["stepsize_controller"] = diffrax.PIDController(rtol=rtol, atol=rtol)
    term = diffrax.ODETerm(field)
    return diffrax.diffeqsolve(term, solver, 0.0, until, None, y, (system, eps), **options)


def nodes(solution) -> tuple[Float[Array, " n"], Float[Array, "n 2n"]]:
    """Times and states of the steps taken; unused ones repeat the last."""
    used = jnp.isfinite(solution.ts)
    last = jnp.maximum(jnp.sum(used) - 1, 0)
    return (
        jnp.where(used, solution.ts, solution.ts[last]),
        jnp.where(used[:, None], solution.ys, solution.ys[last]),
    )


class SmoothOrbit(eqx.Module):
    """The motion over one period, as diffrax's dense solution, and its numbers."""

    solution: Any
    _ranges: Ranges
    _fractions: Fractions
    _monodromy: Float[Array, "2n 2n"]

    def at(self, system: HybridSystem, times) -> Float[Array, "2n n"]:
        """Scaled states at scaled times (n,) within one period."""
        return jax.vmap(self.solution.evaluate, out_axes=1)(times)

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
    system: HybridSystem, eps, y, solver, rtol, max_steps, periods: int = 64, longest: int = 4
):
    """State and period where the motion from y nearly repeats, and the returns in that period.

    The transient takes that many of the slowest `periods`, and the period has at most `longest`
    returns. The last result is True if all were reached within `max_steps` steps for each.
    """
    K = jnp.diag(system.K) if system.K.ndim == 1 else system.K
    K = K[:-1, :-1] if system.excited else K
    flexibility = jnp.max(jnp.sum(jnp.abs(jnp.linalg.inv(K)), axis=1))
    slowest = 2 * jnp.pi * jnp.sqrt(flexibility)
    direction = system.section_direction
    run = functools.partial(solve, system, eps, solver=solver, adjoint=diffrax.ForwardMode())
    maximum = diffrax.Event(
        lambda t, y, args, **_: system.section(y), optimistix.Newton(rtol, rtol), False
    )

    def next_return(y, _):
        solution = run(y, 8 * slowest, rtol=rtol, max_steps=max_steps, event=maximum)
        y = solution.ys[0]
        # Exactly on the section, so that it is not crossed again at once.
        y = y.at[system.n :].add(-system.section(y) * direction / jnp.sum(direction**2))
        return y, (y, solution.ts[0], solution.result != diffrax.RESULTS.max_steps_reached)

    def next_period(y, _):
        solution = run(y, system.excitation_period, rtol=rtol, max_steps=max_steps)
        y = system.with_excitation(system.mechanism_state(solution.ys[0]), 0.0)
        reached = solution.result == diffrax.RESULTS.successful
        return y, (y, system.excitation_period, reached)

    steps, settling = periods * max_steps, periods * slowest
    if system.excited:
        settling = jnp.ceil(settling / system.excitation_period) * system.excitation_period
        next_return = next_period
    settled = run(y, settling, rtol=max(rtol, 1e-7), max_steps=steps)
    _, (ends, times, within) = jax.lax.scan(next_return, settled.ys[0], length=1 + longest)
    gaps = jnp.max(jnp.abs(ends[1:] - ends[:1]), axis=1)
    # States that are 1e-5 from each other repeat, however near the nearest are.
    returns = 1 + jnp.argmax(gaps <= 2 * jnp.min(gaps) + 1e-5)
    followed = (settled.result == diffrax.RESULTS.successful) & jnp.all(within)
    return (ends[0], jnp.cumsum(times[1:])[returns - 1]), returns, followed


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


def without_jump(mechanism: Any) -> Any:
    """`mechanism`, unless a static coefficient lies above mu(0): tanh has no room for its peak.

    **Raises:** `ValueError` naming the joint; a traced mechanism becomes NaN instead.
    """
    for name, joint in mechanism.joints_by_name().items():
        law = joint.friction
        if not law.has_jump:
            continue
        excess = law.mu_s / law.kinetic_limit() - 1
        jumps = excess > 64 * jnp.finfo(excess.dtype).eps
        values = concrete(jumps)
        if values is None:
            mechanism = nan_where(jumps.any(), mechanism)
        elif values.any():
            of = f" of joint {name}" if name else ""
            raise ValueError(
                f"friction{of} must not have mu_s above mu(0) where it is regularised: "
                "leave regularisation out"
            )
    return mechanism


@eqx.filter_jit
def regularised_cycle(
    mechanism: Mechanism,
    start,
    excitation,
    eps,
    exact: LimitCycle,
    solver,
    rtol: float,
    max_steps: int,
) -> LimitCycle:
    """The limit cycle of the regularised law from a start (2n,), beside the `exact` law's.

    The arguments are those of `limit_cycle`, with eps in m/s.
    """
    system = excited_system(mechanism, excitation)
    options = {"solver": solver, "max_steps": max_steps}
    looser, error = 10 * rtol, rtol
    if any(system.opens):
        # The field has a kink where a joint opens, which makes the gap rougher still.
        looser = error = 100 * rtol
        rtol = max(rtol / 100, 4096 * float(jnp.finfo(system.F.dtype).eps))
    frozen = jax.lax.stop_gradient((system, eps, scaled_start(system, start)))
    guess, returns, followed = _settle(*frozen, solver, rtol, max_steps)

    def gap(unknown, args):
        (y, period), (system, eps) = unknown, args
        return solve(system, eps, y, period, rtol=rtol, **options).ys[0] - y, system.section(y)

    def excited_gap(y, args):
        system, eps = args
        full, period = system.with_excitation(y, 0.0), returns * system.excitation_period
        return (
            system.mechanism_state(solve(system, eps, full, period, rtol=rtol, **options).ys[0]) - y
        )

    # Looser than the integration, whose adaptive steps make the gap rough.
    newton = optimistix.Newton(rtol=looser, atol=looser)
    function, unknown = gap, guess
    if system.excited:
        function, unknown = excited_gap, system.mechanism_state(guess[0])
    root = optimistix.root_find(function, newton, unknown, (system, eps), max_steps=16, throw=False)
    if system.excited:
        y = system.with_excitation(root.value, 0.0)
        period = returns * system.excitation_period
    else:
        y, period = root.value
    near = jnp.max(jnp.abs(y - guess[0])) < 0.2 * (1 + jnp.max(jnp.abs(guess[0])))
    # An equilibrium is periodic as well, with any period.
    moves = jnp.max(jnp.abs(field(0.0, y, (system, eps)))) > 1e-4
    exists = (root.result == optimistix.RESULTS.successful) & near & (period > 0) & moves

    solution = solve(system, eps, y, period, rtol=rtol, saveat=DENSE, **options)
    times, states = nodes(solution)
    rates = jax.vmap(lambda y: field(0.0, y, (system, eps)))(states)
    ranges = system.mechanism_state(extremes(times, states, rates).T).T * system.units[None]
    n = system.n
    w = jax.vmap(lambda y: system.sliding(y[n:]))(states)
    change = -jax.vmap(lambda rate: system.along(rate[n:]))(rates)
    width = eps / system.speed
    stuck = [
        share_below_zero(times, w[:, i] ** 2 - width**2, 2 * w[:, i] * change[:, i])
        for i in range(w.shape[1])
    ]
    moving = (states[:, :n].T,), (rates[:, :n].T,)
    pairs = zip(*jax.jvp(system.closures, *moving), strict=True)
    below = [share_below_zero(times, closure, change) for closure, change in pairs]
    below, opens = jnp.stack(below), np.array(system.opens)
    loads, changes = (x.T for x in jax.jvp(system.loads, *moving))
    forces = extremes(times, loads, changes).T[np.array([f[0] for f in system.faces])]
    forces = jnp.where(opens[:, None], jnp.maximum(forces, 0), forces) * system.force_unit

    def end(y):
        # Tangents are less accurate than states at the same tolerance.
        return solve(system, eps, y, period, rtol=rtol / 10, **options).ys[0]

    monodromy = jax.jacfwd(end)(y)
    amplitude = (ranges[1] - ranges[0])[: ranges.shape[1] // 2]
    numbers = jnp.stack([period / system.omega, *amplitude])
    difference = jnp.abs(numbers / jnp.stack([exact.period, *exact.amplitude]) - 1)
    difference = jax.lax.stop_gradient(jnp.max(difference))
    error = jnp.asarray(error, y.dtype)
    unstable = repels(*jax.lax.stop_gradient((monodromy, rates[0])), error)
    status = CycleResult.where(unstable, CycleResult.unstable, CycleResult.converged)
    # A tenth of a per cent, more than which nobody measures.
    status = CycleResult.where(difference <= 1e-3, status, CycleResult.depends_on_eps)
    # The tangential spring of a joint that opens lets go, and the tangents do not see the jump.
    held = [jnp.any(system.L[faces[-1]] != 0) & (len(faces) > 1) for faces in system.faces]
    jumps = jnp.any(opens & jnp.stack(held) & (below > 0))
    lost = CycleResult.where(followed, CycleResult.not_periodic, CycleResult.too_stiff)
    status = CycleResult.where(exists, status, lost)
    status = CycleResult.where(jumps & followed, CycleResult.jumps, status)
    exists = exists & ~jumps

    def only(value):
        return jnp.where(exists, value, jnp.nan)

    return LimitCycle(
        period=only(numbers[0]),
        state=only(system.mechanism_state(y) * system.units),
        error=only(error),
        returns=returns,
        regularisation_error=only(difference),
        result=status,
        of_scene=exact.of_scene,
        _system=system,
        _orbit=SmoothOrbit(
            solution,
            Ranges(ranges, forces),
            Fractions(jnp.stack(stuck), jnp.where(opens, below, 0), jnp.where(opens, 0, below)),
            system.mechanism_state(system.mechanism_state(monodromy).T).T,
        ),
    )
