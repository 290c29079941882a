"""Names, units and dimensions of the arrays that a measure gives, from its names and docstrings."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from .._base.html import attribute_words, meanings

# Dimensions of the arrays in results of this package, beyond the grid.
_DIMENSIONS = {
    **dict.fromkeys(("eigenvalues", "resolutions", "counted"), ("mode",)),
    "shapes": ("mode", "dof"),
    "normal_force": ("joint",),
}


def measure_name(measure: Any) -> str:
    """The name of a measure, "value" for a lambda."""
    name = getattr(getattr(measure, "func", measure), "__name__", "").strip("_")
    return name if name.isidentifier() else "value"


def measure_words(measure: Callable) -> tuple[str, str, str]:
    """Name, unit and meaning of what a function measures, the last two from its docstring."""
    doc = inspect.getdoc(getattr(measure, "func", measure)) or ""
    return measure_name(measure), *attribute_words(doc)


def leaf_names(measure: str, values: Any) -> list[str]:
    """The names of the arrays of a pytree that a measure of this name gives.

    Each is the path that leads to it; a single array has the name of the measure.
    """
    places = [place for place, _ in jax.tree_util.tree_leaves_with_path(values)]
    return [jax.tree_util.keystr(x, simple=True, separator=".") or measure for x in places]


def leaves_by_name(measure: str, values: Any) -> dict[str, Any]:
    """The arrays of a pytree by `leaf_names`."""
    return dict(zip(leaf_names(measure, values), jax.tree.leaves(values), strict=True))


def dimensions(shapes: Mapping[str, Sequence[int]]) -> dict[str, list[str]]:
    """Names of the dimensions of arrays beyond the grid, from the shape of each by its name."""
    sizes: dict[str, set[int]] = {}
    for name, shape in shapes.items():
        for dimension, size in zip(_DIMENSIONS.get(name, ()), shape, strict=False):
            sizes.setdefault(dimension, set()).add(size)
    alike = all(len(each) == 1 for each in sizes.values())  # else they are of something else
    named = {}
    for name, shape in shapes.items():
        known = _DIMENSIONS.get(name, ()) if alike else ()
        fallback = [f"{name}_{i}" for i in range(len(shape))]
        named[name] = list(known) if len(known) == len(shape) else fallback
    return named


def leaf_words(measured: tuple[str, str, str], values: Any, name: str) -> tuple[str, str]:
    """Unit and meaning of an array of `values`: of its field, or of the measure that gives it."""
    if dataclasses.is_dataclass(values):
        return meanings(type(values)).get(name, ("", ""))
    single = isinstance(values, tuple) or hasattr(values, "shape")
    return (measured[1], measured[2]) if single else ("", "")


def attributes(unit: str, meaning: str) -> dict[str, str]:
    """The attributes of an array as xarray has them, without those that are empty."""
    both = {"units": "1" if unit == "-" else unit, "long_name": meaning}
    return {key: value for key, value in both.items() if value}
