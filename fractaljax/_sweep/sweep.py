"""A measure over a grid of any named quantities, in batches of one compiled shape.

The grid itself is never stored: memory is that of one batch and of the result. With a folder every
batch is kept (`shards.py`), so that an interrupted sweep resumes and processes share the work.
"""

import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import ArrayLike, PyTree

from .._base.memory import require_memory
from .._base.parts import require_scalar
from .._mechanism.quantities import (
    axis_values,
    require_independent,
    require_inside,
    with_optional,
)
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .program import Program
from .result import Sweep
from .shards import Shards, describe, description

_POINTS = "points"  # the axis that devices share
_POINTS_EACH = 8192  # in a batch, on every device


def sweep(
    measure: Callable[[Any], PyTree[ArrayLike]],
    x: Scene | Structure,
    batch_size: int | None = None,
    progress: bool = True,
    *,
    out: str | os.PathLike | None = None,
    devices: Sequence[Any] | None = None,
    **axes: ArrayLike | Sequence[float],
) -> Sweep:
    """`measure(x)` at every point of a grid: `sweep(growth_rate, scene, D=Ds, G=Gs)`.

    Each axis is a quantity by its name in `x.replace`, or a ratio as in `**{"K_t/K_n": ratios}`
    (`quantities.py`), and its values (n,). `measure` gives an array or a pytree of arrays; the
    result holds it as NumPy arrays (n_1, n_2, ..., *shape of the measure's). `jax.jit` and
    `jax.grad` act on the measure, not on the sweep. The measure is traced once a sweep, with the
    values that it captures at that time; equal programs are compiled once.

    Points are evaluated `batch_size` at a time (8192 for every device), split evenly over
    `devices` (all of this process).

    `out` names a folder that keeps the batches. The same sweep called again computes what is
    missing. Another sweep is refused, and one begun by other versions resumes under a warning.
    Under `jax.distributed` every process must name the same folder: each computes its share of the
    batches, and all return the whole.

    **Raises:** `ValueError` for no axis, an unknown name, two of one quantity, values that are not
    one-dimensional or outside their domain, a batch that does not divide by the devices, a scene
    that holds arrays, more values than memory, a folder of another sweep or with a damaged batch,
    a measure that calls Python (`jax.pure_callback`) beside a folder, or several processes without
    one; `TypeError` for what is not numeric; `OSError` if the folder cannot be written.
    """
    grid = _checked(x, axes)
    names, shape = tuple(grid), tuple(map(len, grid.values()))
    points, mesh = math.prod(shape), _mesh(devices)
    if batch_size is None and out is not None and (begun := describe(out)) is not None:
        batch_size = begun["batch"]
    batch = _batch_size(batch_size, points, mesh.size)
    whole: Any = with_optional(x, names)  # pyright: ignore[reportArgumentType]
    program = Program(measure, names, whole, list(grid.values()))
    leaves, tree = jax.tree.flatten(program.shapes)
    each = max(1, sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves))
    require_memory(f"a sweep of {points} points", points * each)
    require_memory(f"a batch of {batch} points", batch * each)
    folder = None
    if out is not None:
        folder = Shards(out, description(program, whole, grid, batch))
    elif jax.process_count() > 1:
        raise ValueError("out must name a folder that all processes share, got None")
    arrays = [np.empty((points, *leaf.shape), leaf.dtype) for leaf in leaves]
    everywhere = NamedSharding(mesh, PartitionSpec())
    fixed = jax.device_put((whole, [jnp.asarray(v) for v in grid.values()]), everywhere)

    def run(k):
        return _batch(program, mesh, *fixed, _places(k * batch, batch, shape, mesh))

    def size(k):
        return min(batch, points - k * batch)  # the last batch may be short

    def put(k, found):
        for array, leaf in zip(arrays, found, strict=True):
            array[k * batch : k * batch + size(k)] = leaf[: size(k)]

    batches = range(-(-points // batch))
    share = batches if folder is None else batches[jax.process_index() :: jax.process_count()]
    with _bar(sum(map(size, share)), progress and jax.process_index() == 0) as bar:
        following: Any = run(0) if folder is None else None
        for k in share:
            if folder is None:
                # The next batch runs while this one is copied.
                found, following = following, run(k + 1) if k + 1 in batches else None
                put(k, found)
            elif not folder.has(k):
                folder.write(k, [np.asarray(leaf)[: size(k)] for leaf in run(k)])
            bar.update(size(k))
    if folder is not None:
        if jax.process_count() > 1:
            from jax.experimental.multihost_utils import sync_global_devices

            sync_global_devices("the batches of a sweep are written")
        for k in batches:
            put(k, folder.read(k))
    arrays = [array.reshape(*shape, *array.shape[1:]) for array in arrays]
    return Sweep(jax.tree.unflatten(tree, arrays), tuple(grid.values()), names, x)


def _checked(x: Any, axes: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The values of every axis, each inside its domain together with those of the others."""
    if isinstance(x, Scene):
        require_scalar(x)
    if not axes:
        raise ValueError("sweep needs an axis, such as D=[2.3, 2.4]")
    grid = {name: np.asarray(axis_values(x, name, values)) for name, values in axes.items()}
    require_independent(x, tuple(grid))
    require_inside(x, grid)
    return grid


def _batch_size(asked: int | None, points: int, devices: int) -> int:
    if asked is None:
        return devices * min(_POINTS_EACH, -(-points // devices))
    if isinstance(asked, bool) or not isinstance(asked, int) or asked < 1:
        raise ValueError(f"batch_size must be an integer of at least 1, got {asked!r}")
    if asked % devices:
        raise ValueError(
            f"batch_size must be a multiple of the number of devices, {devices}, got {asked}"
        )
    return asked


def _mesh(devices: Sequence[Any] | None) -> Mesh:
    chosen = jax.local_devices() if devices is None else list(devices)
    if not chosen:
        raise ValueError("devices must name at least one device, got none")
    return Mesh(np.array(chosen), (_POINTS,))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _batch(point: Program, mesh: Mesh, scene, axes, places) -> list[jax.Array]:
    """The program `point` at the points that lie at `places` (batch,) on each of the axes."""

    def one(scene, axes, places):
        return point(scene, [axis[i] for axis, i in zip(axes, places, strict=True)])

    program = jax.vmap(one, (None, None, 0))
    if mesh.size > 1:
        whole, split = PartitionSpec(), PartitionSpec(_POINTS)
        # One program a device: if XLA split a single one, every loop would wait for the slowest.
        program = jax.shard_map(
            program, mesh=mesh, in_specs=(whole, whole, split), out_specs=split, check_vma=False
        )
    return program(scene, axes, places)


def _places(begin: int, batch: int, shape, mesh):
    """Where points begin, begin + 1, ... of the grid lie on each axis; the last one repeats."""
    points = np.minimum(np.arange(begin, begin + batch), math.prod(shape) - 1)
    places = [axis.astype(np.int32) for axis in np.unravel_index(points, shape)]
    return jax.device_put(places, NamedSharding(mesh, PartitionSpec(_POINTS)))


def _bar(points: int, shown: bool):
    from tqdm import tqdm

    return tqdm(total=points, desc="sweep", unit="point", unit_scale=True, disable=not shown)
