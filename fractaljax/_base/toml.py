"""TOML files: one annotated writer, one reader, and parts as tables of quantities."""

import contextlib
import dataclasses
import inspect
import json
import os
import tomllib
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

from .laws import Law
from .parts import Part, argument_name, brief, is_absent, quantity_name


class Noted(NamedTuple):
    """A value with a comment beside it; without a value the key itself is commented out."""

    value: Any
    comment: str


# --- writing ------------------------------------------------------------------------------


def write_toml(comment: str, document: Mapping[str, Any]) -> str:
    """The text of a TOML file: mappings are tables, None is left out, `Noted` gets a comment."""
    return "\n".join([f"# {comment}", *_table("", document)]) + "\n"


def _table(name: str, table: Mapping[str, Any]) -> list[str]:
    inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    rows = [_row(key, x) for key, x in table.items() if key not in inner and x is not None]
    header = [f"[{name}]"] if name and (rows or not inner) else []
    lines = ["", *header, *rows] if header or rows else []
    for key, value in inner.items():
        lines += _table(f"{name}.{_key(key)}" if name else _key(key), value)
    return lines


def _row(key: str, value: Any) -> str:
    value, comment = value if isinstance(value, Noted) else (value, "")
    note = f"  # {comment}" if comment else ""
    return f"# {_key(key)} ={note}" if value is None else f"{_key(key)} = {_value(value)}{note}"


def _key(name: str) -> str:
    bare = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if bare else _quoted(name)


def _value(value: Any) -> str:
    match value:
        case str():
            lines = "\n" in value and value.replace("\n", "").isprintable() and "'''" not in value
            return f"'''\n{value}'''" if lines else _quoted(value)
        case bool() | int():
            return str(value).lower()
        case Mapping():
            return "{" + ", ".join(_row(key, inner) for key, inner in value.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(map(_value, value)) + "]"
    return _value(value.tolist()) if getattr(value, "ndim", 0) else repr(float(value))


def _quoted(text: str) -> str:
    # JSON and TOML escape alike, except for DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", r"\u007f")


def part_table(part: Part) -> dict[str, Any]:
    """The table of a part: numbers with unit and meaning, and its sub-parts as nested tables.

    **Raises:** `ValueError` for a law without a name.
    """
    table = {}
    for field in dataclasses.fields(part):
        name, value = quantity_name(field), getattr(part, field.name)
        if is_absent(field, value):
            continue
        if isinstance(value, Part):
            if isinstance(value, Law) and type(value) is not field.type:
                table[name] = law_table(name, value)
            else:
                table[name] = part_table(value)
        elif "unit" in field.metadata:
            table[name] = Noted(value, "{unit}: {meaning}".format(**field.metadata))
        else:
            note = field.metadata.get("note")
            table[name] = value if note is None else Noted(value, note)
    return table


def law_table(name: str, part: Law) -> dict[str, Any]:
    """The table of a law, with the name of its class; errors as `part_table`."""
    kind, kinds = type(part), part.by_name()
    if kind not in kinds.values():
        choices = ", ".join(choice.__name__ for choice in kinds.values())
        raise ValueError(f"a file holds as {name} one of {choices}, got {kind.__name__}")
    law = next(law for law in kinds if kinds[law] is kind)
    others = ", ".join(f'"{other}"' for other in kinds if other != law)
    return {"law": Noted(law, f"or {others}")} | part_table(part)


# --- reading ------------------------------------------------------------------------------


def read_toml(content: bytes) -> dict[str, Any]:
    """The tables of a TOML file. **Raises:** `ValueError` saying where it is not TOML."""
    try:
        return tomllib.loads(content.decode())
    except ValueError as error:
        raise ValueError(f"not a TOML file: {error}") from None


@contextlib.contextmanager
def naming(path: str | os.PathLike) -> Iterator[None]:
    """Turn errors in the content of a file into one `ValueError` that begins with its name.

    **Raises:** `TypeError` for what is not the name of a file.
    """
    if not isinstance(path, (str, bytes, os.PathLike)):
        raise TypeError(f"path must be the name of a file, got {brief(path)}")
    try:
        yield
    except RecursionError:
        raise ValueError(f"{path}: its tables or arrays are nested too deeply") from None
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def table_at(document: Mapping[str, Any], key: str, inside: str = "") -> dict[str, Any]:
    """The table `key` of `document`, which the file has under the prefix `inside` ("joints.")."""
    if key not in document:
        raise ValueError(f"the table [{inside}{key}] is missing")
    if not isinstance(document[key], dict):
        raise ValueError(f"[{inside}{key}] must be a table, got {brief(document[key])}")
    return document[key]


def refuse_unknown(where: str, keys: Collection[str], allowed: Collection[str]) -> None:
    """Refuse a key in `keys` that is not in `allowed`; `where` names the table."""
    for key in keys:
        if key not in allowed:
            raise ValueError(f"{where} has the unknown key {key!r}; known are {', '.join(allowed)}")


def read_part(kind: type[Part], table: Mapping[str, Any], name: str = "") -> Any:
    """The part of this kind in the table `name` of a file, or in the whole file.

    **Raises:** `ValueError` or `TypeError` naming the table and the key that is unknown, missing
    or outside its domain.
    """
    where, inside = (f"[{name}]", f"{name}.") if name else ("the file", "")
    fields = {quantity_name(field): field for field in dataclasses.fields(kind)}
    refuse_unknown(where, table, fields)
    arguments, parameters = dict(table), inspect.signature(kind.__init__).parameters
    for key, field in fields.items():
        inner = field.metadata.get("kind", field.type)
        if isinstance(inner, type) and issubclass(inner, Part):
            below, name_below = table_at(table, key, inside), f"{inside}{key}"
            if issubclass(inner, Law):
                arguments[key] = read_law(inner, _usual_law(field, inner) | below, name_below)
            else:
                arguments[key] = read_part(inner, below, name_below)
        elif (
            key not in table and parameters[argument_name(field)].default is inspect.Parameter.empty
        ):
            raise ValueError(f"{where} lacks the key {key!r}")
    try:
        return kind(**{argument_name(fields[key]): value for key, value in arguments.items()})
    except (ValueError, TypeError) as error:
        raise type(error)(f"{where} {error}" if name else str(error)) from None


def read_law(base: type[Law], table: Mapping[str, Any], name: str) -> Any:
    """The law whose `law_table` is in the table `name` of a file; errors as `read_part`."""
    below, kinds = dict(table), base.by_name()
    law = below.pop("law", "")
    if not isinstance(law, str) or law not in kinds:
        choices = " or ".join(f'"{choice}"' for choice in kinds)
        raise ValueError(f"[{name}] law must be {choices}, got {brief(law)}")
    return read_part(kinds[law], below, name)


def _usual_law(field: dataclasses.Field, kind: type[Law]) -> dict[str, str]:
    """The law of a table that names none: that of the field's only kind, or its usual one."""
    names = [law for law, each in kind.by_name().items() if each is kind]
    usual = field.metadata.get("law", names[0] if names else None)
    return {} if usual is None else {"law": usual}
