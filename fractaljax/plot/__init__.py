"""Pictures: each function takes a result and an optional Axes, and returns the Axes.

Without an Axes a new figure is made, outside pyplot and its global state; it is `ax.figure`.
`cycle` fills a figure of its own, and returns that.
"""

from .boundary import boundary as boundary
from .cycle import cycle as cycle, phase_portrait as phase_portrait, spectrum as spectrum
from .design import design as design, stability_map as stability_map
from .maps import (
    frequency_map as frequency_map,
    growth_map as growth_map,
    mode_lines as mode_lines,
    mode_surfaces as mode_surfaces,
    modes as modes,
    source_figure as source_figure,
)
from .pareto import pareto as pareto
