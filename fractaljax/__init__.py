"""From a machined surface to a stable mechanism, with gradients all the way back."""

from . import plot as plot
from ._version import __version__ as __version__
from .measured.files import read_measurement as read_measurement
from .measured.identify import Identification as Identification, identify as identify
from .measured.measurement import Measurement as Measurement
from .mechanism.contact import (
    ContactState as ContactState,
    FixedContact as FixedContact,
    FractalContact as FractalContact,
    Regime as Regime,
    contact_load as contact_load,
    contact_state as contact_state,
    dimensionless_normal_stiffness as dimensionless_normal_stiffness,
    dimensionless_tangential_stiffness as dimensionless_tangential_stiffness,
)
from .mechanism.damping import modal_damping as modal_damping, rayleigh_damping as rayleigh_damping
from .mechanism.friction import Coulomb as Coulomb, Stribeck as Stribeck
from .mechanism.materials import Material as Material
from .mechanism.oscillator import Oscillator as Oscillator, equilibrium as equilibrium
from .mechanism.scene import Scene as Scene, brake_scene as brake_scene, stiffness as stiffness
from .mechanism.structure import Joint as Joint, Structure as Structure
from .modes.boundary import (
    Boundary as Boundary,
    Branch as Branch,
    BranchEnd as BranchEnd,
    hopf_boundary as hopf_boundary,
)
from .modes.complex_modes import ComplexModes as ComplexModes, assemble as assemble
from .modes.critical_friction import critical_friction as critical_friction
from .modes.maps import Modes as Modes, modes_over as modes_over
from .modes.margin import margin as margin
from .modes.stability import (
    Stability as Stability,
    growth_rate as growth_rate,
    stability as stability,
)
from .motion.attractors import attractors as attractors
from .motion.cycle import CycleResult as CycleResult, LimitCycle as LimitCycle
from .motion.limit_cycle import limit_cycle as limit_cycle
from .motion.simulate import (
    SimulationResult as SimulationResult,
    Trajectory as Trajectory,
    simulate as simulate,
)
from .optimise import constraints as constraints
from .optimise.design import Design as Design, DesignResult as DesignResult, design as design
from .optimise.design_file import repeat_design as repeat_design
from .optimise.envelope import Envelope as Envelope
from .optimise.pareto import Front as Front, pareto as pareto
from .surface.roughness import Roughness as Roughness, roughness as roughness
from .surface.surfaces import Surface as Surface
from .surface.topography import topography as topography
from .sweeping.stiffness_curves import (
    StiffnessCurves as StiffnessCurves,
    stiffness_over as stiffness_over,
)
from .sweeping.sweep import sweep as sweep
