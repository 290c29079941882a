"""Surfaces as heights on a grid: the Weierstrass-Mandelbrot sum of Eq. 13.

Since sqrt(x^2 + y^2) cos(atan2(y, x) - a) = x cos a + y sin a, every wave of Eq. 13 is
cos(k_x x + k_y y + phi) = cos(k_x x + phi) cos(k_y y) - sin(k_x x + phi) sin(k_y y), and the double
sum over a grid is one product of matrices. It is taken a few hundred waves at a time, so that
memory does not grow with their number.
"""

import functools
import math
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..base.memory import require_memory
from ..base.parts import concrete, number, ordered, require_scalar
from .surfaces import Surface, frequency_count

_BLOCK = 256  # waves in one product of matrices
_ARRAYS_OF_WAVES = 8  # at once: steps, phases, heights
_ROWS = 64  # frequencies whose phases are drawn at once: at gamma = 1.5 L/L_s up to 1e11


class Topographies(NamedTuple):
    """Two surfaces of the same phases on one grid, as `Design.topographies` returns them."""

    before: np.ndarray  # heights [m], (n, n), x along the first axis
    after: np.ndarray
    dx: float  # distance of neighbouring points [m]


def topography(surface: Surface, L, n: int, *, key, L_s=None, M: int = 10) -> jax.Array:
    """Heights z (n, n) [m] of a surface: z[i, j] is Eq. 13 at x = i L/n, y = j L/n.

    Waves run from the wavelength L [m] down to L_s [m], by default 2 L/n, the shortest that the
    grid resolves, M of them in each length. `key`, of `jax.random`, draws the phases: the same key
    gives the same surface, and a smaller L_s adds waves to it and moves none.

    Differentiable in D, G, gamma and L; `jit` and `vmap` work over D, G and key. How many waves
    there are is structure: gamma must be known while a program is traced, and L and L_s as well
    where L_s is given. Phases are reduced exactly, so that float32 is off by 2e-5 Sq at most.

    **Raises:** `ValueError` unless 0 < L_s <= L, n >= 2 and M >= 1, both whole, for an array of
    surfaces or keys, and for more points or waves than memory holds; `TypeError` for what is
    none, and for a gamma, L or L_s that is traced.
    """
    if not isinstance(surface, Surface):
        raise TypeError(f"surface must be a Surface, got {surface!r}")
    require_scalar(surface)
    n, M = _whole("n", n, 2), _whole("M", M, 1)
    size = surface.D.dtype.itemsize * n * (3 * n + 4 * _BLOCK)
    require_memory(f"a topography of {n} x {n} points", size)
    L = _length("L", L)
    gamma = _known("gamma", surface.gamma)
    if L_s is None:
        ratio = n / 2
    else:
        L_s = _length("L_s", L_s)
        with np.errstate(over="ignore"):
            ratio = _known("L", L) / _known("L_s", L_s)
        L = ordered("L", L, "L_s", L_s)
        number("L/L_s", ratio)
    count = int(frequency_count(gamma, ratio, np))
    require_memory(f"{count} x {M} waves", 8 * count * M * _ARRAYS_OF_WAVES)
    angles = np.pi * np.arange(1, M + 1) / M
    directions = np.stack([np.cos(angles), np.sin(angles)])[:, None]
    steps = (float(gamma) ** np.arange(count))[None, :, None] * directions / n
    coarse, fine = _split(steps, n, surface.D.dtype)
    return _sum(surface, L, random_turns(key, count, M), directions, coarse, fine, n)


def random_turns(key, count: int, M: int) -> jax.Array:
    """The phases phi_mn of Eq. 13 over 2 pi (count, M): uniform on [0, 1), a row for each n.

    **Raises:** `TypeError` for what is no key of `jax.random`, `ValueError` for many.
    """
    rows = math.ceil(count / _ROWS) * _ROWS  # drawn whole, so that more of them move none
    try:
        bits = jax.random.bits(key, (rows, M), jnp.uint32)
    except (TypeError, ValueError):
        many = getattr(key, "ndim", 0) > 0
        got = f"an array of shape {key.shape}" if many else repr(key)
        kind = ValueError if many else TypeError
        raise kind(f"key must be one key of jax.random, got {got}") from None
    return bits[:count].astype(float) * 2.0**-32  # of 32 bits: one surface in every precision


def _split(steps, n, dtype):
    """Turns a step as coarse + fine, coarse having so few bits that n times it is exact."""
    bits = jnp.finfo(dtype).nmant + 1 - (n - 1).bit_length()
    steps = steps - np.round(steps)  # whole turns from point to point are none
    coarse = np.round(steps * 2.0**bits) / 2.0**bits
    return coarse, steps - coarse


def _turns(n, coarse, fine):
    """Turns at the points 0 to n - 1 of a line, up to whole ones (n, waves)."""
    i = jnp.arange(n, dtype=coarse.dtype)[:, None]
    turns = i * coarse[None]
    return turns - jnp.round(turns) + i * fine[None]


@functools.partial(jax.jit, static_argnames="n")
def _sum(surface, L, turns, directions, coarse, fine, n):
    """Eq. 13 on the grid (n, n): turns are (n_max + 1, M), coarse and fine (2, n_max + 1, M)."""
    D, G, gamma, dtype = surface.D, surface.G, surface.gamma, surface.D.dtype
    count, M = turns.shape
    powers = gamma ** jnp.arange(count)
    # Zero, with the derivatives of gamma^n: its value is in coarse and fine already.
    slope = (powers - jax.lax.stop_gradient(powers))[None, :, None]
    fine = fine + slope * jnp.asarray(directions / n, dtype)
    scale = L * (G / L) ** (D - 2) * jnp.sqrt(jnp.log(gamma) / M)
    heights = jnp.broadcast_to((scale * powers ** (D - 3))[:, None], (count, M))
    blocks = math.ceil(turns.size / _BLOCK)
    size = math.ceil(turns.size / blocks)

    def cut(x):  # waves of height 0 fill the last block
        x = jnp.asarray(x, dtype).ravel()
        return jnp.pad(x, (0, blocks * size - x.size)).reshape(blocks, size)

    waves = jax.tree.map(cut, ((coarse[0], fine[0]), (coarse[1], fine[1]), heights, turns))

    def add(z, block):
        x_step, y_step, heights, turns = block
        x = 2 * jnp.pi * (_turns(n, *x_step) + turns[None])
        y = 2 * jnp.pi * _turns(n, *y_step)
        of_x = jnp.concatenate([jnp.cos(x), -jnp.sin(x)], axis=1)
        of_y = jnp.concatenate([jnp.cos(y), jnp.sin(y)], axis=1) * jnp.tile(heights, 2)[None]
        constant = jnp.sum(heights * jnp.cos(2 * jnp.pi * turns))
        # A device may have a faster product of fewer digits.
        return z + constant - jnp.matmul(of_x, of_y.T, precision="highest"), None

    z, _ = jax.lax.scan(add, jnp.zeros((n, n), dtype), waves)
    return z


def _whole(name, value, least) -> int:
    try:
        whole = operator.index(value)
    except TypeError:
        whole = -1
    if isinstance(value, bool) or whole < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
    return whole


def _length(name, value) -> jax.Array:
    length = number(name, value, above=0)
    if length.ndim:
        raise ValueError(f"{name} must be a scalar, got shape {length.shape}")
    return length


def _known(name, value) -> np.ndarray:
    values = concrete(value)
    if values is None:
        raise TypeError(
            f"{name} must be known while a program is traced, since the number of waves depends on"
            " it: keep it out of what jit and vmap are given"
        )
    return values
