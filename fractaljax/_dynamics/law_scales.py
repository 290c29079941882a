"""Bounds on velocity-dependent friction and its knots, which limit the steps."""

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._friction import SPEEDS

if TYPE_CHECKING:
    from .hybrid import HybridSystem


class LawScales(eqx.Module):
    """Bounds on velocity-dependent friction at each face."""

    below: Float[Array, " f"]  # how far below w = 0 its law is continued
    # Its steepest slope up to each of `SPEEDS`: by how much a unit of load changes dw/dt with w.
    steepest: Float[Array, "f v"]
    falls_until: Float[Array, " f"]  # velocity at which it is least, up to 100 m/s


def law_knots(system: "HybridSystem") -> Float[Array, "f k"] | None:
    """The knots of the law of each face, in order and followed by infinite ones, if any has some.

    They have no derivatives: what a motion does depends on the law, not on where it is cut.
    """

    def of(law):
        return jnp.asarray(law.knots, system.V.dtype)

    # The same for every number in the laws, hence known when a program is traced.
    many = 0
    for law, joints in zip(system.laws, system.sharing, strict=True):
        knots = jax.eval_shape(of if len(joints) == 1 else jax.vmap(of), law)
        many = max(many, knots.shape[-1])
    if not many:
        return None

    def padded(law, one):
        knots = jnp.sort(of(law) / system.speed)
        return jnp.pad(knots, (0, many - len(knots)), constant_values=jnp.inf) + 0 * one

    knots = system.at_each_face(padded, jnp.zeros_like(system.P))
    return jax.lax.stop_gradient(knots)


def law_scales(system: "HybridSystem") -> LawScales | None:
    """The bounds for a system, if any of its laws depends on the velocity.

    Below w = 0 a law continues while mu is between 0 and 2 mu_s, and is constant beyond: a coarse
    step may overshoot to where the formula of a law has no meaning.
    """
    if not any(law.velocity_dependent for law in system.laws):
        return None
    shares = jnp.asarray(2.0 ** -np.arange(48), system.V.dtype)  # down to rounding of a velocity
    speeds = jnp.asarray(SPEEDS, system.V.dtype)

    def bounds(law, one):
        mu = law.mu(-system.speed * shares)
        inside = ((mu >= 0) & (mu <= 2 * law.mu_s)).astype(shares.dtype)
        below = jnp.max(jax.lax.cummin(inside, reverse=True) * shares)
        falls_until = speeds[jnp.argmin(law.mu(speeds))] / system.speed
        steepest = system.speed * jax.lax.cummax(jnp.abs(law.slope(speeds)))
        return one * jnp.concatenate([jnp.stack([below, falls_until]), steepest])

    of_faces = jax.lax.stop_gradient(system.at_each_face(bounds, jnp.ones_like(system.P)))
    steepest = system.self_acceleration(of_faces[:, 2:])
    return LawScales(of_faces[:, 0], steepest, of_faces[:, 1])
