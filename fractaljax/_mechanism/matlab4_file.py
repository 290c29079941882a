"""Numeric matrices in MATLAB files of version 4, which have no file header."""

import struct
from typing import Any

import numpy as np

from .matrix_entries import assemble, check_size

_TYPES = ("f8", "f4", "i4", "i2", "u2", "u1")
_FULL, _TEXT, _SPARSE = range(3)


def read_matlab_4(content: bytes, largest: int) -> dict[str, Any]:
    """The variables of a file by name, as arrays or sparse matrices of at most `largest` rows.

    A variable that is no matrix of numbers is returned as a `ValueError`.

    **Raises:** `ValueError` if the file is damaged.
    """
    variables: dict[str, Any] = {}
    place = 0
    while place < len(content):
        head = content[place : place + 20]
        if len(head) < 20:
            raise ValueError("it ends within a variable")
        order = "<" if int.from_bytes(head[:4], "little") < 1000 else ">"
        kind, rows, columns, imaginary, length = struct.unpack(f"{order}5i", head)
        machine, rest = divmod(kind, 1000)
        number, what = divmod(rest, 10)
        sound = machine == (order == ">") and number < len(_TYPES) and what <= _SPARSE
        sound = sound and min(rows, columns) >= 0 and imaginary in (0, 1)
        if not (sound and 1 <= length <= 64):  # of the name, with the zero that ends it
            raise ValueError(f"it is no file of MATLAB's version 4, or damaged at byte {place}")
        name = content[place + 20 : place + 20 + length].partition(b"\0")[0]
        name = name.decode("ascii", "backslashreplace")
        dtype = np.dtype(order + _TYPES[number])
        start = place + 20 + length
        size = rows * columns * dtype.itemsize
        place = start + size * (1 + imaginary)
        if place > len(content):
            raise ValueError("it ends within a variable")
        if name in variables:
            raise ValueError(f"it holds {name} twice")
        parts = [
            np.frombuffer(content[at : at + size], dtype).astype(dtype.newbyteorder("="))
            for at in (start, start + size)[: 1 + imaginary]
        ]
        values = parts[0] + 1j * parts[1] if len(parts) == 2 else parts[0]
        values = values.reshape((rows, columns), order="F")
        try:
            variables[name] = _matrix(name, what, values, largest)
        except ValueError as error:
            variables[name] = error
    return variables


def _matrix(name: str, what: int, values: np.ndarray, largest: int) -> Any:
    if what == _TEXT:
        raise ValueError(f"{name} must be real numbers, got text")
    return values if what == _FULL else _sparse(name, values, largest)


def _sparse(name: str, table: np.ndarray, largest: int) -> Any:
    """The sparse matrix from lines of row, column and value; the last line is its shape."""
    whole = np.isfinite(table[:, :2]).all() and (table[:, :2] == np.rint(table[:, :2])).all()
    if table.shape[1] not in (3, 4) or not len(table) or not whole:
        raise ValueError(f"{name} is damaged: it has no rows, columns and values")
    rows, columns = map(int, table[-1, :2])
    check_size(name, (rows, columns), largest)
    i, j, values, *imaginary = table[:-1].T  # a fourth column is of imaginary parts
    if imaginary:
        values = values + 1j * imaginary[0]
    inside = (i >= 1) & (i <= rows) & (j >= 1) & (j <= columns)
    if not inside.all():
        raise ValueError(f"{name} is damaged: an entry lies outside {rows} x {columns}")
    return assemble(name, (rows, columns), i - 1, j - 1, values, largest)
