"""A sweep's batches as files of a folder, so that an interrupted sweep can be gone on with."""

import hashlib
import io
import json
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..base.scene_file import left_behind, write_whole

_ABOUT = "sweep.json"
_MEANINGS = {
    "key": "measure or scene",
    "axes": "axes",
    "batch": "batch size",
    "arrays": "arrays of the measure",
}


class Shards:
    """The folder of one sweep: sweep.json says of which, 00000000.npz and so on are its batches.

    Every file is there whole or not at all.
    """

    def __init__(self, path: str | os.PathLike, about: Mapping[str, Any]):
        """Make the folder of the sweep that `about` describes, or go on with it.

        **Raises:** `ValueError` for the folder of another sweep, or with other files in it.
        """
        self._folder = Path(path)
        self._folder.mkdir(parents=True, exist_ok=True)
        file = self._folder / _ABOUT
        # Another process of the same sweep may write the file between two of these questions.
        if not file.exists():
            # A process killed while it wrote the file leaves the start of it under another name.
            others = [f for f in self._folder.iterdir() if not left_behind(file, f)]
            if others and not file.exists():
                raise ValueError(f"out must be an empty folder or that of this sweep, got {path}")
            write_whole(file, json.dumps(about).encode())
        found = describe(path) or {}
        differs = [meaning for key, meaning in _MEANINGS.items() if found.get(key) != about[key]]
        if differs:
            raise ValueError(f"out {path} holds another sweep: {', '.join(differs)} differ")

    def has(self, k: int) -> bool:
        """Whether batch k is there."""
        return self._file(k).exists()

    def write(self, k: int, arrays: Sequence[np.ndarray]) -> None:
        """Keep the arrays of batch k."""
        content = io.BytesIO()
        np.savez(content, *arrays)
        write_whole(self._file(k), content.getvalue())

    def read(self, k: int) -> list[np.ndarray]:
        """The arrays of batch k. **Raises:** `ValueError` naming a file that is damaged."""
        try:
            # Read at once: NumPy leaves a damaged file open.
            with np.load(io.BytesIO(self._file(k).read_bytes())) as found:
                return [found[name] for name in found.files]
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{self._file(k)} cannot be read, remove it and sweep again: {error}"
            ) from None

    def _file(self, k: int) -> Path:
        return self._folder / f"{k:08d}.npz"


def describe(path: str | os.PathLike) -> dict[str, Any] | None:
    """What the folder of a sweep says of it, or None where there is no such folder.

    **Raises:** `ValueError` for a sweep.json that is none.
    """
    file = Path(path) / _ABOUT
    if not file.exists():
        return None
    try:
        found = json.loads(file.read_bytes())
        if not isinstance(found, dict) or set(found) != set(_MEANINGS):
            raise ValueError("other keys than those of a sweep")
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} does not describe a sweep: {error}") from None
    return found


def description(measure, scene, axes: Mapping[str, np.ndarray], batch: int) -> dict[str, Any]:
    """What sweep.json says of a sweep: equal for equal sweeps on any number of devices."""
    traced = jax.make_jaxpr(measure, return_shape=True)(scene)
    program, shapes = traced
    text = re.sub(r" at 0x[0-9a-f]+", "", str(program))  # where functions lie in memory
    content = hashlib.sha256(text.encode())
    for array in [*program.consts, *jax.tree.leaves(scene)]:
        content.update(np.asarray(array).tobytes())
    return {
        "key": content.hexdigest(),
        "axes": {name: values.tolist() for name, values in axes.items()},
        "batch": batch,
        "arrays": [
            jax.tree_util.keystr(place) for place, _ in jax.tree_util.tree_leaves_with_path(shapes)
        ],
    }
