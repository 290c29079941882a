"""How far up in frequency a stylus tip follows a surface.

A tip of radius R rests on whatever is curved more sharply than itself (Church and Takacs 1991;
ISO 3274 chooses tips by it). Waves of a spectrum S in a band of width Delta f about f have the
amplitude a = sqrt(2 S Delta f) and the curvature (2 pi f)^2 a; all those up to f, the rms curvature

    kappa(f)^2 = int_0^f (2 pi f)^4 S df = (2 pi)^4 S(f) f^5/(5 - p)      for S ~ f^-p

whose bands of Delta f = f/(5-p) say the same. Peaks are curved a few times as sharply as the
rms: the tip follows while kappa(f) < 1/(c R).
"""

import math

from .fit import fit
from .spectrum import Spectrum

_PEAKS = 6.0  # c: what a tip rolled over synthetic profiles is found to need
_LEAST = 4.0  # ratio of the ends of the band that a first law is fitted to


def tip_limit(spectrum: Spectrum, length: float, ratio: float, radius: float) -> float:
    """Frequency [1/m] up to which a tip of a radius [m] follows, at most the Nyquist frequency.

    What lies above the limit is distorted, so laws are fitted from below: the band grows until
    its upper end is where its own law says that the tip fails.
    """
    low = 5 / length
    high = _LEAST * low
    while high < spectrum.nyquist:
        law = fit(spectrum, (low, high), ratio, beyond=1e-3)
        p = min(law.p, 4.5)
        squared = (2 * math.pi) ** 4 * float(law(high)) * high**5 / (5 - p)
        excess = math.sqrt(squared) * _PEAKS * radius
        if excess > 1:
            return high * excess ** (-2 / (5 - p))
        high *= ratio**0.5
    return spectrum.nyquist
