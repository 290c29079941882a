"""Parts that the pictures share: figures, legends, lines, and axes that show a quantity."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from .._mechanism.quantities import label, unit

if TYPE_CHECKING:
    from matplotlib.artist import Artist as Artist
    from matplotlib.axes import Axes as Axes

    from .._dynamics.hybrid import HybridSystem as HybridSystem
    from .figure import Figure as Figure
else:
    Artist = Axes = Figure = HybridSystem = Any  # matplotlib is imported with the first picture

DIRECTIONS = "along the belt", "normal to the belt"


def new_figure(width: float = 8.4, height: float = 6.4) -> Figure:
    """A figure outside pyplot to add axes to; a notebook shows it.

    **Arguments:**

    - `width`, `height`: in inches, 8.4 and 6.4 by default.
    """
    from .figure import Figure

    return Figure((width, height))


def ensure_axes(ax: Axes | None) -> Axes:
    """The axes `ax`, or those of a new figure."""
    return new_figure().add_subplot() if ax is None else ax


def legend_above(ax: Axes, handles: Iterable[Artist]) -> None:
    """Put the legend above the axes, where it hides nothing."""
    place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.01)}
    ax.legend(handles=list(handles), ncols=3, fontsize="small", frameon=False, **place)


def line_colours(count: int) -> np.ndarray:
    """Colours (count, 4) of lines on white: viridis up to where the contrast falls to 3 : 1."""
    import matplotlib as mpl

    return mpl.colormaps["viridis"](np.linspace(0, 0.6, count))


def lines(ax: Axes, x: np.ndarray, rows: Iterable[np.ndarray], names: Sequence[str]) -> list[Any]:
    """Draw rows (n,) or (n, k) over x, each in its colour and style; the first line of each."""
    colours, handles = line_colours(len(names)), []
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        style = ("solid", "dashed", "dashdot", "dotted")[i % 4]
        drawn = ax.plot(x, row, color=colours[i], ls=style, lw=1.6)
        drawn[0].set_label(name)
        handles.append(drawn[0])
    return handles


def format_value(x: Any, name: str, value: float) -> str:
    """A quantity with its value, as a legend shows it: G = 1e-10 m."""
    return f"{name} = {value:.3g} {unit(x, name)}".removesuffix(" -")


def set_quantity_axis(ax: Axes, which: str, x: Any, name: str, values: np.ndarray) -> None:
    """Set limits, scale and label of the "x" or "y" axis for values (n,) of a quantity of x."""
    scale = "log" if geometric(values) else "linear"
    ax.set(**{f"{which}scale": scale, f"{which}label": label(x, name)})
    if values[0] != values[-1]:
        ax.set(**{f"{which}lim": (values[0], values[-1])})


def geometric(values: Float[np.ndarray, " n"]) -> bool:
    """True if values are spaced evenly in the logarithm rather than linearly."""
    low, high = values.min(), values.max()
    return bool(low > 0 and np.median(values) < (np.sqrt(low * high) + (low + high) / 2) / 2)


def frequency_unit(frequencies: Any) -> tuple[float, str]:
    """The factor from Hz, and the unit, in which frequencies are readable."""
    return (1e-3, "kHz") if np.nanmax(frequencies, initial=0) >= 1e3 else (1.0, "Hz")


class Coordinate(NamedTuple):
    """The displacement row @ x that a picture shows."""

    row: Float[np.ndarray, " n"]
    face: int | None  # index from 0 of the face that slides along it
    symbol: str  # of the displacement
    rate: str  # of its velocity
    meaning: str  # ", " and words, or ""


def coordinate(
    system: HybridSystem, direction: int, joint: int | None, times: jax.Array, batch: int
) -> Coordinate:
    """A degree of freedom or t.x of a joint, both from 1; one motion has `times` of `batch` axes.

    **Raises:** `ValueError` for an unknown number, and for a batch of motions.
    """
    if times.ndim != batch:
        raise ValueError("a picture shows one motion: index the batch first")
    n = system.n - system.excited
    name, number, most = "direction", direction, n
    if joint is not None:
        name, number, most = "joint", joint, len(system.faces)
    if number not in range(1, most + 1):
        allowed = "1" if most == 1 else "1 or 2" if most == 2 else f"from 1 to {most}"
        raise ValueError(f"{name} must be {allowed}, got {number!r}")
    rows = np.eye(n) if system.T is None else np.asarray(system.T)[:, :n]
    if joint is not None:
        face = system.faces[joint - 1][0]
        symbol, rate = f"t.x of joint {joint}", f"t.dx/dt of joint {joint}"
        return Coordinate(rows[face], face, symbol, rate, "")
    row, meaning = np.eye(n)[direction - 1], ""
    face = next((k for k, other in enumerate(rows) if (other == row).all()), None)
    if face is not None:
        meaning = f", {DIRECTIONS[all(face != faces[0] for faces in system.faces)]}"
    return Coordinate(row, face, f"x{direction}", f"dx{direction}/dt", meaning)
