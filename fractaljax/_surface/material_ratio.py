"""The material ratio curve and its parameters (ISO 21920-2 and ISO 25178-2; before, ISO 13565-2).

The curve c(p) is the height that a share p of all points exceeds. The i-th highest of n heights is
taken at p = (i - 1/2)/n.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.parts import Numbers


class MaterialRatio(NamedTuple):
    """Parameters of the material ratio curve: Rk, Rpk, Rvk, Mr1 and Mr2, or those of a map."""

    core: Array  # [m]
    peaks: Array  # [m]
    valleys: Array  # [m]
    first: Array  # %
    second: Array  # %


class _Line(NamedTuple):
    ratio: Array
    height: Array
    slope: Array  # at most 0


def material_ratio(z: Numbers) -> MaterialRatio:
    """Core, peaks and valleys of the heights z [m] of any shape.

    The equivalent straight line is fitted by least squares to the 40 % of the curve whose secant
    is the least steep, the first if there are several. Where it meets 0 and 100 % it bounds the
    core. The areas of the curve above and below the core become triangles of the same base: that
    above has the height Rpk, with Rpk Mr1/2 = mean(max(z - upper bound, 0)).
    """
    curve = jnp.sort(z.ravel(), descending=True)
    n = curve.size
    width = round(0.4 * n)
    search = jax.lax.stop_gradient(curve)
    secants = search[:-width] - search[width:]
    rounding = 16 * jnp.finfo(curve.dtype).eps * (search[0] - search[-1])
    start = jnp.argmax(secants <= jnp.min(secants) + rounding)
    line = _fit(curve, start, width + 1)
    upper = line.height - line.slope * line.ratio
    lower = upper + line.slope
    first, below = _share_above(curve, upper), _share_above(-curve[::-1], -lower)

    def triangle(heights, base):
        """Height of the triangle; its base has at least half a point."""
        return 2 * jnp.mean(jnp.maximum(heights, 0)) / jnp.maximum(base, 0.5 / n)

    return MaterialRatio(
        core=-line.slope,
        peaks=triangle(curve - upper, first),
        valleys=triangle(lower - curve, below),
        first=100 * first,
        second=100 * (1 - below),
    )


def _fit(curve, start, count) -> _Line:
    """The least-squares line of `count` points of the curve."""
    n = curve.size
    heights = jax.lax.dynamic_slice(curve, (start,), (count,))
    p = (jnp.arange(count, dtype=curve.dtype) - (count - 1) / 2) / n
    return _Line(
        ratio=_share(start + count / 2, curve),
        height=jnp.mean(heights),
        slope=jnp.sum(p * heights) / jnp.sum(p**2),
    )


def _share(points, curve):
    return jnp.asarray(points, curve.dtype) / curve.size


def _share_above(curve: Float[Array, " n"], height) -> Array:
    """The share of the surface above a height.

    It is read from the line through 0.2 % of the curve about the height, at least two points:
    between two neighbours alone the slope, and so the derivative, would be a matter of chance.
    """
    n = curve.size
    half = max(1, round(0.001 * n))
    above = jnp.sum(jax.lax.stop_gradient(curve > height))
    start = jnp.clip(above - half, 0, n - 2 * half)
    line = _fit(curve, start, 2 * half)
    level = line.slope == 0
    step = (height - line.height) / jnp.where(level, 1, line.slope)
    share = jnp.where(level, _share(above, curve), line.ratio + step)
    return jnp.clip(share, _share(start, curve), _share(start + 2 * half, curve))
