"""Matrices in Matrix Market files, in which every character counts.

The format is that of Boisvert, Pozo and Remington, NISTIR 5935 (1996). SciPy's reader stops at the
first character that it does not know: there 1.0D6 is 1.0, 1500,75 is 1500, and what follows a
number on its line may be anything.
"""

import re
from collections.abc import Iterator
from typing import NoReturn

import numpy as np

# As C and Fortran write them: 1, -1.5, .5, 1e6, 1.0D+06, and 1.0+100, where the letter has no room.
_NUMBER = rb"([+-]?(?:\d+\.?\d*|\.\d+))(?:[eEdDqQ]([+-]?\d+)|([+-]\d+))?"
_WHOLE = rb"([+-]?\d+)()()"
_FIELDS = ("real", "double", "integer", "complex")
_SYMMETRIES = ("general", "symmetric", "skew-symmetric", "hermitian")
_LONGEST = 1000  # characters of a line
_SKIPPED = 10_000  # comments or blank lines after each other


def read_matrix_market(file, largest: int) -> np.ndarray:
    """The matrix (rows, columns) of an open file, complex only if a number has an imaginary part.

    No more than `largest` rows and columns, which the header says before any memory is taken.

    **Raises:** `ValueError` to follow the name of the file, with the line that is not right.
    """
    lines = _Lines(file)
    layout, field, symmetry = _header(lines)
    sizes = _sizes(lines, 3 if layout == "coordinate" else 2)
    shape, count = sizes[:2], sizes[-1]
    if max(shape) > largest:
        raise ValueError(
            f"holds {shape[0]} x {shape[1]} numbers; reduce the model to {largest} at most"
        )
    if min(shape) < 1 or (symmetry != "general" and shape[0] != shape[1]):
        lines.refuse(f"must have the size of a matrix that is {symmetry}")
    above, below = shape[0] * (shape[1] - 1) // 2, shape[0] * (shape[0] + 1) // 2
    most = {"general": shape[0] * shape[1], "skew-symmetric": above}.get(symmetry, below)
    if layout == "array":
        count = most
    elif count > most:
        lines.refuse(f"must have the number of entries, at most {most}")
    places = _columns(shape, symmetry)
    matrix = np.zeros(shape, complex)
    given = np.zeros(shape, bool)
    number = _WHOLE if field == "integer" else _NUMBER
    start = rb"(\d+)\s+(\d+)\s+" if layout == "coordinate" else rb"()()"
    end = rb"\s+" + number if field == "complex" else rb"()()()"
    entry = re.compile(start + number + end).fullmatch
    wanted = ("row column " if layout == "coordinate" else "") + "number"
    wanted += " number" if field == "complex" else ""
    for k in range(count):
        text = lines.filled()
        if text is None:
            raise ValueError(f"ends after {k} of {count} numbers")
        match = entry(text)
        if match is None:
            lines.refuse(f"must be '{wanted}' and nothing else")
        row, column, *parts = match.groups()
        place = next(places) if layout == "array" else (_index(row), _index(column))
        i, j = place
        if not (0 <= i < shape[0] and 0 <= j < shape[1]):
            lines.refuse(f"must be inside {shape[0]} x {shape[1]}, counted from 1")
        if symmetry != "general" and (i < j or (i == j and symmetry == "skew-symmetric")):
            lines.refuse(f"must lie below the diagonal, the matrix being {symmetry}")
        if given[i, j]:
            lines.refuse("must not give an entry twice")
        given[i, j] = True
        value = complex(_value(*parts[:3]), _value(*parts[3:]) if field == "complex" else 0.0)
        if not np.isfinite(value):
            lines.refuse("must be finite")
        matrix[i, j] = value
        if symmetry != "general" and i != j:
            mirrored = -value if symmetry == "skew-symmetric" else value
            matrix[j, i] = mirrored.conjugate() if symmetry == "hermitian" else mirrored
    if lines.filled() is not None:
        lines.refuse(f"must not be there, after all of {count} numbers")
    return matrix if np.imag(matrix).any() else np.real(matrix).copy()


class _Lines:
    """The lines of a file, one after the other, with the number of the last one."""

    def __init__(self, file):
        self.file = file
        self.number = 0
        self.text = b""

    def next(self) -> bytes | None:
        """The next line without blanks at its ends; None at the end of the file."""
        read = self.file.readline(_LONGEST + 1)
        self.number += 1
        self.text = read.strip()
        if len(read) > _LONGEST and not read.endswith(b"\n"):
            self.refuse(f"must have {_LONGEST} characters at most")
        return self.text if read else None

    def filled(self) -> bytes | None:
        """The next line that is not blank."""
        for _ in range(_SKIPPED):
            text = self.next()
            if text != b"":
                return text
        self.refuse("must not be blank")

    def refuse(self, what: str) -> NoReturn:
        """Raise: the last line must be something else."""
        shown = self.text[:40].decode("ascii", "backslashreplace")
        raise ValueError(f"line {self.number} {what}, got {shown!r}")


def _header(lines: _Lines) -> tuple[str, str, str]:
    banner = lines.file.readline(_LONGEST).split()
    lines.number = 1
    if len(banner) != 5 or banner[0].lower() != b"%%matrixmarket":
        raise ValueError("is not a Matrix Market file: it does not begin with %%MatrixMarket")
    kind, layout, field, symmetry = (word.decode("ascii", "replace").lower() for word in banner[1:])
    for name, word, known in [
        ("object", kind, ("matrix",)),
        ("format", layout, ("coordinate", "array")),
        ("field", field, _FIELDS),
        ("symmetry", symmetry, _SYMMETRIES),
    ]:
        if word not in known:
            raise ValueError(f"line 1 must have the {name} {' or '.join(known)}, got {word!r}")
    return layout, field, symmetry


def _sizes(lines: _Lines, count: int) -> list[int]:
    for _ in range(_SKIPPED):
        text = lines.next()
        if text is None or not (text == b"" or text.startswith(b"%")):
            break
    words = (text or b"").split()
    if len(words) != count or not all(re.fullmatch(rb"\d{1,15}", word) for word in words):
        lines.refuse(f"must have the {count} whole numbers of the size")
    return [int(word) for word in words]


def _columns(shape, symmetry) -> Iterator[tuple[int, int]]:
    """The places of the numbers of a dense matrix, column by column."""
    for j in range(shape[1]):
        first = {"general": 0, "skew-symmetric": j + 1}.get(symmetry, j)
        for i in range(first, shape[0]):
            yield i, j


def _index(digits: bytes) -> int:
    return int(digits[:15]) - 1


def _value(digits: bytes, exponent: bytes | None, bare: bytes | None) -> float:
    return float(digits + b"e" + (exponent or bare or b"0"))
