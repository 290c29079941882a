"""Options of the spectrum of measured heights, and of the band in which its law is fitted."""

import dataclasses

from .._base.options import require_number
from .._base.parts import whole


@dataclasses.dataclass(frozen=True)
class SpectralAnalysis:
    """How `identify` estimates a spectrum and chooses its band; the defaults suit most surfaces.

    **Fields:**

    - `tapers`: number of sine tapers of a profile, at least 1; more of them scatter less and
      resolve less. Three have two thirds of the variance of Hann's window.
    - `fewest_periods`: periods of the longest wave of the band in the length, at least 1. From
      longer waves tilt has been taken out, and the window is too wide for them.
    - `resolutions`: the shortest wavelength of the band in units of the lateral resolution, at
      least 1. A Gaussian filter leaves 96 percent of the height of a wave of 4 cut-off wavelengths.
    - `sigmas`: standard errors, at least 0, at which a bend or a noise floor is credible: the
      deviance must fall by their square.
    - `level`: standard errors, at least 0, by which the Sq of a fitted law may differ from that of
      the heights. Where it differs by more the law is not the surface of a map, which has another
      law or its measured spectrum. Of the laws that are true, 2 refuses one in twenty.
    - `gradient`: factor, at least 1, by which the Sdq of a fitted `SelfAffine` may differ from that
      of the measured spectrum of the map: across a strong lay it has waves that no map resolves,
      and it lacks those beyond a band that ends early.

    **Raises:** `ValueError` or `TypeError` for an option that is no number or outside its domain.
    """

    tapers: int = 3
    fewest_periods: float = 5.0
    resolutions: float = 4.0
    sigmas: float = 3.0
    level: float = 2.0
    gradient: float = 2.0

    def __post_init__(self):
        whole("tapers", self.tapers, 1)
        require_number("fewest_periods", self.fewest_periods, 1)
        require_number("resolutions", self.resolutions, 1)
        require_number("sigmas", self.sigmas, 0)
        require_number("level", self.level, 0)
        require_number("gradient", self.gradient, 1)
