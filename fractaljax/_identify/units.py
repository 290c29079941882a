"""Units of length, and the agreement of a file with the user."""

import contextlib
import math

Unit = str | float | None  # a name, or a number of metres

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12, "Å": 1e-10}
UNITS |= dict.fromkeys(("µm", "μm", "micron", "microns", "micrometer", "micrometre"), 1e-6)
UNITS |= {"nanometer": 1e-9, "nanometre": 1e-9, "angstrom": 1e-10}


def unit_named(word: str) -> str | None:
    """The key of `UNITS` for a word, in any case if it has more than two letters, or None."""
    spellings = (word, word.lower() if len(word) > 2 else word)
    return next((spelling for spelling in spellings if spelling in UNITS), None)


def metres(unit: str | float, of: str = "") -> float:
    """One `unit` in metres; `of` names the quantity in an error.

    A number is a unit of so many metres.

    **Raises:** `ValueError` listing the known units.
    """
    key = unit_named(str(unit).strip())
    if key is not None:
        return UNITS[key]
    with contextlib.suppress(ValueError):
        if 0 < float(unit) < math.inf:
            return float(unit)
    known_units = f"one of {', '.join(UNITS)}, or a number of metres"
    raise ValueError(f"the unit{of} must be {known_units}, got {unit!r}")


def scale(file_unit: str | None, user_unit: Unit, what: str, option: str) -> float:
    """The unit of `what` in metres, from the file or from `option`.

    **Raises:** `ValueError` if neither gives it, if they differ, and as `metres` does.
    """
    from_file, from_user = (
        None if u is None else metres(u, f" of {what}") for u in (file_unit, user_unit)
    )
    unit = reconcile(f"the unit of {what}", from_file, from_user)
    if unit is None:
        raise ValueError(f"the file does not say in which unit {what} are: give it ({option} um)")
    return unit


def reconcile(
    name: str, stored: float | None, argument: float | None, where: str = "in the file"
) -> float | None:
    """The value stored in a file, or else the user's argument. They must not differ."""
    if stored is None or argument is None:
        return argument if stored is None else stored
    if abs(stored - argument) > 1e-6 * abs(stored):
        raise ValueError(f"{name} is {stored:g} m {where}, got {argument:g}")
    return stored
