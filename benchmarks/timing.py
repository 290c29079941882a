"""What every benchmark times with, and the machine it ran on."""

import importlib.metadata
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

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
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            times[name].append(each(call, often[name]))
    return times


def ratio(peer: list[float], own: list[float]) -> float:
    """How many times as fast as a peer: the median of the ratios within a turn."""
    return statistics.median(a / b for a, b in zip(peer, own, strict=True))


def too_long(elapsed: float, growth: float, limit: float) -> bool:
    """Whether a call on `growth` times the work would take above `limit` [s].

    A short call is mostly overhead and predicts nothing.
    """
    return elapsed > 0.1 and elapsed * growth > limit


def compiled(function: Callable, *arguments) -> tuple[Callable, float]:
    """The compiled program, and the seconds of tracing and compiling it."""
    jax.clear_caches()  # no program may profit from the tracing of another
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - start


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


def ran_on(result: dict[str, Any]) -> str:
    """The line of a page that names the machine, how busy it was, and the versions."""
    machine = result["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    return (
        f"{machine_name(machine)}, {machine['others_running']:.1f} other programs running before;"
        f" {versions}."
    )


def cpu() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def others_running() -> float:
    """Load of the last minute: what other programs take of the machine."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
