"""Thousands of limit cycles at once: this package on one and two devices, against all the cores.

K_n goes over a range of the reference scene. The peer runs each transient from event to event
until it has settled, a process a core. Everything is measured in one process that has two virtual
devices, the methods taking turns.
"""

import concurrent.futures
import functools
import multiprocessing
import os
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from fractaljax._dynamics.scaled import hybrid_system, scaled_start
from fractaljax._dynamics.search import find_attractor

from .page import draw, png, spread, subplots, table, verdict
from .timing import compiled, devices, ended, ratio, seconds, started, taking_turns, versions
from .transients import heyoka_events, last_period, law, outcomes, reference

TITLE = "Many limit cycles"
PACKAGES = ("numpy", "heyoka")
FULL = {"cycles": 4096, "sample": 256, "repeats": 7, "segments": (None, 24)}
FULL |= {"batches": (1, 16, 256)}
QUICK = {"cycles": 64, "sample": 8, "repeats": 1, "segments": (None,), "batches": ()}
RANGE = (2e8, 6e8)  # of K_n [N/m]
DEVICES = 2
FINE, FINEST = 96, 1e-12  # segments of the truth, and the tolerance by which all are used
TOGETHER = 32  # cycles whose loops run together: each loop waits for the slowest of them
EQUAL, WANTED = 1e-9, 15  # the error at which the package meets its peer, and the ratio wanted
SETTLED = (6e-10, 2e-10, 1e-10, 1e-11)  # how well three maxima of the peer agree, in V/omega
PERIODS = 4000  # of the peer, at most
Row = dict[str, Any]
Timed = tuple[Row, Callable]  # a row without times, and its call


def many(segments: int | None = None, rtol: float | None = None) -> Callable:
    """Period, peak to peak of x1 and result, by K_n (n,)."""

    def one(K):
        cycle = fj.limit_cycle(reference(K), segments=segments, rtol=rtol, throw=False)
        return cycle.period, cycle.amplitude[0], cycle.result

    return functools.partial(jax.lax.map, one, batch_size=TOGETHER)


def batch(segments: int | None, K_n: jax.Array, devices: int = 1) -> tuple[Callable, float]:
    """All cycles in one call, split over so many devices, and the seconds to compile it."""
    body = many(segments)
    if devices > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()), ("cycles",))
        spec = jax.sharding.PartitionSpec("cycles")
        body = jax.shard_map(body, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
        K_n = jax.device_put(K_n, jax.sharding.NamedSharding(mesh, spec))
    program, compile_s = compiled(body, K_n)
    return lambda: program(K_n), compile_s


def own_batch(segments: int | None, devices: int, K_n: jax.Array, truth: np.ndarray) -> Timed:
    """The package: what it finds and how well."""
    call, compile_s = batch(segments, K_n, devices)
    period, amplitude, result = call()
    off = np.abs(np.stack([period, amplitude], axis=1) / truth - 1)
    row = {
        "name": f"fj.limit_cycle, {f'{segments} segments' if segments else 'default'}",
        "devices": devices,
        "cycles": len(K_n),
        "compile_s": compile_s,
        "results": outcomes(result),
        "error": spread(off[np.asarray(result == fj.CycleResult.converged)]),
    }
    return row, call


def lanes(K_n: jax.Array) -> Row:
    """How busy lanes would be that all wait for the longest search."""

    def one(K):
        scene = reference(K)
        system = hybrid_system(scene)
        growth = fj.growth_rate(scene) / system.omega
        start, tolerances = scaled_start(system, None), (jnp.asarray(0.25), jnp.asarray(1e-9))
        most = jnp.asarray(5000.0)
        limits = most, *tolerances, 64, fj.CycleSearch()
        return find_attractor(system, start, system.equilibrium(), growth, *limits).returns

    returns = np.asarray(jax.jit(jax.vmap(one))(K_n))
    groups = dict.fromkeys((TOGETHER, len(returns)))
    return {
        "turns": {"mean": float(returns.mean()), "most": float(returns.max())},
        "busy": {str(n): busy(returns, n) for n in groups},
    }


def busy(lengths: np.ndarray, together: int) -> float:
    """Mean over longest run of those that run together, in the mean over the groups."""
    groups = [lengths[i : i + together] for i in range(0, len(lengths), together)]
    return float(np.mean([np.mean(group) / np.max(group) for group in groups]))


def one_transient(K_n: float, settled: float) -> tuple[float, float, int]:
    """Period [s], amplitude [m] and number of periods run, by the peer."""
    numbers = law(K_n)
    found = heyoka_events(numbers, PERIODS, settled)()
    return *last_period(numbers, found), len(found[0]) // 2


def peer(pool: Any, K_n: list[float], truth: np.ndarray) -> Timed:
    """heyoka over all processes of a pool, by the loosest rule that gives the error wanted."""
    each = max(1, len(K_n) // (8 * (os.cpu_count() or 1)))

    def transients(settled):
        run = functools.partial(one_transient, settled=settled)
        return np.array(list(pool.map(run, K_n, chunksize=each)))

    for settled in SETTLED:
        found = transients(settled)
        off = np.abs(found[:, :2] / truth - 1)
        if np.max(off) < EQUAL:
            break
    row = {
        "name": f"heyoka by events, until maxima agree to {settled:g}",
        "devices": DEVICES,
        "cycles": len(K_n),
        "compile_s": None,
        "periods": {"median": float(np.median(found[:, 2])), "most": found[:, 2].max()},
        "error": spread(off),
    }
    return row, lambda: transients(settled)


def headline(rows: list[Row], times: list[list[float]]) -> list[Row]:
    """The ratio to the peer, of the package over all devices at no larger an error."""
    if "heyoka" not in rows[-1]["name"]:
        return []
    able = [i for i, r in enumerate(rows[:-1]) if r["error"]["worst"] < EQUAL]
    able = [i for i in able if rows[i]["devices"] == DEVICES]
    best = min(able, key=lambda i: rows[i]["seconds_a_cycle"])
    what = f"many cycles to {EQUAL:g}: {rows[best]['name']}, against {rows[-1]['name']}"
    return [{"what": what, "ratio": ratio(times[-1], times[best]), "wanted": WANTED}]


def by_count(count: int, repeats: int) -> Row:
    """Time of a cycle with so many in one call, spread over the range."""
    call, compile_s = batch(None, jnp.linspace(*RANGE, count + 2)[1:-1])
    call()
    taken = statistics.median(seconds(call)[0] for _ in range(repeats))
    return {"cycles": count, "compile_s": compile_s, "seconds_a_cycle": taken / count}


def in_this_process(cycles: int, sample: int, repeats: int, segments, batches) -> Row:
    """All numbers, in a process that has the virtual devices; the peer gets a sample."""
    K_n = jnp.linspace(*RANGE, cycles)
    *truth, results = jax.jit(many(FINE, rtol=FINEST))(K_n)
    truth, every = np.stack(truth, axis=1), cycles // sample
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(DEVICES, mp_context=spawn) as pool:
        timed = [own_batch(n, m, K_n, truth) for n in segments for m in (1, DEVICES)]
        if "heyoka" in versions("heyoka"):
            timed.append(peer(pool, np.asarray(K_n)[::every].tolist(), truth[::every]))
        calls = {str(i): call for i, (_, call) in enumerate(timed)}
        taken = taking_turns(calls, repeats).values()
    rows = [row for row, _ in timed]
    times = [[t / row["cycles"] for t in ts] for row, ts in zip(rows, taken, strict=True)]
    for row, own in zip(rows, times, strict=True):
        row["seconds_a_cycle"] = statistics.median(own)
    return {
        "range": RANGE,
        "fine": FINE,
        "repeats": repeats,
        "not_converged_with_fine": cycles - outcomes(results).get("converged", 0),
        "methods": rows,
        "headline": headline(rows, times),
        "batches": [*(by_count(n, repeats) for n in batches), rows[0]],
        "lanes": lanes(K_n),
    }


def measure(**size: Any) -> Row:
    """The same in a process of its own."""
    return ended(started(__name__, devices(DEVICES), **size))


def rate(found: Row) -> float:
    """Cycles a second."""
    return 1 / found["seconds_a_cycle"]


def page(result: Row) -> list[str]:
    rows, (low, high), lanes = result["methods"], result["range"], result["lanes"]
    one, two, peer = rows[0], rows[1], rows[-1]
    ratios = "".join(
        f"; {head['what'].split(': ')[1].split(' against')[0]} is {head['ratio']:.1f} times as fast"
        f" as the best peer on as many cores (wanted >= {head['wanted']}: {verdict(head)})"
        for head in result["headline"]
    )
    about_peer = "Not installed: heyoka."
    if "periods" in peer:
        about_peer = f"""heyoka runs in {peer["devices"]} processes, over a sample of
            {peer["cycles"]} cycles spread over the range; each transient ends when three maxima in
            a row agree: after {peer["periods"]["median"]:.0f} periods (median),
            {peer["periods"]["most"]:.0f} at most. It agrees with the package's {result["fine"]}
            segments to {peer["error"]["worst"]:.0e}, so each confirms the other."""
    busy = (f"{share:.0%} of the time with {n} together" for n, share in lanes["busy"].items())

    def shown(row):
        found = ", ".join(f"{n} {name}" for name, n in row.get("results", {}).items())
        return row | {"rate": rate(row), "found": found or None}

    return [
        f"""Use `jax.lax.map` over `fj.limit_cycle` with a `batch_size` of {TOGETHER}:
        {rate(one):.0f} cycles a second on one device,
        {rate(two):.0f} over {two["devices"]} with `jax.shard_map`, errors up to
        {two["error"]["worst"]:.0e}{ratios}.""",
        table(
            "method | devices or cores | cycles | compile [s] | cycles a second"
            " | error: median, worst | results",
            map(shown, rows),
            "{name} | {devices} | {cycles} | {compile_s:.1f} | {rate:.0f} | {error:.0e} | {found}",
        ),
        f"""K_n {low:.0e} to {high:.0e} N/m; medians of {result["repeats"]} calls, the methods
        taking turns. Errors are relative, of period and amplitude, against the package with
        {result["fine"]} segments, of which {result["not_converged_with_fine"]} of
        {rows[0]["cycles"]} did not converge. The devices are virtual, on the same processor.""",
        about_peer,
        "By the number of cycles in one call, on one device:",
        table(
            "cycles | compile [s] | time a cycle [ms] | cycles a second",
            map(shown, result["batches"]),
            "{cycles} | {compile_s:.1f} | {seconds_a_cycle!m:.3g} | {rate:.0f}",
        ),
        f"""A loop over a batch ends when its slowest member does. The search for a cycle takes
        {lanes["turns"]["mean"]:.1f} returns of the Poincare map in the mean and
        {lanes["turns"]["most"]:.0f} at most, so that lanes would be busy for {" and ".join(busy)}
        (mean over longest run within a group, in the order of K_n): a measure of the cycles, not of
        a device. An accelerator takes larger batches.""",
    ]


def picture(result: Row) -> bytes:
    """Cycles a second by the size of a batch, and of the methods at full size."""
    figure, ax = subplots(figsize=(8.4, 5.4))
    found, rows = result["batches"], result["methods"]
    counts, rates = [row["cycles"] for row in found], [rate(row) for row in found]
    lines: list[tuple] = [(counts, rates, "C0o-", "fj.limit_cycle, one device")]
    for row, style in zip(rows[1:], ("C9s", "C1^", "C2D", "C3v"), strict=False):
        unit = "cores" if "periods" in row else "devices" if row["devices"] > 1 else "device"
        label = f"{row['name']}, {row['devices']} {unit}"
        lines.append((rows[0]["cycles"], rate(row), style, label))
    draw(ax, lines, "cycles in one call [-]", "cycles a second")
    return png(figure)
