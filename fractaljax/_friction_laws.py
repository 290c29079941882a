"""The friction laws by their names in files."""

from . import _friction_memory as _friction_memory  # its laws register themselves
from ._friction import LAWS as LAWS
from ._tabulated_friction import TabulatedFriction as TabulatedFriction
