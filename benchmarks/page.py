"""A benchmark's page: its numbers, its tables and its picture, side by side in a folder."""

import importlib.metadata
import io
import json
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fractaljax.base.scene_file import write_whole


def versions(*packages: str) -> dict[str, str]:
    """The versions of Python and of those packages that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = [headings, ["---"] * len(headings), *rows]
    return [f"| {' | '.join(line)} |" for line in lines]


def cell(value: Any, form: str) -> str:
    """A number as a table shows it, or a dash."""
    return "-" if value is None else format(value, form)


def spread(errors: Any) -> dict[str, float]:
    """Median and worst."""
    return {"median": float(np.median(errors)), "worst": float(np.max(errors))}


def held(head: dict[str, Any]) -> bool:
    """Whether a number of a page's headline is as wanted: at least, or within two bounds."""
    if "ratio" in head:
        return head["ratio"] >= head["wanted"]
    low, high = head["wanted"]
    return low <= head["value"] <= high


def verdict(head: dict[str, Any]) -> str:
    """The same in a word."""
    return "held" if held(head) else "**missed**"


def in_words(head: dict[str, Any]) -> list[str]:
    """What was measured, what was wanted, and the verdict."""
    if "ratio" in head:
        found, wanted = f"{head['ratio']:.3g} times", f"at least {head['wanted']:g} times"
    else:
        low, high = head["wanted"]
        found, wanted = f"{head['value']:.3g}", f"{low:g} to {high:g}"
    return [found, wanted, verdict(head)]


def subplots(*shape: int, **options: Any) -> tuple[Any, Any]:
    """A figure and its axes, as pyplot makes them, drawn without a screen."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(*shape, layout="constrained", **options)


def png(figure: Any, dpi: int) -> bytes:
    """A figure of pyplot's as a file's content; the figure is closed."""
    from matplotlib import pyplot

    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    pyplot.close(figure)
    return content.getvalue()


def write(out: Path, name: str, result: dict[str, Any], table: str, picture: bytes) -> list[Path]:
    """Write `name`.json, .md and .png into a folder; returns their paths."""
    files = {
        f"{name}.json": (json.dumps(result, indent=1) + "\n").encode(),
        f"{name}.md": table.encode(),
        f"{name}.png": picture,
    }
    out.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        write_whole(out / file, content)
    return [out / file for file in files]
