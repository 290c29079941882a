"""Limit cycles of structures on their meshes, with the contact states of the joints."""

import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from .._base.parts import require_kind, scalar, whole
from .._dynamics.contact_state import STATES, find_state
from .._dynamics.cycle import CycleResult, LimitCycle
from .._mechanism.mesh import Mesh
from .._mechanism.structure import Structure
from .animation import animated, animation_path
from .axes import Axes, Figure, frequency_unit, legend_above, new_figure
from .mesh import draw_mesh, mesh_height, mesh_scale, projection
from .panels import Panels

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation


def cycle_motion(
    cycle: LimitCycle,
    structure: Structure,
    *,
    points: ArrayLike | None = None,
    dofs: ArrayLike | None = None,
    cells: ArrayLike | None = None,
    at: float = 0.0,
    scale: float | None = None,
) -> Panels:
    """A limit cycle at one time: the deformed mesh, and what each joint does over the period.

    The colour is the largest displacement of each node over the period. A mark on the mesh is at
    the mean place of the nodes that a joint's directions touch, in the colour of its contact state.

    **Arguments:**

    - `cycle`: as `limit_cycle` returns it.
    - `structure`: the one of the cycle; for a reduced one, the mesh of the full one is drawn.
    - `points`, `dofs`, `cells`: as in `complex_mode`, by default from the structure's mesh.
    - `at`: the time as a share of the period, from `state` on; 0 by default.
    - `scale`: factor of the displacements from their mean over the period, which by default draws
      the largest as 3 % of the size of the mesh.

    **Raises:** `ValueError` if there is no limit cycle, for a batch, a regularised cycle, the cycle
    of another structure and a mesh that does not fit.
    """
    at = float(scalar("at", at, at_least=0, below=1))
    figure, draw = _picture(_motion(cycle, structure, points, dofs, cells, 1), scale)
    draw(at)
    return Panels(figure)


def animate_cycle(
    cycle: LimitCycle,
    structure: Structure,
    *,
    points: ArrayLike | None = None,
    dofs: ArrayLike | None = None,
    cells: ArrayLike | None = None,
    scale: float | None = None,
    frames: int = 24,
    fps: int = 12,
    path: str | os.PathLike | None = None,
) -> "FuncAnimation":
    """One period of a limit cycle in motion on its mesh, as matplotlib's animation.

    Frame j is the picture of `cycle_motion` at j/frames of the period.

    **Arguments:**

    - `cycle`, `structure`, `points`, `dofs`, `cells`, `scale`: as in `cycle_motion`.
    - `frames`: number of pictures in the period, 24 by default.
    - `fps`: frames per second, 12 by default.
    - `path`: a file, by default none: it ends in .gif for a picture, or in .html for one page with
      its frames and buttons inside, which needs no network.

    **Raises:** as `cycle_motion`; `ValueError` for another ending; `OSError` if the file cannot be
    written.
    """
    frames, fps, path = whole("frames", frames, 2), whole("fps", fps, 1), animation_path(path)
    motion = _motion(cycle, structure, points, dofs, cells, frames)
    figure, draw = _picture(motion, scale)
    return animated(figure, draw, frames, fps, path)


# --- the motion -----------------------------------------------------------------------------


class _Motion(NamedTuple):
    mesh: Mesh
    period: float
    displacements: Float[np.ndarray, "k nodes dim"]  # from the mean, at evenly spaced times
    states: Float[np.ndarray, "k m"]  # of contact, at the same times
    spans: list[list[tuple[float, float, int]]]  # of each joint: begin, duration [s], state
    names: tuple[str, ...]  # of the joints
    places: Float[np.ndarray, "m nodes"] | None  # weights that sum to 1

    def step(self, share: float) -> int:
        """The index of the time nearest to a share of the period."""
        return round(share * len(self.displacements)) % len(self.displacements)


def _motion(
    cycle: LimitCycle, structure: Structure, points: Any, dofs: Any, cells: Any, frames: int
) -> _Motion:
    require_kind("cycle", cycle, LimitCycle)
    require_kind("structure", structure, Structure)
    if np.ndim(cycle.period):
        raise ValueError("a picture shows one cycle: index the batch first")
    if not np.isfinite(cycle.period):
        raise ValueError(f"there is no limit cycle to draw: {CycleResult[cycle.result]}")
    n, faces = cycle.amplitude.shape[-1], cycle._system.faces
    if (n, len(faces)) != (structure.n, len(structure.joints)):
        raise ValueError(
            f"structure must be that of the cycle, with {n} degrees of freedom and {len(faces)} "
            f"joints, got {structure.n} and {len(structure.joints)}"
        )
    mesh_arrays = {"points": points, "dofs": dofs, "cells": cells}
    missing = [name for name, array in mesh_arrays.items() if array is None]
    if len(missing) < len(mesh_arrays):
        if missing:
            raise ValueError(f"a mesh needs {' and '.join(missing)} as well")
        mesh = Mesh(points, dofs, cells)
    elif (mesh := structure.mesh) is None:
        raise ValueError("structure has no mesh: give points, dofs and cells")
    mesh.require(structure._full_n(n))
    # The mean and the largest displacements need more times than are shown: 256 or a few more.
    count = frames * -(-256 // frames)
    x = np.asarray(cycle.orbit(count)[1])[:, :n]
    x = np.asarray(structure.full(x - x.mean(axis=0)))
    tangential = [each[0] for each in faces]
    states = np.asarray(cycle.contact_states(count))[:, tangential]
    spans = [
        list(_spans(cycle, face, start)) for face, start in zip(tangential, states[0], strict=True)
    ]
    touched = structure._touched()
    places = None if touched is None else _places(mesh, touched)
    return _Motion(
        mesh,
        float(cycle.period),
        mesh.displacements(x),
        states,
        spans,
        structure.joint_names,
        places,
    )


def _places(mesh: Mesh, touched: np.ndarray) -> np.ndarray:
    """The weights of nodes in the place of each joint (m, nodes), NaN for a joint off the mesh."""
    weights = np.where(mesh.dofs < 0, 0, touched[:, mesh.dofs]).sum(axis=2)
    total = weights.sum(axis=1, keepdims=True)
    return np.where(total > 0, weights / np.where(total > 0, total, 1), np.nan)


def _spans(cycle: LimitCycle, face: int, start: float) -> Iterator[tuple[float, float, int]]:
    """Yield begin [s], duration [s] and contact state, one after the other over a period."""
    values = {state.name: state.code for state in STATES}
    begin, state = 0.0, int(start)
    for switch in cycle.switches():
        if switch.direction == face + 1:
            yield begin, switch.time - begin, state
            begin, state = switch.time, values[switch.after]
    yield begin, float(cycle.period) - begin, state


# --- drawing --------------------------------------------------------------------------------


def _picture(motion: _Motion, scale: float | None) -> tuple[Figure, Callable[[float], Any]]:
    """The figure, and a function that draws a share of the period."""
    mesh, count = motion.mesh, len(motion.names)
    amplitudes = np.linalg.norm(motion.displacements, axis=2).max(axis=0)
    largest = float(amplitudes.max()) or 1.0
    factor = mesh_scale(mesh, largest) if scale is None else float(scalar("scale", scale, above=0))
    heights = mesh_height(mesh), 1.1 + min(0.26 * count, 4.0)
    figure = new_figure(8.4, sum(heights))
    grid = figure.add_gridspec(2, 1, height_ratios=heights)
    ax: Any = figure.add_subplot(grid[0], projection=projection(mesh))
    per_metre, length = (1e6, "µm") if largest < 1e-3 else (1.0, "m")
    colours = amplitudes * per_metre, largest * per_metre
    _, cells, move = draw_mesh(mesh, ax, factor * largest, *colours)
    bar = figure.colorbar(cells, ax=ax, location="bottom", shrink=0.6, aspect=40)
    bar.set_label(f"largest displacement from the mean [{length}]")
    factor_of, unit = frequency_unit([1 / motion.period])
    ax.set_title(f"{factor_of / motion.period:.4g} {unit}, displacements times {factor:.3g}")
    nowhere = [[np.nan]] * mesh.points.shape[1]
    look: Any = dict(marker="o", markersize=8, markeredgecolor="k", zorder=5)
    marks = [ax.plot(*nowhere, **look)[0] for _ in range(count)]
    cursor = _lanes(figure.add_subplot(grid[1]), motion)

    def draw(share: float) -> Any:
        k = motion.step(share)
        displacements = factor * motion.displacements[k]
        move(displacements)
        cursor.set_xdata([share, share])
        if motion.places is not None:
            at = motion.places @ (mesh.points + displacements)
            for mark, place, state in zip(marks, at, motion.states[k], strict=True):
                mark.set_markerfacecolor(find_state(state).colour)
                if mesh.solid:
                    mark.set_data_3d(*place[:, None])
                else:
                    mark.set_data(*place[:, None])
        return [cells, *marks, cursor]

    return figure, draw


def _lanes(ax: Axes, motion: _Motion) -> Any:
    """Draw the contact states of each joint over the period; a line that marks the time."""
    from matplotlib.patches import Patch

    for i, spans in enumerate(motion.spans):
        bars = [(begin / motion.period, duration / motion.period) for begin, duration, _ in spans]
        colours = [find_state(state).colour for _, _, state in spans]
        ax.broken_barh(bars, (i - 0.4, 0.8), facecolors=colours)
    passed = {state for spans in motion.spans for _, _, state in spans}
    shown = [
        Patch(color=state.colour, label=state.description.format(velocity="t.dx/dt"))
        for state in STATES
        if state.code in passed
    ]
    legend_above(ax, shown)
    few = len(motion.names) <= 24  # more names would overlap
    ax.set_yticks(range(len(motion.names)) if few else [], motion.names if few else [])
    ax.set(xlim=(0, 1), ylim=(len(motion.names) - 0.5, -0.5))
    ax.set_xlabel("share of the period [-]")
    ax.set_ylabel("" if few else "joints")
    return ax.axvline(0.0, color="k", lw=1.2)
