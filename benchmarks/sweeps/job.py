"""One sweep in a Python process of its own: its time, its memory, and some of its values.

`python -m benchmarks.sweeps.job JSON` takes the fields of a `Job` and prints what it measured.
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from fractaljax.sweeping.shards import Shards

IN_MEMORY, SHARDS, AT_ONCE = "sweep, in memory", "sweep, in shards", "one call of jax.vmap"
RANGES = {"D": (2.3, 2.6), "G": (1e-11, 1e-9), "mu_s": (0.3, 0.5), "V": (0.05, 0.3)}


@dataclasses.dataclass(frozen=True)
class Job:
    """A sweep of the growth rate over the axes of `RANGES`, and how it is run."""

    lengths: tuple[int, ...]  # of the axes
    repeats: int = 1
    batch: int | None = None  # points at a time, by default those of `sweep`
    at_once: bool = False  # all points in one call of a vmapped program instead
    shards: str | None = None  # folder in which every repeat keeps its batches
    begun: str | None = None  # file to which the number of every batch that is begun is added
    warm: bool = True  # whether the program is compiled before the clock starts
    picked: tuple[int, ...] = ()  # points whose values are returned
    port: int | None = None  # of the first of two processes
    rank: int = 0

    @property
    def points(self) -> int:
        """How many points the grid has."""
        return math.prod(self.lengths)


def axes(lengths) -> dict[str, Any]:
    """The values on every axis."""
    spaced = {"G": np.geomspace}
    return {
        name: spaced.get(name, np.linspace)(*ends, length)
        for (name, ends), length in zip(RANGES.items(), lengths, strict=True)
    }


def at(lengths, point: int) -> dict[str, float]:
    """The quantities at a point of the grid."""
    places = np.unravel_index(point, lengths)
    values = zip(axes(lengths).items(), places, strict=True)
    return {name: float(axis[place]) for (name, axis), place in values}


def swept(job: Job, folder: str | None) -> np.ndarray:
    """Growth rates over the grid."""
    scene = fj.brake_scene()
    return fj.sweep(fj.growth_rate, scene, job.batch, False, out=folder, **axes(job.lengths))


class _Enough(Exception):
    """The first batch is there."""


def first_batch(job: Job) -> None:
    """Trace, compile and run one batch of the sweep, with axes of the same lengths."""

    def enough(*_):
        raise _Enough

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(Shards, "write", enough),
        contextlib.suppress(_Enough),
    ):
        swept(job, folder)


def whole_grid(job: Job) -> Callable[[], np.ndarray]:
    """A call that makes the grid and gives it to a program compiled for all points at once."""
    scene = fj.brake_scene()

    def growth(*values):
        return fj.growth_rate(scene.replace(**dict(zip(RANGES, values, strict=True))))

    flat = [jax.ShapeDtypeStruct((job.points,), float)] * len(RANGES)
    program = jax.jit(jax.vmap(growth)).lower(*flat).compile()

    def run():
        grid = np.meshgrid(*axes(job.lengths).values(), indexing="ij")
        return np.asarray(program(*(jnp.asarray(values.ravel()) for values in grid)))

    return run


def peak_memory() -> int:
    """The largest number of bytes that were resident so far, or since `forget_peak`."""
    try:
        status = Path("/proc/self/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    except (OSError, StopIteration):  # not Linux
        unit = 1 if sys.platform == "darwin" else 1024
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def forget_peak() -> None:
    """Let `peak_memory` start again from what is resident now, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def log_begun(file: str) -> None:
    """Add the number of every batch that a sweep finds missing to a file, before it is computed."""
    log, has = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND), Shards.has

    def logged(self, k):
        found = has(self, k)
        if not found:
            os.write(log, f"{k}\n".encode())
        return found

    Shards.has = logged


def measured(job: Job) -> dict[str, Any]:
    """Run it: seconds of every repeat, bytes beyond those held before, and picked values."""
    if job.port is not None:
        jax.distributed.initialize(f"127.0.0.1:{job.port}", 2, job.rank)
    if job.begun is not None:
        log_begun(job.begun)
    start = time.perf_counter()
    at_once = whole_grid(job) if job.at_once else None
    if job.warm and not job.at_once:
        first_batch(job)
    prepared = time.perf_counter() - start
    forget_peak()
    base = peak_memory()
    times, result = [], np.empty(0)
    for repeat in range(job.repeats):
        del result
        folder = None if job.shards is None else str(Path(job.shards) / str(repeat))
        if job.port is not None:
            from jax.experimental.multihost_utils import sync_global_devices

            sync_global_devices(f"repeat {repeat} begins")
        start = time.perf_counter()
        result = swept(job, folder) if at_once is None else at_once()
        times.append(time.perf_counter() - start)
    peak = peak_memory()
    return {
        "device": jax.devices()[0].device_kind,
        "devices": jax.local_device_count(),
        "prepared_s": prepared,
        "seconds": times,
        "base_bytes": base,
        "peak_bytes": peak,
        "result_bytes": result.nbytes,
        "values": result.ravel()[list(job.picked)].tolist(),
        "sha256": hashlib.sha256(result.tobytes()).hexdigest(),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(measured(Job(**json.loads(sys.argv[1])))))
