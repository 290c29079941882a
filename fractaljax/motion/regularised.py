"""The regularised friction law, tanh(v/eps) in place of sgn v, on diffrax.

The motion is smooth, so its limit cycle is a plain two-point boundary problem; but it is another
mechanism's, and how far its answers are from the exact law's is not to be seen in them.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix

from ..mechanism.scene import Scene
from .cycle import CycleResult, LimitCycle, repels
from .events import Cubic
from .stick_slip import StickSlip, scaled_start, stick_slip, units

# Turns of the transient run, and those looked at for a period.
_TRANSIENT = 64
_LOOKED_AT = 6
_LONGEST = 4
_SAME = 1e-5  # scaled: states no further apart repeat
_TOLERANCE = 1e-3  # of the relative difference from the exact law's cycle


def field(t, y, args) -> jax.Array:
    """dy/dt of the regularised system in scaled units; `args` is (system, eps) with eps in m/s."""
    system, eps = args
    signs = jnp.tanh(system.V * (1 - y[2:]) / eps)
    return jnp.stack([y[2], y[3], *system.accelerations(y, signs)])


def solve(system: StickSlip, eps, y, until, solver, rtol, max_steps: int, **saveat) -> Any:
    """diffrax's solution from y over [0, until] in scaled time; differentiable in both modes."""
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        solver,
        0.0,
        until,
        None,
        y,
        (system, eps),
        saveat=diffrax.SaveAt(**saveat),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        max_steps=max_steps,
        # Forward and reverse mode; the others know one of the two.
        adjoint=diffrax.DirectAdjoint(),
        throw=False,
    )


def default_solver():
    """For an eps that is not small; an implicit solver takes longer steps below that."""
    return diffrax.Tsit5()


def nodes(solution) -> tuple[jax.Array, jax.Array]:
    """Times (n,) and states (n, 4) of the steps taken; unused ones repeat the last."""
    used = jnp.isfinite(solution.ts)
    last = jnp.maximum(jnp.sum(used) - 1, 0)
    return (
        jnp.where(used, solution.ts, solution.ts[last]),
        jnp.where(used[:, None], solution.ys, solution.ys[last]),
    )


class Periodic(eqx.Module):
    """A closed orbit of the regularised law, in scaled units."""

    y: jax.Array  # (4,) where u1 falls through 0
    period: jax.Array
    turns: jax.Array
    found: jax.Array
    followed: jax.Array  # False where max_steps ended the integration


class Smooth(eqx.Module):
    """The motion as diffrax's dense solution over one period."""

    solution: Any

    def at(self, system: StickSlip, times) -> jax.Array:
        """Scaled states (4, n) at scaled times (n,) within one period."""
        return jax.vmap(self.solution.evaluate, out_axes=1)(times)


def _turns(times, u):
    """Times at which u1 falls through 0, the first ones, by linear interpolation."""
    falls = (u[:-1] > 0) & (u[1:] <= 0)
    (k,) = jnp.nonzero(falls, size=_LOOKED_AT, fill_value=-1)
    share = u[k] / jnp.where(u[k] == u[k + 1], 1, u[k] - u[k + 1])
    return jnp.where(k < 0, jnp.nan, times[k] + share * (times[k + 1] - times[k]))


def close(system: StickSlip, eps, y, solver, rtol, max_steps: int) -> Periodic:
    """The periodic orbit that the motion from y settles on, if it does within 64 turns.

    No event ends an integration: a run over a given time is smooth in all that it depends on.
    """
    frozen, eps_0, y = jax.lax.stop_gradient((system, eps, y))
    slowest = 2 * jnp.pi / jnp.sqrt(jnp.minimum(frozen.a, 1 - frozen.a))
    run = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        solver,
        0.0,
        _TRANSIENT * slowest,
        None,
        y,
        (frozen, eps_0),
        stepsize_controller=diffrax.PIDController(rtol=max(rtol, 1e-7), atol=max(rtol, 1e-7)),
        max_steps=None,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    assert run.ys is not None
    y = run.ys[0]
    steps = _LOOKED_AT * max_steps
    window = solve(
        frozen, eps_0, y, _LOOKED_AT * slowest, solver, rtol, steps, steps=True, dense=True
    )
    times, states = nodes(window)
    times = _turns(times, states[:, 2])
    for _ in range(2):  # between steps u1 is no line, and turns must not differ by that
        ends = jax.vmap(window.evaluate)(jnp.nan_to_num(times))
        rates = jax.vmap(lambda y: field(0.0, y, (frozen, eps_0)))(ends)
        times = times - ends[:, 2] / jnp.where(rates[:, 2] == 0, 1, rates[:, 2])
    ends = jax.vmap(window.evaluate)(jnp.nan_to_num(times))
    distances = jnp.max(jnp.abs(ends[1 : _LONGEST + 1] - ends[:1]), axis=1)
    distances = jnp.where(jnp.isnan(times[1 : _LONGEST + 1]), jnp.inf, distances)
    closest = jnp.min(distances)
    turns = 1 + jnp.argmax(distances <= 2 * closest + _SAME)
    guess = jnp.nan_to_num(ends[0]), jnp.nan_to_num(times[turns] - times[0], nan=1.0)

    def gap(unknown, args):
        y, period = unknown
        system, eps = args
        end = solve(system, eps, y, period, solver, rtol, max_steps, t1=True).ys[0]
        return end - y, y[2]

    root = optimistix.root_find(
        gap,
        # Looser than the integration, whose steps make the gap rough.
        optimistix.Newton(rtol=10 * rtol, atol=10 * rtol),
        guess,
        (system, eps),
        max_steps=16,
        throw=False,
    )
    y, period = root.value
    near = jnp.max(jnp.abs(y - guess[0])) < 0.2 * (1 + jnp.max(jnp.abs(guess[0])))
    found = (root.result == optimistix.RESULTS.successful) & near & (period > 0)
    followed = window.result == diffrax.RESULTS.successful
    # Rest is periodic as well, with any period.
    moves = jnp.max(jnp.abs(field(0.0, y, (frozen, eps_0)))) > 1e-4
    return Periodic(y, period, turns, found & moves, followed)


def extremes(times, states, rates) -> jax.Array:
    """Smallest and largest value of each component (2, 4) over the steps of a solution."""
    change = jnp.diff(times)[None, :, None] * jnp.stack([rates[:-1], rates[1:]])
    sign = jnp.array([1.0, -1.0], states.dtype)[:, None, None]
    cubic = Cubic.through(
        sign * states[None, :-1], sign * states[None, 1:], sign * change[:1], sign * change[1:]
    )
    theta, _ = jax.lax.stop_gradient(cubic.minimum())
    return sign[:, 0] * jnp.min(cubic(theta), axis=1)


def share(times, values, rates) -> jax.Array:
    """The share of the time in which a quantity, given with its rate at the steps, is below 0."""
    h = jnp.diff(times)
    cubic = Cubic.through(values[:-1], values[1:], h * rates[:-1], h * rates[1:])
    starts, ends = values[:-1] < 0, values[1:] < 0
    sign = jnp.where(starts, -1, 1)
    flipped = jax.tree.map(lambda c: sign * c, cubic)
    zero = jax.lax.stop_gradient(flipped.root_before(jnp.ones_like(h)))
    # One Newton step from the zero carries its derivative.
    slope = jax.lax.stop_gradient(flipped.slope(zero))
    zero = zero - flipped(zero) / jnp.where(slope == 0, 1, slope)
    below = jnp.where(starts == ends, starts, jnp.where(starts, zero, 1 - zero))
    return jnp.sum(below * h) / times[-1]


@eqx.filter_jit
def regularised_cycle(
    scene: Scene, start, eps, exact: LimitCycle, solver, rtol: float, max_steps: int
) -> LimitCycle:
    """The limit cycle of the regularised law from a start (4,), beside the `exact` law's.

    The arguments are those of `limit_cycle`, with eps in m/s.
    """
    system = stick_slip(scene)
    y = scaled_start(scene, system, start)
    closed = close(system, eps, y, solver, rtol, max_steps)
    solution = solve(
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
    times, states = nodes(solution)
    rates = jax.vmap(lambda y: field(0.0, y, (system, eps)))(states)
    low, high = extremes(times, states, rates) * units(system)[None]

    def end(y):
        # Tangents are less accurate than states at the same tolerance.
        tight = rtol / 10, max_steps
        return solve(system, eps, y, closed.period, solver, *tight, t1=True).ys[0]

    width = eps / system.V
    stuck = [
        share(times, (1 - u) ** 2 - width**2, 2 * (u - 1) * a)
        for u, a in zip(states.T[2:], rates.T[2:], strict=True)
    ]
    period = closed.period / system.omega
    amplitude = (high - low)[:2]
    differences = jnp.abs(
        jnp.stack([period / exact.period - 1, *(amplitude / exact.amplitude - 1)])
    )
    error = jax.lax.stop_gradient(jnp.max(differences))
    monodromy = jax.jacfwd(end)(closed.y)
    leaves = repels(*jax.lax.stop_gradient((monodromy, rates[0])), jnp.asarray(rtol, y.dtype))
    status = CycleResult.where(leaves, CycleResult.unstable, CycleResult.converged)
    status = CycleResult.where(error <= _TOLERANCE, status, CycleResult.depends_on_eps)
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
        tension_fraction=only(share(times, states[:, 1], rates[:, 1])),
        state=only(closed.y * units(system)),
        error=only(jnp.asarray(rtol, y.dtype)),
        turns=closed.turns,
        regularisation_error=only(error),
        result=status,
        _monodromy=only(monodromy),
        _system=system,
        _motion=Smooth(solution),
    )
