"""A compiled program at any number of points, in batches of one shape, the last one padded."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def in_batches(program: Callable[..., Any], batch: int, *arrays: np.ndarray) -> Any:
    """Evaluate a program on arrays (n, ...), `batch` rows at a time.

    Its results, a pytree of arrays (batch, ...), are concatenated to NumPy arrays (n, ...). Rows
    must be independent of one another: the last row is repeated to fill up a batch.
    """
    if not len(arrays[0]):
        whole = [jax.ShapeDtypeStruct((batch, *x.shape[1:]), x.dtype) for x in arrays]
        shapes = jax.eval_shape(program, *whole)
        return jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), shapes)
    pieces = []
    for i in range(0, len(arrays[0]), batch):
        piece = [array[i : i + batch] for array in arrays]
        count = len(piece[0])
        padded = [np.concatenate([x, np.repeat(x[-1:], batch - count, axis=0)]) for x in piece]
        results = program(*padded)
        pieces.append(jax.tree.map(lambda x, count=count: np.asarray(x)[:count], results))
    return jax.tree.map(lambda *x: np.concatenate(x), *pieces)
