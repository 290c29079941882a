"""Deformed meshes: triangles or quadrilaterals in a plane, or the outer ones of a solid."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from .._mechanism.mesh import Mesh
from .axes import new_figure


def mesh_scale(mesh: Mesh, largest: float) -> float:
    """The factor that draws the largest displacement as 3 % of the size of the mesh."""
    return 0.03 * float(np.linalg.norm(np.ptp(mesh.points, axis=0))) / largest


def draw_mesh(
    mesh: Mesh, ax: Any, reach: float, colours: Float[np.ndarray, " nodes"], most: float
) -> tuple[Any, Any, Callable[[np.ndarray], None]]:
    """The axes, the cells on them, and a function that moves the nodes by (nodes, dim) [m].

    Displacements are at most `reach` [m]; colours from 0 to `most` are means over each cell.
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
    """The projection of the axes that a mesh is drawn on."""
    return "3d" if mesh.solid else None


def mesh_height(mesh: Mesh) -> float:
    """The height of a figure 8.4 inches wide [inches]."""
    if mesh.solid:
        return 6.4
    width, height = np.ptp(mesh.points, axis=0)
    return float(np.clip(7.4 * height / width + 1.8, 2.6, 9.0))
