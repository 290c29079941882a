"""Matrix Market files (Boisvert, Pozo and Remington, NISTIR 5935, 1996), read strictly.

`scipy.io.mmread` cannot serve: it reads 1.0D6 as 1.0 and 1500,75 as 1500, adds up entries that
are given twice, and crashes on some damaged files (SciPy 1.17).
"""

import re
from typing import Any, BinaryIO

import numpy as np

BANNER = b"%%MatrixMarket"
_HEADER = re.compile(rb"([^\n]*)\n((?:[^\S\n]*(?:%[^\n]*)?\n)*+)([^\n]*)\n?")
_WORDS = {
    "object": ("matrix",),
    "format": ("coordinate", "array"),
    "field": ("real", "double", "integer", "complex"),
    "symmetry": ("general", "symmetric", "skew-symmetric", "hermitian"),
}
# Numbers of C and Fortran: 1, -1.5, .5, 1e6, 1.0D+06, and 1.0+100 in narrow fields.
REAL = rb"[+-]?(?:\d++\.?\d*+|\.\d++)(?:[eEdDqQ][+-]?\d++|[+-]\d++)?"
WHOLE = rb"[+-]?\d++"


def read_matrix_market(file: BinaryIO, largest: int) -> np.ndarray:
    """The matrix (rows, columns) of an open file, complex only if a number has an imaginary part.

    It has at most `largest` rows and columns, checked before memory is allocated.

    **Raises:** `ValueError`, to be put after the file name, with the line that is wrong.
    """
    shape, i, j, values = read_entries(file, largest, 32 * largest**2)
    matrix = np.zeros(shape, values.dtype)
    matrix[i, j] = values
    return matrix


def read_entries(
    file: BinaryIO, largest: int, most: int
) -> tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]:
    """The shape, the rows and columns from 0, and the values of the entries of an open file.

    As `read_matrix_market`, for at most `most` bytes. Both triangles of a symmetric matrix are
    returned, and no entry twice.
    """
    start = file.read(len(BANNER))  # only this much: /dev/zero never ends
    text = file.read(most + 1) if start.lower() == BANNER.lower() else b""
    if len(text) > most:
        raise ValueError(f"is larger than {most / 1e6:g} MB")
    header = _HEADER.match(text)
    words = header[1].decode("ascii", "replace").lower().split() if header else []
    if header is None or len(words) != len(_WORDS):
        raise ValueError("is not a Matrix Market file: it does not begin with %%MatrixMarket")
    for (name, allowed), word in zip(_WORDS.items(), words, strict=True):
        if word not in allowed:
            raise ValueError(f"line 1 must have the {name} {' or '.join(allowed)}, got {word!r}")
    _, layout, field, symmetry = words
    before = header[2].count(b"\n") + 2  # lines of the header
    columns = ["row", "column"] * (layout == "coordinate")
    shape, count = _size(header[3], before, bool(columns), symmetry, largest)
    parts = 2 if field == "complex" else 1
    tokens = [rb"\d++"] * len(columns) + [WHOLE if field == "integer" else REAL] * parts
    labels = columns + ["number"] * parts
    numbers = parse_numbers(body := text[header.end() :], before, tokens, labels)
    late = np.arange(len(numbers)) >= count
    refuse_line(late, body, before, f"must not be there, after all of {count} numbers")
    if len(numbers) < count:
        raise ValueError(f"ends after {len(numbers)} of {count} numbers")
    refuse_line(~np.isfinite(numbers).all(axis=1), body, before, "must be finite")
    lowest = {"general": -shape[1], "skew-symmetric": 1}.get(symmetry, 0)  # i - j in the file
    if columns:
        i, j = numbers[:, :2].T - 1
        outside = (i < 0) | (j < 0) | (i >= shape[0]) | (j >= shape[1])
        inside = f"must be inside {shape[0]} x {shape[1]}, counted from 1"
        refuse_line(outside, body, before, inside)
        i, j = i.astype(int), j.astype(int)
        below = f"must lie below the diagonal, the matrix being {symmetry}"
        refuse_line(i - j < lowest, body, before, below)
        again = np.ones(len(numbers), bool)
        again[np.unique(i * shape[1] + j, return_index=True)[1]] = False
        refuse_line(again, body, before, "must not give an entry twice")
    else:
        j, i = np.nonzero(np.tri(*shape, -lowest, dtype=bool).T)
    values = numbers[:, -2:] @ [1, 1j] if parts == 2 else numbers[:, -1]
    values = values if np.imag(values).any() else np.real(values)
    if symmetry != "general":
        off, sign = i != j, -1 if symmetry == "skew-symmetric" else 1
        mirrored = values[off].conj() if symmetry == "hermitian" else sign * values[off]
        i, j = np.concatenate([i, j[off]]), np.concatenate([j, i[off]])
        values = np.concatenate([values, mirrored])
    return shape, i, j, values


def _size(
    line: bytes,
    number: int,
    coordinates: bool,
    symmetry: str,
    largest: int,
    most_dense: int = 16_000_000,
) -> tuple[tuple[int, int], int]:
    """The shape, and the number of entries in the file, at most `most_dense` of a dense array."""
    count, sizes = 3 if coordinates else 2, line.split()
    if len(sizes) != count or not all(re.fullmatch(rb"\d{1,15}", size) for size in sizes):
        raise wrong_line(number, line, f"must have the {count} whole numbers of the size")
    rows, columns, *entries = map(int, sizes)
    if max(rows, columns) > largest:
        raise ValueError(f"holds {rows} x {columns} numbers; reduce the model to {largest} at most")
    if not coordinates and rows * columns > most_dense:
        raise ValueError(f"holds {rows} x {columns} numbers; as a dense array at most {most_dense}")
    if min(rows, columns) < 1 or (symmetry != "general" and rows != columns):
        raise wrong_line(number, line, f"must have the size of a matrix that is {symmetry}")
    most = rows * columns
    if symmetry != "general":
        most = (most + (-rows if symmetry == "skew-symmetric" else rows)) // 2
    if entries and entries[0] > most:
        raise wrong_line(number, line, f"must have the number of entries, at most {most}")
    return (rows, columns), entries[0] if entries else most


def parse_numbers(body: bytes, before: int, tokens: list[bytes], labels: list[str]) -> np.ndarray:
    """The numbers (lines, tokens) of the lines that are not blank, each checked as text.

    `tokens` are the patterns of the numbers of a line, `labels` their names in messages, and
    `before` is the number of lines of the file before `body`.
    """
    line = rb"[^\S\n]++".join(tokens)
    bad = re.compile(rb"^(?![^\S\n]*+(?:" + line + rb")?[^\S\n]*+$).*", re.MULTILINE).search(body)
    if bad:
        number = before + body.count(b"\n", 0, bad.start()) + 1
        raise wrong_line(number, bad[0], f"must be '{' '.join(labels)}' and nothing else")
    return as_floats(body).reshape(-1, len(tokens))


def as_floats(text: bytes) -> np.ndarray:
    """Numbers between blanks that match `REAL`, as floats (n,)."""
    pieces, start = [np.empty(0)], 0
    while start < len(text):  # in pieces of 4 MiB: split text takes ten times the memory
        end = text.find(b"\n", start + 2**22) % (len(text) + 1)  # -1 is the end
        plain = text[start:end].translate(bytes.maketrans(b"dDqQ", b"eeee"))
        plain = re.sub(rb"[+-](?<=[\d.][+-])", rb"e\g<0>", plain)
        pieces.append(np.array(plain.split(), float))
        start = end
    return np.concatenate(pieces)


def refuse_line(wrong: Any, body: bytes, before: int, what: str) -> None:
    """Refuse the first line of `body`, not counting blank ones, for which `wrong` is true."""
    if wrong.any():
        lines = enumerate(body.split(b"\n"), before + 1)
        number, line = [(n, line) for n, line in lines if line.strip()][wrong.argmax()]
        raise wrong_line(number, line, what)


def wrong_line(number: int, line: bytes, what: str) -> ValueError:
    shown = line.strip()[:40].decode("ascii", "backslashreplace")
    return ValueError(f"line {number} {what}, got {shown!r}")
