"""Matrix Market files (Boisvert, Pozo and Remington, NISTIR 5935, 1996), read strictly.

`scipy.io.mmread` cannot serve: it reads 1.0D6 as 1.0 and 1500,75 as 1500, adds up entries that
are given twice, and crashes on some damaged files (SciPy 1.17).
"""

import re
from typing import BinaryIO

import numpy as np

_BANNER = b"%%MatrixMarket"
_HEADER = re.compile(rb"([^\n]*)\n((?:[^\S\n]*(?:%[^\n]*)?\n)*+)([^\n]*)\n?")
_WORDS = {
    "object": ("matrix",),
    "format": ("coordinate", "array"),
    "field": ("real", "double", "integer", "complex"),
    "symmetry": ("general", "symmetric", "skew-symmetric", "hermitian"),
}
# As C and Fortran write them: 1, -1.5, .5, 1e6, 1.0D+06, and 1.0+100 for want of room.
_REAL = rb"[+-]?(?:\d++\.?\d*+|\.\d++)(?:[eEdDqQ][+-]?\d++|[+-]\d++)?"
_WHOLE = rb"[+-]?\d++"


def read_matrix_market(file: BinaryIO, largest: int) -> np.ndarray:
    """The matrix (rows, columns) of an open file, complex only if a number has an imaginary part.

    At most `largest` rows and columns, checked before any memory is taken for them.

    **Raises:** `ValueError` to follow the name of the file, with the line that is wrong.
    """
    start = file.read(len(_BANNER))  # alone: /dev/zero never ends
    most = 32 * largest**2
    text = file.read(most + 1) if start.lower() == _BANNER.lower() else b""
    if len(text) > most:
        raise ValueError(f"is larger than {most / 1e6:g} MB")
    header = _HEADER.match(text)
    words = header[1].decode("ascii", "replace").lower().split() if header else []
    if header is None or len(words) != len(_WORDS):
        raise ValueError("is not a Matrix Market file: it does not begin with %%MatrixMarket")
    for (name, known), word in zip(_WORDS.items(), words, strict=True):
        if word not in known:
            raise ValueError(f"line 1 must have the {name} {' or '.join(known)}, got {word!r}")
    _, layout, field, symmetry = words
    before = header[2].count(b"\n") + 2  # lines of the header
    columns = ["row", "column"] * (layout == "coordinate")
    shape, stored, count = _size(header[3], before, bool(columns), symmetry, largest)
    parts = 2 if field == "complex" else 1
    tokens = [rb"\d++"] * len(columns) + [_WHOLE if field == "integer" else _REAL] * parts
    numbers = _numbers(body := text[header.end() :], before, tokens, columns + ["number"] * parts)

    def refuse(wrong, what: str) -> None:
        """Refuse the first line, blank ones not counted, of which `wrong` is true."""
        if wrong.any():
            lines = enumerate(body.split(b"\n"), before + 1)
            number, line = [(n, line) for n, line in lines if line.strip()][wrong.argmax()]
            raise _wrong(number, line, what)

    late = np.arange(len(numbers)) >= count
    refuse(late, f"must not be there, after all of {count} numbers")
    if len(numbers) < count:
        raise ValueError(f"ends after {len(numbers)} of {count} numbers")
    refuse(~np.isfinite(numbers).all(axis=1), "must be finite")
    if columns:
        i, j = numbers[:, :2].T - 1
        outside = (i < 0) | (j < 0) | (i >= shape[0]) | (j >= shape[1])
        refuse(outside, f"must be inside {shape[0]} x {shape[1]}, counted from 1")
        i, j = i.astype(int), j.astype(int)
        refuse(~stored[i, j], f"must lie below the diagonal, the matrix being {symmetry}")
        again = np.ones(len(numbers), bool)
        again[np.unique(i * shape[1] + j, return_index=True)[1]] = False
        refuse(again, "must not give an entry twice")
    else:
        j, i = np.nonzero(stored.T)
    values = numbers[:, -2:] @ [1, 1j] if parts == 2 else numbers[:, -1]
    matrix = np.zeros(shape, values.dtype)
    matrix[i, j] = values
    if symmetry != "general":
        mirrored = matrix.conj().T if symmetry == "hermitian" else matrix.T
        matrix = np.where(stored, matrix, -mirrored if symmetry == "skew-symmetric" else mirrored)
    return matrix if np.imag(matrix).any() else np.real(matrix).copy()


def _size(
    line: bytes, number: int, coordinates: bool, symmetry: str, largest: int
) -> tuple[tuple[int, int], np.ndarray, int]:
    """The shape, where the file may give numbers, and how many it gives."""
    wanted, sizes = 3 if coordinates else 2, line.split()
    if len(sizes) != wanted or not all(re.fullmatch(rb"\d{1,15}", size) for size in sizes):
        raise _wrong(number, line, f"must have the {wanted} whole numbers of the size")
    rows, columns, *entries = map(int, sizes)
    if max(rows, columns) > largest:
        raise ValueError(f"holds {rows} x {columns} numbers; reduce the model to {largest} at most")
    if min(rows, columns) < 1 or (symmetry != "general" and rows != columns):
        raise _wrong(number, line, f"must have the size of a matrix that is {symmetry}")
    highest = {"general": columns, "skew-symmetric": -1}.get(symmetry, 0)
    stored = np.tri(rows, columns, highest, dtype=bool)
    most = int(stored.sum())
    if entries and entries[0] > most:
        raise _wrong(number, line, f"must have the number of entries, at most {most}")
    return (rows, columns), stored, entries[0] if entries else most


def _numbers(body: bytes, before: int, tokens: list[bytes], wanted: list[str]) -> np.ndarray:
    """The numbers (lines, tokens) of the lines that are not blank, each checked as a text."""
    line = rb"[^\S\n]++".join(tokens)
    bad = re.compile(rb"^(?![^\S\n]*+(?:" + line + rb")?[^\S\n]*+$).*", re.MULTILINE).search(body)
    if bad:
        number = before + body.count(b"\n", 0, bad.start()) + 1
        raise _wrong(number, bad[0], f"must be '{' '.join(wanted)}' and nothing else")
    plain = body.translate(bytes.maketrans(b"dDqQ", b"eeee"))
    plain = re.sub(rb"[+-](?<=[\d.][+-])", rb"e\g<0>", plain)
    return np.array(plain.split(), float).reshape(-1, len(tokens))


def _wrong(number: int, line: bytes, what: str) -> ValueError:
    shown = line.strip()[:40].decode("ascii", "backslashreplace")
    return ValueError(f"line {number} {what}, got {shown!r}")
