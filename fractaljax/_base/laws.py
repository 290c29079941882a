"""User-defined laws: their names in files, their numbers as arrays, and their refusal."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool

from .parts import Part, nan_where, number, quantity_name


def register(law: str, kind: type[Part], laws: dict[str, Any]) -> None:
    """Register `law` as the name of this kind in TOML files.

    **Raises:** `ValueError` if another kind has that name.
    """
    registered = laws.get(law, kind)
    # A notebook cell that is run again creates its class anew.
    if (registered.__module__, registered.__qualname__) != (kind.__module__, kind.__qualname__):
        raise ValueError(f"the law {law!r} is {registered.__name__} already")
    laws[law] = kind


def is_built_in(law: Part, base: str) -> bool:
    """True for a law of the package in which the module `base` defines its base class."""
    return type(law).__module__.rpartition(".")[0] == base.rpartition(".")[0]


def make_arrays(law: Part) -> None:
    """Convert to arrays the numbers that a generated `__init__` has stored unchanged.

    **Raises:** as `number`, for a quantity that is not a number.
    """
    for field in dataclasses.fields(law):
        value, static = getattr(law, field.name), field.metadata.get("static", False)
        plain = isinstance(value, (int, float, np.number, np.ndarray))
        numeric = "unit" in field.metadata or (plain and not isinstance(value, bool))
        if numeric and value is not None and not static:
            object.__setattr__(law, field.name, number(quantity_name(field), value))


def refuse(law: Part, bad: Bool[Array, "..."]) -> None:
    """Set the numbers of a traced law to NaN where it is `bad`."""
    poisoned = refused_where(bad, law)
    for field in dataclasses.fields(law):
        if not field.metadata.get("static", False):
            object.__setattr__(law, field.name, getattr(poisoned, field.name))


def refused_where(bad: Bool[Array, "..."], tree: Any) -> Any:
    """As `nan_where`, for batched numbers only; if there are none, for all if any member is bad."""
    batched = any(np.shape(x) == bad.shape for x in jax.tree.leaves(tree))
    if not batched:
        return nan_where(bad.any(), tree)
    return jax.tree.map(lambda x: nan_where(bad, x) if np.shape(x) == bad.shape else x, tree)
