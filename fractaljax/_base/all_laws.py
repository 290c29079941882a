"""Loads every law of the package: each registers its name in files when its module is loaded."""

from .. import _friction_memory as _friction_memory, _tabulated_friction as _tabulated_friction
from .._contact import (
    asperity as asperity,
    fixed as fixed,
    fractal as fractal,
    measured as measured,
    persson as persson,
)
from .._surface import (
    measured_spectrum as measured_spectrum,
    self_affine as self_affine,
    surface as surface,
)
