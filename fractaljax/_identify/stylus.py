"""How far up in frequency a stylus tip follows a surface.

A tip of radius R bridges what is curved more sharply than itself (Church and Takacs 1991; ISO 3274
chooses tips by it). The rms curvature of all waves up to f is

    kappa(f)^2 = int_0^f (2 pi f)^4 S df = (2 pi)^4 S(f) f^5/(5 - p)      for S ~ f^-p

Peaks are several times as sharp as the rms: the tip follows while kappa(f) < 1/(c R).
"""

import math

from .analysis import SpectralAnalysis
from .fit import FlatPrior, fit
from .spectrum import PowerSpectrum


def tip_limit(
    spectrum: PowerSpectrum,
    length: float,
    ratio: float,
    radius: float,
    *,
    fewest_periods: float = SpectralAnalysis.fewest_periods,
    peaks: float = 6.0,
) -> float:
    """Frequency [1/m] up to which a tip of a radius [m] follows, at most the Nyquist frequency.

    The band begins at `fewest_periods` in the length. `peaks` is the c above, from tips rolled over
    synthetic profiles. Above the limit the spectrum is distorted, so the band grows from below
    until its own law says that the tip fails at its upper end.
    """
    low = fewest_periods / length
    high = 4 * low
    while high < spectrum.nyquist:
        law = fit(spectrum, (low, high), ratio, flat_prior=FlatPrior(deviation=1e-3))
        p = min(law.p, 4.5)
        squared = (2 * math.pi) ** 4 * float(law(high)) * high**5 / (5 - p)
        relative = math.sqrt(squared) * peaks * radius
        if relative > 1:
            return high * relative ** (-2 / (5 - p))
        high *= ratio**0.5
    return spectrum.nyquist
