"""How much D and G of a map differ from place to place, beyond chance.

The standard errors of a fit assume a stationary Gaussian surface. A real one is smoother in some
places and rougher in others. The map is cut into patches, each of which gives its own ln A and p,
to first order in its power. Their covariance S is compared with P, the covariance for a stationary
Gaussian surface. The excess of S over 1.3 P, the mean of the larger of two eigenvalues by chance,
is the variance between patches.

It is added to the covariance of the map, not divided by the number of patches. Real surfaces vary
at all lengths, so that two maps side by side differ about as much as two patches of one map.
"""

import numpy as np

from .fit import Bins, PowerLaw
from .spectrum import Spectrum, map_spectra

_ALONG = 4  # patches along each side
_CHANCE = 1.3  # mean of the larger eigenvalue of a covariance of 16 draws of variance 1
_FEWEST = 2  # bins that ln A and p need


def between_patches(
    z: np.ndarray, dx: float, dy: float, spectrum: Spectrum, law: PowerLaw, band, ratio: float
) -> np.ndarray:
    """Covariance (2, 2) of (ln A, p) between patches of a map without gaps, beyond chance.

    Bins count by their influence on `law`. Waves too long for a patch are left out; 0 where fewer
    than two bins remain.
    """
    from scipy.linalg import eigh

    n, m = (size // _ALONG for size in z.shape)
    cut = z[: _ALONG * n, : _ALONG * m].reshape(_ALONG, n, _ALONG, m).swapaxes(1, 2)
    spectra = [map_spectra(patch, dx, dy)[0] for patch in cut.reshape(-1, n, m)]
    bins = [Bins(each, band, ratio) for each in spectra]
    shared = np.isin(Bins(spectrum, band, ratio).which, bins[0].which)
    if shared.sum() < _FEWEST:
        return np.zeros((2, 2))
    power = np.stack([each(each.power / law(each.f)) for each in bins])
    influence = law.influence[:2, shared]
    covariance = np.cov(influence @ (power / power.mean(axis=0)).T)
    chance = influence * bins[0].variance @ influence.T
    excess, vectors = eigh(covariance, chance)
    vectors = chance @ vectors
    return vectors * np.maximum(excess - _CHANCE, 0) @ vectors.T
