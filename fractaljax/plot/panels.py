"""What a picture of several panels returns."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .figure import Figure as Figure
else:
    Figure = Any  # matplotlib is imported with the first picture


class Panels(tuple):
    """The Axes of a figure as a tuple; other attributes are those of the figure: `savefig`, ...

    A notebook shows the figure.
    """

    figure: Figure

    def __new__(cls, figure: Figure):
        panels = super().__new__(cls, figure.axes)
        panels.figure = figure
        return panels

    def __getattr__(self, name: str) -> Any:
        if name == "figure":  # missing while a copy is made
            raise AttributeError(name)
        return getattr(self.figure, name)

    def __reduce__(self):
        return Panels, (self.figure,)
