"""Scale: `sweep` over more and more points, in memory and in a store, interrupted, and shared.

Every sweep is one of the growth rate over D, G, mu_s and V in a Python process of its own, so that
its peak of memory is its own. Beside it all points in one call of the vmapped program, which is
what a user has without `sweep`.
"""

import contextlib
import hashlib
import math
import os
import resource
import signal
import socket
import statistics
import subprocess
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
from fractaljax._sweep.batches import Batches
from fractaljax._sweep.blocks import blocks
from fractaljax._sweep.store import Store

from .page import columns, draw, in_words, png, subplots, table
from .timing import devices, ended, ratio, started

TITLE = "Scale: a sweep over more and more points"
PACKAGES = ("jaxlib", "numpy")
# Lengths of the axes, from few points to many; repeats up to 1e7 points; most points in one call;
# points of every result beside a single call and 40 digits; lengths of the axes of what is
# interrupted or shared; a batch of what is interrupted; turns of what is shared.
SIDES = ((10,) * 4, (100, 10, 10, 10), (100, 100, 10, 10), (100, 100, 100, 10), (100,) * 4)
FULL = {"sides": SIDES, "repeats": 3, "most_at_once": 10_000_000, "checked": 16}
FULL |= {"lengths": (100, 100, 20, 20), "batch": 8192, "turns": 3}
QUICK = {"sides": SIDES[:2], "repeats": 1, "most_at_once": 10_000, "checked": 4}
QUICK |= {"lengths": (100, 100, 10, 5), "batch": 1024, "turns": 1}
LINEAR, OWN_MEMORY = 0.1, 100  # how far from 1 a slope may be; MB beyond the result
AHEAD = 2  # batches: one is computed while the one before it is written
KILLS = (0.25, 0.5, 0.75)  # shares of the batches that are there when a sweep is killed
IN_MEMORY, STORED, AT_ONCE = "sweep, in memory", "sweep, in a store", "one call of jax.vmap"
RANGES = {"D": (2.3, 2.6), "G": (1e-11, 1e-9), "mu_s": (0.3, 0.5), "V": (0.05, 0.3)}
WAYS = (  # name, devices of a process, processes
    ("one device, in memory", 1, 1),
    ("two devices, in memory", 2, 1),
    ("one process, in a store", 1, 1),
    ("two processes, in a store", 1, 2),
)
Result = dict[str, Any]


# One sweep, in its process


def axes(lengths) -> dict[str, Any]:
    """The values on every axis."""
    return {
        name: (np.geomspace if name == "G" else np.linspace)(*ends, length)
        for (name, ends), length in zip(RANGES.items(), lengths, strict=True)
    }


def at(lengths, point: int) -> dict[str, float]:
    """The quantities at a point of the grid."""
    places = zip(axes(lengths).items(), np.unravel_index(point, lengths), strict=True)
    return {name: float(axis[place]) for (name, axis), place in places}


def swept(lengths, batch: int | None, folder: Path | None) -> np.ndarray:
    """Growth rates over the grid."""
    given = axes(lengths)
    return np.asarray(fj.sweep(fj.growth_rate, fj.brake_scene(), batch, False, out=folder, **given))


class _Enough(Exception):
    """The first batch is there."""


def first_batch(lengths, batch: int | None) -> None:
    """Trace, compile and run one batch of the sweep, with axes of the same lengths."""
    stop = mock.patch.object(Store, "write", side_effect=_Enough)
    with tempfile.TemporaryDirectory() as folder, stop, contextlib.suppress(_Enough):
        swept(lengths, batch, Path(folder))


def whole_grid(lengths) -> Callable[[], np.ndarray]:
    """A call that makes the grid and gives it to a program compiled for all points at once."""
    scene = fj.brake_scene()

    def growth(*values):
        return fj.growth_rate(scene.replace(**dict(zip(RANGES, values, strict=True))))

    flat = [jax.ShapeDtypeStruct((math.prod(lengths),), float)] * len(RANGES)
    program = jax.jit(jax.vmap(growth)).lower(*flat).compile()

    def run():
        grid = np.meshgrid(*axes(lengths).values(), indexing="ij")
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
    """Add the number of every batch of a sweep to a file, before it is computed."""
    log, begin = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND), Batches.begin

    def logged(self, k):
        os.write(log, f"{k}\n".encode())
        return begin(self, k)

    Batches.begin = logged


def in_this_process(
    lengths,
    repeats: int = 1,
    batch: int | None = None,  # points at a time, by default those of `sweep`
    at_once: bool = False,  # all points in one call of a vmapped program instead
    stores: str | None = None,  # folder in which every repeat has its store
    begun: str | None = None,  # file to which the number of every batch that is begun is added
    warm: bool = True,  # whether the program is compiled before the clock starts
    picked=(),  # points whose values are returned
    port: int | None = None,  # of the first of two processes
    rank: int = 0,
) -> Result:
    """Run it: seconds of every repeat, bytes beyond those held before, and picked values."""
    if port is not None:
        jax.distributed.initialize(f"127.0.0.1:{port}", 2, rank)
    if begun is not None:
        log_begun(begun)
    start = time.perf_counter()
    call = whole_grid(lengths) if at_once else None
    if warm and not at_once:
        first_batch(lengths, batch)
    prepared = time.perf_counter() - start
    forget_peak()
    base = peak_memory()
    times, result = [], np.empty(0)
    for repeat in range(repeats):
        del result
        folder = None if stores is None else Path(stores) / str(repeat)
        if port is not None:
            from jax.experimental.multihost_utils import sync_global_devices

            sync_global_devices(f"repeat {repeat} begins")
        start = time.perf_counter()
        result = swept(lengths, batch, folder) if call is None else call()
        times.append(time.perf_counter() - start)
    return {
        "peak_beyond_base": peak_memory() - base,
        "base_bytes": base,
        "result_bytes": result.nbytes,
        "device": jax.devices()[0].device_kind,
        "devices": jax.local_device_count(),
        "compile_s": prepared,
        "times": times,
        "values": result.ravel()[list(picked)].tolist(),
        "sha256": hashlib.sha256(result.tobytes()).hexdigest(),
    }


# Sweeps in processes of their own


def begin(environment: dict[str, str] | None = None, **job: Any) -> subprocess.Popen:
    """The process of a sweep."""
    return started(__name__, environment or {}, **job)


def files(folder: str) -> list[Path]:
    """The marks of the batches that the first repeat of a sweep has kept in its store."""
    return list((Path(folder) / "0" / "computed").glob("c.*[0-9]"))


def measured(way: str, lengths, repeats: int, checked: int) -> Result:
    """Time, memory, files and errors of one way to one number of points."""
    points = math.prod(lengths)
    repeats = repeats if points <= 10_000_000 else 1
    picked = np.random.default_rng(0).integers(points, size=checked).tolist()
    with tempfile.TemporaryDirectory() as place:
        job = {"at_once": way == AT_ONCE, "stores": place if way == STORED else None}
        found = ended(begin(lengths=lengths, repeats=repeats, picked=picked, **job))
        batches = len(files(place))
        kept = [file.stat().st_size for file in Path(place).glob("0/**/*") if file.is_file()]
    row = {"way": way, "points": points, "repeats": repeats, "batches": batches}
    row |= {"seconds": statistics.median(found["times"]), "disk_bytes": sum(kept) or None}
    shown = "device", "compile_s", "base_bytes", "peak_beyond_base", "result_bytes"
    return row | {key: found[key] for key in shown} | errors(lengths, picked, found["values"])


def errors(lengths, picked, values) -> dict[str, float]:
    """Worst errors of values of a sweep, in omega_1: beside single calls, and 40 digits."""
    from mpmath import mpf

    from .loops import brake
    from .truths import growth_of_surface, mp

    single, exact, b = [], [], brake()
    for point, value in zip(picked, values, strict=True):
        there = at(lengths, point)
        single.append(abs(value - float(fj.growth_rate(fj.brake_scene().replace(**there)))))
        with mp.workdps(40):
            truth = growth_of_surface(b | there, mpf(there["D"]), mp.log(mpf(there["G"])))
        exact.append(abs(value - float(truth)))
    return {"off_single": max(single) / b["omega_1"], "off_exact": max(exact) / b["omega_1"]}


def interrupted(lengths, batch: int) -> Result:
    """A sweep killed in the middle, more than once, and finished; beside one left alone."""
    job: Result = {"lengths": lengths, "batch": batch, "warm": False}
    whole = ended(begin(**job))
    batches, kills = blocks(lengths, batch).number, []
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "begun.txt"
        job |= {"stores": place, "begun": str(log)}
        for share in KILLS:
            process = begin(**job)
            while process.poll() is None and len(files(place)) < share * batches:
                time.sleep(1e-3)
            process.send_signal(signal.SIGKILL)
            process.communicate()
            if process.returncode == -signal.SIGKILL:
                there, begun = len(files(place)), len(set(log.read_text().split()))
                kills.append({"batches_there": there, "begun_but_not_there": begun - there})
        resumed = ended(begin(**job))
        begun, complete = log.read_text().split(), len(files(place))
    return {
        "points": math.prod(lengths),
        "batches": batches,
        "batches_at_the_end": complete,
        "kills": kills,
        "computed_again": len(begun) - len(set(begun)),
        "equal_to_the_last_bit": resumed["sha256"] == whole["sha256"],
    }


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def shared(lengths, turns: int) -> list[Result]:
    """One device and two, one process and two, of this processor; each in its turn."""
    times: dict[str, list[float]] = {name: [] for name, _, _ in WAYS}
    counts, hashes = {}, set()
    for _ in range(turns):
        for name, count, processes in WAYS:
            with tempfile.TemporaryDirectory() as place:
                job = {"lengths": lengths, "stores": place if "store" in name else None}
                job["port"] = free_port() if processes > 1 else None
                jobs = [begin(devices(count), **job, rank=rank) for rank in range(processes)]
                found = [ended(process) for process in jobs]
            counts[name] = sum(one["devices"] for one in found)
            hashes |= {one["sha256"] for one in found}
            times[name].append(max(one["times"][0] for one in found))
    rows = []
    for name, own in times.items():
        alone = times[WAYS[2 if "store" in name else 0][0]]
        row = {"name": name, "device_count": counts[name], "beside_one": ratio(alone, own)}
        row["points_a_second"] = math.prod(lengths) / statistics.median(own)
        rows.append(row | {"equal_to_the_last_bit": len(hashes) == 1})
    return rows


def slope(rows: list[Result], key: str) -> float:
    """Of the logarithm of a number over that of the points, over the last decade."""
    (x, y) = ([row[k] for row in rows[-2:]] for k in ("points", key))
    return math.log(y[1] / y[0]) / math.log(x[1] / x[0])


def measure(sides, repeats, most_at_once, checked, lengths, batch: int, turns: int) -> Result:
    """The sweeps of more and more points, the one that is killed and the one that is shared."""
    from tqdm import tqdm

    steps = [(way, side) for way in (IN_MEMORY, STORED, AT_ONCE) for side in sides]
    steps = [step for step in steps if step[0] != AT_ONCE or math.prod(step[1]) <= most_at_once]
    rows = [measured(*step, repeats, checked) for step in tqdm(steps, desc="more points")]
    killed, bounds = interrupted(lengths, batch), []
    own = {way: [row for row in rows if row["way"] == way] for way in (IN_MEMORY, STORED)}
    for way, found in own.items():
        what = f"{way}: slope of log time over log points, last decade"
        bounds.append((what, slope(found, "seconds"), [1 - LINEAR, 1 + LINEAR]))
    for way, found in own.items():
        most = max(row["peak_beyond_base"] - row["result_bytes"] for row in found) / 1e6
        bounds.append((f"{way}: most memory beyond the result [MB]", most, [0, OWN_MEMORY]))
    again = killed["computed_again"] / max(len(killed["kills"]), 1)
    bounds.append(("batches computed again after a kill", again, [0, AHEAD]))
    return {
        "headline": [dict(zip(("what", "value", "wanted"), b, strict=True)) for b in bounds],
        "checked": checked,
        "turns": turns,
        "rows": rows,
        "interrupted": killed,
        "shared_points": math.prod(lengths),
        "shared": shared(lengths, turns),
    }


# The page


def short(count: float) -> str:
    """A number of points as a page shows it, 1e8."""
    mantissa, exponent = f"{count:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def page(result: Result) -> list[str]:
    rows, killed = result["rows"], result["interrupted"]
    by_way = ([r for r in rows if r["way"] == way] for way in (IN_MEMORY, STORED, AT_ONCE))
    own, kept, (*_, peer) = by_way
    same, last = next(r for r in own if r["points"] == peer["points"]), own[-1]
    there = ", ".join(str(kill["batches_there"]) for kill in killed["kills"])
    lost = ", ".join(str(kill["begun_but_not_there"]) for kill in killed["kills"])
    how = "the same to the last bit as" if killed["equal_to_the_last_bit"] else "NOT equal to"
    equal = all(way["equal_to_the_last_bit"] for way in result["shared"])

    def shown(row):
        more = {"count": short(row["points"]), "rate": row["points"] / row["seconds"]}
        return row | more | {"batches": row["batches"] or None}

    return [
        f"""Use `sweep`: {short(last["points"])} growth rates in {last["seconds"]:.3g} s and
        {last["peak_beyond_base"] / 1e6:.0f} MB, of which the result is
        {last["result_bytes"] / 1e6:.0f} MB, while one call of a vmapped program takes
        {peer["peak_beyond_base"] / same["peak_beyond_base"]:.1f} times the memory and
        {peer["seconds"] / same["seconds"]:.2f} times the time for {short(same["points"])} points;
        name a folder (`out=`) where a sweep may be interrupted, which takes
        {kept[-1]["seconds"] / last["seconds"]:.2f} times the time.""",
        table("what | found | wanted | ", map(in_words, result["headline"])),
        "## More points",
        table(
            "way | points | time [s] | points a second | peak memory [MB] | of it the result [MB]"
            " | batches kept | on disk [MB] | before the first batch is there [s]"
            " | error beside single calls | error to 40 digits",
            map(shown, rows),
            "{way} | {count} | {seconds:.3g} | {rate:.3g} | {peak_beyond_base!M:.3g}"
            " | {result_bytes!M:.3g} | {batches} | {disk_bytes!M:.3g} | {compile_s:.1f}"
            " | {off_single:.0e} | {off_exact:.0e}",
        ),
        f"""Growth rates of the reference brake over D, G, mu_s and V in double precision, each row
        in a Python process of its own on {", ".join(sorted({row["device"] for row in rows}))}. Time
        is the median of {rows[0]["repeats"]} runs{
            "" if result["quick"] else ", one run beyond 1e7 points"
        }, without compiling, which is in the column of the first
        batch. Peak memory is beyond what the process held before the clock started, which is
        {max(row["base_bytes"] for row in rows) / 1e6:.0f} MB at most: Python, JAX and the program.
        Errors are the worst of {result["checked"]} points drawn at random, in omega_1. One call of
        jax.vmap holds the grid and all intermediate values at once; more points than shown were not
        tried.""",
        "## Interrupted",
        f"""A sweep of {short(killed["points"])} points in {killed["batches"]} batches, killed by
        SIGKILL when {there} of them were there and started again each time, computed
        {killed["computed_again"]} batches twice ({lost} were begun and lost at each kill); its
        result is {how} that of a sweep left alone.""",
        "## Shared",
        table(
            "way | devices in all | points a second | beside one",
            result["shared"],
            "{name} | {device_count} | {points_a_second:.3g} | {beside_one:.2f}",
        ),
        f"""{short(result["shared_points"])} points; devices are virtual ones of this processor, all
        on the same cores, and processes talk over the loopback address: this shows the cost of
        sharing, not the gain from more machines. Two processes each read back the whole. Ratios are
        medians of those within each of {result["turns"]} turns. The results of all ways and
        processes are {"the same to the last bit" if equal else "NOT the same"}.""",
    ]


STYLES = {IN_MEMORY: "C0o-", STORED: "C1s--", AT_ONCE: "C2^:"}


def picture(result: Result) -> bytes:
    """Time at the left, peak memory at the right, over the points."""
    figure, (left, right) = subplots(1, 2, figsize=(11, 4.8))
    times, memory = [], []
    for way, style in STYLES.items():
        rows = [row for row in result["rows"] if row["way"] == way]
        points, taken, peak = columns(rows, "points", "seconds", "peak_beyond_base")
        times.append((points, taken, style, way))
        memory.append((points, np.divide(peak, 1e6), style, way))
    rows = [row for row in result["rows"] if row["way"] == IN_MEMORY]
    points, taken, needed = columns(rows, "points", "seconds", "result_bytes")
    line = [taken[-1] * n / points[-1] for n in points]
    times.append((points, line, "k-", "in proportion to the points"))
    memory.append((points, np.divide(needed, 1e6), "k-", "the result itself"))
    draw(left, times, "points [-]", "time [s]")
    draw(right, memory, "points [-]", "peak memory beyond the base [MB]")
    return png(figure)
