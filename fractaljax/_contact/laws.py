"""The contact laws by their names in files."""

from .asperity import AsperityContact
from .contact import Contact
from .fixed import FixedContact
from .fractal import FractalContact
from .measured import MeasuredContact
from .persson import PerssonContact

CONTACTS: dict[str, type[Contact]] = {  # user-defined laws are added
    "fractal": FractalContact,
    "asperity": AsperityContact,
    "persson": PerssonContact,
    "measured": MeasuredContact,
    "fixed": FixedContact,
}
