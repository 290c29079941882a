"""Growth rate and its gradient to (D, G) over a grid: this package against a SciPy loop.

The package, compiled and vmapped, beside the loops that a user would write with brentq and
numpy.linalg.eigvals, their gradient by central differences: one as first written with NumPy, one
tuned by hand. Runs alternate, so that a busy machine slows all alike, and the errors of the same
runs are taken to 40 digits.
"""

import dataclasses
import math
import platform
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import mpmath
import numpy as np
import scipy
from tqdm import tqdm

import fractaljax as fj

from .exact import exact_rows
from .loops import STEP, brake, loop_gradient, loop_value, plain_loop, tuned_loop
from .page import png, write
from .timing import compiled, others_running, ran_on, seconds, this_machine

WANTED = 1000  # ratio of the rates of value and gradient
D_RANGE, G_RANGE = (2.35, 2.6), (3e-11, 3e-9)
HEADLINE = "value and gradient, forward"  # two inputs: the case for forward mode
PLAIN, TUNED = "loop", "tuned loop"


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    side: int  # of the grid
    sample: int  # grid points for the loop
    exact: int  # of those, for mpmath
    repeats: int


FULL, QUICK = Size(1000, 2000, 48, 9), Size(100, 200, 12, 3)


# ---------------------------------------------------------------------------------------------
# The package
# ---------------------------------------------------------------------------------------------


def package_methods(quick: bool) -> dict[str, Callable]:
    """Functions of the grid's axes D (n,) and G (m,), by name; each gives (n, m) arrays."""
    scene = fj.brake_scene()

    def value(D, G):
        return fj.growth_rate(scene.replace(D=D, G=G))

    reverse = jax.value_and_grad(value, argnums=(0, 1))

    def forward(D, G):
        rate, push = jax.linearize(value, D, G)
        one, zero = jnp.ones_like(D), jnp.zeros_like(D)
        return rate, (push(one, zero), push(zero, one))

    def at_once(function):
        return jax.vmap(jax.vmap(function, (None, 0)), (0, None))

    def in_chunks(function, batch_size):
        def run(D, G):
            pairs = [x.ravel() for x in jnp.meshgrid(D, G, indexing="ij")]
            out = jax.lax.map(lambda pair: function(*pair), pairs, batch_size=batch_size)
            return jax.tree.map(lambda x: x.reshape(D.size, G.size), out)

        return run

    methods = {
        "value only": at_once(value),
        HEADLINE: at_once(forward),
        "value and gradient, reverse": at_once(reverse),
        "value and gradient, reverse, lax.map of 4096": in_chunks(reverse, 4096),
    }
    if not quick:
        methods |= {
            "value and gradient, forward, lax.map of 4096": in_chunks(forward, 4096),
            "value and gradient, reverse, lax.map of 65536": in_chunks(reverse, 65536),
        }
    return methods


def compiled_methods(methods: dict[str, Callable], D, G) -> dict[str, tuple[Callable, float]]:
    """The methods compiled for a grid, each with the seconds of tracing and compiling it."""
    programs = {}
    for name, method in tqdm(methods.items(), desc="compile"):
        programs[name] = compiled(method, D, G)
        jax.block_until_ready(programs[name][0](D, G))
    return programs


def rows_of(outputs, grid_G: np.ndarray, picked) -> np.ndarray:
    """A method's outputs at the picked grid points, as (n, 1) or (n, 3): value, by D, by ln G."""
    if not isinstance(outputs, tuple):
        return np.asarray(outputs)[picked][:, None]
    value, (by_D, by_G) = outputs
    columns = [np.asarray(column)[picked] for column in (value, by_D, by_G)]
    columns[2] = columns[2] * grid_G[picked[1]]
    return np.stack(columns, axis=1)


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def spread(errors: np.ndarray) -> dict[str, float]:
    """Median and worst."""
    return {"median": float(np.median(errors)), "worst": float(np.max(errors))}


def errors_of(rows: np.ndarray, truth: np.ndarray, omega: np.ndarray) -> dict[str, Any]:
    """Errors of the growth rate in omega; of the gradient in its length, where it has one."""
    found = {"growth_rate": spread(np.abs(rows[:, 0] - truth[:, 0]) / omega)}
    if rows.shape[1] == 3:
        length = np.linalg.norm(truth[:, 1:], axis=1)
        off = np.linalg.norm(rows[:, 1:] - truth[:, 1:], axis=1)
        found["gradient"] = spread(off[length > 0] / length[length > 0])
    return found


def of_each_regime(regimes: list[str], count: int) -> list[int]:
    """Places of the first points of a sample, as many of each of the three regimes."""
    kinds = sorted(set(regimes))
    places = {kind: [i for i, r in enumerate(regimes) if r == kind] for kind in kinds}
    return [i for kind in kinds for i in places[kind][: count // len(kinds)]]


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    grid_D = np.linspace(D_RANGE[0], D_RANGE[1], size.side)
    grid_G = np.exp(np.linspace(math.log(G_RANGE[0]), math.log(G_RANGE[1]), size.side))
    rng = np.random.default_rng(0)
    picked = np.unravel_index(
        rng.choice(size.side**2, size.sample, replace=False), (size.side, size.side)
    )
    D, G = grid_D[picked[0]].tolist(), grid_G[picked[1]].tolist()
    numbers = brake()
    growth = tuned_loop(numbers)
    programs = compiled_methods(package_methods(quick), jnp.asarray(grid_D), jnp.asarray(grid_G))

    calls: dict[str, tuple[int, Callable]] = {}
    for loop, body in [(PLAIN, plain_loop(numbers)), (TUNED, growth)]:
        for what, run in [("value only", loop_value), ("value and gradient", loop_gradient)]:
            calls[f"{loop}, {what}"] = size.sample, lambda f=body, run=run: run(f, D, G)
    for name, (program, _) in programs.items():
        axes = jnp.asarray(grid_D), jnp.asarray(grid_G)
        calls[name] = (size.side**2, lambda program=program, axes=axes: program(*axes))
    times: dict[str, list[float]] = {name: [] for name in calls}
    rows = {}
    for _ in tqdm(range(size.repeats), desc="run"):
        for name, (points, call) in calls.items():
            elapsed, result = seconds(call)
            times[name].append(elapsed / points)
            is_loop = name not in programs
            rows[name] = (
                result.reshape(size.sample, -1) if is_loop else rows_of(result, grid_G, picked)
            )

    states = [growth(d, g) for d, g in zip(D, G, strict=True)]
    omega = np.array([state[1] for state in states])
    regimes = [state[2] for state in states]
    exact = of_each_regime(regimes, size.exact)
    truth = exact_rows(numbers, [D[i] for i in exact], [G[i] for i in exact])
    methods = []
    for name in calls:
        gradient = rows[name].shape[1] == 3
        what = "value and gradient" if gradient else "value only"

        def ratio(loop, name=name, what=what):
            both = zip(times[f"{loop}, {what}"], times[name], strict=True)
            return statistics.median(a / b for a, b in both)

        methods.append(
            {
                "name": name,
                "gradient": gradient,
                "compile_s": programs[name][1] if name in programs else None,
                "seconds_per_point": statistics.median(times[name]),
                "seconds_per_point_fastest": min(times[name]),
                "seconds_per_point_slowest": max(times[name]),
                "points_per_second": 1 / statistics.median(times[name]),
                "ratio_to_loop": ratio(PLAIN),
                "ratio_to_tuned_loop": ratio(TUNED),
                "error_to_40_digits": errors_of(rows[name][exact], truth, omega[exact]),
                "error_to_loop": errors_of(rows[name], rows[f"{PLAIN}, {what}"], omega),
            }
        )
    headline = next(method for method in methods if method["name"] == HEADLINE)
    return {
        "headline": {
            "method": HEADLINE,
            "ratio_to_loop": headline["ratio_to_loop"],
            "ratio_to_tuned_loop": headline["ratio_to_tuned_loop"],
            "wanted": WANTED,
        },
        "quick": quick,
        "grid": {"side": size.side, "D": D_RANGE, "G": G_RANGE},
        "sample": size.sample,
        "exact_points": len(exact),
        "repeats": size.repeats,
        "difference_step": STEP,
        "regimes_of_sample": {r: regimes.count(r) / size.sample for r in sorted(set(regimes))},
        "machine": this_machine(busy),
        "versions": {
            "python": platform.python_version(),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "mpmath": mpmath.__version__,
        },
        "methods": methods,
    }


# ---------------------------------------------------------------------------------------------
# Showing
# ---------------------------------------------------------------------------------------------


def table(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, one table, how it was measured."""
    head = result["headline"]
    met = "holds" if head["ratio_to_loop"] >= head["wanted"] else "is missed"
    found = {method["name"]: method["error_to_40_digits"] for method in result["methods"]}
    errors, loop_errors = found[head["method"]], found["loop, value and gradient"]
    side = result["grid"]["side"]
    lines = [
        "# Growth rate with gradient over a grid of surfaces",
        "",
        f"The growth rate and its gradient to (D, G) come at {head['ratio_to_loop']:.0f} times the"
        f" rate of the loop a user writes with brentq, eigvals and central differences (wanted >="
        f" {head['wanted']}: {met}), {head['ratio_to_tuned_loop']:.0f} times that of the same loop"
        " tuned by hand, with"
        f" errors of at most {errors['growth_rate']['worst']:.0e} omega in the value and"
        f" {errors['gradient']['worst']:.0e} of its length in the gradient, where the loop has"
        f" {loop_errors['growth_rate']['worst']:.0e} and {loop_errors['gradient']['worst']:.0e}.",
        "",
        "| method | compile [s] | time a point [us] | points a second | ratio to the loop "
        "| to the tuned loop "
        "| growth rate error / omega: median, worst | gradient error, relative: median, worst |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in result["methods"]:
        errors = method["error_to_40_digits"]
        cells = [
            method["name"],
            "-" if method["compile_s"] is None else f"{method['compile_s']:.1f}",
            f"{method['seconds_per_point'] * 1e6:.3g}",
            f"{method['points_per_second']:.3g}",
            f"{method['ratio_to_loop']:.3g}",
            f"{method['ratio_to_tuned_loop']:.3g}",
            *(
                ", ".join(f"{errors[key][how]:.1e}" for how in ("median", "worst"))
                if key in errors
                else "-"
                for key in ("growth_rate", "gradient")
            ),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    regimes = ", ".join(f"{name} {v:.0%}" for name, v in result["regimes_of_sample"].items())
    lines += [
        "",
        f"Grid: {side} x {side} surfaces of the reference brake, D {result['grid']['D'][0]} to"
        f" {result['grid']['D'][1]}, G {result['grid']['G'][0]:g} to {result['grid']['G'][1]:g} m,"
        f" even in ln G ({regimes}). The loops run {result['sample']} of its points: brentq on the"
        " load, numpy.linalg.eigvals on the state matrix, and for the gradient four more of each;"
        " the plain one equation by equation with NumPy, the tuned one with the math module,"
        " constants taken out and a reduced load balance."
        f" Every time is the median of {result['repeats']} runs, the methods taking turns, and"
        " every ratio the median of the ratios within a turn. Compile time includes tracing and is"
        " in no other column. Errors are those of the same runs, against mpmath with 40 digits at"
        f" {result['exact_points']} of the points, as many of each regime; omega is the modulus of"
        " the critical eigenvalue.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> bytes:
    """Worst error against time a point, a marker a method: value left, gradient right."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12, 6.2), layout="constrained")
    titles = {
        "growth_rate": "Growth rate: worst error / omega [-]",
        "gradient": "Gradient to (D, ln G): worst relative error [-]",
    }
    for axis, (key, title) in zip(axes, titles.items(), strict=True):
        for method, marker in zip(result["methods"], "osP*^vD<>X", strict=False):
            errors = method["error_to_40_digits"]
            if key in errors:
                axis.loglog(
                    method["seconds_per_point"],
                    errors[key]["worst"],
                    marker,
                    markersize=10,
                    color="tab:red" if method["compile_s"] is None else "tab:blue",
                    fillstyle="none",
                    markeredgewidth=1.8,
                    label=method["name"],
                )
        axis.margins(0.15)
        axis.grid(True, which="major", alpha=0.4)
        axis.set(xlabel="time a point [s]", ylabel=title)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    figure.suptitle(
        f"Value and gradient: {result['headline']['ratio_to_loop']:.0f} times the rate of the loop"
    )
    return png(figure, dpi=130)


def run(out: Path, quick: bool = False) -> list[Path]:
    """Measure, and write growth_rate.json, .md and .png into a folder; returns their paths."""
    result = measure(quick)
    return write(out, "growth_rate", result, table(result), picture(result))
