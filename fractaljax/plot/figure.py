"""The figure that every picture is drawn on."""

import io
from typing import Any

import matplotlib.figure


class Figure(matplotlib.figure.Figure):
    """A figure outside pyplot and its global state, which a notebook shows all the same.

    It is laid out so that nothing is cut off; `size` is its width and height in inches.
    """

    def __init__(self, size: tuple[float, float]) -> None:
        super().__init__(figsize=size, layout="constrained")

    def add_subplot(self, *args: Any, **options: Any) -> Any:
        """As matplotlib does; a notebook shows the figure of axes, too."""
        ax: Any = super().add_subplot(*args, **options)
        ax._repr_png_ = self._repr_png_
        return ax

    def png(self, dpi: float) -> bytes:
        """The pixels of `savefig` as a PNG file, in less time: `savefig` draws everything twice."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.image import imsave

        before, picture = self.dpi, io.BytesIO()
        self.set_dpi(dpi)
        try:
            canvas = FigureCanvasAgg(self)
            canvas.draw()
            # Stronger compression would take longer than the drawing.
            more = {"format": "png", "dpi": dpi, "pil_kwargs": {"compress_level": 1}}
            imsave(picture, canvas.buffer_rgba(), **more)
        finally:
            self.set_dpi(before)
        return picture.getvalue()

    def _repr_png_(self) -> bytes:
        """The PNG that Jupyter shows for a figure as the last expression of a cell."""
        return self.png(self.dpi)
