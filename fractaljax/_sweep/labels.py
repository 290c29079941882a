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


def leaves_by_name(values: Any) -> dict[str, Any]:
    """The arrays of a pytree by the path that leads to each; "" for a single one."""
    leaves = jax.tree_util.tree_leaves_with_path(values)
    return {jax.tree_util.keystr(p, simple=True, separator="."): leaf for p, leaf in leaves}


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


def leaf_words(values: Any, name: str) -> tuple[str, str]:
    """Unit and meaning of an array of `values`, where its class states them."""
    about = meanings(type(values)) if dataclasses.is_dataclass(values) else {}
    return about.get(name, ("", ""))


def attributes(unit: str, meaning: str) -> dict[str, str]:
    """The attributes of an array as xarray has them, without those that are empty."""
    both = {"units": "1" if unit == "-" else unit, "long_name": meaning}
    return {key: value for key, value in both.items() if value}
