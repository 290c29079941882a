from . import plot as plot
from ._base.file_limits import FileLimits as FileLimits
from ._base.parts import quantity as quantity
from ._contact.asperity import AsperityContact as AsperityContact
from ._contact.boundary_element import (
    BoundaryElement as BoundaryElement,
    BoundaryElementResult as BoundaryElementResult,
    boundary_element as boundary_element,
)
from ._contact.compare import (
    LawComparison as LawComparison,
    LawCurve as LawCurve,
    compare_laws as compare_laws,
)
from ._contact.contact import Contact as Contact, ContactState as ContactState, Regime as Regime
from ._contact.dimensionless import (
    dimensionless_normal_stiffness as dimensionless_normal_stiffness,
    dimensionless_tangential_stiffness as dimensionless_tangential_stiffness,
)
from ._contact.fixed import FixedContact as FixedContact
from ._contact.fractal import (
    FractalContact as FractalContact,
    contact_load as contact_load,
    contact_state as contact_state,
)
from ._contact.material import Material as Material
from ._contact.measured import MeasuredContact as MeasuredContact
from ._contact.persson import PerssonContact as PerssonContact
from ._contact.run_in import WornSurface as WornSurface, run_in as run_in
from ._design import constraints as constraints
from ._design.design import (
    Design as Design,
    design as design,
    repeat_design as repeat_design,
)
from ._design.design_search import DesignSearch as DesignSearch
from ._design.envelope import Envelope as Envelope
from ._design.many import DesignMany as DesignMany, design_many as design_many
from ._design.pareto import Front as Front, pareto as pareto
from ._design.problem import DesignProblem as DesignProblem
from ._design.result import DesignResult as DesignResult
from ._design.sensitivity import Sensitivity as Sensitivity
from ._design.tolerance import Tolerance as Tolerance, squeal_probability as squeal_probability
from ._design.verdict import (
    Suggestion as Suggestion,
    Verdict as Verdict,
    suggest as suggest,
    verdict as verdict,
)
from ._dynamics.attractors import attractors as attractors
from ._dynamics.basin import Basin as Basin, basin as basin
from ._dynamics.basin_search import BasinSearch as BasinSearch
from ._dynamics.bifurcation import (
    BifurcationMap as BifurcationMap,
    bifurcation_map as bifurcation_map,
)
from ._dynamics.branch import (
    Branch as Branch,
    BranchEnd as BranchEnd,
    BranchEvent as BranchEvent,
    continue_cycle as continue_cycle,
)
from ._dynamics.cycle import CycleResult as CycleResult, LimitCycle as LimitCycle
from ._dynamics.cycle_search import CycleSearch as CycleSearch
from ._dynamics.event_curve import EventCurve as EventCurve, continue_event as continue_event
from ._dynamics.excitation import Excitation as Excitation
from ._dynamics.limit_cycle import limit_cycle as limit_cycle
from ._dynamics.simulate import (
    SimulationResult as SimulationResult,
    Trajectory as Trajectory,
    simulate as simulate,
)
from ._friction import (
    Coulomb as Coulomb,
    ExponentialStribeck as ExponentialStribeck,
    Friction as Friction,
    HyperbolicStribeck as HyperbolicStribeck,
    Stribeck as Stribeck,
)
from ._friction_memory import (
    Dahl as Dahl,
    Iwan as Iwan,
    Jenkins as Jenkins,
    LuGre as LuGre,
    RateAndState as RateAndState,
)
from ._identify.analysis import SpectralAnalysis as SpectralAnalysis
from ._identify.files import read_measurement as read_measurement
from ._identify.identify import Identification as Identification, identify as identify
from ._identify.measurement import Measurement as Measurement
from ._identify.pool import pool_surfaces as pool_surfaces
from ._identify.preparation import Preprocessing as Preprocessing
from ._identify.prepare_measurement import prepare_measurement as prepare_measurement
from ._identify.spectrum_of import spectrum_of as spectrum_of
from ._identify.warnings import WarningThresholds as WarningThresholds
from ._mechanism.damping import modal_damping as modal_damping, rayleigh_damping as rayleigh_damping
from ._mechanism.matrix_file import Matrices as Matrices, read_matrices as read_matrices
from ._mechanism.mesh import Mesh as Mesh
from ._mechanism.oscillator import Oscillator as Oscillator, equilibrium as equilibrium
from ._mechanism.reduced import ReducedStructure as ReducedStructure
from ._mechanism.scene import Scene as Scene, brake_scene as brake_scene, stiffness as stiffness
from ._mechanism.structure import (
    Joint as Joint,
    ParametricStructure as ParametricStructure,
    Structure as Structure,
    load as load,
    save as save,
)
from ._stability.boundary import (
    Boundary as Boundary,
    BoundaryBranch as BoundaryBranch,
    BoundaryEnd as BoundaryEnd,
    hopf_boundary as hopf_boundary,
)
from ._stability.critical_friction import critical_friction as critical_friction
from ._stability.linearise import assemble as assemble
from ._stability.reduction import reduce as reduce, reduction_errors as reduction_errors
from ._stability.reduction_search import ReductionSearch as ReductionSearch
from ._stability.shares import EnergyShares as EnergyShares, energy_shares as energy_shares
from ._stability.stability import (
    Stability as Stability,
    growth_rate as growth_rate,
    margin as margin,
    stability as stability,
)
from ._stability.tracks import (
    ModeCrossing as ModeCrossing,
    ModeTracks as ModeTracks,
    track_modes as track_modes,
)
from ._surface.areal_parameters import areal_parameters as areal_parameters
from ._surface.drawing_parameters import (
    ArealParameters as ArealParameters,
    ProfileParameters as ProfileParameters,
)
from ._surface.measured_spectrum import MeasuredSpectrum as MeasuredSpectrum
from ._surface.profile_parameters import profile_parameters as profile_parameters
from ._surface.roughness import (
    Roughness as Roughness,
    SpectralMoments as SpectralMoments,
    roughness as roughness,
    spectral_moments as spectral_moments,
)
from ._surface.self_affine import SelfAffine as SelfAffine
from ._surface.specification import specify_surface as specify_surface
from ._surface.spectrum import Spectrum as Spectrum
from ._surface.surface import Surface as Surface
from ._surface.surface_scatter import SurfaceScatter as SurfaceScatter
from ._surface.topography import topography as topography
from ._sweep.result import Sweep as Sweep
from ._sweep.sweep import sweep as sweep
from ._tabulated_friction import TabulatedFriction as TabulatedFriction
from ._validate.validate import (
    Validation as Validation,
    validate as validate,
)
from ._version import __version__ as __version__
from .plot.widgets import explore as explore
