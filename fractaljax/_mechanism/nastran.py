"""Matrices of Nastran: OUTPUT4 files, in binary or text, and DMIG cards.

pyNastran cannot serve: its releases up to 1.4.1 require NumPy below 2.
"""

import re
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from .matrix_entries import assemble, check_size, fixed_fields, label_dofs
from .matrix_market import REAL, as_floats, wrong_line

# A first record of 24 bytes has words of 4 bytes, and one of 48 bytes has words of 8.
_WORDS = {struct.pack(f"{order}i", 6 * wide): f"{order}{wide}" for order in "<>" for wide in (4, 8)}
_OP4_FORMAT = re.compile(r"(?:1P,?)?(\d+)[ED](\d+)\.\d+(?:E\d+)?(?:\|I16)?")
_Column = tuple[int, int, np.ndarray]  # number and first row, both from 1, and values


def read_op4(content: bytes, largest: int) -> dict[str, Any]:
    """The sparse matrices of an OUTPUT4 file by their names.

    Such a file holds symmetric matrices in full. A matrix that is too large or damaged is returned
    as a `ValueError`.

    **Raises:** `ValueError` with the line or the matrix that is wrong.
    """
    word = _WORDS.get(content[:4])
    matrices: dict[str, Any] = {}
    for name, shape, kind, columns in _binary(content, word) if word else _text(content):
        if name in matrices:
            raise ValueError(f"it gives {name} twice")
        unfit = _unfit(name, shape, kind, largest)
        try:
            pieces = [_numbers(name, piece) if kind > 2 else piece for piece in columns]
            matrices[name] = unfit or _assemble_columns(name, shape, pieces, largest)
        except ValueError as error:  # the rest of the file cannot be located
            raise (unfit or error) from None
    return matrices


def _unfit(name: str, shape: tuple[int, int], kind: int, largest: int) -> ValueError | None:
    """The reason why a matrix cannot be read, from its first record."""
    try:
        if kind not in (1, 2, 3, 4):
            raise ValueError(f"{name} must be real numbers, got type {kind}, of 1 to 4")
        check_size(name, shape, largest)
    except ValueError as error:
        return error
    return None


def _numbers(name: str, piece: _Column) -> _Column:
    """A part of a column of complex numbers, from their real and imaginary parts in turn."""
    number, first, parts = piece
    if len(parts) % 2:
        raise ValueError(f"{name} is damaged: a complex number has no imaginary part")
    return number, first, parts[::2] + 1j * parts[1::2]


def _assemble_columns(
    name: str, shape: tuple[int, int], pieces: list[_Column], largest: int
) -> Any:
    """The sparse matrix from its columns, or the `ValueError` that it is damaged."""
    number, first = (np.array([piece[k] for piece in pieces], int) for k in (0, 1))
    length = np.array([len(piece[2]) for piece in pieces], int)
    begun = np.cumsum(length) - length
    i = np.repeat(first - 1 - begun, length) + np.arange(length.sum())
    values = np.concatenate([np.empty(0), *(piece[2] for piece in pieces)])
    if i.size and (number.min() < 1 or i.min() < 0 or i.max() >= shape[0]):
        return ValueError(f"{name} is damaged: an entry lies outside {shape[0]} x {shape[1]}")
    try:
        return assemble(name, shape, i, np.repeat(number - 1, length), values, largest)
    except ValueError as error:
        return error


def _binary(content: bytes, word: str) -> Iterator[tuple[str, tuple[int, int], int, Any]]:
    """Name, shape, type and columns of each matrix, in Fortran's unformatted records."""
    wide, sign = int(word[1]), word[0]
    records = _records(content, "little" if sign == "<" else "big")
    for record in records:
        if len(record) != 6 * wide:
            raise ValueError("it is damaged: a matrix was to begin")
        columns, rows, _, kind = np.frombuffer(record, f"{sign}i{wide}", 4).tolist()
        name = _name(record[4 * wide :])
        real = f"{sign}f{8 if kind in (2, 4) else wide}"
        yield (
            name,
            (abs(rows), columns),
            kind,
            _binary_columns(records, columns, rows < 0, real, word),
        )


def _binary_columns(records, columns: int, big: bool, real: str, word: str) -> Iterator[_Column]:
    wide = int(word[1])
    damaged = ValueError("it is damaged: a column has another length than it says")
    for record in records:
        words = np.frombuffer(record, f"{word[0]}u{wide}", len(record) // wide)
        if len(words) > 3 and words[0] > columns:
            return  # the end mark, of any length
        if len(words) < 3 or len(record) != (3 + int(words[2])) * wide:
            raise damaged
        column, row, end = int(words[0]), int(words[1]), len(words)
        at = 3
        while at < end:
            first, length = row, end - at
            if not row:  # a string of a sparse column
                if big and at + 2 > end:
                    raise damaged
                length, first = map(int, words[at : at + 2] if big else divmod(words[at], 2**16))
                length, at = length - 1, at + 1 + big
            size = length * wide
            if length < 1 or at + length > end or size % int(real[2]):
                raise damaged
            yield column, first, np.frombuffer(record, real, size // int(real[2]), at * wide)
            at += length
    raise ValueError("it ends within a matrix")


def _records(content: bytes, order: Any) -> Iterator[bytes]:
    place = 0
    while place < len(content):
        mark = content[place : place + 4]
        end = place + 4 + int.from_bytes(mark, order)
        if content[end : end + 4] != mark:
            raise ValueError(f"it is damaged: no record at byte {place}")
        yield content[place + 4 : end]
        place = end + 4


def _text(content: bytes) -> Iterator[tuple[str, tuple[int, int], int, Any]]:
    """Name, shape, type and columns of each matrix, in text."""
    lines, at = content.rstrip().split(b"\n"), [0]
    while at[0] < len(lines):
        line = lines[at[0]].decode("ascii", "replace").rstrip()
        wide = 16 if line.endswith("|I16") else 8
        head = [line[:wide], line[wide : 2 * wide]]
        head += [line[k : k + 8] for k in range(2 * wide, 2 * wide + 16, 8)]
        layout = _OP4_FORMAT.fullmatch(line[2 * wide + 24 :].strip() or "5E16.9")
        if not layout or not all(re.fullmatch(" *-?[0-9]+ *", x) for x in head):
            raise wrong_line(at[0] + 1, lines[at[0]], "must begin a matrix of an OUTPUT4 file")
        columns, rows, _, kind = map(int, head)
        at[0] += 1
        pieces = _text_columns(lines, at, columns, rows < 0, kind, (int(layout[1]), int(layout[2])))
        name = _name(line[2 * wide + 16 : 2 * wide + 24].encode())
        yield name, (abs(rows), columns), kind, pieces


def _text_columns(
    lines: list[bytes], at: list[int], columns: int, big: bool, kind: int, layout: tuple[int, int]
) -> Iterator[_Column]:
    per_number = 2 if kind in (2, 4) else 1  # words

    def whole(count: int) -> list[int]:
        """The `count` integers in the next line."""
        if at[0] >= len(lines):
            raise ValueError("it ends within a matrix")
        fields, at[0] = lines[at[0]].split(), at[0] + 1
        if len(fields) != count or not all(re.fullmatch(rb"\d{1,15}", x) for x in fields):
            raise wrong_line(at[0], lines[at[0] - 1], f"must have {count} whole numbers")
        return [int(x) for x in fields]

    while True:
        column, row, words = whole(3)
        if column > columns:
            at[0] += 1  # skip the number of the end mark
            return
        while words:
            first, length = row, words  # in a dense column, numbers rather than words
            if not row:
                length, first = whole(2) if big else divmod(whole(1)[0], 2**16)
                words -= length + big
                length, rest = divmod(length - 1, per_number)
                if length < 1 or rest or words < 0:
                    raise wrong_line(at[0], lines[at[0] - 1], "must begin a string of its column")
            values, at[0] = fixed_fields(lines, at[0], length, layout)
            yield column, first, values
            words = words if not row else 0


def _name(text: bytes) -> str:
    name = text.decode("ascii", "replace").strip()
    if not name.isascii() or not name.isprintable() or not name:
        raise ValueError(f"it is damaged: a matrix has the name {name!r}")
    return name


def read_dmig(content: bytes, largest: int):
    """The sparse matrices in DMIG cards by their names, and the names of the degrees of freedom.

    Other cards are ignored. All matrices share the degrees of freedom that occur in any of them; a
    scalar point has component 0, and a rectangular matrix keeps its own columns. A complex number
    is its real and imaginary part, or amplitude and phase in degrees where the first card says so.

    **Raises:** `ValueError` with the line that is wrong.
    """
    # By name: the form, the columns of form 9, and how numbers are written.
    heads: dict[str, tuple[int, int, str]] = {}
    entries: dict[str, list[tuple[int, int, int, int, str, str]]] = {}
    for number, line, fields in _cards(content):
        name, point, *rest = fields
        try:
            if point == "0":
                form, kind = int(rest[0]), int(rest[1])
                if form not in (1, 2, 6, 9) or kind not in (1, 2, 3, 4) or name in heads:
                    what = "must have a form of 1, 2, 6 and 9, a type of 1 to 4, and a new name"
                    raise wrong_line(number, line, what)
                polar = int(rest[3] or 0) > 0
                written = "real" if kind < 3 else "polar" if polar else "complex"
                heads[name] = form, int(rest[5] or 0), written
                continue
            column = int(point), int(rest[0] or 0)
            for k in range(2, len(rest), 4):
                node, dof, value, imaginary = rest[k : k + 4]
                if node:
                    is_complex = name in heads and heads[name][2] != "real"
                    second = (imaginary or "0") if is_complex else "0"
                    good = all(re.fullmatch(REAL.decode(), x, re.ASCII) for x in (value, second))
                    if not good or (imaginary and not is_complex):
                        raise ValueError
                    row = int(node), int(dof or 0)
                    entries.setdefault(name, []).append((*row, *column, value, second))
                elif dof or value or imaginary:
                    raise ValueError
        except (ValueError, IndexError) as error:
            if str(error).startswith("line"):
                raise
            raise wrong_line(number, line, "begins a DMIG card that cannot be read") from None
    if not heads:
        raise ValueError("it holds no DMIG card that begins a matrix")
    if not set(entries) <= set(heads):
        raise ValueError(f"no DMIG card begins {', '.join(sorted(set(entries) - set(heads)))}")
    return _dmig_matrices(heads, entries, largest)


def _dmig_matrices(heads, entries, largest):
    index, values = {}, {}
    for name in heads:
        rows = entries.get(name, [])
        index[name] = np.array([row[:4] for row in rows], np.int64).reshape(-1, 4).T
        values[name], more = (as_floats(" ".join(row[k] for row in rows).encode()) for k in (4, 5))
        if heads[name][2] == "complex":
            values[name] = values[name] + 1j * more
        elif heads[name][2] == "polar":
            values[name] = values[name] * np.exp(1j * np.deg2rad(more))
        if (index[name] < 0).any() or not np.isfinite(values[name]).all():
            raise ValueError(f"{name} must have finite numbers at points from 1 on")
    square = [index[name] for name, (form, *_) in heads.items() if form in (1, 6)]
    both = [*(x[:2] for x in index.values()), *(x[2:] for x in square)]
    place, names = label_dofs(*np.concatenate(both, axis=1))
    begun = 0
    rows = {}
    for name in heads:
        rows[name] = place[begun : (begun := begun + index[name].shape[1])]
    matrices = {}
    for name, (form, columns, _) in heads.items():
        i, width = rows[name], len(names)
        if form in (1, 6):
            j = place[begun : (begun := begun + len(i))]
        else:
            j, column_names = label_dofs(*index[name][2:])
            width = columns if form == 9 and columns else len(column_names)
            if len(column_names) > width:
                raise ValueError(
                    f"{name} has {len(column_names)} columns, {width} by its first card"
                )
        shape, mirror = (len(names), width), int(form == 6)
        matrices[name] = assemble(name, shape, i, j, values[name], largest, mirror)
    return matrices, names


def _cards(content: bytes) -> Iterator[tuple[int, bytes, list[str]]]:
    """The line number, the first line and the fields from the second on of each DMIG card."""
    card = None
    for number, line in enumerate(content.split(b"\n"), 1):
        text = line.decode("latin-1").split("$")[0].expandtabs(8).rstrip()
        if not text:
            continue
        if "," in text:
            first, *fields = (x.strip() for x in text.split(","))
            count = 4 if "*" in first else 8
            fields = fields[:count]
        else:
            first = text[:8].strip()
            count, wide = (4, 16) if "*" in first else (8, 8)
            fields = [text[k : k + wide].strip() for k in range(8, 8 + count * wide, wide)]
        fields += [""] * (count - len(fields))
        if first[:1] in ("", "+", "*"):
            if card:
                card[2].extend(fields)
            continue
        if card:
            yield card
        card = (number, line, fields) if first.upper().rstrip("*") == "DMIG" else None
    if card:
        yield card
