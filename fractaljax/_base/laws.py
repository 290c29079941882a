"""Laws, of the package and of users: names in files, numbers as arrays, and their refusal."""

import dataclasses
import importlib
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Array, Bool

from .parts import Part, nan_where, number, quantity_name


class Law(Part):
    """The base of contact laws, friction laws and spectra, of which users define their own.

    A class statement with `law="name"` gives the class a name in files.

    **Raises:** `ValueError` for a name that another class has.
    """

    named: ClassVar[dict[str, type["Law"]]]  # the classes of one kind by their names in files

    def __init_subclass__(cls, law: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if Law in cls.__bases__:
            cls.named = {}
        if law is None:
            return
        other = (cls.named if _of_this_package(cls) else cls.by_name()).get(law, cls)
        # A notebook cell that is run again creates its class anew.
        if (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(f"the law {law!r} is {other.__name__} already")
        cls.named[law] = cls

    def __check_init__(self):
        if not self.built_in:
            make_arrays(self)
            self.check_as_defined()

    @classmethod
    def by_name(cls) -> dict[str, type["Law"]]:
        """The classes of this kind by their names in files: the package's and users' own."""
        importlib.import_module(f"{__package__}.all_laws")  # each registers its name
        return dict(sorted(cls.named.items()))

    @property
    def built_in(self) -> bool:
        """True for a law of this package, whose `__init__` checks its numbers."""
        return _of_this_package(type(self))

    def check_as_defined(self) -> None:
        """Check a user's law, whose numbers are arrays by now."""


def _of_this_package(kind: type) -> bool:
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


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
