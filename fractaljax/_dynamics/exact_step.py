"""One step of the motion to a tolerance, up to the first switch inside it."""

import jax
import jax.numpy as jnp

from .events import Cubic, guards_and_rates, without_start
from .guard import NONE
from .hybrid import HybridSystem
from .knots import until_knot
from .segments import flow
from .step_length import step_length
from .transition import switch


def _event(system: HybridSystem, y, s, h, g_0, g_1, d_0, d_1):
    """Time and guard of the first switch in a step.

    The cubics through the guards g and their rates d at both ends give the first guess. The
    eighth-order flow decides, also whether a guard that dips towards zero and rises reaches it.
    """
    # One lane per guard, each at its own time t.
    k = len(g_0)
    lanes = jnp.broadcast_to(y[:, None], (len(y), k)), jnp.broadcast_to(s[:, None], (len(s), k))

    def value(y):
        return jnp.diagonal(system.guards(y, lanes[1])[1:])

    def derivative(function):
        return lambda y: jax.jvp(function, (y,), (system.field(y, lanes[1]),))[1]

    def along(t):
        return flow(system, lanes[0], t, lanes[1])

    rate = derivative(value)
    bend = derivative(rate)

    # In its contact state every guard starts above zero, up to rounding.
    rounding = 16 * jnp.finfo(y.dtype).eps * (1 + jnp.max(jnp.abs(y)) + system.largest_force)
    late = g_0 < -rounding
    g_0 = jnp.maximum(g_0, 0)
    d_0 = jnp.where((g_0 <= rounding) & (d_0 >= -rounding), jnp.maximum(d_0, 0), d_0)
    rising = d_0 >= 0
    cubic = Cubic.through(g_0, g_1, d_0, d_1)
    theta, inside = cubic.minimum()

    def lower(_, t):
        y = along(t)
        second = bend(y)
        return jnp.clip(t - rate(y) / jnp.where(second == 0, 1, second), 0, h)

    bottom = jnp.where(inside, jax.lax.fori_loop(0, 3, lower, theta * h), 0)
    lowest = along(bottom)
    depth, second = value(lowest), bend(lowest)
    dips = inside & (depth < -rounding)
    end = jnp.where(dips, bottom, h)
    falls = dips | (g_1 < 0)
    t = without_start(cubic, rising).root_before(end / h) * h
    # A shallow dip is a parabola. Far from it Newton's method would confuse its two roots.
    half = jnp.sqrt(2 * jnp.maximum(-depth, 0) / jnp.where(second > 0, second, 1))
    shallow = dips & (second > 0) & (depth > -1e-2)
    t = jnp.where(shallow, jnp.clip(bottom - half, 0, bottom), t)
    t = jnp.where(dips & (t >= bottom), bottom / 2, t)

    def searching(carry):
        *_, converged, count = carry
        # Usually four guesses suffice; 60 bisections reach rounding.
        return ~jnp.all(converged) & (count < 60)

    def refine(carry):
        t, low, high, converged, count = carry
        y = along(t)
        g, d = value(y), rate(y)
        low, high = jnp.where(g > 0, t, low), jnp.where(g > 0, high, t)
        # A guard that rises first has a root at the start of the step, which does not count:
        # Newton's method is for its quotient by t.
        slope = jnp.where(rising, d - g / jnp.where(t == 0, 1, t), d)
        guess = t - g / jnp.where(slope == 0, 1, slope)
        between = (guess >= low) & (guess <= high)
        guess = jnp.where(between, guess, (low + high) / 2)
        near = (jnp.abs(guess - t) <= close) | (jnp.abs(g) <= close)
        return jnp.where(converged, t, guess), low, high, converged | near, count + 1

    close = 2 * jnp.finfo(y.dtype).eps
    start = t, jnp.zeros_like(t), end, ~falls | late, 0
    t, *_ = jax.lax.while_loop(searching, refine, start)
    # A step of zero length would be repeated forever.
    t = jnp.where(rising, jnp.maximum(t, 1e-12 * h), t)
    t = jnp.where(late, 0, jnp.where(falls, t, jnp.inf))
    first = jnp.min(t)
    hit = first <= h
    return jnp.where(hit, first, h), jnp.where(hit, 1 + jnp.argmin(t), NONE)


def _smooth_step(system: HybridSystem, y, s, longest, left, rtol):
    """A step in contact state s, as long as rtol allows: the state at its end, and its length."""
    h = jnp.minimum(step_length(system, y, s, system.field(y, s), longest, longest), left)
    if system.knots is not None:
        h = until_knot(system, y, s, h)
    allowed = rtol * (1 + jnp.max(jnp.abs(y)))

    def step(h):
        y_1, error = flow(system, y, h, s, error=True)
        return y_1, h, jnp.max(jnp.abs(error)) / allowed

    def rejected(carry):
        (*_, error), count = carry
        return ~(error <= 1) & (count < 20)  # 0.2^20 of a step is rounding

    def shorter(carry):
        (_, h, error), count = carry
        return step(h * jnp.where(error < 1e5, 0.9 * error ** (-1 / 8), 0.2)), count + 1

    (y_1, h, _), _ = jax.lax.while_loop(rejected, shorter, (step(h), 0))
    return y_1, h


def step_to_switch(system: HybridSystem, y, s, longest, left, rtol):
    """A step up to the first switch: state, contact state, length, and the guard that ended it."""
    y_1, h = _smooth_step(system, y, s, longest, left, rtol)
    g_0, d_0 = guards_and_rates(system, y, s, h, system.field(y, s))
    g_1, d_1 = guards_and_rates(system, y_1, s, h, system.field(y_1, s))
    ends = [x[1:] for x in (g_0, g_1, d_0, d_1)]
    cubic = Cubic.through(*ends)
    theta, dips = cubic.minimum()
    # A cubic well above zero has no event.
    near = (jnp.minimum(cubic(theta), ends[1]) < 0.05) & (dips | (ends[1] < 0.05))
    dt, guard = jax.lax.cond(
        jnp.any(near | (ends[0] < 0)),
        lambda: _event(system, y, s, h, *ends),
        lambda: (h, jnp.array(NONE)),
    )
    end = jnp.where(guard == NONE, y_1, flow(system, y, dt, s))
    return *switch(system, end, s, guard), dt, guard
