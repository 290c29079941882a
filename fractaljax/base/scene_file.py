"""Parts as TOML tables: every number beside its unit and meaning, every key accounted for."""

import contextlib
import dataclasses
import errno
import inspect
import os
import secrets
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from .parts import Part

_DEEPEST = 20  # tables and arrays within each other; a scene has 3
_TOO_DEEP = "not a file of fractaljax: its tables or arrays are nested too deeply"

type_table = Mapping[str, Mapping[str, type[Part]]]


def render(whole: Part, laws: type_table) -> str:
    """The TOML text of the parts of `whole`; `laws` names the kinds each of them can be of."""
    lines = ["# A fractaljax scene, in SI units.", *tables_of(whole, laws)]
    return "\n".join(lines) + "\n"


def tables_of(whole: Part, laws: type_table, inside: str = "") -> list[str]:
    """The lines of `render`, each table named below the table `inside` ("joints.left.", say)."""
    lines = []
    for key, kinds in laws.items():
        part, name = getattr(whole, key), f"{inside}{key}"
        lines += ["", f"[{name}]"]
        if len(kinds) > 1:
            law = next(law for law, kind in kinds.items() if kind is type(part))
            others = ", ".join(f'"{other}"' for other in kinds if other != law)
            lines.append(f'law = "{law}"  # or {others}')
        lines += _rows(name, part)
    return lines


def _rows(name: str, part: Part) -> list[str]:
    rows, tables = [], []
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if isinstance(value, Part):
            tables += ["", f"[{name}.{field.name}]", *_rows(f"{name}.{field.name}", value)]
            continue
        note = f"# {field.metadata['unit']}: {field.metadata['meaning']}"
        rows.append(
            f"# {field.name} =  {note}"
            if value is None
            else f"{field.name} = {float(value)!r}  {note}"
        )
    return rows + tables


def parse(content: bytes, laws: type_table) -> dict[str, Part]:
    """The parts written in a TOML file with this content, by name.

    **Raises:** `ValueError` or `TypeError` naming the table and the key that is unknown, missing
    or outside its domain, or the place where the file is no TOML.
    """
    document = read(content)
    refuse_unknown("the file", document, laws)
    return parts_of(document, laws)


def read(content: bytes) -> dict[str, Any]:
    """The tables of a TOML file with this content.

    **Raises:** `ValueError` with the place where it is no TOML.
    """
    try:
        document = tomllib.loads(content.decode())
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except UnicodeDecodeError as error:
        raise ValueError(f"not a text in UTF-8: {error.reason} at byte {error.start}") from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not a TOML file: {error}") from None
    level: list[Any] = [document]
    for _ in range(_DEEPEST):
        inside = (list(x.values()) if isinstance(x, dict) else x for x in level)
        level = [x for values in inside for x in values if isinstance(x, (dict, list))]
    if level:
        raise ValueError(_TOO_DEEP)
    return document


def read_bounded(path: str | os.PathLike, most: int = 10_000_000) -> bytes:
    """The content of a file, or of a pipe, of no more than `most` bytes.

    **Raises:** `OSError` if it cannot be read; `ValueError` if there is more: /dev/zero has no end.
    """
    with open(path, "rb") as file:
        content = file.read(most + 1) if os.fstat(file.fileno()).st_size <= most else None
    if content is None or len(content) > most:
        raise ValueError(f"the file is larger than {most / 1e6:g} MB, as large as it may be")
    return content


def parts_of(document: dict[str, Any], laws: type_table, inside: str = "") -> dict[str, Part]:
    """The parts in the tables `document`, which lie below the table `inside` of the file."""
    return {
        key: _part(f"{inside}{key}", table_of(document, key, inside), kinds)
        for key, kinds in laws.items()
    }


def _part(name: str, table: dict[str, Any], kinds: Mapping[str, type[Part]]) -> Part:
    if len(kinds) == 1:
        return _build(name, table, *kinds.values())
    law = table.pop("law", None)
    if not isinstance(law, str) or law not in kinds:
        choices = " or ".join(f'"{kind}"' for kind in kinds)
        got = "nothing" if law is None else repr(law)
        raise ValueError(f"[{name}] law must be {choices}, got {got}")
    return _build(name, table, kinds[law])


def _build(name: str, table: dict[str, Any], kind: type[Part]) -> Part:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    refuse_unknown(f"[{name}]", table, fields)
    optional = inspect.signature(kind.__init__).parameters
    arguments = {}
    for key, field in fields.items():
        if not field.metadata:  # a part of its own, in a table of its own
            inner = cast(type[Part], field.type)
            arguments[key] = _build(f"{name}.{key}", table_of(table, key, f"{name}."), inner)
        elif key in table:
            arguments[key] = table[key]
        elif optional[key].default is inspect.Parameter.empty:
            raise ValueError(f"[{name}] lacks the key {key!r}")
    try:
        return kind(**arguments)
    except (ValueError, TypeError) as error:
        raise type(error)(f"[{name}] {error}") from None


def table_of(document: dict[str, Any], key: str, inside: str = "") -> dict[str, Any]:
    """The table `key` of `document`, which lies below the table `inside` of the file."""
    if key not in document:
        raise ValueError(f"the table [{inside}{key}] is missing")
    if not isinstance(document[key], dict):
        raise ValueError(f"[{inside}{key}] must be a table, got {document[key]!r}")
    return document[key]


def refuse_unknown(where: str, given, known) -> None:
    """Refuse a key in `given` that is not in `known`; `where` says what has it."""
    for key in given:
        if key not in known:
            raise ValueError(f"{where} has the unknown key {key!r}; known are {', '.join(known)}")


def quoted(text: str) -> str:
    """A text as a basic string of TOML."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'


def _temporary(target: Path) -> str:
    return f".{target.name}-"


def left_behind(target: Path, file: Path) -> bool:
    """Whether `file` is the start of `target` that a killed `write_whole` left."""
    return file.name.startswith(_temporary(target))


def write_whole(path: str | os.PathLike, content: bytes, *, durable: bool = True) -> None:
    """Write a file through a temporary neighbour, so that it is there whole or not at all.

    A file that is not `durable` may be lost or damaged by a power cut shortly afterwards.

    **Raises:** `OSError` naming the file.
    """
    write_together({path: content}, durable=durable)


def write_together(files: Mapping[Any, bytes], *, durable: bool = True) -> list[Path]:
    """Write files {path: content} that belong together; returns the paths of those replaced.

    All are written and on the disk before the first takes its place, and on an error all are as
    before. A process killed meanwhile may leave some of them missing (moved, under hidden names),
    but never new files beside old ones. They take their places in the order given.

    **Raises:** `OSError` naming the file.
    """
    # A link stays one: what it leads to is written.
    targets = {Path(path): Path(os.path.realpath(path)) for path in files}
    replaced = [path for path, target in targets.items() if target.exists()]
    for path in replaced:
        if not path.is_file():  # a folder, or a device that would become a file
            raise FileExistsError(errno.EEXIST, "not a regular file", str(path))
    new, moves, old = {}, [], []

    def move(start, end):
        moves.append((start, end))  # before it happens: a signal may come in between
        os.replace(start, end)

    try:
        for (path, target), content in zip(targets.items(), files.values(), strict=True):
            new[target] = _neighbour(target)
            _write(new[target], content, path, durable)
        if len(new) == 1:
            for target, file in new.items():
                os.replace(file, target)
        else:
            for path in reversed(replaced):
                move(targets[path], _neighbour(targets[path]))
            old = [end for _, end in moves]
            for target, file in new.items():
                move(file, target)
    except BaseException:
        for start, end in reversed(moves):
            with contextlib.suppress(OSError):  # the last one may not have happened
                os.replace(end, start)
        for file in new.values():
            with contextlib.suppress(OSError):
                file.unlink()
        raise
    for file in old:
        with contextlib.suppress(OSError):
            file.unlink()
    if durable:
        for folder in {target.parent for target in new}:
            _sync(folder)
    return replaced


def _neighbour(target: Path) -> Path:
    return target.with_name(f"{_temporary(target)}{secrets.token_hex(4)}")


def _write(file: Path, content: bytes, name: Path, durable: bool) -> None:
    """Write a new file, where `durable` through to the disk; an error tells `name`."""
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
    """Bring the names in a folder through to the disk, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
