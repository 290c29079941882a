"""What a sweep returns: a measure on the grid of some quantities, with their names and values."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import DTypeLike, Float

from .._base.parts import Record
from .._mechanism.quantities import unit

if TYPE_CHECKING:
    from xarray import DataArray, Dataset  # pyright: ignore[reportMissingImports]


class Sweep(Record):
    """The values of a measure on a grid; the axes of the grid come first, in the order of `names`.

    Other attributes and indices are those of `values`: `sweep.growth_rate`, `sweep[2, 3]`.
    """

    values: Any  # the array of the measure, or its pytree of arrays
    points: tuple[Float[np.ndarray, " _"], ...]  # the values of each quantity
    names: tuple[str, ...] = eqx.field(static=True)
    scene: Any = eqx.field(repr=False)  # the Scene or Structure that was swept

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """The values (n,) of each quantity by its name."""
        return dict(zip(self.names, self.points, strict=True))

    @property
    def _single(self) -> bool:
        return jax.tree_util.all_leaves([self.values])

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        if not self._single:
            raise TypeError("the measure gives several arrays: take them from sweep.values")
        return np.array(self.values, dtype, copy=copy)

    def __getitem__(self, index: Any) -> Any:
        return self.values[index]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "values":
            raise AttributeError(f"a Sweep has no attribute {name!r}")
        return getattr(self.values, name)

    def to_xarray(self) -> "DataArray | Dataset":
        """A `DataArray` with units on its axes; for a pytree a `Dataset`, one variable per leaf.

        **Raises:** `ImportError` unless xarray is installed.
        """
        try:
            import xarray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError("to_xarray needs xarray: python -m pip install xarray") from None
        coords = {
            name: (name, values, {"units": unit(self.scene, name)})
            for name, values in self.axes.items()
        }

        def labelled(name, leaf):
            dimensions = [f"{name}_{i}" for i in range(np.ndim(leaf) - len(self.names))]
            return xarray.DataArray(leaf, coords, [*self.names, *dimensions])

        if self._single:
            return labelled("dim", self.values)
        leaves = jax.tree_util.tree_leaves_with_path(self.values)
        named = [(jax.tree_util.keystr(p, simple=True, separator="."), leaf) for p, leaf in leaves]
        return xarray.Dataset({name: labelled(name, leaf) for name, leaf in named})
