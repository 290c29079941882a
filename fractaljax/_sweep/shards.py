"""The batches of a sweep as files of a folder, so that an interrupted sweep resumes.

Every batch is a .npz file whose ZIP comment is the SHA-256 of the sweep, the number of the batch
and its content: a damaged or misplaced file is not read. (Zarr would be one more dependency, and
has a checksum for each chunk but none that ties it to a program.)
"""

import hashlib
import io
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._base.files import left_behind, write_whole
from .._base.versions import versions, versions_differ
from .._mechanism.scene import Scene
from .program import Program, array_digest

_ABOUT = "sweep.json"
_VERSIONS = "versions"  # those that wrote the folder
_MEANINGS = {
    "key": "measure or scene",
    "axes": "axes",
    "batch": "batch size",
    "arrays": "arrays of the measure",
}
_COMMENT = 2 + 64  # bytes: its length, and a SHA-256


class Shards:
    """The folder of one sweep: sweep.json describes it, 00000000.npz and so on are its batches.

    Every file is written whole or not at all.
    """

    def __init__(self, path: str | os.PathLike, about: Mapping[str, Any]):
        """Make the folder of the sweep that `about` describes, or resume it.

        Warns of a folder that other versions have written.

        **Raises:** `ValueError` for the folder of another sweep, or with other files in it.
        """
        self._folder = Path(path)
        self._folder.mkdir(parents=True, exist_ok=True)
        self._sweep = json.dumps(about, sort_keys=True).encode()
        file = self._folder / _ABOUT
        # Another process of the same sweep may write the file between these two checks.
        if not file.exists():
            # A process killed while it wrote the file leaves a part of it under another name.
            others = [f for f in self._folder.iterdir() if not left_behind(file, f)]
            if others and not file.exists():
                raise ValueError(f"out must be an empty folder or that of this sweep, got {path}")
            write_whole(file, json.dumps({**about, _VERSIONS: versions()}).encode())
        found = describe(path) or {}
        others = versions_differ(found.get(_VERSIONS, {}))
        # Compared as texts, since 0.0 and -0.0 are two values of an axis.
        differs = [
            meaning
            for key, meaning in _MEANINGS.items()
            if json.dumps(found.get(key)) != json.dumps(about[key])
        ]
        if differs:
            began = others if _VERSIONS in found else "begun by an older fractaljax"
            note = f" (it was {began})" if began else ""
            raise ValueError(f"out {path} holds another sweep: {', '.join(differs)} differ{note}")
        if others:
            warnings.warn(f"out {path} was {others}: digits may differ", stacklevel=3)

    def has(self, k: int) -> bool:
        """Whether batch k is there."""
        return self._file(k).exists()

    def write(self, k: int, arrays: Sequence[np.ndarray]) -> None:
        """Keep the arrays of batch k."""
        content = io.BytesIO()
        np.savez(content, *arrays)
        held = content.getvalue()[:-2]  # a ZIP file ends with the length of its comment, here 0
        # Waiting for the disk takes longer than most batches, and the comment reveals damage.
        write_whole(self._file(k), held + self._comment(k, held), durable=False)

    def read(self, k: int) -> list[np.ndarray]:
        """The arrays of batch k. **Raises:** `ValueError` naming a file that is damaged."""
        try:
            content = self._file(k).read_bytes()
            held, comment = content[:-_COMMENT], content[-_COMMENT:]
            if comment != self._comment(k, held):
                raise ValueError("it is damaged, or no batch of this sweep")
            with np.load(io.BytesIO(content)) as found:
                return [found[name] for name in found.files]
        except (OSError, ValueError) as error:
            raise ValueError(
                f"{self._file(k)} cannot be read, remove it and sweep again: {error}"
            ) from None

    def _comment(self, k: int, held: bytes) -> bytes:
        digest = hashlib.sha256(self._sweep + b"%d" % k + held).hexdigest()
        return len(digest).to_bytes(2, "little") + digest.encode()

    def _file(self, k: int) -> Path:
        return self._folder / f"{k:08d}.npz"


def describe(path: str | os.PathLike) -> dict[str, Any] | None:
    """The content of sweep.json in a folder, or None where there is none.

    **Raises:** `ValueError` for a file that does not describe a sweep.
    """
    file = Path(path) / _ABOUT
    if not file.exists():
        return None
    try:
        found = json.loads(file.read_bytes())
        if not isinstance(found, dict) or set(found) - {_VERSIONS} != set(_MEANINGS):
            raise ValueError("other keys than those of a sweep")
        if not isinstance(found.get(_VERSIONS, {}), dict):
            raise ValueError("its versions are no mapping")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} does not describe a sweep: {error}") from None
    return found


def description(
    program: Program, scene: Scene, axes: Mapping[str, np.ndarray], batch: int
) -> dict[str, Any]:
    """The content of sweep.json: equal for equal sweeps on any number of devices.

    **Raises:** `ValueError` for a measure that calls what is not in its program.
    """
    content = hashlib.sha256(program.key())
    for array in jax.tree.leaves(scene):
        content.update(array_digest(array))
    leaves = jax.tree_util.tree_leaves_with_path(program.shapes)
    return {
        "key": content.hexdigest(),
        "axes": {name: values.tolist() for name, values in axes.items()},
        "batch": batch,
        "arrays": [jax.tree_util.keystr(place) for place, _ in leaves],
    }
