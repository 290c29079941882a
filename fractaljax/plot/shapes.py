"""Complex shapes of modes: at one phase, and in motion over a period."""

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from .._base.parts import whole
from .._mechanism.mesh import Mesh
from .._stability.stability import Stability
from .animation import animated, animation_path
from .axes import Axes, ensure_axes, frequency_unit
from .mesh import draw_mesh, mesh_scale

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation


def complex_mode(
    mode: Stability | ArrayLike,
    index: int = 0,
    ax: Any = None,
    *,
    points: ArrayLike | None = None,
    dofs: ArrayLike | None = None,
    cells: ArrayLike | None = None,
    phase: float = 0.0,
    scale: float | None = None,
) -> Axes:
    """The displacement Re(shape exp(i phase)) of a mode: a deformed mesh coloured by amplitude.

    The colour is the greatest displacement of each node over a period, divided by the largest of
    all. Without `points` there is a bar for each degree of freedom, coloured by its phase, within a
    pale one that shows its amplitude.

    **Arguments:**

    - `mode`: a shape (n,), or a `Stability`; for a reduced structure,
      `reduced.full(modes.shapes[index])`.
    - `index`: which shape of a `Stability` is drawn, from 0, the default.
    - `ax`: axes to draw in, by default those of a new figure; for a solid they have to be 3D.
    - `points`: (nodes, 2) or (nodes, 3), places of the nodes [m]; by default there is no mesh.
    - `dofs`: of the same shape, the degree of freedom of each displacement, -1 where it is held.
    - `cells`: (cells, 3) or (cells, 4), the nodes of triangles or quadrilaterals, the outer ones of
      a solid.
    - `phase`: [rad], 0 by default.
    - `scale`: factor of the displacements; by default the largest amplitude is drawn as 3 % of the
      size of the mesh.

    **Raises:** `ValueError` for a batch, an unknown index, and a mesh that does not fit.
    """
    ax, draw = _picture(mode, index, ax, points, dofs, cells, scale)
    draw(phase)
    return ax


def animate_mode(
    mode: Stability | ArrayLike,
    index: int = 0,
    *,
    points: ArrayLike | None = None,
    dofs: ArrayLike | None = None,
    cells: ArrayLike | None = None,
    scale: float | None = None,
    frames: int = 24,
    fps: int = 12,
    path: str | os.PathLike | None = None,
) -> "FuncAnimation":
    """One period of a mode in motion, Re(shape exp(i omega t)), as matplotlib's animation.

    Frame j has the phase omega t = 2 pi j/frames; growth is left out.

    **Arguments:**

    - `mode`, `index`, `points`, `dofs`, `cells`, `scale`: as in `complex_mode`.
    - `frames`, `fps`, `path`: as in `animate_cycle`.

    **Raises:** as `complex_mode`; `ValueError` for another ending; `OSError` if the file cannot be
    written.
    """
    frames, fps, path = whole("frames", frames, 2), whole("fps", fps, 1), animation_path(path)
    ax, draw = _picture(mode, index, None, points, dofs, cells, scale)
    return animated(ax.figure, lambda share: draw(2 * np.pi * share), frames, fps, path)


# --- drawing --------------------------------------------------------------------------------


def _amplitudes(motion: Complex[np.ndarray, "nodes dim"]) -> Float[np.ndarray, " nodes"]:
    """The greatest displacements over a period: the semi-major axes of ellipses."""
    squares = (np.abs(motion) ** 2).sum(axis=1), np.abs((motion**2).sum(axis=1))
    return np.sqrt(sum(squares) / 2)


def _picture(
    mode: Any, index: int, ax: Any, points: Any, dofs: Any, cells: Any, scale: float | None
) -> tuple[Any, Callable[[float], Any]]:
    """The axes, and a function that draws a phase on them."""
    shape, words, names = _read_shape(mode, index)
    if points is None:
        ax, move = _bars(shape, names, ensure_axes(ax))
    else:
        if dofs is None or cells is None:
            raise ValueError("points need dofs and cells beside them")
        ax, move = _deformed(Mesh(points, dofs, cells).require(len(shape)), shape, ax, scale)

    def draw(phase: float) -> Any:
        move(np.exp(1j * phase))
        angle = f"phase {np.degrees(phase):.0f}°"
        ax.set_title(", ".join([*words, angle]), fontsize="medium", loc="left")
        return ()

    return ax, draw


def _read_shape(mode: Any, index: int) -> tuple[np.ndarray, list[str], Any]:
    """A shape (n,), the numbers of its mode, and the names of its degrees of freedom."""
    if not isinstance(mode, Stability):
        shape = np.asarray(mode)
        if shape.ndim != 1 or shape.dtype.kind not in "fciu":
            raise ValueError(f"a shape must have one number a degree of freedom, got {shape.shape}")
        return shape, [], None
    s, shapes = np.asarray(mode.eigenvalues), np.asarray(mode.shapes)
    if s.ndim != 1:
        raise ValueError(f"a picture shows one result, got a batch {s.shape[:-1]}")
    index = whole("index", index, 0, len(s) - 1)
    frequency = abs(s[index].imag) / (2 * np.pi)
    factor, hertz = frequency_unit(frequency)
    words = [f"{factor * frequency:.4g} {hertz}", f"growth rate {s[index].real:.3g} 1/s"]
    return shapes[index], words, mode.names


def _deformed(
    mesh: Mesh, shape: np.ndarray, ax: Any, scale: float | None
) -> tuple[Any, Callable[[complex], Any]]:
    motion = mesh.displacements(shape)
    amplitudes = _amplitudes(motion)
    largest = float(amplitudes.max()) or 1.0
    factor = mesh_scale(mesh, largest) if scale is None else scale
    ax, drawn, move = draw_mesh(mesh, ax, factor * largest, amplitudes / largest, 1.0)
    bar = ax.figure.colorbar(drawn, ax=ax, location="bottom", shrink=0.6, aspect=40)
    bar.set_label("amplitude, of the largest [-]")
    return ax, lambda phasor: move(factor * (motion * phasor).real)


def _bars(shape: Any, names: Any, ax: Axes) -> tuple[Axes, Callable[[complex], Any]]:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    x, amplitude = np.arange(len(shape)), np.abs(shape)
    unit = shape / (amplitude.max() or 1.0)
    colours = ScalarMappable(Normalize(-180, 180), "hsv")
    ax.bar(x, 2 * np.abs(unit), 0.8, -np.abs(unit), color="0.92", edgecolor="0.7", linewidth=0.5)
    bars = ax.bar(x, unit.real, 0.5, color=colours.to_rgba(np.angle(unit, deg=True)))
    ax.axhline(0, color="k", lw=0.8)
    ax.set(ylim=(-1.1, 1.1), xlabel="degree of freedom", ylabel="displacement, of the largest [-]")
    if len(x) <= 24:  # more names would overlap
        ax.set_xticks(x, names or [str(i) for i in x], rotation=0 if names is None else 90)
    bar = ax.figure.colorbar(colours, ax=ax, pad=0.02, ticks=range(-180, 181, 90))
    bar.set_label("phase of the shape [°]")

    def move(phasor: complex) -> None:
        for each, height in zip(bars, (unit * phasor).real, strict=True):
            each.set_height(height)

    return ax, move
