"""Pictures: each function takes a result and an optional Axes, and returns the Axes.

Without an Axes a new figure is made, outside pyplot and its global state; it is `ax.figure`, which
Jupyter shows as the last expression of a cell. `cycle`, `cycles`, `modes`, `source_figure`,
`stiffness` and `topographies` fill a figure of their own, and return that.
"""

from .axes import new_figure as new_figure
from .boundary import boundary as boundary
from .cycle import cycle as cycle, phase_portrait as phase_portrait, spectrum as spectrum
from .cycles import amplitudes as amplitudes, cycles as cycles
from .design import design as design, stability_map as stability_map
from .distribution import distribution as distribution
from .identification import (
    identification as identification,
    power_spectrum as power_spectrum,
)
from .maps import (
    frequency_map as frequency_map,
    growth_map as growth_map,
    mode_lines as mode_lines,
    mode_surfaces as mode_surfaces,
    modes as modes,
    source_figure as source_figure,
)
from .pareto import pareto as pareto
from .stiffness import stiffness as stiffness, stiffness_curves as stiffness_curves
from .topography import topographies as topographies, topography as topography
from .trajectory import trajectory as trajectory
