"""Which periodic orbits a motion can settle on: those that obey the friction law and attract."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .events import Cubic, quintic
from .guard import SECTION
from .hybrid import HybridSystem
from .lanes import log_spectral_radius, product
from .orbit import PeriodicOrbit, block_diagonal
from .segments import Segments, cumulative, next_start
from .transition import switch


def admissible(system: HybridSystem, segments: Segments, middle) -> Bool[Array, " g"]:
    """True where orbits obey the friction law along their itinerary; `middle` are the midpoints.

    No guard is below zero inside a segment, and every switch leads to the next contact state.
    """
    y, s, h, ends = segments.y, segments.s, segments.duration, next_start(segments.y)
    at = jnp.stack([y, middle, ends])
    # One at a time, which compiles and runs faster than all at once.
    d = jax.lax.map(lambda y: h[None] * system.field(y, s), at)
    guards = functools.partial(jax.lax.map, lambda y: system.guards(y, s)[1:])  # no section
    scale = 1 + jnp.max(jnp.abs(y), axis=(0, 1), keepdims=True)
    # On each half of a segment a cubic through samples of a guard tells where it is lowest. The
    # guard itself is evaluated there.
    places = jnp.arange(7) / 6
    inside = jax.vmap(lambda x: quintic(at, d, x))(places)
    g = guards(inside)
    cubics = Cubic.at_thirds(jnp.stack([g[:4], g[3:]], axis=1))
    theta, _ = cubics.minimum()
    lowest = jnp.argmin(cubics(theta), axis=1)[:, None]
    theta = jnp.take_along_axis(theta, lowest, axis=1)
    half = jnp.arange(2).reshape(2, *(1,) * (theta.ndim - 1))
    lowest = jax.vmap(lambda x: quintic(at, d, x))((half + theta) / 2)
    g = jnp.concatenate([g, guards(lowest)])
    # The quintic has this accuracy on a segment of the default length.
    holds = jnp.all(g > -1e-8 * scale[None], axis=(0, 1)) & (h > -1e-10)
    _, after = switch(system, ends, s, segments.guard)
    return jnp.all(holds & jnp.all(after == next_start(s), axis=0), axis=0)


def growth_of(system: HybridSystem, orbit: PeriodicOrbit) -> Float[Array, " g"]:
    """ln of the largest modulus of the Floquet multipliers, without the one along the orbit.

    The multipliers of an excitation, which are 1, are left out too. Without an orbit it is NaN.
    """
    jacobian = orbit.jacobian
    if system.excited:
        # The place where a face rests neither grows nor decays.
        resting = system.resting(orbit.segments.s, orbit.segments.used)
        jacobian = jacobian - product(jacobian, block_diagonal(resting, resting))
    jacobian = system.mechanism_state(jnp.swapaxes(system.mechanism_state(jacobian), 0, 1))
    # After 40 squarings the logarithm of a power's size is too small by rounding alone.
    log = log_spectral_radius(jnp.swapaxes(jacobian, 0, 1), squarings=40)
    return jnp.where(orbit.converged, log, jnp.nan)


def has_shorter_period(orbit: Segments, returns) -> Bool[Array, " g"]:
    """True where orbits are back at their start before the last of their returns (g,)."""
    start = orbit.y[:, :1]
    distance = jnp.max(jnp.abs(next_start(orbit.y) - start), axis=0)
    at_section = orbit.guard == SECTION
    early = at_section & (returns[None] > cumulative(at_section.T).T)
    return jnp.any(early & (distance < 1e-5 * (1 + jnp.max(jnp.abs(start), axis=0))), axis=0)
