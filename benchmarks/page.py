"""A benchmark's page: numbers, text and picture side by side in a folder, and the index of all.

A page is a module with TITLE, PACKAGES (whose versions it names), `measure` for its numbers, whose
arguments are FULL or QUICK, `page(result)` for its blocks of Markdown, the first of which says what
to use, and `picture(result)` for its PNG.
"""

import io
import json
import string
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .timing import machine_name, others_running, this_machine, versions

INDEX = "README.md"  # the page that a folder is shown with
UNITS = {"m": 1e3, "u": 1e6, "n": 1e9, "M": 1e-6}
Result = dict[str, Any]


class Cells(string.Formatter):
    """Fills `{key.key!unit:form}` from a row; median and worst as a pair, what is missing as -."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        value = kwargs
        for key in field_name.split("."):
            value = value.get(key) if value else None
        return value, field_name

    def convert_field(self, value: Any, conversion: str | None) -> Any:
        return value if value is None or conversion is None else value * UNITS[conversion]

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is None:
            return "-"
        if isinstance(value, dict):
            return ", ".join(format(value[how], format_spec) for how in ("median", "worst"))
        return format(value, format_spec)


cell = Cells().format_field  # a number as a table shows it, or a dash


def filled(template: str, row: Result) -> str:
    """The template with the numbers of a row."""
    return Cells().vformat(template, (), row)


def table(head: str, rows: Iterable[Any], template: str = "") -> str:
    """A Markdown table from a heading and rows, given as text or as what fills the template."""
    lines = (filled(template, row) if template else row for row in rows)
    return "\n".join(
        f"| {x} |" for x in (head, " | ".join(["---"] * (head.count("|") + 1)), *lines)
    )


def spread(errors: Any) -> dict[str, float]:
    """Median and worst."""
    return {"median": float(np.median(errors)), "worst": float(np.max(errors))}


# What a page promises: {what, ratio, wanted} or {what, value, wanted: [low, high]}


def held(head: Result) -> bool:
    """Whether a ratio is as large as wanted, or a value within its two bounds."""
    if "ratio" in head:
        return head["ratio"] >= head["wanted"]
    return head["wanted"][0] <= head["value"] <= head["wanted"][1]


def verdict(head: Result) -> str:
    return "held" if held(head) else "**missed**"


def in_words(head: Result) -> str:
    """Cells: what is compared, what was measured, what was wanted, the verdict."""
    found, wanted = "{ratio:.3g} times", "at least {wanted:g} times"
    if "value" in head:
        found, wanted = "{value:.3g}", "{:g} to {:g}".format(*head["wanted"])
    return f"{head['what']} | {filled(f'{found} | {wanted}', head)} | {verdict(head)}"


# Pictures


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


def columns(rows: Iterable[Result], *keys: str) -> tuple[list[Any], ...]:
    """What stands in rows under each key."""
    rows = list(rows)
    return tuple([row[key] for row in rows] for key in keys)


def png(figure: Any, dpi: int = 110) -> bytes:
    """A figure of pyplot as the content of a file; the figure is closed."""
    from matplotlib import pyplot

    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    pyplot.close(figure)
    return content.getvalue()


# Pages and their index


def measured(module: Any, quick: bool) -> Result:
    """All numbers of a page, as they are read back from its JSON."""
    about = {"quick": quick, "machine": this_machine(others_running())}
    about["versions"] = versions("jax", *module.PACKAGES)
    return json.loads(json.dumps(about | module.measure(**module.QUICK if quick else module.FULL)))


def text(module: Any, result: Result) -> str:
    """The Markdown of a page. Tables and lists are kept; of a paragraph the line breaks go."""
    machine = result["machine"]
    ran_on = f"""{machine_name(machine)}, {machine["others_running"]:.1f} other programs running
        before; {", ".join(" ".join(pair) for pair in result["versions"].items())}."""
    blocks = [f"# {module.TITLE}", *module.page(result), ran_on]
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


def stored(folder: Path) -> dict[str, Result]:
    """Numbers of the pages in a folder, by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def index(folder: Path) -> str:
    """The page of all pages: what is held, what to use, on which machine."""
    results = stored(folder)
    heads = [(name, head) for name in results for head in results[name].get("headline", [])]
    missed = sum(not held(head) for _, head in heads)
    machines = dict.fromkeys(machine_name(result["machine"]) for result in results.values())
    opening = {name: (folder / f"{name}.md").read_text().split("\n\n")[:2] for name in results}
    promises = (f"{in_words(head)} | [{name}]({name}.md)" for name, head in heads)
    use = (f"- [{title[2:]}]({name}.md). {first}" for name, (title, first) in opening.items())
    blocks = [
        "# Error against run time",
        f"Of {len(heads)} ratios and bounds to hold, {len(heads) - missed} are held and {missed}"
        f" {'is' if missed == 1 else 'are'} missed. Written by `python -m benchmarks` on"
        f" {' and on '.join(machines)}. Absolute times mean little elsewhere; ratios are between"
        " methods that took turns in one run.",
        "## Ratios to hold",
        table("what | measured | wanted |  | page", promises),
        "## What to use",
        "\n".join(use),
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
        " JAX sees one. A test lowers every public program for CUDA: none calls Python while it"
        " runs, and only the eigenvalues of structures are found on the host, by LAPACK."
    )
    if lanes := results.get("many_cycles", {}).get("lanes"):
        most = max(lanes["busy"], key=int)
        found += (
            " A loop under `jax.vmap` runs until its slowest member ends. With"
            f" {most} limit cycles in one loop the members are busy"
            f" {lanes['busy'][most]:.0%} of the time."
        )
    return found
