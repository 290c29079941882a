"""Common base of `Scene` and `Structure`: named quantities and a TOML file."""

import abc
import os
from pathlib import Path
from typing import Any, Self

from .._base.files import read_bounded
from .._base.parts import Part, brief
from .._base.toml import naming, read_toml


class Mechanism(Part):
    """Bodies with friction in their joints; a `Scene` is the smallest."""

    @abc.abstractmethod
    def _rebuilt(self, changes: dict[str, Any]) -> Self:
        """A checked copy with the applicable changes."""

    @abc.abstractmethod
    def _quantity_names(self) -> list[str]:
        """The names that `replace` takes."""

    def replace(self, *unnamed: Any, **changes: Any) -> Self:
        """A copy with named quantities of any part changed: `replace(D=2.5, mu_s=0.3)`.

        Under a trace (`jit`, `vmap`) a value outside its domain becomes NaN, and so do all results
        that depend on it.

        **Arguments:**

        - `unnamed`: refused, since every quantity has a name.
        - `changes`: new values in SI units, by the names of quantities, also of those that follow
          from others: `replace(**{"K_t/K_n": 0.5})` (`quantities.py`). Whole parts have names as
          well: `replace(friction=Coulomb(0.4))`. A quantity passed together with the part that
          holds it is changed in the new part. For a structure, M, C, K and F can be replaced;
          `replace(D=2.5)` changes every joint that has a D, and `replace(**{"left.D": 2.5})` the
          joint named left, also together with a D for all.

        **Raises:** `ValueError` for a name unknown after the change, listing the known ones, and
        for concrete values outside their domain; `TypeError` for values without a name.
        """
        if unnamed:
            raise TypeError(
                "replace takes quantities by name: type replace(D=2.4), or "
                'replace(**{"left.D": 2.4})'
            )
        new = self._rebuilt(changes)
        others = changes.keys() - {*new._quantity_names()}
        if others:
            from .attributes import with_derived

            return with_derived(new, {name: changes[name] for name in changes if name in others})
        return new

    def _instead_of_setting(self, name: str) -> str:
        return f"type x = x.replace({name}=...), which makes a changed copy"

    def __getattr__(self, name: str) -> Any:
        """A named quantity as `replace` sets it. Python calls this for missing attributes only."""
        from .attributes import attribute

        return attribute(self, name)

    def __getitem__(self, name: str) -> Any:
        """The quantity of this name, also of one that is no attribute's: `scene["K_t/K_n"]`."""
        if not isinstance(name, str):
            raise TypeError(f"a quantity has a name, such as 'D', got {brief(name)}")
        return getattr(self, name)

    def _repr_html_(self) -> str:
        from .attributes import mechanism_table

        return mechanism_table(self)

    def __dir__(self) -> list[str]:
        from .quantities import quantity_names

        return [*super().__dir__(), *filter(str.isidentifier, quantity_names(self))]

    @classmethod
    @abc.abstractmethod
    def _from_document(cls, document: dict[str, Any], folder: Path) -> Self:
        """Built from the tables of a TOML file that lies in `folder`."""

    @classmethod
    def load(cls, path: str | os.PathLike) -> Self:
        """Read a TOML file, as `save` writes it; docs/model.md has the keys of a structure.

        **Arguments:**

        - `path`: the TOML file; files that it names are beside it.

        **Raises:** `OSError` if a file cannot be read; `ValueError` naming the file and the key for
        an entry that is unknown, missing, ill-fitting or outside its domain.
        """
        with naming(path):
            return cls._from_document(read_toml(read_bounded(path)), Path(path).parent)
