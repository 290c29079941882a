"""Deformed meshes: triangles or quadrilaterals in a plane, or the outer ones of a solid."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Shaped

from .axes import new_figure

_SHARE = 0.03  # of the size of a mesh, to which the largest displacement is drawn


class Mesh(NamedTuple):
    """Places of nodes [m], and where their displacements stand among n degrees of freedom."""

    points: Float[np.ndarray, "nodes dim"]
    dofs: Int[np.ndarray, "nodes dim"]  # -1 where held
    cells: Int[np.ndarray, "cells corners"]

    @classmethod
    def of(cls, points: ArrayLike, dofs: ArrayLike, cells: ArrayLike, n: int) -> "Mesh":
        """**Raises:** `ValueError` for a mesh that does not fit n degrees of freedom."""
        p, d, c = np.asarray(points, float), np.asarray(dofs), np.asarray(cells)
        if p.ndim != 2 or p.shape[1] not in (2, 3):
            raise ValueError(f"points must be (nodes, 2) or (nodes, 3), got {p.shape}")
        if d.shape != p.shape:
            raise ValueError(f"dofs must have shape {p.shape} as points, got {d.shape}")
        if c.ndim != 2 or c.shape[1] not in (3, 4):
            raise ValueError(f"cells must be (cells, 3) or (cells, 4), got {c.shape}")
        for name, held, least, end in (("dofs", d, -1, n), ("cells", c, 0, len(p))):
            if not (held.dtype.kind in "iu" and ((held >= least) & (held < end)).all()):
                raise ValueError(f"{name} must be whole numbers from {least} to {end - 1}")
        return cls(p, d, c)

    @property
    def solid(self) -> bool:
        """Whether it is drawn in space."""
        return self.points.shape[1] == 3

    def displacements(self, x: Shaped[np.ndarray, "*k n"]) -> Shaped[np.ndarray, "*k nodes dim"]:
        """Of the nodes, from those of all degrees of freedom."""
        return np.where(self.dofs < 0, 0, x[..., self.dofs])

    def scale(self, largest: float) -> float:
        """The factor that draws the largest displacement as 3 % of the size of the mesh."""
        return _SHARE * float(np.linalg.norm(np.ptp(self.points, axis=0))) / largest


def draw_mesh(
    mesh: Mesh, ax: Any, reach: float, colours: Float[np.ndarray, " nodes"], most: float
) -> tuple[Any, Any, Callable[[np.ndarray], None]]:
    """Axes, the cells on them, and a function that displaces the nodes by (nodes, dim) [m].

    Displacements are of at most `reach` [m]; colours from 0 to `most` are means over each cell.
    """
    from matplotlib.collections import PolyCollection

    rest: Any = mesh.points[mesh.cells]
    ends = np.stack([mesh.points.min(axis=0), mesh.points.max(axis=0)], axis=1)
    ends = ends + 1.1 * reach * np.array([-1.0, 1.0])
    style: dict[str, Any] = {"cmap": "viridis", "edgecolors": "0.2", "linewidths": 0.4}
    if ax is None:
        ax = new_figure(8.4, mesh_height(mesh)).add_subplot(projection=projection(mesh))
    if mesh.solid:
        from matplotlib.ticker import MaxNLocator
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        drawn: Any = Poly3DCollection(rest, **style)
        ax.add_collection3d(drawn)
        ax.set(zlim=ends[2], zlabel="z [m]")
        ax.set_box_aspect(np.ptp(ends, axis=1), zoom=1.1)
        for axis, count in zip((ax.xaxis, ax.yaxis, ax.zaxis), (5, 5, 2), strict=True):
            axis.set_major_locator(MaxNLocator(count))
            axis.labelpad = 8
    else:
        outline: dict[str, Any] = {"facecolors": "none", "edgecolors": "0.8", "linewidths": 0.5}
        ax.add_collection(PolyCollection(rest, **outline))
        drawn = ax.add_collection(PolyCollection(rest, **style))
        ax.set_aspect("equal")
    drawn.set_array(colours[mesh.cells].mean(axis=1))
    drawn.set_clim(0, most)
    ax.set(xlim=ends[0], ylim=ends[1], xlabel="x [m]", ylabel="y [m]")

    def move(displacements: np.ndarray) -> None:
        drawn.set_verts((mesh.points + displacements)[mesh.cells])

    return ax, drawn, move


def projection(mesh: Mesh) -> str | None:
    """Of the axes that a mesh is drawn on."""
    return "3d" if mesh.solid else None


def mesh_height(mesh: Mesh) -> float:
    """Of a figure 8.4 inches wide [inches]."""
    if mesh.solid:
        return 6.4
    width, height = np.ptp(mesh.points, axis=0)
    return float(np.clip(7.4 * height / width + 1.8, 2.6, 9.0))
