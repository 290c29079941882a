"""A benchmark's page: its numbers, its table and its picture, side by side in a folder."""

import io
import json
from pathlib import Path
from typing import Any

from fractaljax.base.scene_file import write_whole


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
