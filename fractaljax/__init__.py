"""From a machined surface to a stable mechanism, with gradients all the way back."""

from . import plot as plot
from .contact import (
    ContactState as ContactState,
    FixedContact as FixedContact,
    FractalContact as FractalContact,
    Regime as Regime,
    contact_state as contact_state,
    dimensionless_normal_stiffness as dimensionless_normal_stiffness,
    dimensionless_tangential_stiffness as dimensionless_tangential_stiffness,
)
from .design import Design as Design, DesignResult as DesignResult, design as design
from .friction import Coulomb as Coulomb, Stribeck as Stribeck
from .limit_cycle import (
    CycleResult as CycleResult,
    LimitCycle as LimitCycle,
    attractors as attractors,
    limit_cycle as limit_cycle,
)
from .materials import Material as Material
from .oscillator import Oscillator as Oscillator, equilibrium as equilibrium
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
from .surfaces import Surface as Surface
