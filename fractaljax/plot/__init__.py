"""Pictures: each function takes a result and an optional Axes, and returns the Axes.

Without an Axes a new figure is made, outside pyplot and its global state; it is `ax.figure`.
`cycle` fills a figure of its own, and returns that.
"""

from .cycle import cycle as cycle, phase_portrait as phase_portrait, spectrum as spectrum
from .design import design as design, stability_map as stability_map
