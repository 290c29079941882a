"""Which columns of a text file are positions, heights, and flags of heights that are valid."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .text import Table

ROLES = ("x", "y", "z", "valid", "invalid")
_TITLES = {  # in lower case and without units
    "x": ("x", "position", "pos", "distance", "lateral", "lateral position", "scan position"),
    "y": ("y",),
    "z": ("z", "height", "heights", "topography", "profile"),
    "valid": ("valid", "validity", "is valid", "quality", "ok", "good", "usable"),
    "invalid": ("invalid", "bad", "missing", "masked"),
}
_UNCLEAR = ("mask", "flag", "flags", "status", "code")  # 1 may stand for good or for bad


def choose_columns(table: Table, selection: Mapping[str, str | int] | None) -> Table:
    """The columns of positions, if any, and heights, in this order; NaN where flags say so.

    `selection` has names of columns, or numbers from 0, by role: x, y, z, and the flags valid or
    invalid. Other roles go by title, or else by the number of columns.

    **Raises:** `ValueError` naming the columns, and what to type, where titles are not clear.
    """
    places = _places(table, selection or {})
    roles = {place: role for role, place in places.items()}
    titles = [_plain(title) for title in table.titles or [""] * table.numbers.shape[1]]
    flagged = "valid" in places or "invalid" in places
    for place, title in enumerate(titles):
        role = next((role for role, synonyms in _TITLES.items() if title in synonyms), None)
        if role is None or place in roles or (flagged and role in ("valid", "invalid")):
            continue
        # Beside selected columns only proper flags count: no option could exclude others.
        flags = role in ("valid", "invalid")
        if "z" not in places or (flags and _other(table, place) is None):
            roles[place] = role
    flags = {place: role for place, role in roles.items() if role in ("valid", "invalid")}
    unclear = [p for p, title in enumerate(titles) if title in _UNCLEAR and p not in roles]
    if unclear and not flagged and "z" not in places:
        title = (table.titles or [])[unclear[0]]
        raise _choice(table, f"1 in column {title!r} may stand for good or bad heights")
    order = _order(table, roles, places, [p for p in range(len(titles)) if p not in flags])
    if flags and len(order) > 3:
        raise _choice(table, "the heights that the flags are of are not clear")
    for place, line in table.words.items():
        if place in order:
            raise ValueError(line)
    numbers = table.numbers[:, order]
    if flags:
        valid = np.all([_valid(table, *flag) for flag in flags.items()], axis=0)
        numbers[~valid, -1] = np.nan
        numbers = numbers[valid | ~np.isnan(numbers[:, :-1]).any(axis=1)]
    picked = [table.titles[place] for place in order] if table.titles else None
    return Table(numbers, picked, [table.units[place] for place in order], table.settings, {})


def suggest_columns(table: Table, error: ValueError) -> ValueError:
    """The error, with a hint how to select columns if there is more than one."""
    return _choice(table, str(error)) if table.numbers.shape[1] > 1 else error


def _order(table: Table, roles: dict[int, str], places: dict[str, int], rest: list[int]):
    """The columns to read: those with a role if they are clear, or else the rest in order."""
    if "z" in places:
        return [places[role] for role in ("x", "y", "z") if role in places]
    by_role = {role: [p for p in rest if roles.get(p) == role] for role in ("x", "y", "z")}
    x, y, z = (len(by_role[role]) for role in ("x", "y", "z"))
    if x == 1 and y <= 1 and z == 1:
        return by_role["x"] + by_role["y"] + by_role["z"]
    several = z > 1 and x > 0  # heights of one profile
    if (several and len(rest) > 2) or (len(rest) > 3 and x + y + z > 1 and z < len(rest)):
        raise _choice(table, "which column is the height is not clear")
    return rest


def _places(table: Table, selection: Mapping[str, str | int]) -> dict[str, int]:
    """The number of each selected column, by role."""
    count = table.numbers.shape[1]
    names = {str(place): place for place in range(count)}
    names |= {title: place for place, title in reversed([*enumerate(table.titles or [])])}
    places = {}
    for role, name in selection.items():
        if role not in ROLES:
            raise _choice(table, f"the role of a column must be one of {', '.join(ROLES)}")
        if str(name) not in names:
            raise _choice(table, f"there is no column {name!r}")
        places[role] = names[str(name)]
    flags = "valid" in places and "invalid" in places
    coordinates = places.keys() & {"x", "y"}
    lacking = (coordinates and "z" not in places) or ("y" in places and "x" not in places)
    if flags or lacking or len(set(places.values())) < len(places):
        what = "x and y need z, y needs x, valid excludes invalid, and each has its own column"
        raise _choice(table, what)
    return places


def _valid(table: Table, place: int, role: str) -> np.ndarray:
    """True where a column of flags marks heights as valid; a gap does not."""
    other = _other(table, place)
    if other is not None:
        name = table.titles[place] if table.titles else place
        what = f"flags must be 0 or 1, got {other:g} in column {name!r}"
        raise _choice(table, what, "x=0 z=1 leaves it out")
    return table.numbers[:, place] == (role == "valid")


def _other(table: Table, place: int) -> float | None:
    """The first number of a column that is not a flag, or None."""
    flags = table.numbers[:, place]
    other = flags[~np.isnan(flags) & (flags != 0) & (flags != 1)]
    return float(other[0]) if other.size else None


def _plain(title: str) -> str:
    return " ".join(title.replace("_", " ").replace("-", " ").lower().split())


def _choice(table: Table, what: str, example: str = "") -> ValueError:
    names: list[Any] = table.titles or list(range(table.numbers.shape[1]))
    shown = ", ".join(f"{k} {name!r}" if table.titles else f"{k}" for k, name in enumerate(names))
    example = example or "x=0 z=1" + " valid=2" * (len(names) > 2)
    return ValueError(f"{what}; columns are {shown}: say which is which (--columns {example})")
