"""Packages that import each of their names on first use, so that a user waits for those alone."""

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from .suggest import did_you_mean


class _Lazy(ModuleType):
    """A package whose stub tells where each of its names is defined."""

    _places: dict[str, tuple[str, str]]  # module and the name in it

    def __getattr__(self, name: str) -> Any:
        if name not in self._places:
            hint = did_you_mean(name, self._places)
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}{hint}")
        place, there = self._places[name]
        home = importlib.import_module(place, self.__name__)
        attributes = vars(home)
        # A name that it lacks is a module in it.
        value = (
            attributes[there]
            if there in attributes
            else importlib.import_module(f".{there}", home.__name__)
        )
        from .usage import explain_class, explained  # they load JAX

        if isinstance(value, type):
            explain_class(value)
        elif callable(value) and not isinstance(value, ModuleType):
            value = explained(value, name, self.__name__)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Python binds each imported module in its package, but `plot.cycle` is a function.
        if not (name in self._places and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __reduce__(self):
        return importlib.import_module, (self.__name__,)  # functions that name it can be pickled

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self._places})


def make_lazy(package: str) -> None:
    """Give a package the names that its stub, `__init__.pyi`, imports; checkers read it too."""
    module = sys.modules[package]
    stub = ast.parse(Path(str(module.__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    places = {}
    for node in stub.body:
        if isinstance(node, ast.ImportFrom):
            for name in node.names:
                place = "." * node.level + (node.module or "")
                places[name.asname or name.name] = (place, name.name)
    module.__dict__.update(_places=places, __all__=list(places))
    module.__class__ = _Lazy
