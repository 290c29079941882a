"""Residuals of growth rates that solvers can follow through the coalescence of two modes.

Beyond coalescence a growth rate rises like a square root; before it, the rate may be constant. The
Hopf test function of the two modes (`critical_pair.py`), with rates relative to the target, is
smooth there. Unless both modes grow it is positive exactly where neither does; the sign of their
mean decides that case.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._mechanism.scene import Scene
from .._stability.critical_pair import hopf_test
from .._stability.quadratic import Leading
from .._stability.two_directions import two_directions


def neighbour_residuals(
    modes: Leading, target: Float[Array, ""], scale: Float[Array, ""]
) -> Float[Array, " k"]:
    """Residuals of k modes, all at most 0 exactly where no growth rate is above the target.

    `scale` is the scale of growth rates [1/s].
    """
    mean = (modes.s + modes.neighbour) / 2 - target
    spread = ((modes.s - modes.neighbour) / 2) ** 2
    decay = mean.real < 0
    test = hopf_test(mean, spread, ~decay)
    unit = _unit(jnp.abs(jax.lax.stop_gradient(modes.s)) ** 2)
    unit = jnp.where(unit > 0, unit, 1)
    faster = jnp.where(decay, -test / unit, (modes.s.real - target) / scale)
    return jnp.arcsinh(jnp.where(modes.first, faster, mean.real / scale))


def scene_residuals(
    scene: Scene,
    friction_slope: bool,
    growth: Float[Array, ""],
    target: Float[Array, ""],
    scale: Float[Array, ""],
) -> list[Float[Array, ""]]:
    """As `neighbour_residuals`, for the two modes of a scene, from its Hurwitz determinant."""
    # (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g at s + target: s^4 + q_3 s^3 + q_2 s^2 + q_1 s + q_0.
    lin = two_directions(scene, friction_slope).polynomial
    c_1, c_2 = lin.c_1 + 2 * target, lin.c_2 + 2 * target
    a, b = lin.a + (lin.c_1 + target) * target, lin.b + (lin.c_2 + target) * target
    q_3, q_2, q_1, q_0 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + lin.g
    decide = (q_3 > 0) & (q_2 > 0) & (q_1 > 0) & (q_0 > 0)  # necessary
    ratio, squared = q_1 / jnp.where(decide, q_3, 1), jnp.where(decide, q_2, 1)
    test = ratio * (1 - ratio / squared) - q_0 / squared
    faster = jnp.where(decide, -test / _unit(squared), (growth - target) / scale)
    return [jnp.arcsinh(faster), jnp.arcsinh(-q_3 / (4 * scale))]


def _unit(squared_frequency: Array) -> Array:
    """(s_1 - s_2)^2 [1/s^2] of two modes whose residuals are of order one."""
    return 0.01 * squared_frequency
