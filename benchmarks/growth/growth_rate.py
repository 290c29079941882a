"""Growth rate and its gradient to (D, G): this package against what SciPy and NumPy give.

The package, compiled and vmapped, beside the loops that a user would write with brentq and
numpy.linalg.eigvals, and beside the quickest peer, NumPy arrays throughout; their gradients are
differences. The methods take turns, so that a busy machine slows all alike, and the errors of the
same calls are taken to 40 digits.
"""

import dataclasses
import statistics
from typing import Any

import numpy as np
from tqdm import tqdm

from ..page import cell, png, subplots, table, verdict, versions
from ..timing import others_running, ran_on, taking_turns, this_machine, too_long
from .exact import Truth, errors_of, truth_of
from .growth_rate_methods import (
    ARRAYS,
    D_RANGE,
    FORWARD,
    FORWARD_32,
    G_RANGE,
    GRADIENT,
    PLAIN,
    REVERSE,
    TUNED,
    VALUE,
    Method,
    loops,
    package,
    surfaces,
    with_arrays,
)
from .loops import STEP, arrays, brake, differences

WANTED = 1000  # ratio of the rates of value and gradient
LIMIT = 10.0  # s: a call that would take longer is left out
STEPS = tuple(float(step) for step in 10.0 ** -np.arange(2, 10.25, 0.5))  # in D and ln G
HEADLINE = FORWARD  # two inputs: the case for forward mode


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    points: int  # of the package
    at_once: int  # of those in one call
    arrays: int  # of those, for the NumPy arrays
    loop: int  # for the loops
    exact: int  # for mpmath
    repeats: int
    batches: tuple[int, ...]


FULL = Size(1_000_000, 10_000, 20_000, 2000, 48, 9, tuple(10**k for k in range(7)))
QUICK = Size(10_000, 1000, 1000, 200, 6, 3, (1000,))


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def by_step(D: np.ndarray, G: np.ndarray, truth: Truth) -> list[dict[str, Any]]:
    """Errors of the differences of NumPy arrays, by their order and step."""
    growth = arrays(brake())
    at = D[truth.places], G[truth.places]
    return [
        {"order": order, "step": step}
        | errors_of(differences(growth, *at, step, order), truth)["gradient"]
        for order in (2, 4)
        for step in STEPS
    ]


def best_steps(rows: list[dict[str, Any]]) -> dict[int, float]:
    """By order the step with the least worst error, which no user without the truth can know."""
    found = {}
    for row in sorted(rows, key=lambda row: row["worst"]):
        found.setdefault(row["order"], row["step"])
    return found


def by_batch(size: Size, D: np.ndarray, G: np.ndarray, steps) -> list[dict[str, Any]]:
    """Points a second in one call, by the number of points in it."""
    rows, last = [], {}  # points, and seconds for all of them

    def wanted(peer: Method) -> bool:
        points, elapsed = last.get(peer.name, (1, 0.0))
        return not too_long(elapsed, peer.points / points, LIMIT)

    for many in tqdm(size.batches, desc="batch"):
        first = D[:many], G[:many]
        methods = [peer for peer in with_arrays(brake(), *first, steps) if wanted(peer)]
        methods += [package(name, *first, many) for name in (VALUE, FORWARD, REVERSE)]
        calls = {method.name: method.run for method in methods}
        turns = taking_turns(calls, min(size.repeats, 5))
        last |= {name: (many, statistics.median(elapsed)) for name, elapsed in turns.items()}
        rates = {name: many / last[name][1] for name in calls}
        rows.append({"points": many, "points_per_second": rates})
    return rows


def describe(method: Method, turns: dict[str, list[float]], G, truth: Truth) -> dict[str, Any]:
    """A method's times a point, ratios to its peers, and errors."""
    kind = GRADIENT if method.gradient else VALUE
    rows = method.rows(G)

    def ratio(peer: str) -> float:
        return statistics.median(a / b for a, b in zip(turns[peer], own, strict=True))

    own = turns[method.name]
    return {
        "name": method.name,
        "gradient": method.gradient,
        "points": method.points,
        "compile_s": method.compile_s,
        "seconds_per_point": statistics.median(own),
        "seconds_per_point_fastest": min(own),
        "seconds_per_point_slowest": max(own),
        "points_per_second": 1 / statistics.median(own),
        "ratio_to_loop": ratio(f"{PLAIN}, {kind}"),
        "ratio_to_tuned_loop": ratio(f"{TUNED}, {kind}"),
        "ratio_to_arrays": ratio(f"{ARRAYS}, {kind}" + (", order 2" if method.gradient else "")),
        "not_finite": int((~np.isfinite(rows)).any(axis=1).sum()),
        "error_to_40_digits": errors_of(rows[truth.places], truth),
    }


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    D, G = surfaces(size.points)
    truth = truth_of(brake(), D[: size.loop], G[: size.loop], size.exact)
    steps = by_step(D, G, truth)
    best = best_steps(steps)
    methods = [
        *loops(brake(), D[: size.loop], G[: size.loop]),
        *with_arrays(brake(), D[: size.arrays], G[: size.arrays], best),
        *(package(name, D, G, size.at_once) for name in (VALUE, FORWARD, REVERSE, FORWARD_32)),
    ]
    turns = taking_turns({method.name: method.run for method in methods}, size.repeats)
    for method in methods:
        turns[method.name] = [elapsed / method.points for elapsed in turns[method.name]]
    found = [describe(method, turns, G, truth) for method in methods]
    head = next(row for row in found if row["name"] == HEADLINE)
    return {
        "headline": [
            {
                "what": f"{GRADIENT}, {HEADLINE}, beside the loop as a user writes it",
                "ratio": head["ratio_to_loop"],
                "ratio_to_tuned_loop": head["ratio_to_tuned_loop"],
                "ratio_to_arrays": head["ratio_to_arrays"],
                "wanted": WANTED,
            }
        ],
        "quick": quick,
        "ranges": {"D": D_RANGE, "G": G_RANGE},
        "size": dataclasses.asdict(size),
        "exact_points": len(truth.places),
        "loop_step": STEP,
        "best_steps": best,
        "regimes": truth.regimes,
        "machine": this_machine(busy),
        "versions": versions("jax", "numpy", "scipy", "mpmath"),
        "methods": found,
        "steps": steps,
        "batches": by_batch(size, D, G, best),
    }


# ---------------------------------------------------------------------------------------------
# The page
# ---------------------------------------------------------------------------------------------


def choice(result: dict[str, Any]) -> str:
    """One sentence: what to take."""
    rows = {row["name"]: row for row in result["methods"]}
    own, single = rows[FORWARD], rows[FORWARD_32]
    peer = min(
        (row for name, row in rows.items() if name.startswith(ARRAYS) and row["gradient"]),
        key=lambda row: row["error_to_40_digits"]["gradient"]["worst"],
    )
    worst = {
        row["name"]: f"{row['error_to_40_digits']['gradient']['worst']:.0e}"
        for row in (own, single, peer)
    }
    time = {row["name"]: f"{row['seconds_per_point'] * 1e6:.2g} us" for row in rows.values()}
    return (
        "Take forward mode in float64 for the gradient to (D, G), and"
        f" some {result['size']['at_once']:,} points in a call, as `fj.sweep` does: {time[FORWARD]}"
        f" a point, good to {worst[FORWARD]} of its length (reverse mode: {time[REVERSE]}), where"
        f" the best differences of the quickest peer take {time[peer['name']]} for"
        f" {worst[peer['name']]}; float32 takes {time[FORWARD_32]} and is good to"
        f" {worst[FORWARD_32]}."
    )


def in_figures(result: dict[str, Any]) -> str:
    """Whether the ratio that was wanted holds, and those to quicker peers."""
    head = result["headline"][0]
    return (
        f"Value and gradient come at {head['ratio']:.0f} times the rate of the loop that a user"
        f" writes with brentq, eigvals and central differences (wanted >= {head['wanted']}:"
        f" {verdict(head)}), {head['ratio_to_tuned_loop']:.0f} times that of the same loop tuned"
        f" by hand, and {head['ratio_to_arrays']:.0f} times that of NumPy arrays without any loop."
    )


HEADINGS = [
    "method",
    "compile [s]",
    "time a point [us]",
    "points a second",
    "ratio to the loop",
    "to the tuned loop",
    "to NumPy arrays",
    "growth rate error / omega: median, worst",
    "gradient error, relative: median, worst",
    "not finite",
]


def cells(row: dict[str, Any]) -> list[str]:
    """One row of the table of methods."""
    errors = [row["error_to_40_digits"].get(key) for key in ("growth_rate", "gradient")]
    ratios = [row[f"ratio_to_{peer}"] for peer in ("loop", "tuned_loop", "arrays")]
    return [
        row["name"],
        cell(row["compile_s"], ".1f"),
        f"{row['seconds_per_point'] * 1e6:.3g}",
        f"{row['points_per_second']:.3g}",
        *(f"{ratio:.3g}" for ratio in ratios),
        *(f"{x['median']:.1e}, {x['worst']:.1e}" if x else "-" for x in errors),
        str(row["not_finite"]),
    ]


def step_table(result: dict[str, Any]) -> list[str]:
    """Errors of the peer's differences by step: a column for each order."""
    rows = {(row["order"], row["step"]): row for row in result["steps"]}
    errors = [
        [f"{row['median']:.1e}, {row['worst']:.1e}" for row in (rows[2, step], rows[4, step])]
        for step in STEPS
    ]
    lines = [[f"{step:.1e}", *pair] for step, pair in zip(STEPS, errors, strict=True)]
    return table(["step", "order 2: median, worst", "order 4: median, worst"], lines)


def batch_table(result: dict[str, Any]) -> list[str]:
    """Points a second: a column for each batch."""
    names = list(result["batches"][0]["points_per_second"])
    rows = [
        [name, *(cell(row["points_per_second"].get(name), ".2g") for row in result["batches"])]
        for name in names
    ]
    return table(["method", *(f"{row['points']:,}" for row in result["batches"])], rows)


def text(result: dict[str, Any]) -> str:
    """The Markdown page: what to take, three tables, how it was measured."""
    size, ranges, best = result["size"], result["ranges"], result["best_steps"]
    regimes = ", ".join(f"{name} {share:.0%}" for name, share in result["regimes"].items())
    lines = [
        "# Growth rate with gradient over surfaces",
        "",
        choice(result),
        "",
        in_figures(result),
        "",
        *table(HEADINGS, [cells(row) for row in result["methods"]]),
        "",
        "Gradient error of the differences of NumPy arrays by their step, relative:",
        "",
        *step_table(result),
        "",
        "Points a second in one call, by the number of points in it:",
        "",
        *batch_table(result),
        "",
        f"Surfaces of the reference brake at random, D {ranges['D'][0]} to {ranges['D'][1]}, G"
        f" {ranges['G'][0]:g} to {ranges['G'][1]:g} m, even in ln G ({regimes}). The package gets"
        f" {size['points']:,}, {size['at_once']:,} in a call, the NumPy arrays {size['arrays']:,},"
        f" the loops {size['loop']:,}. The loops call brentq for the load and numpy.linalg.eigvals"
        " for the state matrix, and for the gradient four more of each, at a step of"
        f" {result['loop_step']:g}; the plain one equation by equation with NumPy, the tuned one"
        " with the math module, constants taken out and a reduced load balance. NumPy arrays have"
        " that balance too, with Newton's steps in place of brentq, and LAPACK for all matrices in"
        f" one call; their steps, {best[2]:.1e} for order 2 and {best[4]:.1e} for order 4, are"
        " those with the least worst error here, which a user without the truth cannot know.",
        "",
        f"Every time is the median of {size['repeats']} turns (at most 5 by batch), the methods"
        " taking turns, and every ratio the median of the ratios within a turn. Compile time"
        " includes tracing and is in no other column. A call that would take above"
        f" {LIMIT:.0f} s is left out. Errors are those of the same calls, against mpmath with 40"
        f" digits at {result['exact_points']} of the points, as many of each regime; omega is the"
        " modulus of the critical eigenvalue. The surfaces are ones that float32 holds; its row"
        " has the rounding of the brake's other numbers in it.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


# ---------------------------------------------------------------------------------------------
# The picture
# ---------------------------------------------------------------------------------------------


def draw_errors(axis, methods: list[dict[str, Any]]) -> None:
    """A marker a method: worst error of the gradient, or open of the value, over its time."""
    for row, marker in zip(methods, "osP*^vDX<>hd", strict=False):
        errors = row["error_to_40_digits"]
        colour = "tab:orange" if row["compile_s"] is None else "tab:blue"
        style = {"marker": marker, "c": colour, "mec": "k", "ms": 9, "ls": ""}
        times = row["seconds_per_point"] * 1e6
        if row["gradient"]:
            axis.loglog(times, errors["gradient"]["worst"], **style, label=row["name"])
        else:
            worst = errors["growth_rate"]["worst"]
            axis.loglog(times, worst, **style | {"mfc": "w", "mec": colour}, label=row["name"])
    axis.margins(0.12)
    axis.set(xlabel="time a point [us]", ylabel="worst error [-]")
    axis.set(title="filled: gradient, of its length; open: value, of omega")


def draw_steps(axis, result: dict[str, Any]) -> None:
    """Errors of differences over their step, beside that of the package."""
    own = next(row for row in result["methods"] if row["name"] == FORWARD)
    for order, colour, marker in ((2, "tab:orange", "s"), (4, "tab:red", "^")):
        rows = [row for row in result["steps"] if row["order"] == order]
        steps = [row["step"] for row in rows]
        for how, line, fill in (("worst", "-", colour), ("median", "--", "w")):
            style = {"marker": marker, "ls": line, "c": colour, "mfc": fill}
            label = f"differences of order {order}, {how}"
            axis.loglog(steps, [row[how] for row in rows], **style, label=label)
    for how, line in (("worst", "-"), ("median", "--")):
        error = own["error_to_40_digits"]["gradient"][how]
        axis.axhline(error, c="tab:blue", ls=line, label=f"{FORWARD}, {how}")
    axis.set(xlabel="step in D and ln G [-]", ylabel="error of the gradient, of its length [-]")


def draw_batches(axis, batches: list[dict[str, Any]]) -> None:
    """A line for each method."""
    names = list(batches[0]["points_per_second"])
    for name, marker in zip(names, "sXP*oD^", strict=False):
        own = [row for row in batches if name in row["points_per_second"]]
        colour = "tab:orange" if name.startswith(ARRAYS) else "tab:blue"
        line = "--" if name.endswith(VALUE) else "-"
        axis.loglog(
            [row["points"] for row in own],
            [row["points_per_second"][name] for row in own],
            marker=marker,
            ls=line,
            c=colour,
            mec="k",
            label=name,
        )
    axis.set(xlabel="points in one call [-]", ylabel="points a second [1/s]")


def picture(result: dict[str, Any]) -> bytes:
    """Worst error over time a point; errors over the step; points a second over the batch."""
    figure, axes = subplots(1, 3, figsize=(19, 6.4))
    draw_errors(axes[0], result["methods"])
    draw_steps(axes[1], result)
    draw_batches(axes[2], result["batches"])
    for axis in axes:
        axis.grid(True, which="major", alpha=0.4)
    for axis, place in zip(axes, ("center right", (0.02, 0.22), "lower right"), strict=True):
        axis.legend(loc=place, fontsize="small")
    return png(figure, dpi=100)
