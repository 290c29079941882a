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
from .spectrum import PowerSpectrum, map_spectra


def patch_covariance(
    z: np.ndarray,
    dx: float,
    dy: float,
    spectrum: PowerSpectrum,
    law: PowerLaw,
    band,
    ratio: float,
    *,
    along: int = 4,
    chance_ratio: float = 1.3,
) -> np.ndarray:
    """Covariance (2, 2) of (ln A, p) between patches of a map without gaps, beyond chance.

    There are `along` patches along each side; `chance_ratio` is that of S and P by chance. Bins
    count by their influence on `law`. Waves too long for a patch are left out; 0 where fewer than
    two bins remain.
    """
    from scipy.linalg import eigh

    n, m = (size // along for size in z.shape)
    cut = z[: along * n, : along * m].reshape(along, n, along, m).swapaxes(1, 2)
    spectra = [map_spectra(patch, dx, dy)[0] for patch in cut.reshape(-1, n, m)]
    bins = [Bins(each, band, ratio) for each in spectra]
    shared = np.isin(Bins(spectrum, band, ratio).which, bins[0].which)
    if shared.sum() < 2:
        return np.zeros((2, 2))
    power = np.stack([each(each.power / law(each.f)) for each in bins])
    influence = law.influence[:2, shared]
    covariance = np.cov(influence @ (power / power.mean(axis=0)).T)
    chance = influence * bins[0].variance @ influence.T
    excess, vectors = eigh(covariance, chance)
    vectors = chance @ vectors
    return vectors * np.maximum(excess - chance_ratio, 0) @ vectors.T
