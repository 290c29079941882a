"""What every picture shares."""

from typing import Any


def new_figure(width: float = 8.4, height: float = 6.4) -> Any:
    """A figure outside pyplot, for axes of one's own; a notebook shows it. Sizes in inches."""
    from .figure import Figure

    return Figure((width, height))


def new_axes():
    """Axes of a new figure."""
    return new_figure().add_subplot()


def legend_above(ax, handles):
    """The legend above the axes, where it hides nothing."""
    ax.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.01),
        ncols=3,
        fontsize="small",
        frameon=False,
    )
