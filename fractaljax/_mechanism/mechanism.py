"""Common base of `Scene` and `Structure`: named quantities and a TOML file."""

import abc
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import equinox as eqx
from jaxtyping import Array

from .._base.files import read_bounded
from .._base.parts import Part
from .._base.toml import naming, read_toml

if TYPE_CHECKING:
    from .joint import AnyJoint
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

    @abc.abstractmethod
    def require_one(self) -> None:
        """Refuse a batch, and what is too large for computations without reduction."""

    @abc.abstractmethod
    def as_structure(self) -> "Structure":
        """This mechanism by its matrices."""

    @abc.abstractmethod
    def joints_by_name(self) -> "dict[str, AnyJoint]":
        """The joints; a scene is its own joint, named ""."""

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

    def replace(self, **changes: Any) -> Self:
        """A copy with named quantities of any part changed: `replace(D=2.5, mu_s=0.3)`.

        Under a trace (`jit`, `vmap`) a value outside its domain becomes NaN, and so do all results
        that depend on it.

        **Arguments:**

        - `changes`: new values in SI units, by the names of quantities. Whole parts have names as
          well: `replace(friction=Coulomb(0.4))`. A quantity passed together with the part that
          holds it is changed in the new part. For a structure, M, C, K and F can be replaced;
          `replace(D=2.5)` changes every joint that has a D, and `replace(**{"left.D": 2.5})` the
          joint named left, also together with a D for all.

        **Raises:** `ValueError` for a name unknown after the change, listing the known ones, and
        for concrete values outside their domain.
        """
        new = self._rebuilt(changes)
        for name in changes:
            if name not in new._quantity_names():
                listed = ", ".join(new._quantity_names())
                raise ValueError(f"{self.kind} has no quantity {name!r}; it has {listed}")
        return new

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
