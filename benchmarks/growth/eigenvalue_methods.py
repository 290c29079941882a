"""Growth rates of many linearised systems, by the closed form and by LAPACK in several settings.

LAPACK gets matrices that are made before its time is taken.
"""

import functools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from fractaljax.mechanism.oscillator import Linearised
from fractaljax.modes.stability import growth_rate_of_linearised

from ..timing import compiled
from .systems import Columns, state_matrices

CHUNK = 100_000  # systems at a time; what a program works on then stays in the cache
CLOSED, CLOSED_32 = "closed form", "closed form, float32"
SCENES, AT_ONCE = "closed form, from scenes", "closed form, all at once"
NUMPY, THREADS = "numpy.linalg.eigvals", "numpy.linalg.eigvals, a thread a core"
JAX, JAX_32 = "jax.numpy.linalg.eigvals", "jax.numpy.linalg.eigvals, float32"
TIMED: tuple[str, ...] = (CLOSED, SCENES, AT_ONCE, CLOSED_32, NUMPY, THREADS, JAX)
WITH_ERRORS = (CLOSED, NUMPY, JAX, CLOSED_32, JAX_32)

closed_form = jax.vmap(growth_rate_of_linearised)


def linearised(columns: Columns, dtype: Any = np.float64) -> Linearised:
    """Systems as the package takes them."""
    return Linearised(*(jnp.asarray(column, dtype) for column in columns))


def scene_rates(scenes) -> jax.Array:
    """Growth rates (n,) of the reference brake with joints of given K_n, K_t and friction."""
    oscillator = fj.brake_scene().oscillator

    def one(K_n, K_t, mu):
        return fj.growth_rate(fj.Scene(fj.FixedContact(K_n, K_t), fj.Coulomb(mu), oscillator))

    return jax.vmap(one)(*scenes)


def lapack(A: np.ndarray) -> np.ndarray:
    """Largest real parts (n,) of the eigenvalues of matrices (n, 4, 4), by NumPy."""
    return np.linalg.eigvals(A).real.max(axis=1)


def jax_lapack(A) -> jax.Array:
    """The same by JAX."""
    return jnp.linalg.eigvals(A).real.max(axis=1)


def threaded(parts: list[np.ndarray]) -> list[np.ndarray]:
    """NumPy's in as many threads as there are parts: it lets go of the interpreter's lock."""
    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(lapack, parts))


def program(function: Callable, systems: Any, size: int = CHUNK) -> tuple[Callable, float]:
    """A call of a function for all systems, `size` at a time, and the seconds to compile it."""
    leaves, structure = jax.tree.flatten(systems)
    # Of equal lengths, since every shape is a program of its own.
    split = [jnp.split(leaf, math.ceil(leaf.shape[0] / size)) for leaf in leaves]
    parts = [jax.tree.unflatten(structure, part) for part in zip(*split, strict=True)]
    run, compile_s = compiled(function, parts[0])
    return lambda: [run(part) for part in parts], compile_s


def worth(name: str, many: int) -> bool:
    """Whether a method differs from the others in a batch of so many systems."""
    return name != AT_ONCE or many > CHUNK


def timed(name: str, columns: Columns, scenes: Columns) -> tuple[Callable, float | None]:
    """The call of a method for these systems or scenes, and the seconds it took to compile."""
    if name == CLOSED:
        return program(closed_form, linearised(columns))
    if name == AT_ONCE:
        return program(closed_form, linearised(columns), len(columns[0]))
    if name == CLOSED_32:
        return program(closed_form, linearised(columns, np.float32))
    if name == SCENES:
        return program(scene_rates, [jnp.asarray(column) for column in scenes])
    matrices, _ = state_matrices(columns)
    if name == JAX:
        return program(jax_lapack, jnp.asarray(matrices), len(matrices))
    if name == THREADS:
        return functools.partial(threaded, np.array_split(matrices, os.cpu_count() or 1)), None
    return functools.partial(lapack, matrices), None


def growth_rates(columns: Columns, dtype: Any) -> dict[str, np.ndarray]:
    """Growth rates (n,) by every method that has errors of its own in this precision."""
    matrices, omega = state_matrices(columns)
    A = matrices.astype(dtype)
    closed = np.asarray(jax.jit(closed_form)(linearised(columns, dtype)))
    by_jax = np.asarray(jax.jit(jax_lapack)(A)) * omega
    if dtype == np.float32:  # NumPy computes these in double precision
        return {CLOSED_32: closed, JAX_32: by_jax}
    return {CLOSED: closed, NUMPY: lapack(A) * omega, JAX: by_jax}
