"""Growth rate and its gradient to (D, G) at many surfaces, by the package and by its peers."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from ..timing import compiled
from .loops import arrays, differences, loop_gradient, loop_value, plain_loop, tuned_loop

D_RANGE, G_RANGE = (2.35, 2.6), (3e-11, 3e-9)
VALUE, GRADIENT = "value", "value and gradient"
PLAIN, TUNED, ARRAYS = "loop", "tuned loop", "NumPy arrays"
FORWARD, REVERSE, FORWARD_32 = "forward mode", "reverse mode", "forward mode, float32"


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to values or gradients at the first `points` surfaces."""

    name: str
    gradient: bool
    points: int
    run: Callable[[], Any]
    compile_s: float | None = None  # of the package; peers are not compiled

    def rows(self, G: np.ndarray) -> np.ndarray:
        """What it gives, as (n, 1) or (n, 3): value, by D, by ln G; n at least `at_once`."""
        found = self.run()
        if self.compile_s is None:
            return found.reshape(len(found), -1)
        value, *slopes = (np.asarray(x, float) for x in jax.tree.leaves(found[0]))
        if slopes:
            slopes[1] = slopes[1] * G[: len(value)]
        return np.stack([value, *slopes], axis=1)


def surfaces(count: int) -> tuple[np.ndarray, np.ndarray]:
    """D and G (n,) at random, G even in the logarithm; float32 holds them too."""
    rng = np.random.default_rng(0)
    D = rng.uniform(*D_RANGE, count)
    G = np.exp(rng.uniform(math.log(G_RANGE[0]), math.log(G_RANGE[1]), count))
    return D.astype(np.float32).astype(float), G.astype(np.float32).astype(float)


def loops(numbers: dict[str, float], D: np.ndarray, G: np.ndarray) -> list[Method]:
    """Both loops, for values and for gradients."""
    found = []
    for name, body in ((PLAIN, plain_loop(numbers)), (TUNED, tuned_loop(numbers))):
        for loop, gradient in ((loop_value, False), (loop_gradient, True)):
            run = functools.partial(loop, body, D.tolist(), G.tolist())
            title = f"{name}, {GRADIENT if gradient else VALUE}"
            found.append(Method(title, gradient, len(D), run))
    return found


def with_arrays(numbers, D: np.ndarray, G: np.ndarray, steps: dict[int, float]) -> list[Method]:
    """NumPy arrays, for values and for gradients by the step of each order of difference."""
    growth, many = arrays(numbers), len(D)
    found = [Method(f"{ARRAYS}, {VALUE}", False, many, functools.partial(growth, D, G))]
    for order, step in sorted(steps.items()):
        run = functools.partial(differences, growth, D, G, step, order)
        found.append(Method(f"{ARRAYS}, {GRADIENT}, order {order}", True, many, run))
    return found


def functions(dtype: Any) -> dict[str, Callable]:
    """The package's, of D and G (n,); each gives arrays (n,)."""
    scene = jax.tree.map(lambda x: jnp.asarray(x, dtype), fj.brake_scene())

    def value(D, G):
        return fj.growth_rate(scene.replace(D=D, G=G))

    def forward(D, G):
        rate, push = jax.linearize(value, D, G)
        one, zero = jnp.ones_like(D), jnp.zeros_like(D)
        return rate, (push(one, zero), push(zero, one))

    reverse = jax.value_and_grad(value, argnums=(0, 1))
    found = {VALUE: value, FORWARD: forward, REVERSE: reverse}
    return {name: jax.vmap(function) for name, function in found.items()}


@functools.cache
def program(name: str, at_once: int) -> tuple[Callable, float]:
    """One of the package's functions, compiled for so many points, and the seconds it took."""
    dtype = np.float32 if name == FORWARD_32 else np.float64
    column = jax.ShapeDtypeStruct((at_once,), dtype)
    function = functions(dtype)[FORWARD if name == FORWARD_32 else name]
    return compiled(function, column, column)


def package(name: str, D: np.ndarray, G: np.ndarray, at_once: int) -> Method:
    """One of the package's programs, called for `at_once` points until it has had all."""
    run, compile_s = program(name, at_once)
    dtype = np.float32 if name == FORWARD_32 else np.float64
    columns = [jnp.split(jnp.asarray(column, dtype), len(D) // at_once) for column in (D, G)]
    parts = list(zip(*columns, strict=True))
    return Method(name, name != VALUE, len(D), lambda: [run(*part) for part in parts], compile_s)
