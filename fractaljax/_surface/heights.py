"""Heights of a profile (n,) or a map (n, m): checks, mean line or plane, slopes, statistics."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.parts import Numbers, array_like, concrete, number


class HeightStatistics(NamedTuple):
    """Statistics of heights about zero."""

    mean_absolute: Array  # [m]
    root_mean_square: Array  # [m]
    skewness: Array
    kurtosis: Array


def height_numbers(name: str, z) -> Numbers:
    """Heights as floating-point numbers of any shape; lists of numbers or of rows are taken.

    **Raises:** `TypeError` unless z is real and numeric; `ValueError` where a height is not finite
    or masked.
    """
    z = array_like(name, z)
    if isinstance(z, np.ma.MaskedArray):
        z = np.ma.filled(z.astype(float), np.nan)
    try:
        return number(name, z)
    except ValueError:
        values = np.asarray(concrete(jnp.asarray(z)))
        missing = int(np.isnan(values).sum())
        if not 0 < missing < values.size:  # infinite, or there is nothing to fill them from
            raise
        raise ValueError(
            f"{name} must be finite, got {missing} NaN: fill them in, or cut out a part without "
            "any; fractaljax.prepare_measurement(z, dx).z has them filled"
        ) from None


def check_heights(z, axes: str) -> Numbers:
    """Heights z as floating-point numbers with axes "n" or "n m", at least 8 points along each.

    **Raises:** as `height_numbers`; `ValueError` for another shape.
    """
    heights = height_numbers("z", z)
    ndim = len(axes.split())
    if heights.ndim != ndim or min(heights.shape) < 8:
        shape = f"({', '.join(axes.split())}{',' if ndim == 1 else ''})"
        raise ValueError(
            f"z must have shape {shape} with 8 points or more along each axis, got {heights.shape}"
        )
    return heights


def remove_mean(z: Numbers) -> Numbers:
    """Heights less their mean; exactly 0 for equal heights."""
    relative = z - z.ravel()[0]
    return relative - jnp.mean(relative)


def remove_form(z: Numbers) -> Numbers:
    """Heights less their least-squares line or plane."""
    level = remove_mean(z)
    for axis, n in enumerate(z.shape):
        x = np.arange(n) - (n - 1) / 2
        shape = [n if i == axis else 1 for i in range(z.ndim)]
        x = jnp.asarray((x / np.linalg.norm(x)).reshape(shape), z.dtype)
        level = level - x * (jnp.sum(x * level) * n / z.size)
    return level


def slope(z: Float[Array, "*rows n"], dx) -> Float[Array, "*rows n"]:
    """dz/dx along the last axis, by the seven-point formula of ISO 21920-2 and ISO 25178-2.

    The three points at either end, which have fewer neighbours, have formulas of fewer points.
    """
    one, two, three = ((z[..., 2 * k :] - z[..., : -2 * k]) / (2 * k) for k in (1, 2, 3))
    five_points = (4 * one[..., 1:-1] - two) / 3
    seven_points = (15 * one[..., 2:-2] - 6 * two[..., 1:-1] + three) / 10
    first = (4 * (z[..., 1:2] - z[..., :1]) - (z[..., 2:3] - z[..., :1])) / 2
    last = (4 * (z[..., -1:] - z[..., -2:-1]) - (z[..., -1:] - z[..., -3:-2])) / 2
    begin = [first, one[..., :1], five_points[..., :1]]
    end = [five_points[..., -1:], one[..., -1:], last]
    return jnp.concatenate([*begin, seven_points, *end], axis=-1) / dx


def extremes(rows: Float[Array, "k n"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """(highest, lowest) of each row, by their indices: the derivative is that of one height."""
    highest, lowest = (
        jnp.take_along_axis(rows, index(rows, axis=1, keepdims=True), axis=1)[:, 0]
        for index in (jnp.argmax, jnp.argmin)
    )
    return highest, lowest


def height_statistics(z: Numbers) -> HeightStatistics:
    """Ra, Rq, Rsk and Rku, or Sa, Sq, Ssk and Sku, of all heights; flat ones have no shape."""
    root_mean_square = jnp.sqrt(jnp.mean(z**2))
    relative = z / root_mean_square  # fourth powers of nanometres would underflow in float32
    return HeightStatistics(
        jnp.mean(jnp.abs(z)),
        root_mean_square,
        jnp.mean(relative**3),
        jnp.mean(relative**4),
    )
