"""What every benchmark times with, and the machine it ran on."""

import math
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

LEAST = 0.2  # s: what is timed lasts this long at least, so that the first calls count little


def seconds(function: Callable, *arguments) -> tuple[float, Any]:
    """Wall-clock seconds of one call, and what it gave."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start, result


def taking_turns(calls: dict[str, Callable], repeats: int) -> dict[str, list[float]]:
    """Seconds of each call, `repeats` times, by turns: what disturbs the machine disturbs all.

    Short calls are repeated: the first of a turn finds the caches full of another's data.
    """

    def each(call: Callable, often: int) -> float:
        start = time.perf_counter()
        for _ in range(often):
            jax.block_until_ready(call())
        return (time.perf_counter() - start) / often

    often = {
        name: math.ceil(LEAST / min(each(call, 1), each(call, 1))) for name, call in calls.items()
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            times[name].append(each(call, often[name]))
    return times


def too_long(elapsed: float, times_the_work: float, limit: float) -> bool:
    """Whether a call would take above `limit` [s], by what it took for a part of the work.

    What a short call takes is mostly the calling, and says nothing.
    """
    return elapsed > 0.1 and elapsed * times_the_work > limit


def compiled(function: Callable, *arguments) -> tuple[Callable, float]:
    """The compiled program, and the seconds of tracing and compiling it."""
    jax.clear_caches()  # no program may profit from the tracing of another
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - start


def this_machine(busy: float) -> dict[str, Any]:
    """The processor, how `busy` it was before the benchmark, and the device; ready for JSON."""
    return {
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "others_running": busy,
    }


def ran_on(result: dict[str, Any]) -> str:
    """The line of a page that names the machine, how busy it was, and the versions."""
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    machine = result["machine"]
    return (
        f"{named(machine)}, {machine['others_running']:.1f} programs running on them before;"
        f" {versions}."
    )


def named(machine: dict[str, Any]) -> str:
    """Processor and cores, and the device where that is another."""
    device = "" if machine["device"] == "cpu" else f"{machine['device']} beside "
    return f"{device}{machine['cpu']}, {machine['cores']} cores"


def cpu_model() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def others_running() -> float:
    """Load of the last minute before the benchmark: what other programs took of the machine."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
