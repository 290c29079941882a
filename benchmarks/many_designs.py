"""Many designs at once: one program for a family of brakes, against one design after another.

Load and static friction of the reference brake are drawn at random; each brake gets the surface
nearest to its own that is quiet. Beside `fj.design_many` stand `fj.design`, brake by brake, and
what a user of SciPy would write: SLSQP from several places on compiled rows and Jacobians of the
package. The optima come from a dense grid, polished on the plain NumPy loop of `whole_design`.
"""

import functools
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import fractaljax as fj

from .page import Result, draw, png, spread, subplots, table, verdict
from .timing import compiled, devices, ended, ratio, seconds, started, taking_turns
from .whole_design import (
    MEETS,
    SURFACE,
    TARGET,
    DesignTask,
    by_package,
    least_stiffness,
    optimum,
    slsqp,
)

TITLE = "Many designs"
PACKAGES = ("numpy", "scipy")
RANGES = {"P": (1300.0, 2600.0), "mu_s": (0.36, 0.55)}  # of load [N] and static friction
DEVICES = 2
PLACES = 4  # from which SLSQP starts
CLOSE = 1e-6  # largest error, in scaled variables, of a design that counts as the optimum
FULL = {"designs": 4096, "sample": 32, "dense": 10_000, "repeats": 5, "batches": (1, 16, 256)}
QUICK = {"designs": 16, "sample": 2, "dense": 2_500, "repeats": 1, "batches": (1,)}
WANTED = 10.0  # ms a design


def family(count: int) -> dict[str, np.ndarray]:
    """Load and friction of so many brakes."""
    drawn = np.random.default_rng(0).random((count, len(RANGES)))
    ends = np.array([*RANGES.values()])
    values = ends[:, 0] + drawn * (ends[:, 1] - ends[:, 0])
    return dict(zip(RANGES, values.T, strict=True))


def task_of(quantities: dict[str, float]) -> DesignTask:
    """The design of one brake, as `whole_design` states it."""
    conditions = {name: (value,) for name, value in quantities.items()}
    return DesignTask("one", "one", SURFACE, conditions, nearest=True)


REQUIRED: dict[str, Any] = {"target": TARGET, "progress": False}


def by_many(quantities: dict[str, np.ndarray], count: int) -> Callable[[], fj.DesignMany]:
    """The designs of all brakes on so many devices."""
    xs = fj.brake_scene().replace(**{name: jnp.asarray(q) for name, q in quantities.items()})
    required = REQUIRED | {"K_n_min": least_stiffness(), "devices": jax.devices()[:count]}
    return lambda: fj.design_many(xs, SURFACE, **required)


def by_design(quantities: dict[str, np.ndarray]) -> np.ndarray:
    """D and G (n, 2) by `fj.design`, one brake after another."""
    found = []
    for row in zip(*quantities.values(), strict=True):
        x = fj.brake_scene().replace(**dict(zip(quantities, map(float, row), strict=True)))
        best = fj.design(x, SURFACE, K_n_min=least_stiffness(), **REQUIRED).scene
        found.append([float(best.contact.surface.D), float(best.contact.surface.G)])
    return np.array(found)


def user_of_scipy() -> tuple[Callable, float]:
    """D and G (n, 2) by SLSQP on the package's rows, and the seconds to compile these."""
    plain = DesignTask("one", "one", SURFACE, nearest=True)

    def evaluate(u, quantities):
        task = DesignTask("one", "one", SURFACE, {n: q[None] for n, q in quantities.items()}, True)
        return by_package(task)(u)

    given = {name: jnp.asarray(1.0) for name in RANGES}
    row, row_s = compiled(evaluate, jnp.zeros(2), given)
    slopes, slopes_s = compiled(jax.jacfwd(evaluate), jnp.zeros(2), given)
    starts = plain.starts(PLACES)

    def solve(quantities: dict[str, np.ndarray]) -> np.ndarray:
        found = []
        for values in zip(*quantities.values(), strict=True):
            at = {n: jnp.asarray(v) for n, v in zip(quantities, values, strict=True)}
            own, jacobian = (lambda u, f=f, at=at: np.asarray(f(u, at)) for f in (row, slopes))
            ends = [slsqp(plain, own, jacobian, start).answer for start in starts]
            rows = np.array([own(u) for u in ends])
            value = np.where(rows[:, 1:].max(axis=1) <= MEETS, rows[:, 0], np.inf)
            best = plain.quantities(ends[int(value.argmin())])
            found.append([best["D"], best["G"]])
        return np.array(found)

    return solve, row_s + slopes_s


def errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The largest errors (n,) of scaled D and ln G of designs (n, 2)."""
    (low, high), (least, most) = SURFACE["D"], SURFACE["G"]
    by_D = np.abs(found[:, 0] - truth[:, 0]) / (high - low)
    return np.maximum(by_D, np.abs(np.log(found[:, 1] / truth[:, 1])) / np.log(most / least))


def truths(quantities: dict[str, np.ndarray], dense: int) -> np.ndarray:
    """The optima (n, 2), each from a dense grid and polished on the loop."""
    found = []
    for values in tqdm([*zip(*quantities.values(), strict=True)], desc="optima"):
        task = task_of(dict(zip(quantities, map(float, values), strict=True)))
        evaluate = jax.jit(jax.vmap(by_package(task)))
        best = optimum(task, lambda us, run=evaluate: np.asarray(run(jnp.asarray(us))), dense, 2)
        found.append([best["quantities"]["D"], best["quantities"]["G"]])
    return np.array(found)


def in_this_process(designs: int, sample: int, dense: int, repeats: int, batches) -> Result:
    """All numbers, in a process that has the virtual devices; the peers get a sample."""
    whole, every = family(designs), designs // sample
    few = {name: values[::every] for name, values in whole.items()}
    truth = truths(few, dense)
    rows, calls = [], {}
    for count in (1, DEVICES):
        call = by_many(whole, count)
        jax.clear_caches()
        first, found = seconds(call)
        later = seconds(call)[0]
        surfaces = np.stack([found.D, found.G], axis=1)
        name = f"fj.design_many, {count} device{'s' * (count > 1)}"
        about = {"name": name, "devices": count, "designs": designs, "compile_s": first - later}
        about |= {"met": int(found.met.sum()), "error": spread(errors(surfaces[::every], truth))}
        about["right"] = int((errors(surfaces[::every], truth) < CLOSE).sum())
        rows.append(about)
        calls[name] = call
    by_scipy, scipy_s = user_of_scipy()
    peers = [("fj.design", by_design, None), (f"SLSQP from {PLACES} places", by_scipy, scipy_s)]
    for name, solve, compile_s in peers:
        first, found = seconds(solve, few)
        later = seconds(solve, few)[0] if compile_s is None else first
        error = errors(found, truth)
        about = {"name": name, "devices": 1, "designs": sample, "met": sample}
        about |= {"compile_s": first - later if compile_s is None else compile_s}
        about |= {"error": spread(error), "right": int((error < CLOSE).sum())}
        rows.append(about)
        calls[name] = functools.partial(solve, few)
    taken = taking_turns(calls, repeats)
    times = [[t / row["designs"] for t in taken[row["name"]]] for row in rows]
    for row, own in zip(rows, times, strict=True):
        row["seconds_a_design"] = statistics.median(own)
    by_count = []
    for count in batches:
        call = by_many({name: values[:count] for name, values in whole.items()}, 1)
        call()
        some = statistics.median(seconds(call)[0] for _ in range(repeats))
        by_count.append({"designs": count, "seconds_a_design": some / count})
    each = f"{rows[0]['name']} [ms a design]"
    peer = f"many designs: {rows[1]['name']}, against {rows[-1]['name']}"
    return {
        "ranges": RANGES,
        "sample": sample,
        "repeats": repeats,
        "methods": rows,
        "batches": [*by_count, rows[0]],
        "headline": [
            {"what": each, "value": 1e3 * rows[0]["seconds_a_design"], "wanted": [0, WANTED]},
            {"what": peer, "ratio": ratio(times[-1], times[1]), "wanted": 1},
        ],
    }


def measure(**size: Any) -> Result:
    """The same in a process of its own."""
    return ended(started(__name__, devices(DEVICES), **size))


def page(result: Result) -> list[str]:
    rows, (each, against) = result["methods"], result["headline"]
    bounds = " and ".join(f"{n} {low:g} to {high:g}" for n, (low, high) in result["ranges"].items())
    return [
        f"""Use `fj.design_many`: {each["value"]:.2g} ms a design on one device (wanted <=
        {each["wanted"][1]:g}: {verdict(each)}), {against["ratio"]:.0f} times as many designs a
        second on {rows[1]["devices"]} devices as SLSQP on one core. Of a sample of
        {result["sample"]}, {rows[0]["right"]} are within {CLOSE:g} of the optimum,
        {rows[-1]["right"]} of SLSQP's.""",
        table(
            "method | devices | designs | first call more [s] | time a design [ms]"
            " | meet all requirements | optimum found | error: median, worst",
            rows,
            "{name} | {devices} | {designs} | {compile_s:.1f} | {seconds_a_design!m:.3g} | {met}"
            f" | {{right}} of {result['sample']} | {{error:.0e}}",
        ),
        f"""The reference brake with {bounds}, drawn at random. Designed are D and G, the nearest
        that are quiet, with K_n no less than that of the reference brake. Errors are of scaled
        variables, against optima from a dense grid that are polished on a plain NumPy loop, of
        which no line is the package's. Medians of {result["repeats"]} calls, the methods taking
        turns; the devices are virtual, on the same processor.""",
        "By the number of designs in one call, on one device:",
        table(
            "designs | time a design [ms]",
            result["batches"],
            "{designs} | {seconds_a_design!m:.3g}",
        ),
    ]


def picture(result: Result) -> bytes:
    """Time a design by the size of a batch, and of the methods."""
    figure, ax = subplots(figsize=(8.4, 5.4))
    found, rows = result["batches"], result["methods"]
    counts = [row["designs"] for row in found]
    times = [1e3 * row["seconds_a_design"] for row in found]
    lines: list[tuple] = [(counts, times, "C0o-", rows[0]["name"])]
    for row, style in zip(rows[1:], ("C9s", "C1^", "C3v"), strict=True):
        lines.append((row["designs"], 1e3 * row["seconds_a_design"], style, row["name"]))
    draw(ax, lines, "designs in one call [-]", "time a design [ms]")
    return png(figure)
