"""Columns of numbers in a text, with the units that its header gives: CSV of any dialect."""

import csv
import math
import re
from array import array
from typing import NamedTuple, cast

import numpy as np

from .measurement import known_unit, metres

_SEPARATORS = (";", "\t", ",", None)  # None: any white space
_COMMENTS = ("#", "%", "//", "!")
_GAPS = {"", "nan", "inf", "-inf", "na", "n/a", "null", "none", "bad", "invalid", "no data"}
_TRIED = 1000  # lines from which the separator is found
_MOST_LINES, _LONGEST_LINE = 2**24, 2**23  # what takes about a gigabyte to read, and characters
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_WORD = re.compile(r"(?!nan|inf)[^\W\d_]{3}")  # titles and dates have them, numbers do not
_THOUSANDS = re.compile(r"(?<![\d.])[1-9]\d{0,2},0\d\d(?!\d)")  # 1,034.5
_QUOTED = re.compile(r'^"(.*)"$')
_BRACKETED = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]$")  # z [nm], z (nm)
_SUFFIXED = re.compile(r"(?:^|[/_]\s*|[^\W\d]\s+)([^\s/_]+)$")  # nm, z/nm, z_nm, z in nm, z nm
_QUANTITY = re.compile(r"^[^:]+:\s*([-+.\deE]+)\s*([^\s\d]+)$")  # Width: 12.3 um
_VALUE_UNITS = re.compile(r"^Value units:\s*(\S+)$")


class Table(NamedTuple):
    """The numbers of a text, (rows, columns) with NaN for gaps, and a unit or None a column.

    `size` is the width and the height of a map [m] where the header tells them, as Gwyddion's does.
    """

    numbers: np.ndarray
    units: list[str | None]
    size: tuple[float, float] | None = None


def read_table(content: bytes) -> Table:
    """The table in a text: header and comment lines, then as many numbers in every line.

    Columns are separated by semicolons, tabs, commas or spaces; a comma that does not separate is
    a decimal comma. Empty cells, nan, dashes, asterisks and words like bad are gaps.

    **Raises:** `ValueError` naming the line that is different, or if there is no line of numbers;
    for more than 2^24 lines, or one of more than 2^23 characters; for decimal points beside decimal
    commas.
    """
    lines = _lines(content)
    separator = _separator(lines)
    start = next((i for i, line in enumerate(lines) if _is_data(line, separator)), None)
    if start is None:
        raise ValueError("there is no line of numbers in it")
    columns = len(_fields(lines[start], separator))
    while columns > 3 and start and _is_gap(lines[start - 1], separator, columns):
        start -= 1  # a line of a map without a height is one of its lines
    _refuse_broken(lines, start, separator)
    numbers, empty, marks = array("d"), columns - 1, set()
    for at, line in enumerate(lines[start:], start=start + 1):
        if line.lstrip().startswith(_COMMENTS) or (columns > 1 and not line.strip()):
            continue
        fields = _fields(line, separator) or [""]
        if len(fields) != columns:
            raise ValueError(f"line {at} has {len(fields)} columns, the first one has {columns}")
        if separator == "," and ",0" in line and _THOUSANDS.search(line):
            raise ValueError(f"line {at}: does a comma separate thousands in {line[:40]!r}?")
        marks.update(mark for mark in ".," if separator != "," and mark in line)
        numbers.extend(_numbers(fields, at))
        empty = min(empty, columns - _filled(fields))
    if len(marks) > 1:
        raise ValueError("there are both decimal points and decimal commas in it")
    table = np.array(numbers).reshape(-1, columns)
    numbers = table[:, : columns - empty]  # every line may end with separators
    size, unit = _map_header(lines[:start])
    if size is not None:
        return Table(numbers, [unit] * numbers.shape[1], size)
    return Table(numbers, _units(lines[:start], separator, numbers.shape[1]))


def _lines(content) -> list[str]:
    if max(content.count(b"\n"), content.count(b"\r")) > _MOST_LINES:
        raise ValueError(f"it has too many lines: at most {_MOST_LINES} are read")
    text = _text(content).lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    for at, line in enumerate(lines, start=1):
        if len(line) > _LONGEST_LINE:
            raise ValueError(
                f"line {at} has {len(line)} characters: at most {_LONGEST_LINE} are read"
            )
    return lines


def _refuse_broken(lines, start, separator):
    """Refuse a last line of the header that looks like numbers: it may be the first of them."""
    at = next((i for i in range(start - 1, -1, -1) if lines[i].strip()), None)
    if at is None or lines[at].lstrip().startswith(_COMMENTS):
        return
    cells = [cell for cell in _fields(lines[at], separator) if cell]
    titled = any(cell[:2].isalpha() or _WORD.search(cell) for cell in cells)
    if not (titled or all(cell[0].isalpha() for cell in cells)) and any(
        map(str.isdigit, lines[at])
    ):
        raise ValueError(
            f"line {at + 1} is neither a title nor numbers: {lines[at][:40]!r} (if it is to be"
            " left out, put # before it)"
        )


def _is_gap(line, separator, columns):
    cells = [_cell(field) for field in _fields(line, separator)]
    return len(cells) == columns and None not in cells


def _filled(fields) -> int:
    """How many columns there are up to the last one that is not empty."""
    return max((i for i, field in enumerate(fields, start=1) if field), default=0)


def _map_header(header):
    """Width and height [m], and the unit of heights, that Gwyddion writes above a map; or None.

    Their titles are in the user's language: width is the first of two lengths.
    """
    lines = [line.strip().lstrip("#").strip() for line in header if line.startswith("#")]
    lengths = [
        float(found[1]) * metres(unit)
        for found in map(_QUANTITY.match, lines)
        if found and (unit := known_unit(found[2])) is not None
    ]
    units = [found[1] for found in map(_VALUE_UNITS.match, lines) if found]
    if len(lengths) != 2 or len(units) != 1:
        return None, None
    return (lengths[0], lengths[1]), units[0]


def _text(content: bytes) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16")
    if b"\0" in content:
        raise ValueError("it is not a text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _separator(lines):
    """The separator with which most lines are numbers."""
    counts = [sum(_is_data(line, s) for line in lines[:_TRIED]) for s in _SEPARATORS]
    return _SEPARATORS[int(np.argmax(counts))]


def _is_data(line, separator) -> bool:
    if separator is not None and separator not in line:
        return False
    fields = [_cell(field) for field in _fields(line, separator)]
    if separator is None and "," in line and len(fields) == 1:
        return False  # as likely two whole numbers
    return None not in fields and any(x == x for x in fields)


def _fields(line, separator):
    if '"' not in line:
        cells = line.split(separator)
    elif separator is None:
        cells = [_QUOTED.sub(r"\1", cell) for cell in line.split()]
    else:
        try:
            cells = next(csv.reader([line], delimiter=separator, strict=True))
        except csv.Error:  # quotes in the middle of a cell, or without an end
            return [line]
    cells = [cell.strip() for cell in cells]
    return cells if separator == "," else [cell.replace(",", ".") for cell in cells]


def _numbers(fields, at):
    cells = [_cell(field) for field in fields]
    if None in cells:
        raise ValueError(f"line {at}: {fields[cells.index(None)]!r} is not a number")
    if math.inf in cells or -math.inf in cells:
        raise ValueError(f"line {at} has a number that is too large")
    return cast(list[float], cells)


def _cell(field):
    """A number, NaN for a gap, or None."""
    if _NUMBER.fullmatch(field):
        return float(field)
    if field.lower() in _GAPS or not field.strip("-*"):
        return math.nan
    return None


def _units(header, separator, columns):
    """The unit of each column: from the lines that name columns, or the only one in the header."""
    units, anywhere = [None] * columns, set()
    for line in header:
        line = line.strip().lstrip("".join(_COMMENTS)).strip()
        fields = [cell for cell in _fields(line, separator) if cell]
        found = [_unit(field) for field in fields]
        titles = [_unit(line), *(found if separator else ())]  # words are no titles
        anywhere |= {unit for unit in titles if unit and known_unit(unit)}
        if len(fields) == columns:
            units = [new or old for new, old in zip(found, units, strict=True)]
    if not any(units) and len(anywhere) == 1:
        return [anywhere.pop()] * columns
    return units


def _unit(title):
    """The unit that a title ends with; in brackets, also one that is unknown."""
    bracketed = _BRACKETED.search(title)
    if bracketed:
        return bracketed[1]
    suffixed = _SUFFIXED.search(title)
    return suffixed[1] if suffixed and known_unit(suffixed[1]) else None
