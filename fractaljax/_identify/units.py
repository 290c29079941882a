"""Units of length, and what a file says against what the user says."""

import contextlib
import math

Unit = str | float | None  # a name, or a number of metres

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12, "Å": 1e-10}
UNITS |= dict.fromkeys(("µm", "μm", "micron", "microns", "micrometer", "micrometre"), 1e-6)
UNITS |= {"nanometer": 1e-9, "nanometre": 1e-9, "angstrom": 1e-10}


def known_unit(word: str) -> str | None:
    """The key of `UNITS` for a word, in any case if it has more than two letters, or None."""
    spellings = (word, word.lower() if len(word) > 2 else word)
    return next((spelling for spelling in spellings if spelling in UNITS), None)


def metres(unit: str | float, of: str = "") -> float:
    """One `unit` in metres; `of` says what it is the unit of.

    A number is a unit of so many metres.

    **Raises:** `ValueError` listing the known units.
    """
    known = known_unit(str(unit).strip())
    if known is not None:
        return UNITS[known]
    with contextlib.suppress(ValueError):
        if 0 < float(unit) < math.inf:
            return float(unit)
    known_units = f"one of {', '.join(UNITS)}, or a number of metres"
    raise ValueError(f"the unit{of} must be {known_units}, got {unit!r}")


def scale(own: str | None, given: Unit, what: str, option: str) -> float:
    """The unit of `what` in metres, from the file or from `option`.

    **Raises:** `ValueError` if neither says it, if both differ, and as `metres`.
    """
    from_file, asked = (None if u is None else metres(u, f" of {what}") for u in (own, given))
    unit = agreed(f"the unit of {what}", from_file, asked)
    if unit is None:
        raise ValueError(f"the file does not say in which unit {what} are: give it ({option} um)")
    return unit


def agreed(
    name: str, own: float | None, given: float | None, where: str = "in the file"
) -> float | None:
    """The file's own value, or the given one where it has none. They must not differ."""
    if own is None or given is None:
        return given if own is None else own
    if abs(own - given) > 1e-6 * abs(own):
        raise ValueError(f"{name} is {own:g} m {where}, got {given:g}")
    return own
