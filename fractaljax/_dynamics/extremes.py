"""Extreme values of linear functions along a periodic orbit, and how long one is below zero."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .events import Cubic, first_root, rounding
from .hybrid import HybridSystem
from .lanes import first_least, row_numbers
from .segments import Segments, cumulative, flow, next_start


def _along(system: HybridSystem, y, s, t, row):
    """row @ y and its first two time derivatives, each lane at its own time t."""
    y = flow(system, y, t, s)
    rate = system.field(y, s)
    _, change = jax.jvp(lambda y: system.field(y, s), (y,), (rate,))
    return tuple(jnp.sum(row * x, axis=0) for x in (y, rate, change))


def _lowest(x, count: int) -> tuple[Array, Array]:
    """Lowest values (r, count) in the rows of x (r, k) and their indices, faster than sorting."""

    def without(x, _):
        k, least = first_least(x)
        return jnp.where(row_numbers(x) == k[None], jnp.inf, x), (least, k)

    _, (least, k) = jax.lax.scan(without, x.T, length=count)
    return least.T, k.T


def _vertex(segment, t):
    """The minimum of row @ y by the parabola at t, to third order, and a step towards it."""
    system, y, s, h, row = segment
    value, rate, change = _along(system, y, s, t, row)
    most = h / 8
    near = jnp.abs(rate) < change * most
    newton = jnp.where(near, -rate / jnp.where(near, change, 1), 0)
    return value + rate * newton / 2, jnp.where(near, newton, -jnp.sign(rate) * most)


@jax.custom_jvp
def _minima(segment: tuple, t, exists) -> tuple[Array, Array]:
    """The minima near the times t, infinite unless one `exists`, and their times.

    Derivatives are those of the last parabola: with respect to its time a minimum is stationary.
    """
    length = segment[3]

    def going(carry):
        _, change, _, steps = carry
        return (steps < 6) & jnp.any(exists & (jnp.abs(change) > length / 2**20))

    # The cubic's minimum is near, except where it is almost an inflection.
    def step(carry):
        t, _, _, steps = carry
        value, change = _vertex(segment, t)
        return jnp.clip(t + change, 0, length), change, value, steps + 1

    far = jnp.full_like(t, jnp.inf)
    t, _, value, _ = jax.lax.while_loop(going, step, (t, far, far, 0))
    return jnp.where(exists, value, jnp.inf), t


@_minima.defjvp
def _minima_jvp(primals, tangents):
    segment, t, exists = primals
    value, t = _minima(segment, t, exists)
    _, change = jax.jvp(lambda primal: _vertex(primal, t)[0], (segment,), (tangents[0],))
    return (value, t), (jnp.where(exists, change, 0), jnp.zeros_like(t))


def extreme_values(
    system: HybridSystem, segments: Segments, rows, minima: int = 4
) -> Float[Array, "2 r"]:
    """Smallest and largest value along the orbit of linear functions rows @ y, rows (r, 2n).

    `minima` is the largest number of nearly equal minima of a displacement or a velocity.
    """
    y, h, s = segments.y, segments.duration, segments.s
    nodes = _at_nodes(system, segments, lambda x: system.times(rows, x))
    g_0, g_1, d_0, d_1 = (jnp.concatenate([x, -x]) for x in nodes)
    rows = jnp.concatenate([rows, -rows])
    # Minima inside segments, by the cubic through the ends. It cannot tell which of nearly equal
    # ones is the lowest, so that a few are refined. A row at rest has none.
    through = jax.lax.stop_gradient((g_0, g_1, d_0, d_1))
    cubic, small = Cubic.through(*through), jnp.max(rounding(y))
    theta, inside = cubic.minimum()
    least = jnp.where(inside & (d_1 - d_0 > small / 64), cubic(theta), jnp.inf)
    least, k = (x.ravel() for x in _lowest(least, minima))
    of_row, length = jnp.arange(len(k)) // minima, h[k]
    selected = (system, y[:, k], s[:, k], length, rows[of_row].T)
    value, _ = _minima(selected, theta[of_row, k] * length, least < jnp.inf)
    value = jnp.min(value.reshape(-1, minima), axis=1)
    # At the end of a segment both are equal to rounding, and only the parabola tracks it.
    node = jnp.min(g_0, axis=1)
    value = jnp.where(value <= node + small, value, node)
    low, high = jnp.split(value, 2)
    return jnp.stack([low, -high])


def _at_nodes(system: HybridSystem, segments: Segments, values: Callable) -> list[Array]:
    """Linear `values` of the states at the starts and the ends of segments, and their slopes."""
    y, h, s = segments.y, segments.duration, segments.s
    starts = values(y)
    slopes = [values(h[None] * system.field(end, s)) for end in (y, next_start(y))]
    return [starts, jnp.roll(starts, -1, axis=-1), *slopes]


def time_below_zero(
    system: HybridSystem, segments: Segments, row, offset, crossings: int = 16
) -> Float[Array, ""]:
    """Time for which row @ y + offset is negative in one period.

    `crossings` is the largest number of segments in which it changes sign.
    """
    y, h, s = segments.y, segments.duration, segments.s
    g_0, g_1, d_0, d_1 = _at_nodes(system, segments, lambda x: system.times(row[None], x)[0])
    g_0, g_1 = g_0 + offset, g_1 + offset
    whole_segments = jnp.sum(jnp.where(g_0 < 0, h, 0))
    # In a segment with crossings: from its start to the first zero, and from the last to its end.
    sign, reversed_sign = jnp.where(g_0 < 0, -1, 1), jnp.where(g_0 * g_1 < 0, -1, 1)
    g_0, g_1, d_0, d_1 = (sign * x for x in (g_0, g_1, d_0, d_1))
    back = [reversed_sign * x for x in (g_1, g_0, -d_1, -d_0)]
    cubics = Cubic.through(*(jnp.stack(x) for x in zip((g_0, g_1, d_0, d_1), back, strict=True)))
    first, last = first_root(cubics)
    until, number = cumulative(first <= 1), jnp.arange(crossings)
    crosses, k = number < until[-1], jnp.argmax(until[None] > number[:, None], axis=1)
    t = jax.lax.stop_gradient(jnp.concatenate([first[k], 1 - last[k]]))
    twice = jnp.concatenate([k, k])
    t = t * h[twice]
    lanes = jnp.broadcast_to(row[:, None], (len(row), len(t)))
    value, rate, change = _along(system, y[:, twice], s[:, twice], t, lanes)
    # One step of third order from the cubic's root, which carries the derivative as well.
    rate = jnp.where(rate == 0, 1, rate)
    newton = (value + offset) / rate
    t = t - newton * (1 + newton * change / (2 * rate))
    first, last = jnp.split(t, 2)
    # With one crossing the rest of the segment has the other sign, else the time between two.
    crossed = jnp.where(jax.lax.stop_gradient(g_1[k]) < 0, h[k] - first, last - first)
    return whole_segments + jnp.sum(jnp.where(crosses, sign[k] * crossed, 0))
