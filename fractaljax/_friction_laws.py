"""The friction laws by their names in files."""

from ._friction import LAWS as LAWS
from ._tabulated_friction import TabulatedFriction as TabulatedFriction
