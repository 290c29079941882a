"""What the scripts that write the pages and pictures of this folder share."""

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import jax
from matplotlib.figure import Figure

from fractaljax._base.files import write_whole


def run(contents: Mapping[Path, Callable[[], bytes]]) -> None:
    """Write the files, each whole or not at all, computed in float64."""
    jax.config.update("jax_enable_x64", True)
    for path, content in contents.items():
        write_whole(path, content())


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    rule = "|---" * len(head) + "|"
    return [f"| {' | '.join(head)} |", rule, *(f"| {' | '.join(row)} |" for row in rows)]


def png(figure: Figure, dpi: float = 110) -> bytes:
    """A picture as it is."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def small_png(figure: Figure) -> bytes:
    """A picture of few colours, a third of the size."""
    from PIL import Image

    reduced = io.BytesIO()
    image = Image.open(io.BytesIO(png(figure, dpi=85))).convert("RGB")
    image.quantize(128).save(reduced, format="png", optimize=True)
    return reduced.getvalue()
