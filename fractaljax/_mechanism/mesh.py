"""Positions of the degrees of freedom of a structure, for pictures of its motion."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Shaped

_KEYS = ("points", "dofs", "cells")


class Mesh:
    """Nodes and the cells between them; meshes with equal arrays are equal.

    **Arguments:**

    - `points`: (nodes, 2) or (nodes, 3), positions of the nodes [m].
    - `dofs`: the degree of freedom of each displacement, from 0, of the same shape, or -1 where it
      is fixed.
    - `cells`: (cells, 3) or (cells, 4), the nodes, from 0, of triangles or quadrilaterals, on the
      surface if the body is solid.

    **Raises:** `ValueError` for other shapes, and for indices of nodes that do not exist.
    """

    points: Float[np.ndarray, "nodes dim"]
    dofs: Int[np.ndarray, "nodes dim"]
    cells: Int[np.ndarray, "cells corners"]

    def __init__(
        self,
        points: ArrayLike | Sequence[Any],
        dofs: ArrayLike | Sequence[Any],
        cells: ArrayLike | Sequence[Any],
    ):
        p, d, c = np.asarray(points, float), np.asarray(dofs), np.asarray(cells)
        if p.ndim != 2 or p.shape[1] not in (2, 3):
            raise ValueError(f"points must be (nodes, 2) or (nodes, 3), got {p.shape}")
        if d.shape != p.shape:
            raise ValueError(f"dofs must have shape {p.shape} as points, got {d.shape}")
        if c.ndim != 2 or c.shape[1] not in (3, 4):
            raise ValueError(f"cells must be (cells, 3) or (cells, 4), got {c.shape}")
        _require_whole("dofs", d, -1, np.inf)
        _require_whole("cells", c, 0, len(p))
        self.points, self.dofs, self.cells = p, d.astype(int), c.astype(int)
        content = hashlib.sha256()
        for each in self.arrays().values():
            content.update(np.ascontiguousarray(each).tobytes())
        self._digest = content.hexdigest()

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], name: str) -> "Mesh":
        """The mesh in `arrays`, by name, of the file called `name`.

        **Raises:** `ValueError` naming the file.
        """
        if missing := [key for key in _KEYS if key not in arrays]:
            raise ValueError(f"{name} lacks {', '.join(missing)}: a mesh is {', '.join(_KEYS)}")
        try:
            return cls(*(arrays[key] for key in _KEYS))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None

    def require(self, n: int) -> "Mesh":
        """The mesh itself, for a structure of `n` degrees of freedom.

        **Raises:** `ValueError` unless its degrees of freedom are below n.
        """
        _require_whole("dofs", self.dofs, -1, n)
        return self

    def arrays(self) -> dict[str, Any]:
        """The arrays points, dofs and cells by name, as the functions in `plot` take them."""
        return {key: getattr(self, key) for key in _KEYS}

    @property
    def solid(self) -> bool:
        """True if the mesh is three-dimensional."""
        return self.points.shape[1] == 3

    def displacements(self, x: Shaped[np.ndarray, "*k n"]) -> Shaped[np.ndarray, "*k nodes dim"]:
        """Displacements of the nodes from `x` (..., n), those of all degrees of freedom."""
        return np.where(self.dofs < 0, 0, x[..., self.dofs])

    def __eq__(self, other) -> bool:
        return isinstance(other, Mesh) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    def __repr__(self) -> str:
        nodes, cells = len(self.points), len(self.cells)
        return f"Mesh({nodes} nodes, {cells} cells, {self._digest[:16]})"


def _require_whole(name: str, held: np.ndarray, least: int, end: float) -> None:
    whole = held.dtype.kind in "iu" or (held == np.rint(held)).all()
    if not (whole and ((held >= least) & (held < end)).all()):
        most = f"from {least} to {end - 1:g}" if np.isfinite(end) else f"from {least} on"
        raise ValueError(f"{name} must be whole numbers {most}")
