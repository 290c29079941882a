"""What every benchmark times with, Pythons of their own, and the machine they run on."""

import functools
import importlib
import importlib.metadata
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

SHORTEST = 0.2  # s: quicker calls are repeated for so long, so that the first ones count little


def seconds(function: Callable, *arguments) -> tuple[float, Any]:
    """Wall-clock seconds of one call, and its result."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start, result


def taking_turns(calls: dict[str, Callable], repeats: int) -> dict[str, list[float]]:
    """Seconds of each call, `repeats` times in turn: what disturbs the machine disturbs all.

    Quick calls are repeated within a turn: the first one finds the caches full of other data.
    """

    def each(call: Callable, often: int) -> float:
        start = time.perf_counter()
        for _ in range(often):
            jax.block_until_ready(call())
        return (time.perf_counter() - start) / often

    often = {n: math.ceil(SHORTEST / min(each(c, 1), each(c, 1))) for n, c in calls.items()}
    turns = [{n: each(c, often[n]) for n, c in calls.items()} for _ in range(repeats)]
    return {name: [turn[name] for turn in turns] for name in calls}


def ratio(peer: list[float], own: list[float]) -> float:
    """How many times as fast as a peer: the median of the ratios within a turn."""
    return statistics.median(a / b for a, b in zip(peer, own, strict=True))


def in_batches(
    calls: Callable[[int, Callable[[str], bool]], dict[str, Callable]],
    batches: Iterable[int],
    repeats: int,
    limit: float,
) -> Iterator[tuple[int, dict[str, list[float]]]]:
    """Each batch and the seconds of `calls(batch, quick)`, where `quick(name)` says what to leave.

    That is what would take above `limit` [s], going by the batch before. A short call is mostly
    overhead and predicts nothing.
    """
    last: dict[str, float] = {}  # seconds of the work of one
    from tqdm import tqdm  # here, since pages list what a scene imports

    def quick(batch: int, name: str) -> bool:
        return last.get(name, 0) * batch <= limit

    for batch in tqdm(batches, desc="batch"):
        turns = taking_turns(calls(batch, functools.partial(quick, batch)), repeats)
        taken = {name: statistics.median(own) for name, own in turns.items()}
        last |= {name: own / batch if own > 0.1 else 0.0 for name, own in taken.items()}
        yield batch, turns


def compiled(function: Callable, *arguments) -> tuple[Callable, float]:
    """The compiled program, and the seconds of tracing and compiling it."""
    jax.clear_caches()  # no program may profit from the tracing of another
    compile_s, program = seconds(lambda: jax.jit(function).lower(*arguments).compile())
    return program, compile_s


def in_parts(function: Callable, columns: Iterable[jax.Array], size: int) -> tuple[Callable, float]:
    """A call of a function for all of the columns, `size` at a time, and the seconds to compile it.

    Parts are of equal lengths, since every shape is a program of its own.
    """
    split = [jnp.split(column, math.ceil(len(column) / size)) for column in columns]
    parts = list(zip(*split, strict=True))
    run, compile_s = compiled(function, *parts[0])
    return lambda: [run(*part) for part in parts], compile_s


# Pythons of their own


def started(module: str, environment: dict[str, str], **arguments: Any) -> subprocess.Popen:
    """`module.in_this_process` of such arguments in another Python."""
    child = "from benchmarks.timing import answer; answer()"
    return subprocess.Popen(
        [sys.executable, "-c", child, module, json.dumps(arguments)],
        cwd=Path(__file__).parents[1],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen) -> Any:
    """What it returned."""
    said, complaint = process.communicate()
    if process.returncode:
        raise RuntimeError(f"{process.args} failed: {complaint}")
    return json.loads(said.splitlines()[-1])


def answer() -> None:
    """The other end of `started`."""
    jax.config.update("jax_enable_x64", True)
    module, arguments = sys.argv[1:]
    print(json.dumps(importlib.import_module(module).in_this_process(**json.loads(arguments))))


def devices(count: int) -> dict[str, str]:
    """An environment in which JAX sees so many virtual devices on the processor."""
    return {"JAX_NUM_CPU_DEVICES": str(count), "JAX_PLATFORMS": "cpu"}


# The machine


def versions(*packages: str) -> dict[str, str]:
    """The versions of Python and of those packages that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def this_machine(busy: float) -> dict[str, Any]:
    """The processor, how `busy` it was before the benchmark, and the device."""
    device = jax.devices()[0].device_kind
    return {"cpu": cpu(), "cores": os.cpu_count(), "device": device, "others_running": busy}


def machine_name(machine: dict[str, Any]) -> str:
    """Processor and cores, and the device where that is another."""
    device = "" if machine["device"] == "cpu" else f"{machine['device']} beside "
    return f"{device}{machine['cpu']}, {machine['cores']} cores"


def cpu() -> str:
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def others_running() -> float:
    """Load of the last minute: what other programs take of the machine."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
