"""A measure over a grid of any named quantities, in batches of one compiled shape.

The grid itself is never stored: memory holds two batches and the result. With a folder every batch
is kept (`store.py`), so that an interrupted sweep resumes and processes share the work. With an
executor other processes and machines compute (`workers.py`).
"""

import contextlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from .._base.memory import require_memory
from .._mechanism.quantities import (
    axis_values,
    require_independent,
    require_inside,
    with_optional,
)
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .batches import Batches, mesh_of
from .blocks import blocks
from .labels import measure_words
from .program import Program
from .result import Sweep
from .store import Store, describe, description, leaf_names, zarr
from .workers import Computed, Job, gathered, require_executor


def sweep(
    measure: Callable[[Any], PyTree[ArrayLike]],
    x: Scene | Structure,
    batch_size: int | None = None,
    progress: bool = True,
    out: str | os.PathLike | None = None,
    executor: Any = None,
    *,
    devices: Sequence[Any] | None = None,
    **axes: ArrayLike | Sequence[float],
) -> Sweep:
    """`measure(x)` at every point of a grid: `sweep(growth_rate, scene, D=Ds, G=Gs)`.

    Points are evaluated in batches, which are blocks of the grid. The last digits of a result may
    depend on the size of a batch, and on nothing else here. `jax.jit` and `jax.grad` act on the
    measure, not on the sweep.

    **Arguments:**

    - `measure`: a function of a scene or structure that gives an array or a pytree of arrays. It is
      traced once per sweep, with the values that it captures at that time; equal programs are
      compiled once.
    - `x`: the scene or structure whose quantities are replaced.
    - `batch_size`: the most points of a batch, by default 8192 for every device, fewer for a
      structure with more than 8 degrees of freedom.
    - `progress`: shows a bar.
    - `out`: a folder for a Zarr store, by default none, which `xarray.open_zarr` opens, finished or
      not: the values of each axis with unit and meaning (K_t/K_n as K_t_over_K_n), each array of
      the measure, and `computed`, which is 0 where a point is not computed yet. The same sweep
      called again computes what is missing; batches running when it was killed are lost. Another
      sweep is refused, and one begun by other versions resumes with a warning. Under
      `jax.distributed` every process must name the same folder: each computes its share of the
      batches, and all return the whole. Needs `fractaljax[sweep]`.
    - `executor`: computes the batches: a `ThreadPoolExecutor`, a `ProcessPoolExecutor` that spawns,
      `client.get_executor()` of Dask, an `MPIPoolExecutor`, or anything like them; by default this
      thread. It needs several batches for each worker. Unless the workers are threads, measure and
      x are sent along by cloudpickle (`fractaljax[sweep]`); workers trace and compile them once,
      with the 64 bits and other settings of the caller, who collects the results and alone writes
      to `out`. If a batch fails, those that were running are kept in `out` before its error is
      raised.
    - `devices`: the devices that share each batch evenly, by default all of this process.
    - `axes`: each axis is a quantity by its name in `x.replace`, or a ratio as in
      `**{"K_t/K_n": ratios}` (`quantities.py`), and its values (n,) in SI units.

    **Returns:** a `Sweep`, which holds each array of the measure as a NumPy array
    (n_1, n_2, ..., *shape of the measure's).

    **Raises:** `ValueError` for no axis, an unknown name, two axes of one quantity, values that are
    not one-dimensional or outside their domain, a batch size that does not divide by the devices, a
    scene that holds arrays, more values than memory, a store of another sweep or with a damaged
    batch, a measure that calls Python (`jax.pure_callback`) beside `out`, several processes without
    it, devices beside an executor, or an executor that forks; `TypeError` for what is not numeric,
    no executor, or cannot be sent to a worker; `RuntimeError` if a worker of a pool dies, or traces
    another program; `OSError` if the folder cannot be written; `ImportError` for `out` without
    Zarr, or for workers that are not threads without cloudpickle.
    """
    grid = _check_axes(x, axes)
    names = tuple(grid)
    whole: Any = with_optional(x, names)  # pyright: ignore[reportArgumentType]
    program = Program(measure, names, whole, list(grid.values()))
    how: dict[str, Any] = dict(
        each=_points_each(x), batch_size=batch_size, progress=progress, out=out
    )
    values = run(program, whole, grid, x, measure, **how, devices=devices, executor=executor)
    return Sweep(values, tuple(grid.values()), names, x, measure_words(measure))


def run(
    program: Program,
    whole: Any,
    grid: Mapping[str, np.ndarray],
    x: Any,
    measure: Callable[[Any], Any],
    *,
    each: int,
    batch_size: int | None,
    progress: bool,
    out: str | os.PathLike | None,
    devices: Sequence[Any] | None,
    executor: Any = None,
) -> Any:
    """The pytree of a program's arrays over a grid, in batches; arguments and errors as `sweep`.

    The program takes the scene at each point from `whole`. By default a batch has `each` points on
    every device.
    """
    if executor is not None:
        require_executor(executor)
        if devices is not None:
            raise ValueError("devices are those of this process: leave them out beside executor")
    if out is not None:
        zarr()
    names, shape = tuple(grid), tuple(map(len, grid.values()))
    points, mesh = math.prod(shape), mesh_of(devices)
    if batch_size is None and out is not None and (begun := describe(out)) is not None:
        most: int = begun["batch"]
    else:
        most = _batch_size(batch_size, points, mesh.size, each)
    parts = blocks(shape, most)
    leaves, tree = jax.tree.flatten(program.shapes)
    size = max(1, sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves))
    require_memory(f"a sweep of {points} points", points * size)
    store = None
    if out is not None:
        named = dict(zip(leaf_names(measure, program.shapes, grid), leaves, strict=True))
        about = description(program, whole, grid, most)
        store = Store(out, about, x, grid, named, parts)
    elif jax.process_count() > 1:
        raise ValueError("out must name a folder that all processes share, got None")
    arrays = [np.empty((*shape, *leaf.shape), leaf.dtype) for leaf in leaves]

    def put(k, batch):
        for array, leaf in zip(arrays, batch, strict=True):
            array[parts.index(k)] = leaf

    share = range(jax.process_index(), parts.number, jax.process_count())
    kept = store.there() if store else set()
    missing = [k for k in share if k not in kept]
    if executor is None:
        computed = _compute_in_turn(
            Batches(program, whole, list(grid.values()), parts, mesh), missing
        )
    else:
        job = Job(measure, names, whole, list(grid.values()), parts, program)
        hint = f"out {out} keeps what is done" if store else "out would keep what is done"
        computed = gathered(executor, job, missing, f"{hint}, for the next call to resume")
    shown = progress and jax.process_index() == 0
    with contextlib.closing(computed), _progress_bar(sum(map(parts.size, share)), shown) as bar:
        bar.update(sum(parts.size(k) for k in share if k in kept))
        for k, batch in computed:
            if store:
                store.write(k, batch)
            put(k, batch)
            bar.update(parts.size(k))
    if store:
        if jax.process_count() > 1:
            from jax.experimental.multihost_utils import sync_global_devices

            sync_global_devices("the batches of a sweep are written")
        for k in sorted(set(range(parts.number)) - set(missing)):
            put(k, store.read(k))
    return jax.tree.unflatten(tree, arrays)


def _compute_in_turn(batches: Batches, numbers: Sequence[int]) -> Computed:
    """Each batch by its number with its leaves, computed while the previous one is stored."""
    begun = None
    for k in numbers:
        last, begun = begun, (k, batches.begin(k))
        if last is not None:
            yield last[0], batches.end(*last)
    if begun is not None:
        yield begun[0], batches.end(*begun)


def _check_axes(x: Any, axes: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The values of every axis, inside their domains jointly with those of the other axes."""
    x.require_one()
    if not axes:
        raise ValueError("sweep needs an axis, such as D=[2.3, 2.4]")
    grid = {name: np.asarray(axis_values(x, name, values)) for name, values in axes.items()}
    require_independent(x, tuple(grid))
    require_inside(x, grid)
    return grid


def _points_each(x: Any) -> int:
    """The default number of points of a batch on a device."""
    points = 8192
    if x.uncoupled:
        return points
    # The memory of its modes grows as the square of their number: at all points together, a matrix
    # of the eigenvalue problem has at most 2^21 entries.
    return max(1, min(points, 2**21 // (2 * x.n) ** 2))


def _batch_size(batch_size: int | None, points: int, devices: int, each: int) -> int:
    if batch_size is None:
        return devices * min(each, -(-points // devices))
    if isinstance(batch_size, bool) or not isinstance(batch_size, int) or batch_size < 1:
        raise ValueError(f"batch_size must be an integer of at least 1, got {batch_size!r}")
    if batch_size % devices:
        raise ValueError(
            f"batch_size must be a multiple of the number of devices, {devices}, got {batch_size}"
        )
    return batch_size


def _progress_bar(points: int, shown: bool):
    from tqdm import tqdm

    return tqdm(total=points, desc="sweep", unit="point", unit_scale=True, disable=not shown)
