"""Numeric matrices in MATLAB files of versions 5 to 7, 7.3 and 4.

`scipy.io.loadmat` cannot serve: damaged sparse matrices crash the interpreter (SciPy 1.17), and a
small file may unpack to any size.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from .._base.file_limits import FileLimits
from .matlab4_file import read_matlab_4
from .matlab73_file import read_matlab_7_3
from .matrix_entries import check_size

_ORDERS = {b"\0\1IM": "<", b"\1\0MI": ">"}
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"}
_TYPES |= {7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS, _SPARSE, _OPAQUE = range(5, 16), 5, 17  # classes
_KINDS = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 16: "a function"}
_KINDS |= {17: "an object"}
_COMPLEX, _LOGICAL = 0x800, 0x200  # flags


def read_matlab(content: bytes, limits: FileLimits) -> dict[str, Any]:
    """The variables of a .mat file by name, as arrays or sparse matrices within `limits`.

    A variable that is no matrix of numbers is returned as a `ValueError`.

    **Raises:** `ValueError` if the file is damaged or too large.
    """
    if content.startswith((b"MATLAB 7.3", b"\x89HDF")):
        return read_matlab_7_3(content, limits)
    order = _ORDERS.get(content[124:128])
    if order is None and b"\0" in content[:4]:  # always so in version 4, never in a text
        return read_matlab_4(content, limits.dofs)
    if order is None:
        raise ValueError("it is no file of MATLAB's version 5 to 7, or 4")
    variables: dict[str, Any] = {}
    most = limits.matrices
    for kind, element in _elements(content[128:], order, padded=False):
        most -= len(element)
        if kind == _COMPRESSED:
            element = _unpack(element, most)
            most -= len(element)
            kind, element = next(_elements(element, order), (0, b""))
        if kind != _MATRIX:
            raise ValueError(f"it is damaged: a variable was to begin, not {kind}")
        parts = list(_elements(element, order))
        name, flags = _header(parts, order)
        if name in variables:
            raise ValueError(f"it holds {name} twice")
        if name:  # the parts of objects have none
            try:
                variables[name] = _matrix(name, flags, parts, order, limits.dofs)
            except ValueError as error:
                variables[name] = error
    return variables


def _unpack(element: bytes, most: int) -> bytes:
    inflate = zlib.decompressobj()
    try:
        content = inflate.decompress(element, max(most, 0) + 1)
    except zlib.error:
        raise ValueError("it is damaged: a variable cannot be unpacked") from None
    if len(content) > most:
        raise ValueError("it unpacks to more than is read")
    if not inflate.eof:
        raise ValueError("it ends within a variable")
    return content


def _elements(content: bytes, order: str, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """The type and the bytes of each element; elements of variables are padded to 8 bytes."""
    place = 0
    while place < len(content):
        tag = content[place : place + 8].ljust(8, b"\0")
        kind, size = struct.unpack(f"{order}2I", tag)
        start = place + 8
        if kind >> 16:  # a small element, with its bytes in the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, place + 4
        end = start + size
        if end > len(content) or (start == place + 4 and size > 4):
            raise ValueError("it ends within a variable")
        yield kind, content[start:end]
        place = end + (place - end) % 8 if padded else end


def _header(parts: list[tuple[int, bytes]], order: str) -> tuple[str, int]:
    """The name of a variable, and its flags and class."""
    if len(parts) < 3 or len(parts[0][1]) != 8:
        raise ValueError("it is damaged: a variable lacks its header")
    flags = struct.unpack(f"{order}2I", parts[0][1])[0]
    at = 1 if flags & 0xFF == _OPAQUE else 2  # an opaque object has no size
    return parts[at][1].decode("ascii", "backslashreplace"), flags


def _holds_bytes(data: bytes, begun: np.ndarray) -> bool:
    """True if the values of sparse columns, which begin at `begun`, have one byte each."""
    count = int(begun[-1]) if len(begun) else 0
    return count <= len(data) < 8 * count


def _matrix(name: str, flags: int, parts: list[tuple[int, bytes]], order: str, largest: int) -> Any:
    import scipy.sparse

    if flags & 0xFF not in _NUMBERS:
        kind = _KINDS.get(flags & 0xFF, f"MATLAB's class {flags & 0xFF}")
        raise ValueError(f"{name} must be real numbers, got {kind}")
    sparse = flags & 0xFF == _SPARSE
    arrays: list[np.ndarray] = []
    for kind, data in [parts[1], *parts[3:]]:
        if sparse and flags & _LOGICAL and len(arrays) == 3 and _holds_bytes(data, arrays[2]):
            kind = 2  # MATLAB calls the bytes of sparse logicals doubles
        dtype = np.dtype(order + _TYPES.get(kind, "f8"))
        if kind not in _TYPES or len(data) % dtype.itemsize:
            raise ValueError(f"{name} is damaged: it has numbers of type {kind}")
        arrays.append(np.frombuffer(data, dtype).astype(dtype.newbyteorder("=")))
    if flags & _COMPLEX and len(arrays) > 1 and len(arrays[-1]) == len(arrays[-2]):
        imaginary = arrays.pop()
        arrays[-1] = arrays[-1] + 1j * imaginary
    shape = tuple(arrays[0].tolist())
    if len(arrays) != (4 if sparse else 2) or min(shape, default=-1) < 0:
        raise ValueError(f"{name} is damaged: it has {len(arrays) - 1} arrays")
    try:
        if not sparse:
            return arrays[1].reshape(shape, order="F")
        check_size(name, shape, largest)
        _, i, begun, values = arrays  # with room for more entries, which SciPy drops
        matrix = scipy.sparse.csc_array((values, i, begun), shape=shape)
        matrix.check_format(full_check=True)
        return matrix
    except (ValueError, IndexError, OverflowError) as error:
        raise ValueError(f"{name} is damaged: {' '.join(str(error).split())}") from None
