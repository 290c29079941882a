"""The figure that every picture is drawn on."""

import io

import matplotlib.figure


class Figure(matplotlib.figure.Figure):
    """A figure outside pyplot and its global state, which a notebook shows all the same.

    It is laid out so that nothing is cut off; `size` is its width and height in inches.
    """

    def __init__(self, size: tuple[float, float]) -> None:
        super().__init__(figsize=size, layout="constrained")

    def _repr_png_(self) -> bytes:
        """What Jupyter asks for where a figure is the last expression of a cell."""
        picture = io.BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()
