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

from .events import Cubic
from .stick_slip import StickSlip

# Turns of the transient run, and those looked at for a period.
_TRANSIENT = 64
_LOOKED_AT = 6
_LONGEST = 4


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
    ends = jax.vmap(window.evaluate)(jnp.nan_to_num(times))
    distances = jnp.max(jnp.abs(ends[1 : _LONGEST + 1] - ends[:1]), axis=1)
    distances = jnp.where(jnp.isnan(times[1 : _LONGEST + 1]), jnp.inf, distances)
    closest = jnp.min(distances)
    turns = 1 + jnp.argmax(distances <= 2 * closest + 1e-6)
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
