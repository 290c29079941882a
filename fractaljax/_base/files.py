"""Bounded reading and atomic writing of files."""

import contextlib
import errno
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def read_bounded(path: str | os.PathLike, most: int = 10_000_000) -> bytes:
    """The content of a file, or of a pipe, of at most `most` bytes.

    **Raises:** `OSError` if it cannot be read; `ValueError` if it is larger: /dev/zero never ends.
    """
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size  # 0 for a pipe
        content = file.read(size + 1) if size <= most else None
        if content is not None and len(content) > size:
            content += file.read(most + 1 - len(content))  # allocates as much at once
    if content is None or len(content) > most:
        raise ValueError(f"the file is larger than {most / 1e6:g} MB, the most that is read")
    return content


def write_whole(path: str | os.PathLike, content: bytes, *, durable: bool = True) -> None:
    """Write a file atomically, through a temporary file beside it.

    A file that is not `durable` may be lost or damaged by a power cut shortly afterwards.

    **Raises:** `OSError` naming the file.
    """
    write_together({path: content}, durable=durable)


def write_together(files: Mapping[Any, bytes], *, durable: bool = True) -> list[Path]:
    """Write files {path: content} that belong together; return the paths that were replaced.

    All are on the disk before the first is moved into place, in order, and an error restores all
    of them. A process killed meanwhile may leave some missing (under hidden names), but never new
    files beside old ones.

    **Raises:** `OSError` naming the file.
    """
    # A link stays a link: its target is written.
    targets = {Path(path): Path(os.path.realpath(path)) for path in files}
    replaced = [path for path, target in targets.items() if target.exists()]
    for path in replaced:
        if not path.is_file():  # a folder, or a device that would become a file
            raise FileExistsError(errno.EEXIST, "not a regular file", str(path))
    new: dict[Path, Path] = {}
    old: list[Path] = []
    with contextlib.ExitStack() as undo:
        for (path, target), content in zip(targets.items(), files.values(), strict=True):
            new[target] = _neighbour(target)
            undo.callback(_unlink, new[target])
            _write(new[target], content, path, durable)
        if len(new) > 1:
            for path in reversed(replaced):
                old.append(_neighbour(targets[path]))
                _move(targets[path], old[-1], undo)
        for target, file in new.items():
            if len(new) > 1:
                _move(file, target, undo)
            else:
                os.replace(file, target)
        undo.pop_all()
    for file in old:
        _unlink(file)
    if durable:
        for folder in {target.parent for target in new}:
            _sync(folder)
    return replaced


def _neighbour(target: Path) -> Path:
    return target.with_name(f".{target.name}-{secrets.token_hex(4)}")


def _move(start: Path, end: Path, undo: contextlib.ExitStack) -> None:
    undo.callback(_move_back, start, end)  # before the move: a signal may come in between
    os.replace(start, end)


def _move_back(start: Path, end: Path) -> None:
    with contextlib.suppress(OSError):  # the move may not have happened
        os.replace(end, start)


def _unlink(file: Path) -> None:
    with contextlib.suppress(OSError):
        file.unlink()


def _write(file: Path, content: bytes, name: Path, durable: bool) -> None:
    """Write a new file, through to the disk where `durable`; an error names the file `name`."""
    try:
        with open(file, "xb") as stream:
            stream.write(content)
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
    except OSError as error:
        error.filename = str(name)
        raise


def _sync(folder: Path) -> None:
    """Write the names in a folder through to the disk, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
