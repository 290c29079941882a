from .axes import new_figure as new_figure
from .basin import basin as basin
from .bifurcation import bifurcation_map as bifurcation_map
from .boundary import boundary as boundary
from .branch import branch as branch
from .curves import (
    curves as curves,
    stiffness as stiffness,
    stiffness_curves as stiffness_curves,
)
from .cycle import cycle as cycle, phase_portrait as phase_portrait, spectrum as spectrum
from .cycles import amplitudes as amplitudes, cycles as cycles
from .design import design as design, stability_map as stability_map
from .designs import design_map as design_map
from .distribution import distribution as distribution
from .explore import explore as explore
from .identification import (
    identification as identification,
    power_spectrum as power_spectrum,
)
from .laws import law_curves as law_curves, laws as laws
from .maps import (
    frequency_map as frequency_map,
    growth_map as growth_map,
    stability_chart as stability_chart,
)
from .modes import (
    mode_lines as mode_lines,
    mode_surfaces as mode_surfaces,
    modes as modes,
)
from .motion import animate_cycle as animate_cycle, cycle_motion as cycle_motion
from .pareto import pareto as pareto
from .shapes import animate_mode as animate_mode, complex_mode as complex_mode
from .topography import topographies as topographies, topography as topography
from .tracks import mode_tracks as mode_tracks
from .trajectory import trajectory as trajectory
