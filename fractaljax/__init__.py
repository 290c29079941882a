"""From a machined surface to a stable mechanism, with gradients all the way back."""

from . import constraints as constraints, plot as plot
from .attractors import attractors as attractors
from .boundary import (
    Boundary as Boundary,
    Branch as Branch,
    BranchEnd as BranchEnd,
    hopf_boundary as hopf_boundary,
)
from .complex_modes import ComplexModes as ComplexModes, assemble as assemble
from .contact import (
    ContactState as ContactState,
    FixedContact as FixedContact,
    FractalContact as FractalContact,
    Regime as Regime,
    contact_load as contact_load,
    contact_state as contact_state,
    dimensionless_normal_stiffness as dimensionless_normal_stiffness,
    dimensionless_tangential_stiffness as dimensionless_tangential_stiffness,
)
from .critical_friction import critical_friction as critical_friction
from .cycle import CycleResult as CycleResult, LimitCycle as LimitCycle
from .damping import modal_damping as modal_damping, rayleigh_damping as rayleigh_damping
from .design import Design as Design, DesignResult as DesignResult, design as design
from .design_file import repeat_design as repeat_design
from .envelope import Envelope as Envelope
from .friction import Coulomb as Coulomb, Stribeck as Stribeck
from .limit_cycle import limit_cycle as limit_cycle
from .maps import Modes as Modes, modes_over as modes_over
from .margin import margin as margin
from .materials import Material as Material
from .measured.files import read_measurement as read_measurement
from .measured.identify import Identification as Identification, identify as identify
from .measured.measurement import Measurement as Measurement
from .oscillator import Oscillator as Oscillator, equilibrium as equilibrium
from .pareto import Front as Front, pareto as pareto
from .roughness import Roughness as Roughness, roughness as roughness
from .scene import Scene as Scene, brake_scene as brake_scene, stiffness as stiffness
from .simulate import (
    SimulationResult as SimulationResult,
    Trajectory as Trajectory,
    simulate as simulate,
)
from .stability import (
    Stability as Stability,
    growth_rate as growth_rate,
    stability as stability,
)
from .stiffness_curves import StiffnessCurves as StiffnessCurves, stiffness_over as stiffness_over
from .structure import Joint as Joint, Structure as Structure
from .surfaces import Surface as Surface
from .sweep import sweep as sweep
from .topography import topography as topography
