"""A hundred million points on a Dask cluster: `python docs/make_cluster.py` writes cluster.md."""

import os
import platform
import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from writing import run, small_png, table

import fractaljax as fj

PAGE = Path(__file__).with_name("cluster.md")
PICTURE = Path(__file__).with_name("cluster.png")
SIDE, BATCH, WORKERS = 10_000, 500_000, 2
CYCLES = 256

INTRODUCTION = """# A sweep that outgrows the machine

The growth rate of the reference brake at {points:.0e} surfaces, {side} of D by {side} of G, on a
Dask cluster of {workers} workers with one thread each on one machine. One worker is killed after a
quarter of the batches. The call is the one that runs without a cluster, and an executor:

```python
from dask.distributed import Client

client = Client("tcp://scheduler:8786")  # or Client(n_workers=2, threads_per_worker=1) here
found = fj.sweep(
    fj.growth_rate,
    fj.brake_scene(),
    {batch},
    executor=client.get_executor(),
    out="run.zarr",
    D=np.linspace(2.2, 2.6, {side}),
    G=np.geomspace(1e-11, 1e-9, {side}),
)
```
"""

NEEDS = """
## What a cluster needs

- The same versions of Python, JAX and this package on every machine, with the `sweep` extra. A
  worker traces the measure itself, and refuses if it gets another program than the caller. Results
  are equal to the last bit on processors of one kind.
- A worker with one thread for every core, `dask worker tcp://scheduler:8786 --nworkers N --nthreads
  1`: JAX takes all cores for a batch, and the threads of a worker would wait for one another.
- Batches that take a worker some tenths of a second, for each of which the scheduler needs about a
  thousandth. Here {batch} points are {megabytes:.0f} MB and take {task:.2f} s.
- At least three batches for every worker, so that none is idle at the end. Of a worker that dies
  the batches that it had begun are computed again, no more.
- At the caller the memory of the whole result, {result:.1f} GB here; at a worker that of two
  batches and of JAX. No disk is shared: the caller alone writes `out`.
- A network that takes {rate:.0f} MB/s from each worker to the caller for this measure, the most of
  any: a growth rate is one number of 8 bytes for {each:.0f} ns of computing.

## Measures that branch

A limit cycle is searched for until it is found, sooner at one surface than at another. Side by side
in one loop all points wait for the slowest, and every point takes both sides of every branch. So on
a CPU a sweep computes the points of such a batch in turn, which is decided when the measure is
traced; an accelerator takes them side by side. {cycles} cycles for D from 2.30 to 2.39 take
{together:.1f} s side by side and {turn:.2f} s in turn, {gain:.1f} times less.
"""


class Watched:
    """An executor that calls `kill` once, after so many batches."""

    def __init__(self, executor: Any, after: int, kill: Callable[[], None]):
        self._executor, self._left, self._kill = executor, after, kill

    def submit(self, *arguments):
        """The future of a call on a worker."""
        future = self._executor.submit(*arguments)
        future.add_done_callback(self._count)
        return future

    def map(self, *arguments):
        """As of any executor."""
        return self._executor.map(*arguments)

    def _count(self, _):
        self._left -= 1
        if self._left == 0:
            self._kill()


class Measured(NamedTuple):
    """A sweep on a cluster: its result and what the scheduler's dashboard says of it."""

    values: np.ndarray
    seconds: float
    killed: float  # [s] after the begin
    tasks: list[tuple[str, float, float]]  # worker, begin and end [s] of each that ended
    memory: float  # [bytes], the most of all workers together


def axes(side: int) -> dict[str, np.ndarray]:
    """The grid."""
    return {"D": np.linspace(2.2, 2.6, side), "G": np.geomspace(1e-11, 1e-9, side)}


def here(side: int, batch: int) -> tuple[np.ndarray, float]:
    """The sweep in this process: its values and its time [s], with compiling."""
    begin = time.perf_counter()
    found = fj.sweep(fj.growth_rate, fj.brake_scene(), batch, False, **axes(side))
    return np.asarray(found.values), time.perf_counter() - begin


def on_cluster(side: int, batch: int, workers: int) -> Measured:
    """The sweep on a cluster of which one worker is killed after a quarter of the batches."""
    from distributed import Client, LocalCluster, get_task_stream
    from distributed.diagnostics import MemorySampler

    options: Any = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
    sampler, killed, quarter = MemorySampler(), [], side**2 // batch // 4
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(processes=True, memory_limit=0, **options) as cluster,
        Client(cluster) as client,
    ):
        pids: Any = client.run(os.getpid)

        def kill():
            killed.append(time.time())
            os.kill(next(iter(pids.values())), signal.SIGKILL)

        executor: Any = Watched(client.get_executor(), quarter, kill)
        begin = time.time()
        with get_task_stream(client) as stream, sampler.sample("all", measure="process"):
            found = fj.sweep(
                fj.growth_rate, fj.brake_scene(), batch, False, Path(folder) / "run.zarr", executor,
                **axes(side),
            )  # fmt: skip
        seconds = time.time() - begin
    tasks = [
        (task["worker"], step["start"] - begin, step["stop"] - begin)
        for task in stream.data
        for step in task["startstops"]
        if step["action"] == "compute"
    ]
    memory = float(np.max(sampler.to_pandas()["all"]))
    return Measured(np.asarray(found.values), seconds, killed[0] - begin, tasks, memory)


def branching(count: int) -> tuple[float, float]:
    """The seconds of limit cycles side by side and in turn, without compiling."""

    def one(D):
        return fj.limit_cycle(fj.brake_scene().replace(D=D), throw=False).period

    times, values = [], jnp.linspace(2.30, 2.39, count)
    for every in (jax.vmap(one), lambda values: jax.lax.map(one, values)):
        program = jax.jit(every).lower(values).compile()
        begin = time.perf_counter()
        jax.block_until_ready(program(values))
        times.append(time.perf_counter() - begin)
    return times[0], times[1]


def draw(measured: Measured) -> Figure:
    """What each worker did when: the task stream of the dashboard."""
    figure = Figure(figsize=(9, 2.4), layout="constrained")
    panel = figure.subplots()
    names = list(dict.fromkeys(worker for worker, *_ in measured.tasks))
    for k, name in enumerate(names):
        bars = [(begin, end - begin) for worker, begin, end in measured.tasks if worker == name]
        panel.broken_barh(bars, (k - 0.35, 0.7), edgecolor="white", linewidth=0.3)
    panel.axvline(measured.killed, color="C3", label="a worker is killed")
    panel.set_yticks(range(len(names)), [f"worker {k + 1}" for k in range(len(names))])
    panel.set_xlabel("time [s]")
    panel.set_xlim(0, measured.seconds)
    panel.invert_yaxis()
    figure.legend(loc="outside upper right", frameon=False)
    return figure


def page(side: int, batch: int, workers: int, cycles: int) -> tuple[str, Figure]:
    """The text and the picture of cluster.md."""
    measured = on_cluster(side, batch, workers)
    values, alone = here(side, batch)
    if not np.array_equal(values, measured.values, equal_nan=True):
        raise RuntimeError("the cluster found other values than this process")
    together, turn = branching(cycles)
    points, batches = side**2, -(-(side**2) // batch)
    lengths = [end - begin for _, begin, end in measured.tasks]
    task = statistics.median(lengths)
    rows = [
        ["points a second, on the cluster", f"{points / measured.seconds:.3g}"],
        ["points a second, in one process with all cores", f"{points / alone:.3g}"],
        ["batches, computed by the workers", f"{batches}, {len(lengths)}"],
        ["a batch, median and longest [s]", f"{task:.2f}, {max(lengths):.2f}"],
        [
            "share of the workers' time in batches",
            f"{sum(lengths) / workers / measured.seconds:.0%}",
        ],
        ["results sent to the caller [MB]", f"{values.nbytes / 1e6:.0f}"],
        ["most memory of all workers [MB]", f"{measured.memory / 1e6:.0f}"],
        ["values that differ from those of one process", "0"],
    ]
    numbers = dict(points=points, side=side, batch=batch, workers=workers)
    needs = NEEDS.format(
        batch=batch,
        megabytes=batch * 8 / 1e6,
        task=task,
        result=values.nbytes / 1e9,
        rate=batch * 8 / 1e6 / task,
        each=task / batch * 1e9,
        cycles=cycles,
        together=together,
        turn=turn,
        gain=together / turn,
    )
    lines = [
        INTRODUCTION.format(**numbers),
        *table(["what the scheduler says", ""], rows),
        "",
        "![When each worker computed](cluster.png)",
        "",
        f"After {measured.killed:.1f} s a worker is killed. Dask starts another one, which compiles"
        " the program first; what the dead one had begun or not yet handed over is computed again,"
        " and nothing is stored twice.",
        needs,
        f"{platform.machine()}, {os.cpu_count()} cores; Python {platform.python_version()}, "
        f"JAX {jax.__version__}. Times are of this machine, which other programs share.",
        "",
        "Written by `python docs/make_cluster.py`.",
        "",
    ]
    return "\n".join(lines), draw(measured)


def main() -> None:
    """Write the page and its picture."""
    jax.config.update("jax_enable_x64", True)
    text, figure = page(SIDE, BATCH, WORKERS, CYCLES)
    run({PAGE: lambda: text.encode(), PICTURE: lambda: small_png(figure)})


if __name__ == "__main__":
    main()
