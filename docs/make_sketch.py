"""Draw sketch.png: the mass on the belt and its joint, `python docs/make_sketch.py`."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

PICTURE = Path(__file__).with_name("sketch.png")
LINE, JOINT = "#1f2933", "#c2410c"


def spring(ax: Axes, start, end, color=LINE, coils: int = 5, width: float = 0.11) -> None:
    """A zigzag from one point to the other."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = (end - start) / np.hypot(*(end - start))
    across = np.array([-along[1], along[0]])
    at = np.concatenate([[0, 0.2], np.linspace(0.2, 0.8, 2 * coils + 1)[1:-1], [0.8, 1]])
    sides = np.concatenate([[0, 0], np.resize([1, -1], 2 * coils - 1), [0, 0]])
    points = start + at[:, None] * (end - start) + width * sides[:, None] * across
    ax.plot(*points.T, color=color, lw=1.8, solid_joinstyle="round")


def damper(ax: Axes, start, end, width: float = 0.11) -> None:
    """A piston in a pot from one point to the other."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = (end - start) / np.hypot(*(end - start))
    across = width * np.array([-along[1], along[0]])
    pot, plate = start + 0.4 * (end - start), start + 0.55 * (end - start)
    rim = start + 0.65 * (end - start)
    for points in (
        (start, pot),
        (rim + across, pot + across, pot - across, rim - across),
        (plate + 0.7 * across, plate - 0.7 * across),
        (plate, end),
    ):
        ax.plot(*np.array(points).T, color=LINE, lw=1.8)


def wall(ax: Axes, start, end, side) -> None:
    """A line with hatching on one side."""
    start, end, side = (np.asarray(x, float) for x in (start, end, side))
    ax.plot(*np.array([start, end]).T, color=LINE, lw=1.8)
    slant = 0.12 * (end - start) / np.hypot(*(end - start))
    for share in np.linspace(0.05, 0.95, 9):
        at = start + share * (end - start)
        ax.plot(*np.array([at, at + 0.13 * side + slant]).T, color=LINE, lw=0.9)


def rough_line(n: int = 400) -> np.ndarray:
    """Heights of a profile with a few dozen waves, the same at each call."""
    x, rng = np.linspace(0, 1, n), np.random.default_rng(4)
    waves = 2 * np.pi * 1.5 ** np.arange(2, 12)
    phases = rng.uniform(0, 2 * np.pi, len(waves))
    return (waves[:, None] ** -0.75 * np.cos(waves[:, None] * x + phases[:, None])).sum(0)


def draw(path=PICTURE) -> Axes:
    """The mass on its springs and dampers, the belt, and the joint seen closely."""
    figure = Figure(figsize=(8.4, 3.5))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, 8.4), ylim=(0, 3.5), aspect="equal")
    ax.axis("off")
    write = {"fontsize": 13, "color": LINE, "ha": "center", "va": "center"}
    arrow = {"arrowstyle": "-|>", "lw": 1.8, "color": LINE, "shrinkA": 0, "shrinkB": 0}

    ax.add_patch(Rectangle((2.0, 1.1), 1.5, 1.0, facecolor="#e5e9ee", edgecolor=LINE, lw=1.8))
    ax.text(2.6, 1.6, "$m$", **write)
    wall(ax, (0.5, 1.1), (0.5, 2.1), (-1, 0))
    spring(ax, (0.5, 1.85), (2.0, 1.85))
    damper(ax, (0.5, 1.35), (2.0, 1.35))
    ax.text(1.25, 2.18, r"$\omega_1,\ \xi_1$", **write)
    wall(ax, (2.2, 3.2), (3.3, 3.2), (0, 1))
    spring(ax, (2.45, 3.2), (2.45, 2.1), coils=4)
    damper(ax, (3.05, 3.2), (3.05, 2.1))
    ax.text(1.82, 2.65, r"$\omega_2,\ \xi_2$", **write)
    # The force at 45 degrees, as Eq. 39 has it, and the two directions of motion.
    ax.annotate("", (4.0, 2.6), (3.5, 2.1), arrowprops=arrow)
    ax.annotate("", (4.15, 1.75), (3.6, 1.75), arrowprops=arrow)
    ax.text(4.35, 1.75, "$x_1$", **write)
    ax.annotate("", (3.85, 1.22), (3.85, 1.62), arrowprops=arrow)
    ax.text(4.1, 1.35, "$x_2$", **write)
    ax.text(3.62, 2.5, "$F$", **write)
    # The belt.
    ax.plot([0.9, 4.6], [1.0, 1.0], color=LINE, lw=1.8)
    ax.plot([0.9, 4.6], [0.45, 0.45], color=LINE, lw=1.8)
    for x in (0.9, 4.6):
        ax.add_patch(Circle((x, 0.725), 0.275, facecolor="white", edgecolor=LINE, lw=1.8))
        ax.plot([x], [0.725], "o", color=LINE, ms=3)
    ax.annotate("", (3.3, 0.725), (2.5, 0.725), arrowprops=arrow)
    ax.text(2.25, 0.725, "$V$", **write)
    # The joint, seen closely.
    ax.add_patch(Circle((2.9, 1.05), 0.24, fill=False, edgecolor=JOINT, lw=1.6))
    centre, radius = np.array([6.75, 1.75]), 1.5
    for y in (1, -1):
        angle = np.arctan2(y, 0.25)
        tip = centre + radius * np.array([-np.sqrt(1 - 0.9**2), 0.9 * y])
        near = np.array([2.9, 1.05]) + 0.24 * np.array([np.cos(angle), np.sin(angle)])
        ax.plot(*np.array([near, tip]).T, color=JOINT, lw=0.8)
    lens = Circle(centre, radius, facecolor="white", edgecolor=JOINT, lw=1.6)
    ax.add_patch(lens)
    x = np.linspace(centre[0] - radius, centre[0] + radius, 400)
    z = rough_line()
    surface = 0.8 + 0.17 * (z - z.min()) / z.std()  # its lowest hill touches the belt
    outline = [*zip(x, surface, strict=True), (x[-1], 3.5), (x[0], 3.5)]
    above = Polygon(outline, facecolor="#e5e9ee", edgecolor=LINE, lw=1.4)
    below = Rectangle((x[0], 0.0), 2 * radius, 0.82, facecolor="#cfd6dd", edgecolor=LINE, lw=1.4)
    for patch in (above, below):
        ax.add_patch(patch).set_clip_path(lens)
    ax.text(6.75, 0.5, "belt", **write)
    ax.annotate("", (6.1, 1.75), (6.1, 2.35), arrowprops=arrow)
    ax.text(5.85, 2.1, "$P$", **write)
    spring(ax, (6.75, 2.45), (6.75, 1.55), JOINT, coils=4, width=0.09)
    ax.text(7.0, 2.0, "$K_n$", **write | {"color": JOINT})
    spring(ax, (7.25, 1.72), (8.0, 1.72), JOINT, coils=3, width=0.09)
    ax.text(7.55, 2.0, r"$K_t,\ \mu$", **write | {"color": JOINT})
    ax.text(6.75, 2.8, "surface: $D$, $G$", **write)
    figure.savefig(path, dpi=110)
    return ax


if __name__ == "__main__":
    draw()
