"""Profile elements, a hill and the valley beside it, and their mean width RSm (ISO 21920-2)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def mean_element_width(z: Float[Array, " n"], dx, height, width) -> Array:
    """RSm [m]: the mean width of the complete profile elements; NaN if there is none.

    The profile is cut where it crosses the mean line, interpolated between points. Hills and
    valleys of less than `height` [m] are part of what is around them, and so are then those
    narrower than `width` [m]. Elements begin at the first crossing, upwards or downwards.
    """
    n, points = z.size, np.arange(z.size)
    signs = jax.lax.stop_gradient(jnp.where(z >= height, 1, jnp.where(z <= -height, -1, 0)))
    begins = _alternations(signs)
    # The last point on the other side of the mean line: the crossing is behind it.
    below, above = (
        jax.lax.cummax(jnp.where(jax.lax.stop_gradient(other), points, 0))
        for other in (z <= 0, z >= 0)
    )
    last = jnp.where(signs > 0, below, above)
    drop = z[last] - z[jnp.minimum(last + 1, n - 1)]
    inside = begins & (drop != 0)
    crossing = dx * (last + jnp.where(inside, z[last] / jnp.where(inside, drop, 1), 0))

    # Features between crossings, one behind the other; the last is incomplete and taken as wide.
    order = jnp.where(begins, jnp.cumsum(begins) - 1, n)
    crossing = jnp.zeros_like(crossing).at[order].set(crossing, mode="drop")
    sign = jnp.zeros_like(signs).at[order].set(signs, mode="drop")
    count = jnp.sum(begins)
    following = jnp.where(points + 1 < count, jnp.roll(crossing, -1), jnp.inf)
    wide = jax.lax.stop_gradient(following - crossing) >= width
    # What precedes the first crossing is of the other sign.
    signs = jnp.concatenate([-sign[:1], jnp.where(wide, sign, 0)])
    begins = _alternations(signs)[1:]

    rank = jnp.cumsum(begins) - 1
    elements = (jnp.sum(begins) - 1) // 2
    first, end = (
        jnp.sum(jnp.where(begins & (rank == number), crossing, 0)) for number in (0, 2 * elements)
    )
    return jnp.where(elements > 0, (end - first) / jnp.maximum(elements, 1), jnp.nan)


def _alternations(signs) -> Bool[Array, " n"]:
    """True where a sign, 1 or -1, differs from the last one that was not 0."""
    points = np.arange(signs.size)
    latest = jax.lax.cummax(jnp.where(signs != 0, points, -1))
    before = jnp.concatenate([jnp.full(1, -1, latest.dtype), latest[:-1]])
    previous = jnp.where(before >= 0, signs[before], 0)
    return signs * previous < 0
