"""What every picture shares."""


def new_axes():
    """Axes of a new figure, outside pyplot."""
    from matplotlib.figure import Figure

    return Figure(figsize=(8.4, 6.4), layout="constrained").add_subplot()


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
