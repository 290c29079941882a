"""Surfaces as heights on a grid: of Eq. 13, or with random phases by another spectrum.

The Weierstrass-Mandelbrot sum of Eq. 13: since sqrt(x^2 + y^2) cos(atan2(y, x) - a) =
x cos a + y sin a, each wave is cos(k_x x + phi) cos(k_y y) - sin(k_x x + phi) sin(k_y y), and the
double sum over a grid is a product of matrices. It is computed a block of waves at a time to bound
memory. Phases are counted in cycles, so that whole cycles can be dropped exactly.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, ScalarLike

from .._base.memory import require_memory
from .._base.parts import (
    concrete,
    flag,
    number,
    ordered,
    require_kind,
    require_scalar,
    scalar,
    whole,
)
from .._base.programs import exported_jit
from .._base.singular import positive_sqrt
from .spectrum import Spectrum
from .surface import Surface, frequency_count

_BLOCK = 256  # waves in one product of matrices
_ARRAYS_OF_WAVES = 8  # held at once: phase steps, phases, heights
_ROWS = 64  # frequencies whose phases are drawn together: at gamma = 1.5, L/L_s up to 1e11


class Topographies(NamedTuple):
    """Two surfaces with the same phases on one grid, as `Design.topographies` returns them."""

    before: np.ndarray  # heights [m], (n, n), x along the first axis
    after: np.ndarray
    dx: float  # grid spacing [m]


def topography(
    surface: Spectrum,
    L: ScalarLike,
    n: int,
    *,
    key: PRNGKeyArray | None = None,
    seed: int | None = None,
    L_s: ScalarLike | None = None,
    M: int = 10,
    periodic: bool = False,
) -> Float[Array, "n n"]:
    """Heights z [m] of a surface on a square grid, z[i, j] at x = i L/n, y = j L/n.

    Those of a `Surface` are Eq. 13. Any other spectrum gets one wave of random phase at each
    wavevector of a period, L of a periodic topography and 2 L of another, that the grid resolves:
    their amplitudes are those of the spectrum, so that Sq is too, on the period. `lay` is along x.

    **Arguments:**

    - `surface`: a `Surface`, `SelfAffine`, `MeasuredSpectrum` or a spectrum of one's own.
    - `L`: side of the square [m]; of a `Surface` also its longest wavelength.
    - `n`: points along a side.
    - `key`: of `jax.random`, which draws the phases: the same key gives the same surface.
    - `seed`: a whole number in place of the key, `jax.random.key(seed)`.
    - `L_s`: shortest wavelength [m] of a `Surface`, by default 2 L/n, the shortest that the grid
      resolves. A smaller one adds waves without moving the others.
    - `M`: directions of each frequency of a `Surface`, 10 by default.
    - `periodic`: opposite edges meet, as contact solvers by FFT require; False by default.

    In a periodic `Surface` the vector gamma^n (cos a, sin a) of each wave is rounded to whole waves
    k per L along x and y, none shorter than L_s, and its amplitude follows its own wavelength:
    |k|^(D-3) in place of gamma^((D-3)n). The phases are the same. With M = 10, `roughness` stays
    right to 0.3 percent in Sdq, and in Sq to 1 percent at gamma = 1.5, 8 at gamma = 2. A derivative
    in gamma leaves the waves in place.

    Differentiable in D, G, gamma and L; `jit` and `vmap` work over D, G and key. The number of
    waves is structure: gamma must be known at trace time, and so must L and L_s if L_s is given.
    In float32 the error is at most 2e-5 Sq.

    **Raises:** `ValueError` unless 0 < L_s <= L, n >= 2 and M >= 1, both whole, for an array of
    surfaces or keys, for L_s beside another spectrum, and if there is not enough memory;
    `TypeError` for a wrong type, and for a traced gamma, L or L_s.
    """
    require_kind("surface", surface, Spectrum)
    require_scalar(surface)
    key = _key(key, seed)
    n, M, periodic = whole("n", n, 2), whole("M", M, 1), flag("periodic", periodic)
    if not isinstance(surface, Surface):
        if L_s is not None:
            kind = type(surface).__name__
            raise ValueError(f"L_s is for a Surface; a {kind} has a shortest wavelength of its own")
        require_memory(f"a topography of {n} x {n} points", 8 * n * n * (8 if periodic else 32))
        _require_key(key)
        return _random_phases(surface, scalar("L", L, above=0), key, n, periodic)
    dtype = surface.D.dtype
    require_memory(f"a topography of {n} x {n} points", dtype.itemsize * n * (3 * n + 4 * _BLOCK))
    L = scalar("L", L, above=0)
    gamma, ratio = _require_concrete("gamma", surface.gamma), n / 2
    if L_s is not None:
        L_s = scalar("L_s", L_s, above=0)
        with np.errstate(over="ignore"):
            ratio = _require_concrete("L", L) / _require_concrete("L_s", L_s)
        L = ordered("L", L, "L_s", L_s)
        number("L/L_s", ratio)
    count = int(frequency_count(gamma, ratio, np))
    require_memory(f"{count} x {M} waves", 8 * count * M * _ARRAYS_OF_WAVES)
    angles = np.pi * np.arange(1, M + 1) / M
    directions = np.stack([np.cos(angles), np.sin(angles)])[:, None]
    k, lengths = (float(gamma) ** np.arange(count))[None, :, None] * directions, None
    if periodic:
        most = np.floor(ratio * (1 + 1e-9))  # rounding may not pass L_s
        k = np.clip(np.round(k), -most, most)  # never (0, 0): |k| was 1 or more
        lengths = np.hypot(*k)
    steps = k / n
    # Cycles per grid step, the coarse part with so few bits that n times it is exact.
    steps = steps - np.round(steps)
    bits = jnp.finfo(dtype).nmant + 1 - (n - 1).bit_length()
    coarse = np.round(steps * 2.0**bits) / 2.0**bits
    _require_key(key)
    return _sum(surface, L, key, directions, coarse, steps - coarse, lengths, n)


def random_phases(key: PRNGKeyArray, count: int, M: int) -> Float[Array, "count M"]:
    """The phases of Eq. 13 in cycles, phi_mn/(2 pi): uniform on [0, 1), a row for each n.

    **Raises:** `TypeError` unless `key` is a key of `jax.random`, `ValueError` for several.
    """
    _require_key(key)
    rows = math.ceil(count / _ROWS) * _ROWS  # whole blocks, so that more rows change none
    bits = jax.random.bits(key, (rows, M), jnp.uint32)
    return bits[:count].astype(float) * 2.0**-32  # of 32 bits: one surface in every precision


def _key(key, seed) -> PRNGKeyArray:
    """The key, or that of a seed, of which there must be one."""
    if (key is None) == (seed is None):
        raise TypeError("topography needs a key or a seed, and not both: type seed=0")
    return key if seed is None else jax.random.key(whole("seed", seed, 0, 2**63 - 1))


def _require_key(key) -> None:
    try:
        jax.eval_shape(jax.random.bits, key)
    except (TypeError, ValueError):
        many = getattr(key, "ndim", 0) > 0
        got = f"an array of shape {key.shape}" if many else repr(key)
        kind = ValueError if many else TypeError
        raise kind(
            f"key must be one key of jax.random, got {got}: type seed=0 in its place"
        ) from None


def _require_concrete(name: str, value: jax.Array) -> np.ndarray:
    values = concrete(value)
    if values is None:
        raise TypeError(
            f"{name} must be known while a program is traced, since the number of waves depends on"
            " it: keep it out of the arguments of jit and vmap"
        )
    return values


@functools.partial(jax.jit, static_argnums=(3, 4))
def _random_phases(spectrum: Spectrum, L, key, n: int, periodic: bool):
    """A wave of random phase at every wavevector, of mean square C (2 pi/period)^2/(2 pi)^2."""
    points = n if periodic else 2 * n
    period = L * (points / n)
    waves = jnp.fft.rfft2(jax.random.normal(key, (points, points), period.dtype))
    size = jnp.abs(waves)
    phases = waves / jnp.where(size > 0, size, 1)
    q_x, q_y = 2 * np.pi * np.fft.fftfreq(points), 2 * np.pi * np.fft.rfftfreq(points)
    step = points / period
    at_mean = (q_x[:, None] == 0) & (q_y[None] == 0)
    waves_x = jnp.asarray(np.where(at_mean, 1, q_x[:, None])) * step
    C = spectrum.C_at(waves_x, jnp.asarray(q_y)[None] * step)
    amplitude = jnp.where(at_mean, 0, positive_sqrt(C)) / period
    return jnp.fft.irfft2(phases * amplitude, s=(points, points))[:n, :n] * points**2


@functools.partial(exported_jit, static_argnames="n")
def _sum(surface, L, key, directions, coarse, fine, lengths, n):
    """Eq. 13 on the grid (n, n), with phases by `key`; coarse and fine (2, n_max + 1, M).

    `lengths` (n_max + 1, M) replace gamma^n, which then moves no wave, unless they are None.
    """
    D, G, gamma, dtype = surface.D, surface.G, surface.gamma, surface.D.dtype
    count, M = coarse.shape[1:]
    phases = random_phases(key, count, M)
    powers = gamma ** jnp.arange(count)[:, None] if lengths is None else jnp.asarray(lengths, dtype)
    # Zero, with the derivatives of gamma^n: its value is in coarse and fine already.
    slope = (powers - jax.lax.stop_gradient(powers))[None]
    fine = fine + slope * jnp.asarray(directions / n, dtype)
    scale = L * (G / L) ** (D - 2) * jnp.sqrt(jnp.log(gamma) / M)
    heights = jnp.broadcast_to(scale * powers ** (D - 3), (count, M))
    blocks = math.ceil(phases.size / _BLOCK)
    size = math.ceil(phases.size / blocks)

    def cut(x):  # waves of height 0 fill the last block
        x = jnp.asarray(x, dtype).ravel()
        return jnp.pad(x, (0, blocks * size - x.size)).reshape(blocks, size)

    def cycles(coarse, fine):  # at the points of a line (n, waves), less whole cycles
        i = jnp.arange(n, dtype=dtype)[:, None]
        exact = i * coarse[None]
        return exact - jnp.round(exact) + i * fine[None]

    def add(z, block):
        x_step, y_step, heights, phases = block
        x = 2 * jnp.pi * (cycles(*x_step) + phases[None])
        y = 2 * jnp.pi * cycles(*y_step)
        of_x = jnp.concatenate([jnp.cos(x), -jnp.sin(x)], axis=1)
        of_y = jnp.concatenate([jnp.cos(y), jnp.sin(y)], axis=1) * jnp.tile(heights, 2)[None]
        constant = jnp.sum(heights * jnp.cos(2 * jnp.pi * phases))
        # Some devices have a faster product with fewer digits.
        return z + constant - jnp.matmul(of_x, of_y.T, precision="highest"), None

    waves = jax.tree.map(cut, ((coarse[0], fine[0]), (coarse[1], fine[1]), heights, phases))
    return jax.lax.scan(add, jnp.zeros((n, n), dtype), waves)[0]
