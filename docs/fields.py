"""For griffe, which reads the API: what is said of a field beside it becomes its docstring."""

import ast
import re
from typing import Any

import griffe


class Fields(griffe.Extension):
    """The comment at the end of a field's lines or above it, or what `quantity` says of it.

    A line of a docstring that begins with >= is no quotation.
    """

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = re.sub(r"(?m)^(\s*)(>=?) ", r"\1\\\2 ", obj.docstring.value)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        if attr.docstring or not isinstance(attr.parent, griffe.Class) or not attr.lineno:
            return
        said = _declared(attr.value) or _commented(attr.filepath, attr.lineno, attr.endlineno)
        if said:
            said = said.replace("[", "&#91;")  # [x] [m] would be a link
            attr.docstring = griffe.Docstring(said, lineno=attr.lineno, parent=attr)
            attr.value = None  # `quantity(...)` says nothing more


def _declared(value: Any) -> str:
    """Meaning and unit of `quantity(unit, meaning)`."""
    if not str(value).startswith("quantity("):
        return ""
    call: Any = ast.parse(str(value), mode="eval").body
    unit, meaning = map(ast.literal_eval, call.args[:2])
    return f"{meaning} [{unit}]"


def _commented(path: Any, first: int, last: int | None) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    for line in lines[first - 1 : last]:
        if found := re.search(r"  # (.*)", line):
            return found[1]
    above = []
    for line in reversed(lines[: first - 1]):
        if not (found := re.match(r"\s+# (.*)", line)):
            break
        above.insert(0, found[1])
    return " ".join(above)
