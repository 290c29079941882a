"""Thousands of limit cycles at once: this package on one and two devices, against all the cores.

K_n goes over a range of the reference scene. The peer runs each transient from event to event
until it has settled, a process a core. Everything is measured in one process that has two virtual
devices, the methods taking turns.
"""

import concurrent.futures
import dataclasses
import functools
import json
import multiprocessing
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from fractaljax.modes.stability import growth_rate
from fractaljax.motion import transient
from fractaljax.motion.stick_slip import rest, scaled_start, stick_slip

from ..page import spread, versions
from ..timing import compiled, others_running, seconds, taking_turns, this_machine
from .events import TOLERANCE, heyoka_events
from .many_cycles_page import picture as picture, text as text
from .reference import MEMBERS, member, reference
from .transients import last_turn, law

RANGE = (2e8, 6e8)  # of K_n [N/m]
DEVICES = 2
FINE = 96  # segments of the truth
EQUAL, WANTED = 1e-9, 10  # the error at which the package meets its peer, and the ratio wanted
SETTLED = (6e-10, 2e-10, 1e-10, 1e-11)  # how well three maxima of the peer agree, in V/omega
PERIODS = 4000  # of the peer, at most
BATCH = ("cycles", "compile_s", "seconds_a_cycle")


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    cycles: int
    sample: int  # of them for the peer
    repeats: int
    segments: tuple[int | None, ...]  # None for the default
    batches: tuple[int, ...]  # beside `cycles`


FULL = Size(4096, 256, 7, (None, 24), (1, 16, 256))
QUICK = Size(64, 8, 1, (None,), ())


# ---------------------------------------------------------------------------------------------
# The package
# ---------------------------------------------------------------------------------------------


def many(segments: int | None = None) -> Callable:
    """Period, peak to peak of x1 and the place of the result in MEMBERS, by K_n (n,)."""

    def one(K):
        cycle = fj.limit_cycle(reference(K), segments=segments, throw=False)
        return cycle.period, cycle.amplitude[0], member(cycle)

    return jax.vmap(one)


def over_devices(segments: int | None, K_n: jax.Array) -> tuple[Callable, float]:
    """The batch over all devices, a part each: a call, and the seconds to compile it."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("cycles",))
    spec = jax.sharding.PartitionSpec("cycles")
    body = jax.shard_map(many(segments), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    parted = jax.device_put(K_n, jax.sharding.NamedSharding(mesh, spec))
    program, compile_s = compiled(body, parted)
    return lambda: program(parted), compile_s


def on_one(segments: int | None, K_n: jax.Array) -> tuple[Callable, float]:
    """The same on the first device."""
    program, compile_s = compiled(many(segments), K_n)
    return lambda: program(K_n), compile_s


def turns_of(K_n: jax.Array) -> np.ndarray:
    """Turns (n,) of the coarse run that looks for each cycle."""

    def one(K):
        scene = reference(K)
        system = stick_slip(scene)
        still, growth = rest(scene, system), growth_rate(scene) / system.omega
        start = scaled_start(scene, system, None)
        return transient.find(system, start, still, growth, jnp.asarray(5000.0), 40).turns

    return np.asarray(jax.jit(jax.vmap(one))(K_n))


def busy(turns: np.ndarray, together: int) -> float:
    """Mean over longest run of those that run together, in the mean over the groups."""
    groups = [turns[i : i + together] for i in range(0, len(turns), together)]
    return float(np.mean([np.mean(group) / np.max(group) for group in groups]))


# ---------------------------------------------------------------------------------------------
# The peer
# ---------------------------------------------------------------------------------------------


def one_transient(K_n: float, settled: float) -> tuple[float, float, int]:
    """Period [s], amplitude [m] and number of periods run."""
    numbers = law(K_n)
    found = heyoka_events(numbers, TOLERANCE, PERIODS, settled)()
    return *last_turn(numbers, found), len(found[0]) // 2


def transients(pool: Any, K_n: list[float], settled: float) -> np.ndarray:
    """The same of many (n, 3), over all processes of a pool."""
    each = max(1, len(K_n) // (8 * (os.cpu_count() or 1)))
    run = functools.partial(one_transient, settled=settled)
    return np.array(list(pool.map(run, K_n, chunksize=each)))


def settle(pool: Any, K_n: list[float], truth: np.ndarray) -> tuple[float, np.ndarray]:
    """The loosest rule to stop by that gives the error wanted, and what it gives (n, 3)."""
    for settled in SETTLED:
        found = transients(pool, K_n, settled)
        if np.max(off(found[:, :2], truth)) < EQUAL:
            break
    return settled, found


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def off(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Relative errors of periods and amplitudes (n, 2)."""
    return np.abs(found / truth - 1)


def described(call: Callable, compile_s: float, truth: np.ndarray) -> dict[str, Any]:
    """What a batch of the package finds, and how well."""
    period, amplitude, result = (np.asarray(x) for x in call())
    errors = off(np.stack([period, amplitude], axis=1), truth)[result == 0]
    counts = {name: int(np.sum(result == i)) for i, name in enumerate(MEMBERS)}
    return {
        "compile_s": compile_s,
        "results": {name: count for name, count in counts.items() if count},
        "error": spread(errors),
    }


Timed = list[tuple[dict[str, Any], Callable]]  # rows without times, and their calls


def own_batches(size: Size, K_n: jax.Array, truth: np.ndarray) -> Timed:
    """The package by segments and devices."""
    found: Timed = []
    for segments in size.segments:
        label = f"{segments} segments" if segments else "default"
        for devices, make in ((1, on_one), (DEVICES, over_devices)):
            call, compile_s = make(segments, K_n)
            row = {"name": f"fj.limit_cycle, {label}", "devices": devices, "cycles": len(K_n)}
            found.append((row | described(call, compile_s, truth), call))
    return found


def peer(pool: Any, K_n: list[float], truth: np.ndarray) -> Timed:
    """heyoka over all processes of a pool, where it is installed."""
    if "heyoka" not in versions("heyoka"):
        return []
    settled, found = settle(pool, K_n, truth)
    errors = off(found[:, :2], truth)
    row = {
        "name": f"heyoka by events, until maxima agree to {settled:g}",
        "devices": DEVICES,
        "cycles": len(K_n),
        "compile_s": None,
        "periods": {"median": float(np.median(found[:, 2])), "most": found[:, 2].max()},
        "error": spread(errors),
    }
    return [(row, lambda: transients(pool, K_n, settled))]


def measured(size: Size) -> dict[str, Any]:
    """All numbers, in a process that has the virtual devices."""
    K_n = jnp.linspace(*RANGE, size.cycles)
    *truth, results = (np.asarray(x) for x in jax.jit(many(FINE))(K_n))
    truth = np.stack(truth, axis=1)
    own, every = own_batches(size, K_n, truth), size.cycles // size.sample
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(DEVICES, mp_context=spawn) as pool:
        timed = own + peer(pool, np.asarray(K_n)[::every].tolist(), truth[::every])
        calls = {str(i): call for i, (_, call) in enumerate(timed)}
        taken = taking_turns(calls, size.repeats).values()
    rows = [row for row, _ in timed]
    times = [[t / row["cycles"] for t in ts] for row, ts in zip(rows, taken, strict=True)]
    for row, own_times in zip(rows, times, strict=True):
        row["seconds_a_cycle"] = statistics.median(own_times)
    return {
        "range": RANGE,
        "fine": FINE,
        "repeats": size.repeats,
        "not_converged_with_fine": int(np.sum(results != 0)),
        "methods": rows,
        "headline": headline(rows, times),
        "batches": [*batches(size), {key: rows[0][key] for key in BATCH}],
        "lanes": lanes(K_n),
    }


def headline(rows: list[dict[str, Any]], times: list[list[float]]) -> list[dict[str, Any]]:
    """The ratio to the peer, of the package over all devices at no larger an error."""
    if "heyoka" not in rows[-1]["name"]:
        return []
    own = [
        i for i, found in enumerate(rows) if found["devices"] == DEVICES and "fj." in found["name"]
    ]
    own = [i for i in own if rows[i]["error"]["worst"] < EQUAL]
    best = min(own, key=lambda i: rows[i]["seconds_a_cycle"])
    ratio = statistics.median(a / b for a, b in zip(times[-1], times[best], strict=True))
    return [
        {
            "what": f"many cycles to {EQUAL:g}: {rows[best]['name']}, against {rows[-1]['name']}",
            "ratio": ratio,
            "wanted": WANTED,
        }
    ]


def batches(size: Size) -> list[dict[str, Any]]:
    """Time of a cycle by how many there are in one call, spread over the range."""
    rows = []
    for count in size.batches:
        call, compile_s = on_one(None, jnp.linspace(*RANGE, count + 2)[1:-1])
        call()
        taken = statistics.median(seconds(call)[0] for _ in range(size.repeats))
        rows.append(dict(zip(BATCH, (count, compile_s, taken / count), strict=True)))
    return rows


def lanes(K_n: jax.Array) -> dict[str, Any]:
    """How busy lanes would be that all wait for the longest run."""
    turns = turns_of(K_n)
    groups = dict.fromkeys((transient._TOGETHER, len(turns)))
    return {
        "turns": {"mean": float(turns.mean()), "most": float(turns.max())},
        "busy": {str(n): busy(turns, n) for n in groups},
    }


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    load = others_running()
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"
    command = [sys.executable, "-m", __name__, "quick" if quick else "full"]
    done = subprocess.run(
        command,
        cwd=Path(__file__).parents[2],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return {
        "quick": quick,
        "machine": this_machine(load),
        "versions": versions("jax", "numpy", "heyoka"),
        **json.loads(done.stdout.splitlines()[-1]),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(measured(QUICK if sys.argv[1] == "quick" else FULL)))
