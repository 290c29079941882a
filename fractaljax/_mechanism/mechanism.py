"""Common base of `Scene` and `Structure`: named quantities and a TOML file."""

import abc
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._base.files import read_bounded
from .._base.parts import Part, brief
from .._base.toml import naming, read_toml

if TYPE_CHECKING:
    from .joint import AnyJoint, Dof
    from .structure import Structure


class Derived(NamedTuple):
    """A quantity that is not stored but follows from stored ones, and can be set by them."""

    meaning: str  # and symbol
    domain: dict[str, float]  # as `number` takes it
    get: Callable[[Any], Array]
    set: Callable[[Any, Any], dict[str, Any]]  # the changes of stored quantities


class Mechanism(Part):
    """Bodies with friction in their joints: a `Structure`, or a `Scene`, the smallest.

    Callers ask the mechanism for what they need, not which class it is.
    """

    names: eqx.AbstractVar[tuple[str, ...] | None]  # of the n degrees of freedom
    joint_names: eqx.AbstractVar[tuple[str, ...]]
    F: eqx.AbstractVar[Any]  # external force [N], None if there is none
    mesh: eqx.AbstractVar[Any]  # for pictures, None if there is none
    kind: eqx.AbstractClassVar[str]  # in messages

    @property
    @abc.abstractmethod
    def n(self) -> int:
        """The number of degrees of freedom."""

    @property
    def uncoupled(self) -> bool:
        """True for the mass on a belt of Eq. 39, for which equations of closed form hold.

        Its M, C and K are diagonal, and its joint acts along its two degrees of freedom.
        """
        return False

    @property
    def band(self) -> tuple[float, float] | None:
        """The range of |Im s| [rad/s] in which eigenvalues are valid; None for no limit."""
        return None

    @property
    def coarse(self) -> Any:
        """A subspace with approximate modes for a reduced structure, else None."""
        return None

    def index(self, dof: "Dof | np.integer") -> int:
        """The index of a degree of freedom from `dof`, its index or name.

        **Raises:** `ValueError` if there is none; `TypeError` for anything else.
        """
        if isinstance(dof, bool) or not isinstance(dof, (int, str, np.integer)):
            raise TypeError(f"a degree of freedom must be an index or a name, got {dof!r}")
        dofs: list[Any] = list((self.names or ()) if isinstance(dof, str) else range(self.n))
        if dof not in dofs:
            has = some_of(dofs) or "no names"
            raise ValueError(f"unknown degree of freedom {dof!r}; the {self.kind} has {has}")
        return dofs.index(dof)

    @abc.abstractmethod
    def over_mass(self, forces: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """M^-1 times forces."""

    @property
    def is_sparse(self) -> bool:
        """True if the matrices are large and sparse, so that `reduce` must come first."""
        return False

    @abc.abstractmethod
    def require_one(self) -> None:
        """Refuse a batch, and what is too large for computations without reduction."""

    @abc.abstractmethod
    def as_structure(self) -> "Structure":
        """This mechanism by its matrices."""

    @abc.abstractmethod
    def joints_by_name(self) -> "dict[str, AnyJoint]":
        """The joints; a scene is its own joint, named ""."""

    @property
    def sole_joint(self) -> "AnyJoint | None":
        """The joint of a scene; None for a structure, whose joints have names."""
        return self.joints_by_name().get("")

    @abc.abstractmethod
    def with_joints(self, joints: Mapping[str, Any]) -> Self:
        """A copy with other joints of the same names, not checked."""

    @abc.abstractmethod
    def substituted(self, changes: Mapping[str, Any]) -> Self:
        """Like `replace` for stored quantities that have a value, without checks."""

    def derived_quantities(self) -> Mapping[str, Derived]:
        """The quantities that can be set besides the stored ones."""
        return {}

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

    @abc.abstractmethod
    def embedded(self, beside: Path) -> tuple[str, dict[Path, bytes]]:
        """What stands for it in another TOML file, with the contents of files `beside` that one."""

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


def some_of(items: Iterable[Any]) -> str:
    """At most ten of the items, and their number."""
    texts = list(map(str, items))
    return ", ".join(texts[:10]) + (f", ... ({len(texts)} in all)" if len(texts) > 10 else "")
