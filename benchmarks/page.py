"""A benchmark's page: its numbers, its table and its picture, side by side in a folder."""

import json
from pathlib import Path
from typing import Any

from fractaljax.scene_file import write_whole


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
