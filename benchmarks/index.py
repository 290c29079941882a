"""The page that shows all others: ratios to hold, what to take, and on which machine."""

import json
from pathlib import Path
from typing import Any

from fractaljax.base.scene_file import write_whole

from .page import in_words, table
from .timing import named

NAME = "README.md"  # which a folder is shown with


def pages(folder: Path) -> dict[str, dict[str, Any]]:
    """Numbers of the pages in a folder, by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def opening(page: str) -> tuple[str, str]:
    """Title and first paragraph of a page, which says what to take."""
    title, paragraph = page.split("\n\n")[:2]
    return title.removeprefix("# "), paragraph.replace("\n", " ")


def accelerator(results: dict[str, dict[str, Any]]) -> str:
    """On which devices the pages were measured, and what is known of others."""
    found = {result["machine"]["device"] for result in results.values()}
    others = sorted(found - {"cpu"})
    if others:
        return f"Measured on {', '.join(others)}."
    text = (
        "Not measured: JAX saw the processor alone. The same commands run on an accelerator"
        " where JAX sees one."
    )
    lanes = results.get("many_cycles", {}).get("lanes")
    if lanes:
        most = max(lanes["busy"], key=int)
        text += (
            " Loops under `jax.vmap` run until the slowest member ends. Of limit cycles,"
            f" {most} in one loop, the members are busy for {lanes['busy'][most]:.0%} of it."
        )
    return text


def write_index(folder: Path) -> Path:
    """Write the page of the pages in a folder beside them; returns its path."""
    write_whole(folder / NAME, text(folder).encode())
    return folder / NAME


def text(folder: Path) -> str:
    """The page, from the pages in a folder."""
    results = pages(folder)
    rows = []
    for name, result in results.items():
        for head in result.get("headline", []):
            rows.append([head["what"], *in_words(head), f"[{name}]({name}.md)"])
    missed = sum("missed" in row[3] for row in rows)
    machines = dict.fromkeys(named(result["machine"]) for result in results.values())
    lines = [
        "# Error against run time",
        "",
        f"Of {len(rows)} ratios and bounds to hold, {len(rows) - missed} are held and {missed} are"
        f" missed. Written by `python -m benchmarks` on {' and on '.join(machines)}; absolute"
        " times mean little elsewhere, ratios are between methods that took turns in one run.",
        "",
        "## Ratios to hold",
        "",
        *table(["what", "measured", "wanted", "", "page"], rows),
        "",
        "## What to take",
        "",
    ]
    for name in results:
        title, first = opening((folder / f"{name}.md").read_text())
        lines += [f"- [{title}]({name}.md). {first}"]
    lines += ["", "## On an accelerator", "", accelerator(results), ""]
    return "\n".join(lines)
