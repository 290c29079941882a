"""Plain text: a header, then the same number of columns in every line."""

import dataclasses
import io
import math
import re
from array import array
from collections.abc import Iterator

import numpy as np

from .header import Settings, is_setting, read_settings, sets_something
from .units import unit_named

_SEPARATORS = (";", "\t", ",", None)  # None: white space
_COMMENTS = ("#", "%", "//", "!")
_GAPS = {"", "nan", "na", "n/a", "null", "none", "bad", "invalid"}
_WORDS = {"true": 1.0, "false": 0.0}  # of flags
_FIRST = ("t", "T", "f", "F")
_BITS = re.compile(r"[01]\s*/\s*[01]")  # in place of a unit for flags
# No leading zeros: in 1,034.5 a comma separates thousands.
_NUMBER = re.compile(r"[-+]?((0|[1-9]\d*)(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_LIKE_A_NUMBER = re.compile(r"[-+.\"]*\d")
# Bracketed, z [nm], or last, z/nm, z_nm, z in nm, but not the unit of a quantity, 5 nm.
_UNIT = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]$|(?:^|[/_]\s*|[^\W\d]\s+)([^\s/_\[\]()]+)$")


@dataclasses.dataclass(frozen=True)
class Table:
    """The numbers of a text, and what its header says about them."""

    numbers: np.ndarray  # (rows, columns), NaN for gaps
    titles: list[str] | None  # of the columns, without their units
    units: list[str | None]
    settings: Settings
    words: dict[int, str]  # by column: error for its first true or false, if it is not flags


def text_encoding(content: bytes) -> str | None:
    """UTF-16 with a byte order mark, UTF-8 or else Latin-1; None if it is not text."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if b"\0" in content:
        return None
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def read_table(content: bytes, encoding: str) -> Table:
    """The numbers with their titles, units, and the settings above them.

    The first line of numbers sets the separator. Any other comma is a decimal comma.

    **Raises:** `ValueError` naming the line that is not like the first, or if none holds numbers.
    """
    header: list[str] = []
    numbers, columns, separator, marks = array("d"), 0, None, set()
    words: dict[int, str] = {}
    for at, line in _lines(content, encoding):
        if not columns:
            fitting = [s for s in _SEPARATORS if _is_data(line, s)]
            if not fitting:
                header.append(line)
                continue
            separator, columns = fitting[0], len(_cells(line, fitting[0]))
            _refuse_damaged(header, separator)
        if line.lstrip().startswith(_COMMENTS) or (columns > 1 and not line.strip()):
            continue
        cells = _cells(line, separator)
        if len(cells) != columns:
            raise ValueError(f"line {at} has {len(cells)} columns, the first one has {columns}")
        for column, cell in enumerate(cells):
            value = _number(cell)
            if cell[:1] in _FIRST and cell.lower() in _WORDS:
                words.setdefault(column, f"line {at}: {cell!r} is not a number")
            if value is None or math.isinf(value):
                why = "is not a number" if value is None else "is too large"
                raise ValueError(f"line {at}: {cell[:40]!r} {why}")
            numbers.append(value)
        marks.update(mark for mark in ".," if separator != "," and mark in line)
    if not columns:
        raise ValueError("there is no line of numbers in it")
    if len(marks) > 1:
        raise ValueError("it mixes decimal points and decimal commas")
    table = np.array(numbers).reshape(-1, columns)
    width = int(np.flatnonzero(~np.isnan(table).all(axis=0))[-1]) + 1  # separators may end lines
    units = _units(header, separator, width)
    titles, settings = _titles(header, separator, width), read_settings(header)
    return Table(table[:, :width], titles, units, settings, words)


def _lines(content: bytes, encoding: str, longest: int = 2**23) -> Iterator[tuple[int, str]]:
    """The number and the text of each line, of at most `longest` characters."""
    if encoding == "utf-16":
        content, encoding = content.decode(encoding).encode(), "utf-8"
    file = io.TextIOWrapper(io.BytesIO(content.rstrip(b"\r\n ")), encoding)
    for at, line in enumerate(file, start=1):
        if len(line) > longest:
            raise ValueError(f"line {at} is longer than {longest} characters")
        yield at, line.rstrip("\n")


def _cells(line: str, separator: str | None) -> list[str]:
    cells = [cell.strip() for cell in line.split(separator)] or [""]
    return cells if separator == "," else [cell.replace(",", ".") for cell in cells]


def _number(cell: str) -> float | None:
    """The number in a cell, 1 or 0 for a flag, NaN for a gap, or else None."""
    if _NUMBER.fullmatch(cell):
        return float(cell)
    if cell.lower() in _WORDS:
        return _WORDS[cell.lower()]
    return math.nan if cell.strip("-*").lower() in _GAPS else None


def _is_data(line: str, separator: str | None) -> bool:
    """True if the line holds only numbers and gaps, and at least one number."""
    values = [_number(cell) for cell in _cells(line, separator)]
    present = separator is None or separator in line
    return present and None not in values and any(value == value for value in values)


def _refuse_damaged(header: list[str], separator: str | None):
    """The line above the numbers must be a title, not a damaged line of numbers."""
    at, line = max(
        ((at, line) for at, line in enumerate(header, 1) if line.strip()), default=(0, "#")
    )
    if line.lstrip().startswith(_COMMENTS) or sets_something(line):
        return
    cells = [cell for cell in _cells(line, separator) if not _BITS.fullmatch(cell)]
    if any(_LIKE_A_NUMBER.match(cell) for cell in cells):
        raise ValueError(f"line {at} is neither a title nor numbers: {line[:40]!r}")


def _units(header: list[str], separator: str | None, columns: int) -> list[str | None]:
    """Units in the last line that names the columns, or else the only unit in the header."""
    lines = _plain(header)
    for line in reversed(lines):
        units = [_unit(cell.strip('"')) for cell in _cells(line, separator) if cell]
        if len(units) == columns and any(units):
            return units
    alone = {unit for unit in map(_unit, lines) if unit and unit_named(unit)}
    return [alone.pop() if len(alone) == 1 else None] * columns


def _titles(header: list[str], separator: str | None, columns: int) -> list[str] | None:
    """Titles in the last line of the header, or in the line above a line of units only."""
    for line in reversed([line for line in _plain(header) if line][-2:]):
        cells = [cell.strip('"') for cell in _cells(line, separator) if cell]
        titles = [_without_unit(cell) for cell in cells]
        if len(titles) == columns and all(titles):
            return titles
    return None


def _plain(header: list[str]) -> list[str]:
    """The lines that hold titles, units or words, without comment signs."""
    lines = [line.strip().lstrip("".join(_COMMENTS)).strip() for line in header]
    return [line for line in lines if not is_setting(line)]


def _without_unit(title: str) -> str:
    match = _UNIT.search(title)
    if match and (match[1] or unit_named(match[2])):
        unit = 1 if match[1] else 2
        title = title[: match.start(unit)].rstrip("([/_ ").removesuffix(" in").rstrip()
    return "" if _BITS.fullmatch(title) or title == "-" else title.strip()


def _unit(title: str) -> str | None:
    """The unit at the end of a title; in brackets, also an unknown one."""
    match = _UNIT.search(title)
    if match is None:
        return None
    return match[1] or (match[2] if unit_named(match[2]) else None)
