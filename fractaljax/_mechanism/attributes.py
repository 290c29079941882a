"""Quantities of a mechanism as its attributes, by the names that `replace` takes."""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

from .._base import html
from .._base.parts import leaf, part_rows, quantities
from .._base.suggest import close
from .mechanism import Mechanism
from .quantities import meaning, quantity_names, replaced, value_of


def with_derived(x: Mechanism, values: Mapping[str, Any]) -> Any:
    """`x` with quantities set that it does not store, such as K_t/K_n.

    **Raises:** `ValueError` for an unknown name, listing the others.
    """
    names = quantity_names(x)
    for name in values:
        if name not in names:
            kind, listed = x.kind, ", ".join(x._quantity_names())
            near = similar(x, name)
            hint = f": did you mean {near}?" if near else ""
            raise ValueError(f"{kind} has no quantity {name!r}; it has {listed}{hint}")
    return replaced(x, values)


def similar(x: Mechanism, name: str) -> str:
    """The names of quantities like `name`, or with it in their meaning; else ""."""
    names = list(dict.fromkeys([*quantity_names(x), *x._quantity_names()]))
    word = name.lower().replace("_", " ")
    meant = {each: about.meaning for each, about in x.stored_quantities().items()}
    near = [each for each in names if each.lower() == name.lower()]
    near = near or [each for each in meant if word in re.findall(r"\w+", meant[each].lower())]
    return " or ".join((near or close(name, names))[:3])


def mechanism_table(x: Mechanism) -> str:
    """The quantities of a scene or structure as a table of HTML."""
    title = f"fractaljax.{type(x).__name__}"
    if "contact" in {field.name for field in dataclasses.fields(x)}:
        names = [name for name in quantity_names(x) if name not in x.stored_quantities()]
        rows = part_rows(x) + [(each, value_of(x, each), "-", meaning(x, each)) for each in names]
        return html.table(title, rows)
    rows: list[html.Row] = [("n", x.n, "-", "degrees of freedom")]
    for name, about in x.stored_quantities().items():
        if "." in name or about.meaning == "parameter":
            rows.append((name, about.value, about.unit, about.meaning))
    return html.table(title, [row for row in rows if row[1] is not None], getattr(x, "notes", ()))


def attribute(x: Mechanism, name: str) -> Any:
    """The value of a quantity of `x`, or of a scene's part, that has no attribute of this name.

    **Raises:** `AttributeError` for an unknown name, naming similar ones, and for the quantity of
    several joints that differ in it.
    """
    kind = type(x).__name__
    fields = {field.name for field in dataclasses.fields(x)}
    # A field is missing only while an object is being built; a property may lack one of them.
    if name.startswith("_") or name in fields or hasattr(type(x), name):
        raise AttributeError(f"{kind!r} object has no attribute {name!r}")
    if name in quantity_names(x):
        stored = x.stored_quantities()
        if name in stored and stored[name].value is None:
            return None
        try:
            return value_of(x, name)
        except ValueError as error:
            raise AttributeError(str(error)) from None
    if "contact" in fields and name in (paths := quantities(x)):  # a part of a scene
        return leaf(x, paths[name])
    raise AttributeError(f"a {kind} has no {name}{_instead(x, name)}")


def _instead(x: Mechanism, name: str) -> str:
    """What to type for an attribute that is none."""
    import fractaljax as public

    if name in ("K_n", "K_t"):
        return ": K_n, K_t = fractaljax.stiffness(scene)"
    if name in vars(public)["__all__"]:
        return f": type fractaljax.{name}(...), a function of it"
    near = similar(x, name)
    return f": did you mean {near}?" if near else ""
