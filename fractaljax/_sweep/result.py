"""What a sweep returns: a measure on the grid of some quantities, with their names and values."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import DTypeLike, Float

from .._base import html
from .._base.parts import Record
from .._mechanism.quantities import meaning, unit
from . import labels

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
    # Name, unit and meaning of what a measure with a single array gives.
    measured: tuple[str, str, str] = eqx.field(static=True, repr=False, default=("value", "", ""))

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """The values (n,) of each quantity by its name."""
        return dict(zip(self.names, self.points, strict=True))

    @property
    def _single(self) -> bool:
        return jax.tree_util.all_leaves([self.values])

    def _leaves(self) -> dict[str, Any]:
        """The arrays of the measure by name."""
        return labels.leaves_by_name(self.measured[0], self.values)

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

    def _repr_html_(self) -> str:
        """What Jupyter shows: the axes of the grid, then the arrays of the measure."""
        size = " x ".join(f"{name}: {len(x)}" for name, x in self.axes.items())
        x = self.scene
        rows = [(name, v, unit(x, name), meaning(x, name)) for name, v in self.axes.items()]
        for name, leaf in self._leaves().items():
            rows.append((name, leaf, *labels.leaf_words(self.measured, self.values, name)))
        return html.table(f"fractaljax.Sweep ({size})", rows)

    def to_xarray(self) -> "DataArray | Dataset":
        """A `DataArray` with units on its axes; for a pytree a `Dataset`, one variable per leaf.

        It has the name of the measure. Units and meanings of axes and arrays are in their `attrs`,
        and dimensions beyond the grid have names, such as mode and dof.

        **Raises:** `ImportError` unless xarray is installed.
        """
        try:
            import xarray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError("to_xarray needs xarray: python -m pip install xarray") from None
        x, coords = self.scene, {}
        for name, values in self.axes.items():
            coords[name] = name, values, {"units": unit(x, name), "long_name": meaning(x, name)}

        grid = len(self.names)
        leaves = self._leaves()
        dims = labels.dimensions({name: np.shape(x)[grid:] for name, x in leaves.items()})
        arrays = {}
        for name, leaf in leaves.items():
            key = name + "_" * (name in coords)  # an axis may have the name already
            about = labels.attributes(*labels.leaf_words(self.measured, self.values, name))
            arrays[key] = xarray.DataArray(leaf, coords, [*self.names, *dims[name]], key, about)
        return next(iter(arrays.values())) if self._single else xarray.Dataset(arrays)

    def plot(self, ax: Any = None, **options: Any) -> Any:
        """A picture of the sweep: a map of growth rates, the stiffness, or curves of a scalar.

        **Arguments:**

        - `ax`: axes to draw in, by default those of a new figure.
        - `options`: those of the function of `fractaljax.plot` that draws it: `growth_map` over
          two quantities, `stability_chart` over one, `stiffness`, or `curves`.

        **Returns:** the Axes; of a stiffness, both.

        **Raises:** `ValueError` for more than two axes, and for arrays that no picture shows.
        """
        from .. import plot

        own = {} if ax is None else {"ax": ax}
        maps = len(self.names) == 2 and min(map(len, self.points)) > 1
        grows = hasattr(self.values, "growth_rate") or self.measured[0] == "growth_rate"
        if len(self.names) > 2:
            raise ValueError(f"a picture has one or two axes, the sweep {len(self.names)}")
        if grows and maps:
            return plot.growth_map(self, **own, **options)
        if hasattr(self.values, "eigenvalues") and not maps:
            return plot.stability_chart(self, **own, **options)
        if not self._single:
            if ax is None and (isinstance(self.values, tuple) or hasattr(self.values, "K_n")):
                return plot.stiffness(self, **options)
            names = ", ".join(self._leaves())
            raise ValueError(f"the sweep holds several arrays: plot one of {names}")
        name, unit_text, _ = self.measured
        options = {"label": f"{name} [{unit_text}]" if unit_text else name} | options
        return plot.curves(self, **own, **options)
