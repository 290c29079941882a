"""The page and the picture of whole designs."""

from typing import Any

import numpy as np

from ..page import cell, png, subplots, table
from ..timing import ran_on
from .methods import MEETS
from .tasks import GROWTH_SCALE, TARGET

FLOOR = 1e-9  # least gap that is shown


def quickest(runs: list[dict[str, Any]], near: str, cold: bool) -> dict[str, Any] | None:
    """The shortest whole run that comes near from every start, and None where none does.

    Whole, since nobody who does not know the optimum can stop where a run first comes near it.
    """
    able = [run for run in runs if run[near]["starts"] == run["starts"]]
    return min(able, key=lambda run: took(run, cold), default=None)


def took(run: dict[str, Any], cold: bool) -> float:
    """Seconds of a whole run of a method, with compiling if it is cold."""
    return run["seconds"] + (run["compile_s"] if cold else 0)


def choice(result: dict[str, Any]) -> str:
    """One sentence: what to take."""
    task = result["tasks"][0]
    runs = [run for run in result["runs"] if run["task"] == task["name"]]
    named = []
    for near, cold in (("near", True), ("exact", True), ("exact", False)):
        best = quickest(runs, near, cold)
        named.append(
            "nothing that was tried"
            if best is None
            else f"{best['name']} ({took(best, cold):.2g} s)"
        )
    own = next(run for run in runs if run["family"] == "design")
    return (
        f"For one design of D and G take, where the start may be anywhere, {named[0]} to 1 % and"
        f" {named[1]} to 1e-6, compiling included, and where many designs follow {named[2]};"
        f" `fj.design` comes within 1e-6 from {own['exact']['starts']} of {own['starts']} starts,"
        f" in {took(own, True):.2g} s the first time and {took(own, False):.2g} s after."
    )


def quickest_table(result: dict[str, Any]) -> list[str]:
    """The shortest run of a method that never depends on its start, of every task."""
    lines = []
    for task in result["tasks"]:
        runs = [run for run in result["runs"] if run["task"] == task["name"]]
        line = [task["title"]]
        for near in ("near", "exact"):
            for cold in (True, False):
                best = quickest(runs, near, cold)
                line.append("-" if best is None else f"{best['name']}: {took(best, cold):.2g} s")
        lines.append(line)
    return table(
        ["task", "to 1 %, first design", "later ones", "to 1e-6, first design", "later ones"], lines
    )


HEADINGS = [
    "method",
    "compile [s]",
    "a run [s]",
    "evaluations",
    "gap: median",
    "gap: worst",
    "violation",
    "to 1 %: starts",
    "time [s]",
    "to 1e-6: starts",
    "time [s]",
]


def cells(run: dict[str, Any]) -> list[str]:
    """One row of a task's table."""
    line = [
        run["name"],
        cell(run["compile_s"] or None, ".1f"),
        f"{run['seconds']:.3g}",
        f"{run['evaluations']:.0f}",
        *(cell(run["gap"][key], ".0e") for key in ("median", "worst")),
        f"{run['violation']:.0e}",
    ]
    for near in ("near", "exact"):
        line.append(f"{run[near]['starts']} of {run['starts']}")
        line.append(cell(run[near]["seconds"], ".3g"))
    return line


def task_text(task: dict[str, Any], runs: list[dict[str, Any]]) -> list[str]:
    """What is asked, the optimum and how sure it is, and the table of the methods."""
    best = task["optimum"]
    bounds = ", ".join(f"{n} {low:g} to {high:g}" for n, (low, high) in task["bounds"].items())
    at = ", ".join(f"{name} = {value:.8g}" for name, value in best["quantities"].items())
    aim = "least squared scaled change" if task["nearest"] else "least growth rate"
    return [
        f"## {task['title']}",
        "",
        f"The {aim} within {bounds}, at the worst of {task['conditions']} conditions. The optimum"
        f" is {best['value']:.10g} {task['unit']} at {at}: {best['agree']} of {best['polished']}"
        f" polished designs agree to 1e-8, the best of {best['dense']} on a grid is"
        f" {best['dense_gap']:.1e} above it, and the growth rate there is {best['off_exact']:.0e}"
        " 1/s off 40 digits.",
        "",
        *table(HEADINGS, [cells(run) for run in runs]),
        "",
    ]


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, what is quickest, every task, how it was measured."""
    lines = [
        "# A whole design: gradients, Nelder-Mead and grids",
        "",
        choice(result),
        "",
        "The shortest whole run that comes so near from every start:",
        "",
        *quickest_table(result),
        "",
    ]
    for task in result["tasks"]:
        own = [run for run in result["runs"] if run["task"] == task["name"]]
        lines += task_text(task, own)
    lines += [
        "The reference brake, with the requirements of `fj.design`: growth rate at most"
        f" {TARGET:.4f} 1/s, K_n no less than that of the brake, a_l at least 2 a_e, Q_e at most"
        " 0.9 mu_s P, each held against a plain loop of NumPy, brentq and eigvals which a user has"
        f" without the package. Gaps are to the optimum, relative to xi_1 omega_1 ="
        f" {GROWTH_SCALE:.4f} 1/s or, of the nearest design, to the optimum itself, of the best"
        f" design so far that meets every requirement to {MEETS:g}; violation is the worst of the"
        f" answers. Up to {result['starts']} starts, the brake itself and random ones; a grid is"
        " shifted at random instead. Times are medians over all starts, those that never come so"
        " near counted as infinite, without compiling; those beside a count of starts are when a"
        " run first comes so near, which only shows to who knows the optimum. Compiling includes"
        " tracing and is in a column of its own, for `fj.design` what its first call took longer."
        " Evaluations are of one design at one condition, with or without a gradient. `fj.design`"
        " moves D and G only, and its answer keeps 1e-6 of every requirement in hand.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


STYLES = {
    "design": ("-", "D", "k", "fj.design"),
    "slsqp": ("-", "o", "tab:blue", "SLSQP, package"),
    "slsqp loop": (":", "o", "tab:blue", "SLSQP, loop"),
    "scattered": ("-", "P", "tab:cyan", "SLSQP, many places, package"),
    "scattered loop": (":", "P", "tab:cyan", "SLSQP, many places, loop"),
    "simplex": ("-", "v", "tab:red", "Nelder-Mead, package"),
    "simplex loop": (":", "v", "tab:red", "Nelder-Mead, loop"),
    "simplices": ("-", "^", "tab:purple", "Nelder-Mead, many places, package"),
    "simplices loop": (":", "^", "tab:purple", "Nelder-Mead, many places, loop"),
    "grid": ("-", "s", "tab:green", "grid, package"),
    "zoom": ("--", "X", "tab:olive", "zoomed grid, package"),
    "grid loop": (":", "s", "tab:green", "grid, loop"),
}


def median_curve(curves: list[list[list[float]]]) -> tuple[np.ndarray, np.ndarray]:
    """The median over the starts at every time at which one of them improves."""
    times = np.array(sorted({t for c in curves for t, _ in c}))
    gaps = np.full((len(curves), len(times)), np.inf)
    for row, c in zip(gaps, curves, strict=True):
        for t, gap in c:
            row[times >= t] = np.minimum(row[times >= t], gap)
    middle = np.median(gaps, axis=0) if len(times) else np.empty(0)
    known = np.isfinite(middle)
    return times[known], middle[known]


def draw(ax: Any, run: dict[str, Any], cold: bool) -> None:
    """A light line for every start of a method and a bold one for their median."""
    line, marker, colour, _ = STYLES[run["family"]]
    wait = run["compile_s"] if cold else 0
    steps: dict[str, Any] = dict(c=colour, ls=line, drawstyle="steps-post")
    for points in run["curves"]:
        if points:
            t, gap = np.transpose(points)
            ax.plot(t + wait, gap, lw=0.7, alpha=0.5, **steps)
    t, gap = median_curve(run["curves"])
    if len(t):
        end = max(run["seconds"], t[0])
        within = t <= end
        t, gap = np.append(t[within], end), np.append(gap[within], run["gap"]["median"])
        ax.plot(t + wait, gap, lw=1.8, **steps)
        ax.plot(t[-1] + wait, gap[-1], marker, c=colour, mec="k", ms=8, zorder=5)


def picture(result: dict[str, Any]) -> bytes:
    """Gap to the optimum over time: a column for every task, below with compiling."""
    tasks = result["tasks"]
    figure, axes = subplots(2, len(tasks), figsize=(5.2 * len(tasks), 9.2), sharey=True)
    for column, task in zip(axes.T, tasks, strict=True):
        runs = [run for run in result["runs"] if run["task"] == task["name"]]
        for ax, cold in zip(column, (False, True), strict=True):
            for run in runs:
                draw(ax, run, cold)
            ax.set(xscale="log", yscale="log", ylim=(FLOOR / 2, 1e3))
            ax.grid(True, which="major", alpha=0.4)
        column[0].set_title(task["title"])
        column[0].set_xlabel("time without compiling [s]")
        column[1].set_xlabel("time of the first design, with compiling [s]")
    for ax in axes[:, 0]:
        ax.set_ylabel("gap to the optimum [-]")
    drawn = {run["family"] for run in result["runs"]}
    handles = [
        axes[0, 0].plot([], [], ls=line, marker=marker, c=colour, mec="k", label=label)[0]
        for family, (line, marker, colour, label) in STYLES.items()
        if family in drawn
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=6 if len(tasks) > 2 else 4,
        fontsize="small",
    )
    return png(figure, dpi=100)
