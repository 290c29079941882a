"""Checks of the plain numbers in a class of options, which start no backend of JAX."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .parts import brief, whole


def require_number(name: str, value: Any, least: float, most: float = math.inf) -> None:
    """Refuse a value that is no real number from `least` to `most`, both included."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number, got {brief(value)}")
    if not least <= value <= most:
        bound = f"at least {least:g}" + f" and at most {most:g}" * math.isfinite(most)
        raise ValueError(f"{name} must be {bound}, got {value!r}")


def check_numbers(
    options: Any,
    least: Mapping[str, int] | None = None,
    most_count: float = math.inf,
    most: float = math.inf,
) -> None:
    """Check the numbers of a frozen class of options, and store them as plain ones.

    Counts, fields with a whole default, are at least 1 or what `least` says, and at most
    `most_count`; the other numbers are above 0, and finite or at most `most`.

    **Raises:** `ValueError` naming the field.
    """
    for field in dataclasses.fields(options):
        name, value = field.name, getattr(options, field.name)
        if type(field.default) is int:
            value = whole(name, value, (least or {}).get(name, 1), most_count)
        elif type(field.default) is float:
            plain = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (plain and 0 < value <= most and value < math.inf):
                bound = "a number above 0" if most == math.inf else f"above 0 and at most {most:g}"
                raise ValueError(f"{name} must be {bound}, got {brief(value)}")
            value = float(value)
        object.__setattr__(options, name, value)  # of plain types, so that programs are kept
