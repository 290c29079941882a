"""A quantity over the grid of any number of axes, in batches of one compiled shape.

Memory is that of one batch and of the values: the grid itself is never made. With a folder the
batches are kept as they come (`shards.py`), so that an interrupted sweep goes on where it was, and
several processes share the work.
"""

import contextlib
import functools
import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..base.memory import require_memory
from ..base.parts import require_scalar
from ..mechanism.quantities import (
    axis_values,
    require_independent,
    require_inside,
    with_optional,
)
from ..mechanism.scene import Scene
from .program import Program
from .shards import Shards, describe, description

_POINTS = "points"  # the axis that devices share
_POINTS_EACH = 8192  # in a batch, of every device


def sweep(
    measure: Callable[[Scene], Any],
    scene: Scene,
    batch_size: int | None = None,
    progress: bool = True,
    *,
    out: str | os.PathLike | None = None,
    devices: Sequence[Any] | None = None,
    **axes: Any,
) -> Any:
    """`measure(scene)` at every point of a grid: `sweep(growth_rate, scene, D=Ds, G=Gs)`.

    Each axis is a quantity of the scene, by its name in `scene.replace` or that of a ratio, as in
    `**{"K_t/K_n": ratios}` (`quantities.py`), and its values (n,); the first one comes first in
    the result's shape. `measure` gives an array or any pytree of arrays, and so is the result: as
    NumPy arrays (n_1, n_2, ..., *shape of the measure's). `jax.jit` and `jax.grad` do not see
    through it: what they act on is the measure. It is traced once a sweep, with what it captures
    as that is then; the compiled program serves every later sweep of an equal one.

    Points are evaluated `batch_size` at a time (8192 for every device), split evenly over
    `devices` (all that this process has), on each of which loops end by themselves.

    `out` names a folder that keeps the batches. The same sweep called again computes what is
    missing; another one is refused, and one that other versions began is resumed under a
    warning. Under `jax.distributed` every process of a sweep must name the same folder and
    computes its share of the batches; all of them return the whole.

    **Raises:** `ValueError` for no axis, an unknown name, two of one quantity, values that are not
    one-dimensional or outside their domain, a batch that does not divide by the devices, a scene
    that holds arrays, more values than memory, a folder of another sweep or with a damaged batch,
    a measure that calls Python (`jax.pure_callback`) beside a folder, or several processes without
    one; `TypeError` for what is not numeric; `OSError` if the folder cannot be written.
    """
    require_scalar(scene)
    names, grid = tuple(axes), _checked(scene, axes)
    scene = with_optional(scene, names)
    shape = tuple(values.size for values in grid)
    points = math.prod(shape)
    mesh = _mesh(devices)
    if batch_size is None and out is not None and (begun := describe(out)) is not None:
        batch_size = begun["batch"]
    batch = _batch_size(batch_size, points, mesh.size)
    program = Program(measure, names, scene, grid)
    values = _Values(program.shapes, points, batch)
    kept = None
    if out is not None:
        named = dict(zip(names, grid, strict=True))
        kept = Shards(out, description(program, scene, named, batch))
    elif jax.process_count() > 1:
        raise ValueError("out must name a folder that all processes share, got None")
    whole = NamedSharding(mesh, PartitionSpec())
    fixed = jax.device_put((scene, [jnp.asarray(values) for values in grid]), whole)

    def arguments(k):
        return program, mesh, *fixed, _places(k * batch, batch, shape, mesh)

    run = _in_memory if kept is None else functools.partial(_through_folder, kept)
    run(lambda k: _batch(*arguments(k)), values, progress and jax.process_index() == 0)
    return values.on_grid(shape)


class _Values:
    """NumPy arrays for every array of a measure, filled batch by batch."""

    def __init__(self, shapes, points: int, batch: int):
        leaves, self._tree = jax.tree.flatten(shapes)  # of a point
        each = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)
        require_memory(f"a sweep of {points} points", points * max(each, 1))
        require_memory(f"a batch of {batch} points", batch * max(each, 1))
        self._arrays = [np.empty((points, *leaf.shape), leaf.dtype) for leaf in leaves]
        self.points, self._batch = points, batch
        self.batches = -(-points // batch)

    def size(self, k: int) -> int:
        """Points of batch k: the last one may be short."""
        return min(self._batch, self.points - k * self._batch)

    def put(self, k: int, leaves) -> None:
        """Fill in batch k; what goes beyond the last point is dropped."""
        begin, size = k * self._batch, self.size(k)
        for array, leaf in zip(self._arrays, leaves, strict=True):
            array[begin : begin + size] = leaf[:size]

    def on_grid(self, shape):
        """The pytree of the measure, its arrays with the axes of the grid first."""
        arrays = [array.reshape(*shape, *array.shape[1:]) for array in self._arrays]
        return jax.tree.unflatten(self._tree, arrays)


def _checked(scene: Scene, axes) -> list[np.ndarray]:
    """The values of every axis, each inside its domain together with those of the others."""
    if not axes:
        raise ValueError("sweep needs an axis, such as D=[2.3, 2.4]")
    grid = []
    for name, values in axes.items():
        grid.append(np.asarray(axis_values(scene, name, values)))
    require_independent(scene, tuple(axes))
    require_inside(scene, dict(zip(axes, grid, strict=True)))
    return grid


def _batch_size(asked, points, devices) -> int:
    if asked is None:
        return devices * min(_POINTS_EACH, -(-points // devices))
    if isinstance(asked, bool) or not isinstance(asked, int) or asked < 1:
        raise ValueError(f"batch_size must be an integer of at least 1, got {asked!r}")
    if asked % devices:
        raise ValueError(
            f"batch_size must be a multiple of the number of devices, {devices}, got {asked}"
        )
    return asked


def _mesh(devices) -> Mesh:
    chosen = jax.local_devices() if devices is None else list(devices)
    if not chosen:
        raise ValueError("devices must name at least one device, got none")
    return Mesh(np.array(chosen), (_POINTS,))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _batch(point, mesh, scene, axes, places):
    """The program `point` at the points that lie at `places` (batch,) on each of the axes."""

    def one(scene, axes, places):
        return point(scene, [axis[i] for axis, i in zip(axes, places, strict=True)])

    program = jax.vmap(one, (None, None, 0))
    if mesh.size > 1:
        whole, split = PartitionSpec(), PartitionSpec(_POINTS)
        # A program for each device: if XLA split one, every loop would wait for the slowest.
        program = jax.shard_map(
            program, mesh=mesh, in_specs=(whole, whole, split), out_specs=split, check_vma=False
        )
    return program(scene, axes, places)


def _places(begin: int, batch: int, shape, mesh):
    """Where points begin, begin + 1, ... of the grid lie on each axis; the last one repeats."""
    points = np.minimum(np.arange(begin, begin + batch), math.prod(shape) - 1)
    places = [axis.astype(np.int32) for axis in np.unravel_index(points, shape)]
    return jax.device_put(places, NamedSharding(mesh, PartitionSpec(_POINTS)))


def _in_memory(evaluate, values, shown):
    """Every batch, the next one running while one is copied."""
    with _bar(values.points, shown) as advance:
        following = evaluate(0)
        for k in range(values.batches):
            running = following
            following = evaluate(k + 1) if k + 1 < values.batches else None
            values.put(k, _arrays(running))
            advance(values.size(k))


def _through_folder(kept, evaluate, values, shown):
    """This process's share of the batches that are missing, then all of them from the folder."""
    share = range(jax.process_index(), values.batches, jax.process_count())
    with _bar(sum(map(values.size, share)), shown) as advance:
        for k in share:
            if not kept.has(k):
                kept.write(k, [array[: values.size(k)] for array in _arrays(evaluate(k))])
            advance(values.size(k))
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import sync_global_devices

        sync_global_devices("the batches of a sweep are written")
    for k in range(values.batches):
        values.put(k, kept.read(k))


def _arrays(batch) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(batch)]


@contextlib.contextmanager
def _bar(points, shown):
    from tqdm import tqdm

    with tqdm(total=points, desc="sweep", unit="point", unit_scale=True, disable=not shown) as bar:
        yield bar.update
