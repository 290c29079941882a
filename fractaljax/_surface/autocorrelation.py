"""The autocorrelation of a map, and its lengths: Sal and Str of ISO 25178-2.

The map is continued periodically: by FFT, the autocorrelation is that of the waves that close over
the map. Where they do not close, the part t/L of the products at a lag t spans the opposite edges
of a side L.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def autocorrelation_lengths(
    z: Float[Array, "n m"], steps, level: float = 0.2
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(Sal [m], Str): the lag of the fastest decay to `level`, and its ratio to the slowest.

    Along each of 720 directions the lag is that of the first crossing, or half the map if there is
    none. Near the shortest and the longest of them it is refined on the sum of waves that the
    autocorrelation is. Both results have first derivatives.
    """
    power = jnp.abs(jnp.fft.fft2(z)) ** 2
    power = power / jnp.sum(power)
    angles = np.pi * np.arange(720) / 720
    directions = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1), z.dtype)
    values = jnp.fft.fft2(jax.lax.stop_gradient(power)).real
    lags, crosses = _first_crossings(values, directions, steps, level)

    def refine(best, no_crossing):
        coarse = jnp.where(crosses, lags, no_crossing)
        near = (best(coarse) + np.arange(-16, 17)) % angles.size
        roots = jax.vmap(lambda k: _crossing_near(power, directions[k], lags[k], steps, level))(
            near
        )
        k = best(jnp.where(crosses[near], roots, coarse[near]))
        refined = _with_derivatives(power, directions[near[k]], roots[k], steps, level)
        return jnp.where(crosses[near[k]], refined, lags[near[k]])

    fastest = refine(jnp.argmin, jnp.inf)
    fastest = jnp.where(jnp.any(crosses), fastest, jnp.nan)  # flat, or not a number
    return fastest, fastest / refine(jnp.argmax, lags)


def _first_crossings(values, directions, steps, level):
    """The lag (720,) at which `values` (n, m) fall to `level` along each direction, and if so."""
    n, m = values.shape
    # From point to point of a ray one index advances by one, the other by less.
    advance = directions / steps[None]
    spacing = 1 / jnp.max(jnp.abs(advance), axis=1)
    advance = spacing[:, None] * advance
    least = jnp.finfo(values.dtype).eps  # no division by zero along an axis
    half = jnp.array([[n / 2, m / 2]], values.dtype)
    most = jnp.min(half / jnp.maximum(jnp.abs(advance), least), axis=1)
    k = np.arange(max(n, m) // 2 + 1)
    i, j = (axis[:, None] * k[None] for axis in advance.T)
    low_i, low_j = jnp.floor(i), jnp.floor(j)
    part_i, part_j = i - low_i, j - low_j
    low_i, low_j = low_i.astype(int), low_j.astype(int)

    def column(j):
        below, above = values[low_i % n, j % m], values[(low_i + 1) % n, j % m]
        return below + part_i * (above - below)

    first, second = column(low_j), column(low_j + 1)
    along = first + part_j * (second - first)
    falls = (along < level) & (k[None] <= most[:, None])
    crosses = jnp.any(falls, axis=1)
    end = jnp.maximum(jnp.argmax(falls, axis=1), 1)[:, None]
    before, after = (jnp.take_along_axis(along, x, axis=1)[:, 0] for x in (end - 1, end))
    drop = jnp.where(crosses, before - after, 1)
    crossing = end[:, 0] - 1 + (before - level) / drop
    return spacing * jnp.where(crosses, crossing, most), crosses


def _correlation(power, direction, lag, steps):
    """The autocorrelation at a lag along a direction: the sum of all waves."""
    (n, m), shift = power.shape, lag * direction / steps
    x = jnp.asarray(2 * np.pi * np.fft.fftfreq(n), power.dtype) * shift[0]
    y = jnp.asarray(2 * np.pi * np.fft.fftfreq(m), power.dtype) * shift[1]
    along_y = jnp.matmul(power, jnp.stack([jnp.cos(y), jnp.sin(y)], 1), precision="highest")
    return jnp.sum(jnp.cos(x) * along_y[:, 0] - jnp.sin(x) * along_y[:, 1])


def _value_and_fall(power, direction, lag, steps):
    """The autocorrelation and its slope, which is minus infinite where it does not fall."""
    value, slope = jax.jvp(
        lambda lag: _correlation(power, direction, lag, steps), (lag,), (jnp.ones_like(lag),)
    )
    return value, jnp.where(slope < 0, slope, -jnp.inf)


def _crossing_near(power, direction, lag, steps, level):
    """The lag at which the autocorrelation is `level`, by Newton's method; without derivatives."""
    power, start, steps = jax.lax.stop_gradient((power, lag, steps))
    reach = jnp.max(steps)

    def newton(_, lag):
        value, slope = _value_and_fall(power, direction, lag, steps)
        return jnp.clip(lag - (value - level) / slope, start - reach, start + reach)

    return jax.lax.fori_loop(0, 5, newton, start)


def _with_derivatives(power, direction, root, steps, level):
    """The same lag with its derivatives, which one more step of Newton's method carries."""
    slope = _value_and_fall(*jax.lax.stop_gradient((power, direction, root, steps)))[1]
    return root - (_correlation(power, direction, root, steps) - level) / slope
