"""A benchmark's page: numbers, text and picture side by side in a folder, and the index of all.

A page is a module with TITLE, PACKAGES (whose versions it names), `measure(quick)` for its numbers,
`page(result)` for its blocks of Markdown and `picture(result)` for its PNG.
"""

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .timing import machine_name, others_running, ran_on, this_machine, versions

INDEX = "README.md"  # the page that a folder is shown with
Result = dict[str, Any]


def table(head: str, rows: Iterable[str]) -> str:
    """A Markdown table from a heading and rows with cells apart by ` | `."""
    lines = [head, " | ".join(["---"] * (head.count("|") + 1)), *rows]
    return "\n".join(f"| {line} |" for line in lines)


def cell(value: Any, form: str) -> str:
    """A number as a table shows it, or a dash."""
    return "-" if value is None else format(value, form)


def spread(errors: Any) -> dict[str, float]:
    """Median and worst."""
    return {"median": float(np.median(errors)), "worst": float(np.max(errors))}


def both(errors: dict[str, float] | None, form: str = ".1e") -> str:
    """Median and worst in one cell."""
    return f"{errors['median']:{form}}, {errors['worst']:{form}}" if errors else "-"


# Ratios and bounds that a page promises -----------------------------------------------------------


def held(head: Result) -> bool:
    """Whether a ratio is as large as wanted, or a value within its two bounds."""
    if "ratio" in head:
        return head["ratio"] >= head["wanted"]
    low, high = head["wanted"]
    return low <= head["value"] <= high


def verdict(head: Result) -> str:
    """The same in a word."""
    return "held" if held(head) else "**missed**"


def in_words(head: Result) -> str:
    """Cells: what is compared, what was measured, what was wanted, the verdict."""
    if "ratio" in head:
        found, wanted = f"{head['ratio']:.3g} times", f"at least {head['wanted']:g} times"
    else:
        low, high = head["wanted"]
        found, wanted = f"{head['value']:.3g}", f"{low:g} to {high:g}"
    return f"{head['what']} | {found} | {wanted} | {verdict(head)}"


# Pictures -----------------------------------------------------------------------------------------


def subplots(*shape: int, **options: Any) -> tuple[Any, Any]:
    """A figure and its axes, as pyplot makes them, drawn without a screen."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(*shape, layout="constrained", **options)


def draw(ax: Any, lines: Iterable[tuple], xlabel: str, ylabel: str, title: str = "") -> None:
    """Lines (x, y, style, label) over logarithmic axes, the style as pyplot writes it."""
    for x, y, style, label in lines:
        ax.plot(x, y, style, mec="k", label=label)
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel, title=title)
    ax.grid(True, which="major", alpha=0.4)
    ax.legend(loc="best", fontsize="small")


def png(figure: Any, dpi: int = 110) -> bytes:
    """A figure of pyplot as the content of a file; the figure is closed."""
    from matplotlib import pyplot

    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    pyplot.close(figure)
    return content.getvalue()


# Pages --------------------------------------------------------------------------------------------


def measured(module: Any, quick: bool) -> Result:
    """All numbers of a page, as they are read back from its JSON."""
    busy = others_running()
    found = module.measure(quick)
    about = {"machine": this_machine(busy), "versions": versions("jax", *module.PACKAGES)}
    return json.loads(json.dumps({"quick": quick} | about | found))


def text(module: Any, result: Result) -> str:
    """The Markdown of a page. Tables and lists are kept; of a paragraph the line breaks go."""
    blocks = [f"# {module.TITLE}", *module.page(result), ran_on(result)]
    kept = (b if b.startswith(("| ", "- ")) else " ".join(b.split()) for b in blocks if b)
    return "\n\n".join(kept) + "\n"


def write(folder: Path, name: str, module: Any, result: Result) -> list[Path]:
    """Write `name`.json, .md and .png; returns their paths."""
    files = {
        folder / f"{name}.json": (json.dumps(result, indent=1) + "\n").encode(),
        folder / f"{name}.md": text(module, result).encode(),
        folder / f"{name}.png": module.picture(result),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in files.items():
        path.write_bytes(content)
    return list(files)


# The index ----------------------------------------------------------------------------------------


def stored(folder: Path) -> dict[str, Result]:
    """Numbers of the pages in a folder, by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def index(folder: Path) -> str:
    """The page of all pages: what is held, what to use, on which machine."""
    results = stored(folder)
    heads = [
        (name, head) for name, result in results.items() for head in result.get("headline", [])
    ]
    missed = sum(not held(head) for _, head in heads)
    machines = dict.fromkeys(machine_name(result["machine"]) for result in results.values())
    opening = {name: (folder / f"{name}.md").read_text().split("\n\n")[:2] for name in results}
    blocks = [
        "# Error against run time",
        f"Of {len(heads)} ratios and bounds to hold, {len(heads) - missed} are held and {missed}"
        f" {'is' if missed == 1 else 'are'} missed. Written by `python -m benchmarks` on"
        f" {' and on '.join(machines)}. Absolute times mean little elsewhere; ratios are between"
        " methods that took turns in one run.",
        "## Ratios to hold",
        table(
            "what | measured | wanted |  | page",
            (f"{in_words(head)} | [{name}]({name}.md)" for name, head in heads),
        ),
        "## What to use",
        "\n".join(
            f"- [{title.removeprefix('# ')}]({name}.md). {first}"
            for name, (title, first) in opening.items()
        ),
        "## On an accelerator",
        accelerators(results),
    ]
    return "\n\n".join(blocks) + "\n"


def accelerators(results: dict[str, Result]) -> str:
    """On which devices the pages were measured, and what is known of others."""
    others = sorted({result["machine"]["device"] for result in results.values()} - {"cpu"})
    if others:
        return f"Measured on {', '.join(others)}."
    found = (
        "Not measured: JAX saw only the processor. The same commands use an accelerator where"
        " JAX sees one."
    )
    if lanes := results.get("many_cycles", {}).get("lanes"):
        most = max(lanes["busy"], key=int)
        found += (
            " A loop under `jax.vmap` runs until its slowest member ends. With"
            f" {most} limit cycles in one loop the members are busy"
            f" {lanes['busy'][most]:.0%} of the time."
        )
    return found
