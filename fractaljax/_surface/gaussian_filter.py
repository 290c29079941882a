"""The Gaussian filters of ISO 16610-21 (profiles) and ISO 16610-61 (maps).

A filter of the nesting index lambda passes the share 2^-(lambda f)^2 of a wave of frequency f: one
half at f = 1/lambda. S-filter `shortest` (lambda_s) and L-filter `cutoff` (lambda_c) leave

    [1 - 2^-(lambda_c f)^2] 2^-(lambda_s f)^2

of its amplitude. Near the ends of the heights the weights are divided by their sum within the
heights, the moment criterion of order 0 of ISO 16610-28.
"""

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from .._base.parts import Numbers, concrete, scalar
from .heights import remove_form


def low_pass_transmission(frequency: ArrayLike, nesting_index: ArrayLike) -> Numbers:
    """Amplitude of a wave behind the filter over that before it: 2^-(lambda f)^2."""
    return jnp.exp2(-((jnp.asarray(nesting_index) * frequency) ** 2))


def low_pass(z: Numbers, nesting_index, steps) -> Numbers:
    """The long waves of heights on a grid with these `steps` [m] along its axes.

    The convolution goes by FFT, with as many zeros behind the heights as they have points. No
    weight reaches further: the heights are at least two nesting indices long.
    """
    for axis, dx in enumerate(steps):
        n, rows = z.shape[axis], jnp.moveaxis(z, axis, -1)
        frequency = jnp.asarray(np.fft.rfftfreq(2 * n), z.dtype)
        transmitted = low_pass_transmission(frequency, nesting_index / dx).astype(z.dtype)
        transmitted = transmitted.reshape((1,) * (z.ndim - 1) + (-1,))
        ones = jnp.ones((1,) * (z.ndim - 1) + (n,), z.dtype)
        weighted, weights = (
            jnp.fft.irfft(transmitted * jnp.fft.rfft(x, 2 * n), 2 * n)[..., :n]
            for x in (rows, ones)
        )
        z = jnp.moveaxis(weighted / weights, -1, axis)
    return z


def band_pass(z: Numbers, cutoff, shortest, steps) -> Numbers:
    """Heights behind the filters, each of which is left out if it is None."""
    if cutoff is not None:
        z = remove_form(z)
    if shortest is not None:
        z = low_pass(z, shortest, steps)
    return z if cutoff is None else z - low_pass(z, cutoff, steps)


def check_nesting_indices(cutoff, shortest, steps) -> tuple[Numbers | None, Numbers | None]:
    """(cutoff, shortest), each None or a length [m] of two grid steps or more, in this order.

    **Raises:** `TypeError` or `ValueError` otherwise; `TypeError` for traced lengths.
    """
    if shortest is not None:
        shortest = scalar("shortest", shortest, above=0)
        for step in steps:
            _require_order("shortest", shortest, "two grid steps", 2 * length_in_metres("dx", step))
    if cutoff is not None:
        cutoff = scalar("cutoff", cutoff, above=0)
        for step in steps:
            _require_order("cutoff", cutoff, "two grid steps", 2 * length_in_metres("dx", step))
        if shortest is not None:
            _require_order("cutoff", cutoff, "shortest", length_in_metres("shortest", shortest))
    return cutoff, shortest


def _require_order(name, value, other_name, least):
    length = length_in_metres(name, value)
    if length < least:
        raise ValueError(f"{name} must be at least {other_name} = {least:.6g} m, got {length:.6g}")


def length_in_metres(name: str, value: Numbers) -> float:
    """A length that decides how many points there are.

    **Raises:** `TypeError` if it is traced.
    """
    length = concrete(value)
    if length is None:
        raise TypeError(
            f"{name} must be known while a program is traced, since the number of points depends on"
            " it: keep it out of the arguments of jit and vmap"
        )
    return float(length)
