"""Checks of the plain numbers in a class of options, which start no backend of JAX."""

import math
from typing import Any

import numpy as np

from .parts import brief


def require_number(name: str, value: Any, least: float, most: float = math.inf) -> None:
    """Refuse a value that is no real number from `least` to `most`, both included."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number, got {brief(value)}")
    if not least <= value <= most:
        bound = f"at least {least:g}" + f" and at most {most:g}" * math.isfinite(most)
        raise ValueError(f"{name} must be {bound}, got {value!r}")
