"""The spectra of surfaces by their names in files."""

from .measured_spectrum import MeasuredSpectrum
from .self_affine import SelfAffine
from .spectrum import Spectrum
from .surface import Surface

SPECTRA: dict[str, type[Spectrum]] = {  # user-defined spectra are added
    "fractal": Surface,
    "self-affine": SelfAffine,
    "measured": MeasuredSpectrum,
}
