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
    none. The two that count are refined on the sum of waves, and have first derivatives.
    """
    power = jnp.abs(jnp.fft.fft2(z)) ** 2
    power = power / jnp.sum(power)
    angles = np.pi * np.arange(720) / 720
    directions = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1), z.dtype)
    values = jnp.fft.fft2(jax.lax.stop_gradient(power)).real
    lags, crosses = _first_crossings(values, directions, steps, level)

    def refine(k):
        refined = _refine_crossing(power, directions[k], lags[k], steps, level)
        return jnp.where(crosses[k], refined, lags[k])

    fastest = refine(jnp.argmin(jnp.where(crosses, lags, jnp.inf)))
    fastest = jnp.where(jnp.any(crosses), fastest, jnp.nan)  # flat, or not a number
    return fastest, fastest / refine(jnp.argmax(lags))


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


def _refine_crossing(power, direction, lag, steps, level):
    """The lag near `lag` at which the sum of waves is `level`, by Newton's method."""
    n, m = power.shape
    waves = [2 * np.pi * np.fft.fftfreq(count) for count in (n, m)]

    def correlation(power, lag, steps):
        x, y = (
            jnp.asarray(wave, power.dtype) * part
            for wave, part in zip(waves, lag * direction / steps, strict=True)
        )
        product = jnp.matmul(power, jnp.stack([jnp.cos(y), jnp.sin(y)], 1), precision="highest")
        return jnp.sum(jnp.cos(x) * product[:, 0] - jnp.sin(x) * product[:, 1])

    fixed_power, start, fixed_steps = jax.lax.stop_gradient((power, lag, steps))
    reach = jnp.max(fixed_steps)

    def at(lag):
        value, fall = jax.jvp(
            lambda lag: correlation(fixed_power, lag, fixed_steps), (lag,), (jnp.ones_like(lag),)
        )
        return value, jnp.where(fall < 0, fall, -jnp.inf)  # no step where it does not fall

    def newton(_, lag):
        value, fall = at(lag)
        return jnp.clip(lag - (value - level) / fall, start - reach, start + reach)

    root = jax.lax.fori_loop(0, 5, newton, start)
    # One more step, which carries the derivatives.
    return root - (correlation(power, root, steps) - level) / at(root)[1]
