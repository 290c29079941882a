"""How short a step must be where friction or a load curve is stiff."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._friction import SPEEDS
from .contact_state import in_states
from .hybrid import HybridSystem


def crowding(system: HybridSystem, y, s) -> Array:
    """Factor (...) by which segments should be shorter where load curves bend."""
    return 2 * _rate_of_curves(system, y, s, 1 / 4)


def density(system: HybridSystem, y, s, longest) -> Array:
    """Factor (...) by which segments from y on should be shorter than `longest` (...)."""
    shortest = step_length(system, y, s, system.field(y, s), longest, longest)
    return jnp.maximum(longest / shortest, crowding(system, y, s))


def step_length(system: HybridSystem, y, s, rate, longest, allowed) -> Array:
    """The length (...) of a step, at most `longest`, that is `allowed`/2 at a stiffness of 1.

    `rate` is dy/dt. The stiffness is the largest rate at which load curves change, or at which
    friction alone changes the velocity of a slipping face, at any velocity that the step can
    reach: far from equilibrium it exceeds every other rate, and a law may fall within a small
    part of the way to w = 0.
    """
    least = allowed / longest
    step = allowed / jnp.maximum(least, 2 * _rate_of_curves(system, y, s, 1 / 16))
    if system.scales is None:
        return step
    u, loads = y[system.n :], system.loads(y[: system.n])
    rubbing = in_states(s, [state for state in system.states if state.closed and state.force])
    loads = system.self_acceleration(jnp.where(rubbing, jnp.abs(loads), 0))
    w, change = jnp.abs(system.sliding(u)), jnp.abs(system.along(rate[system.n :]))
    # No eigenfrequency exceeds 1, so that accelerations change by about the velocities.
    bend = (1 + jnp.max(jnp.abs(u), axis=0)) / 2
    fastest = w + (change + (longest * bend)[None]) * longest[None]
    bound = jnp.max(_steepest(system, fastest) * loads, axis=0)

    def shortened():
        # The longest of these shares of the step over which the friction ahead is not too steep.
        trials = jnp.multiply.outer(jnp.asarray(4.0 ** -np.arange(13), y.dtype), longest)
        ways = (change[None] + (trials * bend[None])[:, None]) * trials[:, None]
        speeds = jnp.concatenate([jnp.maximum(w[None] - ways, 0), w[None], w[None] + ways])
        rates = jax.vmap(lambda w: _steepness(system, w, loads))(speeds)
        slower, here, faster = jnp.split(rates, [len(trials), len(trials) + 1])
        most = jnp.maximum(here, jnp.maximum(slower, faster))
        most = jax.lax.cummax(most, reverse=True)
        steps = jnp.minimum(trials, allowed[None] / jnp.maximum(least[None], 2 * most))
        return jnp.minimum(step, jnp.max(steps, axis=0))

    return jax.lax.cond(jnp.all(2 * bound * longest <= allowed), lambda: step, shortened)


def _steepest(system: HybridSystem, w) -> Array:
    """The steepest slope of each face's friction at speeds up to w (f, ...)."""
    assert system.scales is not None
    # In lanes each has its own unit of speed.
    speeds = (system.speed[None] if system.speed.ndim else system.speed) * w
    # The table's speeds are 0 and then evenly spaced in their logarithm.
    decades = jnp.log10(jnp.maximum(speeds, SPEEDS[1]) / SPEEDS[1])
    place = 1 + jnp.ceil(decades / np.log10(SPEEDS[2] / SPEEDS[1])).astype(int)
    slopes = system.over_lanes(system.scales.steepest, w.ndim - 1)
    place = jnp.minimum(place, len(SPEEDS) - 1)[:, None]
    steepest = jnp.take_along_axis(slopes, place, axis=1)[:, 0]
    return jnp.where(speeds <= SPEEDS[-1], steepest, jnp.inf)


def _steepness(system: HybridSystem, w, loads) -> Array:
    """The largest rate (...) at which friction at |w| (f, ...) changes w; 0 without load."""

    def rate(law, w, load):
        return jnp.abs(system.speed * law.slope(system.speed * w)) * load

    return jnp.max(system.at_each_face(rate, w, loads), axis=0)


def _rate_of_curves(system: HybridSystem, y, s, closing: float) -> Array:
    """The largest rate (...) at which load curves change; 0 without any.

    It is half the rate of the stiffness that they add to the springs of the preload, or `closing`
    times the rate of relative change of the way to the opening, where they are not smooth,
    whichever is larger.
    """
    x, u = y[: system.n], y[system.n :]
    linear, by_time = system.linear_loads(x), system.times(system.L, u)
    most = jnp.zeros_like(x[0])
    for j, P, e, force in system.load_curves(linear):
        tangential, normal = system.faces[j]
        _, slope = jax.jvp(force, (e,), (jnp.ones_like(e),))
        unit_force = jnp.zeros((len(linear), *e.shape), e.dtype).at[normal].set(1)
        added = system.times(system.L, system.acceleration(unit_force))[tangential] * (slope - 1)
        stiffer = jnp.sqrt(jnp.where(added > 0, added, 0)) / 2
        # Nearer than 1e-4 of the way, what a load curve adds is below rounding.
        way = jnp.abs(e + force.opening) + 1e-4 * force.opening
        is_open = system.is_open(s[tangential])
        nearing = jnp.where(is_open, 0, jnp.abs(by_time[tangential] / P) / way)
        most = jnp.maximum(most, jnp.maximum(stiffer, closing * nearing))
    return most
