"""Objects as the tables that notebooks show: quantity, value, unit and meaning."""

import ast
import contextlib
import dataclasses
import functools
import html
import inspect
import re
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from .parts import enumeration_of

Row = tuple[str, Any, str, str]  # quantity, value, unit and meaning


def table(title: str, rows: Iterable[Row], notes: Iterable[str] = ()) -> str:
    """Rows as a table of HTML under a title, with lines below; all text is escaped."""
    lines = [_line("th", ("quantity", "value", "unit", "meaning"))]
    for name, value, unit, words in rows:
        numeric = hasattr(value, "__array__") or isinstance(value, float)
        lines.append(_line("td", (name, shown(value), unit or "-" * numeric, words)))
    below = "".join(f"<div>{html.escape(note)}</div>" for note in notes)
    return (
        f"<div><div><b>{html.escape(title)}</b></div>"
        f"<table><tbody>{''.join(lines)}</tbody></table>{below}</div>"
    )


def _line(tag: str, cells: Iterable[str]) -> str:
    start = f'<{tag} style="text-align:left">'
    return f"<tr>{''.join(f'{start}{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"


def record_rows(record: Any, names: Iterable[str]) -> list[Row]:
    """The rows of attributes of a result, without those that are None."""
    about = meanings(type(record))
    rows = [(name, getattr(record, name), *about.get(name, ("", ""))) for name in names]
    return [row for row in rows if row[1] is not None]


def shown(value: Any) -> str:
    """A value in few characters: an array of many numbers by its shape and its range."""
    if isinstance(value, Tracer):
        return "traced"
    members: Any = enumeration_of(value)
    if members is not None:
        return str(members[value]) if np.ndim(jax.tree.leaves(value)[0]) == 0 else "of each member"
    if value is None or isinstance(value, (str, bool)):
        return "none" if value is None else str(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {shown(each)}" for key, each in value.items()) or "none"
    if isinstance(value, (tuple, list)):
        words = [shown(each) for each in value[:8]]
        return ", ".join(words + ["..."] * (len(value) > 8)) or "none"
    if dataclasses.is_dataclass(value) or not hasattr(value, "__array__"):
        numeric = isinstance(value, (int, float, complex))
        return f"{value:.6g}" if numeric else type(value).__name__
    array = np.asarray(value)
    if array.size <= 8 and array.dtype.kind in "biufc":
        return ", ".join(f"{x:.6g}" for x in array.ravel().tolist())
    size = " x ".join(map(str, array.shape))
    real = array[np.isfinite(array)] if array.dtype.kind in "iuf" else array[:0]
    spread = f" from {real.min():.6g} to {real.max():.6g}" if real.size else ""
    return f"{size} values{spread}"


# --- units and meanings --------------------------------------------------------------------


@functools.cache
def meanings(kind: type) -> dict[str, tuple[str, str]]:
    """Unit and meaning of the attributes of a class, as its source states them beside each.

    Those of a field are in its comment, those of a property in its docstring. Without the source
    there are none.
    """
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        with contextlib.suppress(OSError, TypeError, SyntaxError):
            source = textwrap.dedent(inspect.getsource(base))
            (body,) = (x.body for x in ast.parse(source).body if isinstance(x, ast.ClassDef))
            lines = source.splitlines()
            for node in body:
                if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                    found[node.target.id] = _split(_comment(lines, node))
                elif isinstance(node, ast.FunctionDef):
                    found[node.name] = attribute_words(ast.get_docstring(node) or "")
    for field in dataclasses.fields(kind):
        if "unit" in field.metadata:
            found[field.name] = field.metadata["unit"], field.metadata["meaning"]
    return found


def attribute_words(doc: str) -> tuple[str, str]:
    """Unit and meaning in the first sentence of a docstring."""
    first = " ".join(doc.split("\n\n")[0].split())
    return _split(re.split(r"\.(?= [A-Z]|$)", first)[0])


def _comment(lines: list[str], node: ast.AnnAssign) -> str:
    """The comment at the end of the lines of a field, or those above it."""
    for line in lines[node.lineno - 1 : node.end_lineno]:
        if (beside := re.search(r"  # (.*)", line)) is not None:
            return beside[1]
    above: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if (comment := re.match(r"\s+# (.*)", line)) is None:
            break
        above.insert(0, comment[1])
    return " ".join(above)


def _split(words: str) -> tuple[str, str]:
    """The unit in words such as "period [s]", "m: of the tip" or "1/m", and the rest of them."""
    if (alone := re.fullmatch(r"(m|1/m|m\^3|m\^2)(?:: (.*))?", words)) is not None:
        return alone[1], alone[2] or ""
    units = [each for each in re.findall(r"\[([^\]]*)\]", words) if each not in ("x, v", "x")]
    if not units:
        return "", words
    rest = " ".join(words.replace(f"[{units[0]}]", "").split())
    return units[0], re.sub(r" +([,;.:])", r"\1", rest).lstrip(",;.: ")
