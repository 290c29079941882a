"""Sparse matrices from text files of Abaqus and in Harwell-Boeing format."""

import re
from typing import Any

import numpy as np

from .matrix_market import REAL, WHOLE, as_floats, parse_numbers, refuse_line, wrong_line

_FORMAT = re.compile(rb"\((?:\d*P,?)?(\d*)([IEDFG])(\d+)(?:\.\d+(?:E\d+)?)?\)")
_KINDS = {b"r": "real", b"i": "integer"}
_SYMMETRIES = {b"u": 0, b"r": 0, b"s": 1, b"z": -1}  # rectangular, symmetric, skew


def assemble(
    name: str,
    shape: tuple[int, int],
    i: Any,
    j: Any,
    values: Any,
    largest: int,
    mirror: int = 0,
):
    """The sparse matrix of `shape` with `values` (n,) in rows i and columns j, counted from 0.

    It has at most `largest` rows and columns. `mirror` 1 makes a triangle symmetric and -1 skew.
    Duplicate entries are refused, because no format says whether to add them.

    **Raises:** `ValueError` naming the entry.
    """
    import scipy.sparse

    check_size(name, shape, largest)
    i, j, values = np.asarray(i, np.int64), np.asarray(j, np.int64), np.asarray(values)
    values = values if values.dtype.kind == "c" else values.astype(float)
    if mirror:
        off = i != j
        i, j = np.concatenate([i, j[off]]), np.concatenate([j, i[off]])
        values = np.concatenate([values, mirror * values[off]])
    place = np.sort(i * shape[1] + j)
    again = place[1:][place[1:] == place[:-1]]
    if again.size:
        row, column = divmod(int(again[0]), shape[1])
        both = ", or above and below the diagonal" * bool(mirror)
        raise ValueError(f"{name} gives row {row + 1}, column {column + 1} twice{both}")
    return scipy.sparse.coo_array((values, (i, j)), shape=shape).tocsr()


def check_size(name: str, shape: tuple[int, ...], largest: int) -> None:
    """**Raises:** `ValueError` for a shape that is empty or larger than `largest`."""
    if not 1 <= min(shape) <= max(shape) <= largest:
        raise ValueError(f"{name} must have from 1 to {largest} rows and columns, got {shape}")


def label_dofs(node: np.ndarray, dof: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """The index (n,) of each (node, dof) in sorted order, and the names "node.dof".

    **Raises:** `ValueError` for a node of 2^40 or more and a dof of 2^20 or more: a label is one
    integer of 64 bits.
    """
    if max(np.abs(node).max(initial=0) / 2**40, dof.max(initial=0) / 2**20) >= 1:
        raise ValueError("a node or a degree of freedom has too large a number")
    labels, place = np.unique(node * 2**20 + dof, return_inverse=True)
    return place, tuple(f"{label >> 20}.{label % 2**20}" for label in labels.tolist())


def read_abaqus(name: str, content: bytes, largest: int):
    """The matrix of an Abaqus .mtx file, the names of its dofs, and True if it was mirrored.

    Lines hold row node, dof, column node, dof and value (FORMAT=MATRIX INPUT and LABELS), or row,
    column and value (COORDINATE), without names.

    **Raises:** `ValueError` with the line that is wrong.
    """
    body = re.sub(rb"(?m)^[^\S\n]*\*\*.*", b"", content).replace(b",", b" ")
    first = len((re.search(rb"\S[^\n]*", body) or [b""])[0].split())
    if first not in (3, 5):
        raise ValueError("it is neither a Matrix Market file nor a matrix of Abaqus")
    labels = ["row", "column"] if first == 3 else ["node", "dof", "node", "dof"]
    whole = rb"\d{1,15}+" if first == 3 else rb"-?\d{1,15}+"  # internal nodes are negative
    numbers = parse_numbers(body, 0, [whole] * (first - 1) + [REAL], [*labels, "number"])
    refuse_line(~np.isfinite(numbers[:, -1]), body, 0, "must be finite")
    index, values = numbers[:, :-1].astype(np.int64), numbers[:, -1]
    names = None
    if first == 3:
        refuse_line((index < 1).any(axis=1), body, 0, "must be counted from 1")
        i, j = index.T - 1
        size = int(index.max())
    else:
        refuse_line((index[:, 1::2] < 0).any(axis=1), body, 0, "must have dofs from 0")
        place, names = label_dofs(index[:, ::2].T.ravel(), index[:, 1::2].T.ravel())
        (i, j), size = place.reshape(2, -1), len(names)
    # The file does not say whether it holds one triangle. An unsymmetric finite-element matrix
    # has entries on both sides of the diagonal, so a file without any pair holds a triangle.
    off = i != j
    paired = np.isin(i[off] * size + j[off], j[off] * size + i[off]).any()
    mirrored = not paired and bool(off.any())
    return assemble(name, (size, size), i, j, values, largest, int(mirrored)), names, mirrored


def read_harwell_boeing(name: str, content: bytes, largest: int):
    """The matrix of an ASCII Harwell-Boeing or Rutherford-Boeing file, without right-hand sides.

    `scipy.io.hb_read` cannot serve: it refuses symmetric files and files with a right-hand side,
    both of which Ansys writes.

    **Raises:** `ValueError` with the line that is wrong.
    """
    lines = content.rstrip().split(b"\n")
    unlike = ValueError("it is no Harwell-Boeing file in ASCII")
    if len(lines) < 5 or b"\0" in content[:4096]:
        raise unlike
    cards, kind = lines[1].split(), lines[2][:3].lower()
    sizes, formats = lines[2][3:].split(), _FORMAT.findall(lines[3].upper().replace(b" ", b""))
    if not all(x.isdigit() for x in cards + sizes) or len(cards) < 4 or len(sizes) < 3:
        raise unlike
    if not re.fullmatch(rb"[ir][ursz]a", kind):
        raise wrong_line(3, lines[2], "must have the type RUA, RSA, RZA, RRA or their like of I")
    if len(formats) < 3 or [x[1] for x in formats[:2]] != [b"I", b"I"]:
        raise wrong_line(4, lines[3], "must have the formats of pointers, rows and values")
    rows, columns, entries = map(int, sizes[:3])
    if int(cards[0]) + 4 > len(lines):
        raise ValueError(f"it ends after {len(lines)} lines of {int(cards[0]) + 4}")
    start = 5 if len(cards) > 4 and int(cards[4]) else 4  # one more line for right-hand sides
    arrays = []
    for (each, letter, width), count in zip(formats, (columns + 1, entries, entries), strict=False):
        pattern = WHOLE if letter == b"I" else REAL
        layout = (int(each or 1), int(width))
        numbers, start = fixed_fields(lines, start, count, layout, pattern)
        arrays.append(numbers)
    pointers, index, values = arrays
    steps = np.diff(pointers)
    if pointers[0] != 1 or (steps < 0).any() or pointers[-1] != entries + 1:
        raise ValueError("its column pointers are damaged")
    if entries and not (index.min() >= 1 and index.max() <= rows):
        raise ValueError(f"its row indices must be from 1 to {rows}")
    j = np.repeat(np.arange(columns), steps.astype(int))
    mirror = _SYMMETRIES[kind[1:2]]
    if mirror and rows != columns:
        raise ValueError(f"it holds {rows} x {columns} numbers and calls them symmetric")
    return assemble(name, (rows, columns), index - 1, j, values, largest, mirror)


def fixed_fields(
    lines: list[bytes], start: int, count: int, layout: tuple[int, int], pattern: bytes = REAL
) -> tuple[np.ndarray, int]:
    """`count` numbers (count,) from the lines from `start` on, and the index of the next line.

    `layout` is the number of fields per line and their width; fields may touch.
    """
    each, width = layout
    if not each * width:
        raise ValueError("a format in it has no width")
    after = start - -count // each
    if after > len(lines):
        raise ValueError(f"it ends before {count} numbers from line {start + 1} on")
    used = [line.rstrip() for line in lines[start:after]]
    text = b"\n".join(used)
    not_separated = rb"(?m)^(?![^\S\n]*+(?:" + pattern + rb"(?:[^\S\n]++|$))*+$)"
    # SciPy writes separated fields that are narrower than declared.
    if not re.search(not_separated, text) and len(values := as_floats(text)) == count:
        return values, after
    for number, line in enumerate(used, start + 1):
        if len(line) > each * width:
            raise wrong_line(number, line, f"must have at most {each} fields of {width}")
    padded = b"".join(line.ljust(each * width) for line in used)
    text = b"\n".join(np.char.strip(np.frombuffer(padded, f"S{width}")[:count]).tolist())
    bad = re.search(rb"(?m)^(?!(?:" + pattern + rb")$).*", text) if count else None
    if bad:
        number = start + text.count(b"\n", 0, bad.start()) // each
        raise wrong_line(number + 1, lines[number], "must be numbers in their fields")
    return as_floats(text), after
