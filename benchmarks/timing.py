"""What every benchmark times with, and the machine it ran on."""

import math
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax


def seconds(function: Callable, *arguments) -> tuple[float, Any]:
    """Wall-clock seconds of one call, and what it gave."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start, result


def compiled(function: Callable, *arguments) -> tuple[Callable, float]:
    """The compiled program, and the seconds of tracing and compiling it."""
    jax.clear_caches()  # no program may profit from the tracing of another
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - start


def this_machine(busy: float) -> dict[str, Any]:
    """The processor, and how `busy` it was before the benchmark, ready for JSON."""
    return {"cpu": cpu_model(), "cores": os.cpu_count(), "others_running": busy}


def ran_on(result: dict[str, Any]) -> str:
    """The line of a page that names the machine, how busy it was, and the versions."""
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    machine = result["machine"]
    return (
        f"{machine['cpu']}, {machine['cores']} cores, {machine['others_running']:.1f} programs"
        f" running on them before; {versions}."
    )


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
