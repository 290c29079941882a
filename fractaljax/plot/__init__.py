"""Pictures: each function takes a result and an optional Axes, and returns the Axes.

Without an Axes it makes a new figure, outside pyplot and its global state: `ax.figure`. Jupyter
shows it where the Axes are the last expression of a cell. `cycle`, `cycles`, `cycle_motion`,
`modes`, `mode_tracks`, `stiffness`, `laws` and `topographies` fill a figure of their own and return
the tuple of its Axes, which has the attributes of the figure too: `savefig`, ...
"""

from .._base.lazy import make_lazy

make_lazy(__name__)
del make_lazy
