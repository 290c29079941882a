"""A whole design: by gradients, by Nelder and Mead's simplex, by grids; how near by when.

Each method solves the same task from the same starts, on the package and on the plain NumPy loop.
Whatever designs it looked at are judged afterwards by one program, off the clock; the best of them
so far that meets every requirement is what a user could have stopped with. The optimum itself
comes from a dense grid, polished on the loop, which shares no line with the package.
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from mpmath import mpf
from tqdm import tqdm

from ..growth.exact import exact_growth, mp
from ..growth.loops import brake
from ..page import versions
from ..timing import others_running, seconds, this_machine
from .methods import MEETS, Method, Rows, Trace, methods, scaled_row, slsqp
from .tasks import GROWTH_SCALE, TARGET, TASKS, DesignTask, by_loop
from .whole_design_page import FLOOR, picture as picture, text as text

NEAR, EXACT = 1e-2, 1e-6  # relative gaps to the optimum that are timed
SHOWN = 1.05  # a curve keeps a point where the gap falls by this factor


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured: starts, and sides of the grids of every task."""

    tasks: tuple[str, ...]
    starts: int
    loop_runs: int  # starts of the methods on the loop
    dense: int  # designs of the grid below the optimum
    polished: int  # of them
    sides: dict[str, dict[str, tuple[int, ...]]]


FULL = Size(
    tuple(task.name for task in TASKS),
    8,
    4,
    90_000,
    4,
    {
        "one condition": {"package": (64, 256, 1024), "zoom": (32,), "loop": (16, 48)},
        "envelope": {"package": (64, 256), "zoom": (32,), "loop": (8, 20)},
        "five variables": {"package": (6, 12), "zoom": (6,), "loop": (3, 5)},
    },
)
QUICK = Size(
    ("one condition", "five variables"),
    2,
    2,
    10_000,
    2,
    {
        "one condition": {"package": (32,), "zoom": (16,), "loop": (8,)},
        "five variables": {"package": (5,), "zoom": (5,), "loop": (3,)},
    },
)


# ---------------------------------------------------------------------------------------------
# The optimum
# ---------------------------------------------------------------------------------------------


def optimum(task: DesignTask, rows: Rows, size: Size) -> dict[str, Any]:
    """The best of a dense grid, polished on the loop; and its growth rate beside 40 digits."""
    variables, loop = len(task.bounds), by_loop(task)
    side = round(size.dense ** (1 / variables))
    axes = np.meshgrid(*[np.linspace(0, 1, side)] * variables, indexing="ij")
    us = np.stack([axis.ravel() for axis in axes], axis=1)
    found = rows(us)
    values = np.where(found[:, 1:].max(axis=1) <= 0, found[:, 0], np.inf)
    merit = scaled_row(task, found)
    merit = merit[:, 0] + 10 * np.maximum(merit[:, 1:], 0).sum(axis=1)  # infeasible ones last
    order = np.argsort(np.where(np.isfinite(values), merit - 1e6, merit))
    spread = order[: size.polished**3 : size.polished**2]
    ends = [slsqp(task, loop, None, us[i]).answer for i in spread]
    polished = [(u, loop(u)) for u in ends if u is not None]
    polished = [(u, row) for u, row in polished if row[1:].max() <= MEETS]
    best, row = min(polished, key=lambda pair: pair[1][0])
    return {
        "u": best.tolist(),
        "value": float(row[0]),
        "quantities": task.quantities(best),
        "polished": len(ends),
        "agree": sum(
            bool(other[0] - row[0] <= 1e-8 * scale(task, row[0])) for _, other in polished
        ),
        "dense": len(us),
        "dense_gap": float(values.min() - row[0]),
        "off_exact": off_exact(task, best, row),
    }


def scale(task: DesignTask, best: float) -> float:
    """What gaps are relative to: the distance itself, or the decay rate xi_1 omega_1."""
    return best if task.nearest else GROWTH_SCALE


def off_exact(task: DesignTask, u: np.ndarray, row: np.ndarray) -> float:
    """The worst growth rate of the loop beside 40 digits [1/s]."""
    b = brake() | task.quantities(u)
    conditions = zip(*task.conditions.values(), strict=True) if task.conditions else [()]
    with mp.workdps(40):
        exact = max(
            float(exact_growth(b | at, mpf(b["D"]), mp.log(mpf(b["G"]))))
            for at in (dict(zip(task.conditions, values, strict=True)) for values in conditions)
        )
    return abs(TARGET + GROWTH_SCALE * math.sinh(row[3]) - exact)


# ---------------------------------------------------------------------------------------------
# The methods
# ---------------------------------------------------------------------------------------------


def curve(trace: Trace, rows: Rows, truth: dict[str, Any], unit: float) -> np.ndarray:
    """When (n,), and the relative gap (n,) of the best design so far that meets everything."""
    found = rows(np.concatenate([us for _, us in trace.seen]))
    gaps = np.where(
        found[:, 1:].max(axis=1) <= MEETS, (found[:, 0] - truth["value"]) / unit, np.inf
    )
    ends = np.cumsum([len(us) for _, us in trace.seen])
    least = np.minimum.accumulate(np.maximum(np.where(np.isnan(gaps), np.inf, gaps), FLOOR))
    return np.array([[t for t, _ in trace.seen], least[ends - 1]])


def thinned(points: np.ndarray) -> list[list[float]]:
    """The points of a curve where the gap falls, and the last."""
    kept, last = [], np.inf
    for t, gap in points.T:
        if np.isfinite(gap) and gap * SHOWN < last:
            kept.append([float(f"{t:.4g}"), float(f"{gap:.4g}")])
            last = gap
    end = points[:, -1]
    if np.isfinite(end[1]):
        kept.append([float(f"{x:.4g}") for x in end])
    return kept


def reached(curves: list[np.ndarray], gap: float) -> dict[str, Any]:
    """How many starts come this near, and the median time over all of them, if half do."""
    times = [
        float(c[0, np.argmax(c[1] <= gap)]) if (c[1] <= gap).any() else math.inf for c in curves
    ]
    median = float(np.median(times))
    count = sum(math.isfinite(t) for t in times)
    return {"starts": count, "seconds": median if math.isfinite(median) else None}


def solved(task: DesignTask, method: Method, rows: Rows, truth, starts) -> dict[str, Any]:
    """Every run of a method: times, evaluations, gaps, violations."""
    compile_s = method.compile_s
    if compile_s is None:
        jax.clear_caches()
        compile_s = seconds(method.solve, starts[0])[0]
    else:
        method.solve(starts[0])  # what is imported and looked up the first time
    traces = [method.solve(start) for start in starts[: method.runs]]
    walls = [trace.seen[-1][0] for trace in traces]
    if method.compile_s is None:
        compile_s -= walls[0]
    unit = scale(task, truth["value"])
    curves = [curve(trace, rows, truth, unit) for trace in traces]
    answers = rows(np.array([trace.answer for trace in traces]))
    final = [float(c[1, -1]) for c in curves]
    return {
        "task": task.name,
        "name": method.name,
        "family": method.family,
        "compile_s": compile_s,
        "starts": len(traces),
        "seconds": float(np.median(walls)),
        "evaluations": float(np.median([trace.evaluations for trace in traces])),
        "gap": {
            "median": finite(float(np.median(final))),
            "worst": finite(max(final)),
        },
        "violation": float(np.maximum(answers[:, 1:].max(axis=1), 0).max()),
        "near": reached(curves, NEAR),
        "exact": reached(curves, EXACT),
        "curves": [thinned(c) for c in curves],
    }


def finite(value: float) -> float | None:
    """A number, or None where there is none."""
    return value if math.isfinite(value) else None


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    tasks, runs = [], []
    for task in (task for task in TASKS if task.name in size.tasks):
        ways, rows = methods(task, size.sides[task.name], size.loop_runs)
        truth = optimum(task, rows, size)
        starts = task.starts(size.starts)
        tasks.append(
            {
                "name": task.name,
                "title": task.title,
                "unit": task.unit,
                "nearest": task.nearest,
                "conditions": task.condition_count,
                "bounds": {name: list(ends) for name, ends in task.bounds.items()},
                "optimum": truth,
            }
        )
        for way in tqdm(ways, desc=task.name):
            runs.append(solved(task, way, rows, truth, starts))
    return {
        "quick": quick,
        "starts": size.starts,
        "near": NEAR,
        "exact": EXACT,
        "machine": this_machine(busy),
        "versions": versions("jax", "numpy", "scipy", "mpmath"),
        "tasks": tasks,
        "runs": runs,
    }
