"""Scale: `sweep` over more and more points, in memory and in shards, interrupted, and shared.

Every sweep is one of the growth rate over D, G, mu_s and V in a Python process of its own
(`job.py`), so that its peak of memory is its own. Beside it all points in one call of the
vmapped program, which is what a user has without `sweep`.
"""

import contextlib
import dataclasses
import json
import math
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from mpmath import mpf
from tqdm import tqdm

import fractaljax as fj

from ..growth.exact import exact_growth, mp
from ..growth.loops import brake
from ..page import versions
from ..timing import others_running, this_machine
from .job import AT_ONCE, IN_MEMORY, SHARDS, Job, at
from .scale_page import picture as picture, text as text

LINEAR, OWN_MEMORY = 0.1, 100e6  # how far from 1 a slope may be; bytes beyond the result
KILLS = (0.25, 0.5, 0.75)  # shares of the batches that are there when a sweep is killed


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    sides: tuple[tuple[int, ...], ...]  # lengths of the axes, from few points to many
    at_once: int  # most points in one call
    repeats: int  # of a sweep up to 1e7 points; beyond, one
    checked: int  # points of every result beside a single call and 40 digits
    shared: tuple[int, ...]  # lengths of the axes of what is interrupted or shared
    batch: int  # of what is interrupted
    turns: int  # of what is shared


FULL = Size(
    ((10,) * 4, (100, 10, 10, 10), (100, 100, 10, 10), (100, 100, 100, 10), (100,) * 4),
    10_000_000,
    3,
    16,
    (100, 100, 20, 20),
    8192,
    3,
)
QUICK = Size(((10,) * 4, (100, 10, 10, 10)), 10_000, 1, 4, (100, 100, 10, 5), 1024, 1)


# ---------------------------------------------------------------------------------------------
# Sweeps in processes of their own
# ---------------------------------------------------------------------------------------------


def started(job: Job, devices: int = 1, shared: bool = False) -> subprocess.Popen:
    """The process of a job; on virtual devices of the processor where it is shared."""
    environment = dict(os.environ)
    if shared:
        flags = f"--xla_force_host_platform_device_count={devices}"
        environment |= {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.sweeps.job", json.dumps(dataclasses.asdict(job))],
        cwd=Path(__file__).parents[2],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen) -> dict[str, Any]:
    """What a job has measured."""
    said, complaint = process.communicate()
    if process.returncode:
        raise RuntimeError(f"a sweep failed: {complaint}")
    return json.loads(said.splitlines()[-1])


def files(folder: Path) -> list[Path]:
    """The batches that a folder holds."""
    return list(folder.glob("[0-9]*.npz"))


@contextlib.contextmanager
def folder():
    """A temporary folder."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


# ---------------------------------------------------------------------------------------------
# More and more points
# ---------------------------------------------------------------------------------------------


def ladder(size: Size) -> list[dict[str, Any]]:
    """Time, memory, files and errors of every way to take every number of points."""
    rows, b = [], brake()
    steps = [
        (way, lengths)
        for way in (IN_MEMORY, SHARDS, AT_ONCE)
        for lengths in size.sides
        if way != AT_ONCE or math.prod(lengths) <= size.at_once
    ]
    for way, lengths in tqdm(steps, desc="more points"):
        points = math.prod(lengths)
        picked = np.random.default_rng(0).integers(points, size=size.checked).tolist()
        with folder() as place:
            job = Job(
                lengths,
                size.repeats if points <= 10_000_000 else 1,
                at_once=way == AT_ONCE,
                shards=str(place) if way == SHARDS else None,
                picked=tuple(picked),
            )
            found = ended(started(job))
            kept = files(place / "0")
            on_disk = sum(file.stat().st_size for file in kept) if kept else None
        rows.append(
            {
                "way": way,
                "points": points,
                "repeats": job.repeats,
                "device": found["device"],
                "compile_s": found["prepared_s"],
                "seconds": statistics.median(found["seconds"]),
                "base_bytes": found["base_bytes"],
                "peak_beyond_base": found["peak_bytes"] - found["base_bytes"],
                "result_bytes": found["result_bytes"],
                "disk_bytes": on_disk,
                "files": len(kept),
                **errors(b, lengths, picked, found["values"]),
            }
        )
    return rows


def errors(b: dict[str, float], lengths, picked, values) -> dict[str, float]:
    """Worst errors of values of a sweep, in omega_1: beside single calls, and 40 digits."""
    scene, single, exact = fj.brake_scene(), [], []
    for point, value in zip(picked, values, strict=True):
        there = at(lengths, point)
        single.append(abs(value - float(fj.growth_rate(scene.replace(**there)))))
        with mp.workdps(40):
            truth = exact_growth(b | there, mpf(there["D"]), mp.log(mpf(there["G"])))
        exact.append(abs(value - float(truth)))
    return {
        "off_single": max(single) / b["omega_1"],
        "off_exact": max(exact) / b["omega_1"],
    }


def slope(rows: list[dict[str, Any]], key: str) -> float:
    """Of the logarithm of a number over that of the points, over the last decade."""
    (x, y) = ([row[k] for row in rows[-2:]] for k in ("points", key))
    return math.log(y[1] / y[0]) / math.log(x[1] / x[0])


# ---------------------------------------------------------------------------------------------
# Killed and gone on with
# ---------------------------------------------------------------------------------------------


def interrupted(size: Size) -> dict[str, Any]:
    """A sweep killed in the middle, more than once, and finished; beside one left alone."""
    whole = ended(started(Job(size.shared, batch=size.batch, warm=False)))
    batches, kills = -(-math.prod(size.shared) // size.batch), []
    with folder() as place:
        log = place / "begun.txt"
        job = Job(size.shared, 1, size.batch, shards=str(place), begun=str(log), warm=False)
        for share in tqdm(KILLS, desc="kill"):
            process = started(job)
            while process.poll() is None and len(files(place / "0")) < share * batches:
                time.sleep(1e-3)
            process.send_signal(signal.SIGKILL)
            process.communicate()
            if process.returncode == -signal.SIGKILL:
                begun = log.read_text().split()
                there = {file.stem for file in files(place / "0")}
                lost = sum(f"{int(k):08d}" not in there for k in set(begun))
                kills.append({"batches_there": len(there), "begun_but_not_there": lost})
        resumed = ended(started(job))
        begun = log.read_text().split()
        complete = len(files(place / "0"))
    return {
        "points": math.prod(size.shared),
        "batches": batches,
        "batches_at_the_end": complete,
        "kills": kills,
        "computed_again": len(begun) - len(set(begun)),
        "equal_to_the_last_bit": resumed["sha256"] == whole["sha256"],
    }


# ---------------------------------------------------------------------------------------------
# Shared by devices and processes
# ---------------------------------------------------------------------------------------------


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def shared(size: Size) -> list[dict[str, Any]]:
    """One device and two, one process and two, of this processor; each in its turn."""
    ways = [
        {"name": "one device, in memory", "devices": 1, "processes": 1, "shards": False},
        {"name": "two devices, in memory", "devices": 2, "processes": 1, "shards": False},
        {"name": "one process, in shards", "devices": 1, "processes": 1, "shards": True},
        {"name": "two processes, in shards", "devices": 1, "processes": 2, "shards": True},
    ]
    times: list[list[float]] = [[] for _ in ways]
    for _ in tqdm(range(size.turns), desc="share"):
        for kept, way in zip(times, ways, strict=True):
            with folder() as place:
                port = free_port() if way["processes"] > 1 else None
                jobs = [
                    Job(size.shared, shards=str(place) if way["shards"] else None)
                    if port is None
                    else Job(size.shared, shards=str(place), port=port, rank=rank)
                    for rank in range(way["processes"])
                ]
                running = [started(job, way["devices"], shared=True) for job in jobs]
                found = [ended(process) for process in running]
            way |= {"device_count": sum(one["devices"] for one in found)}
            way.setdefault("hashes", []).extend(one["sha256"] for one in found)
            kept.append(max(one["seconds"][0] for one in found))
    peers = {True: times[2], False: times[0]}
    everything = {digest for way in ways for digest in way["hashes"]}
    for kept, way in zip(times, ways, strict=True):
        turns = zip(peers[way["shards"]], kept, strict=True)
        way["points_a_second"] = math.prod(size.shared) / statistics.median(kept)
        way["beside_one"] = statistics.median(peer / own for peer, own in turns)
        way["equal_to_the_last_bit"] = len(everything) == 1
        del way["hashes"]
    return ways


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    rows = ladder(size)
    killed = interrupted(size)
    own = {way: [row for row in rows if row["way"] == way] for way in (IN_MEMORY, SHARDS)}
    headline = [
        {
            "what": f"{way}: slope of log time over log points, last decade",
            "value": slope(found, "seconds"),
            "wanted": [1 - LINEAR, 1 + LINEAR],
        }
        for way, found in own.items()
    ]
    headline += [
        {
            "what": f"{way}: most memory beyond the result [MB]",
            "value": max(row["peak_beyond_base"] - row["result_bytes"] for row in found) / 1e6,
            "wanted": [0, OWN_MEMORY / 1e6],
        }
        for way, found in own.items()
    ]
    headline.append(
        {
            "what": "batches computed again after a kill",
            "value": killed["computed_again"] / max(len(killed["kills"]), 1),
            "wanted": [0, 1],
        }
    )
    return {
        "quick": quick,
        "headline": headline,
        "checked": size.checked,
        "turns": size.turns,
        "machine": this_machine(busy),
        "versions": versions("jax", "jaxlib", "numpy"),
        "rows": rows,
        "interrupted": killed,
        "shared_points": math.prod(size.shared),
        "shared": shared(size),
    }
