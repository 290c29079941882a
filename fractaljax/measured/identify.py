"""D and G of a measured profile or map, with standard errors."""

import math
from typing import Any

import numpy as np

from ..base.parts import Record
from ..surface.surfaces import Surface
from .band import HIGHEST, LOWEST, PER_RESOLUTION, chosen_band, given_band
from .fit import PowerLaw, fit
from .flags import flags_of, unit_flags
from .levels import level_flags, step_limit
from .preparation import checked, prepared, spacing
from .spectrum import Spectrum, map_spectra, profile_spectrum
from .structure_function import StructureFunction, structure_function
from .stylus import tip_limit

_SIGMAS = 3.0
_DISAGREES = 0.05  # in D, where both standard errors are tiny
_VAGUE = 2.0  # in ln G
_MANY = 0.02  # share of all heights


class Identification(Record):
    """The fractal parameters that a measurement shows, and how well.

    G is that of Eq. 13, as the contact law takes it. NaN where D leaves nothing to say of it.
    """

    D: float
    G: float  # m
    D_standard_error: float
    ln_G_standard_error: float
    covariance: np.ndarray  # of (D, ln G), (2, 2)
    G_profile: float  # m: by Majumdar's and Bhushan's formula
    gamma: float
    band: tuple[float, float]  # 1/m
    limit: float  # 1/m: of the instrument, or the Nyquist frequency
    folded: bool
    noise_floor: float  # m^3
    law: PowerLaw
    spectrum: Spectrum
    second_opinion: StructureFunction
    missing: int
    outliers: int
    unused: int
    flags: tuple[str, ...]

    @property
    def decades(self) -> float:
        """Decades of frequency in the band."""
        return math.log10(self.band[1] / self.band[0])

    @property
    def G_standard_error(self) -> float:
        """Of G [m], to first order; where that of ln G is not small, use that one."""
        return self.G * self.ln_G_standard_error

    @property
    def surface(self) -> Surface:
        """As a part of a scene. **Raises:** `ValueError` unless 2 < D < 3."""
        return Surface(self.D, self.G, self.gamma)

    def __repr__(self) -> str:
        from ..report import table

        return "\n".join([table([""], [_rows(self)]), *(f"! {flag}" for flag in self.flags)])


def identify(
    z: Any,
    dx: float,
    dy: float | None = None,
    *,
    band: tuple[float, float] | None = None,
    resolution: float | None = None,
    stylus_radius: float | None = None,
    folded: bool | None = None,
    gamma: float = 1.5,
) -> Identification:
    """D and G of heights z [m], a profile (n,) or a map (n, m), from their power spectrum.

    Points are dx [m] apart along the first axis, dy (dx, if not given) along the second; NaN is
    missing. The surface is taken to be that of Eq. 13, a profile a cut through it.

    - `band`: lowest and highest frequency [1/m] of the fit; chosen, if not given.
    - `resolution` [m]: lateral resolution, or the cut-off wavelength of a Gaussian filter.
    - `stylus_radius` [m] of the tip. Both set the upper end of a band that is chosen.
    - `folded`: whether points were taken of a profile that has finer waves than two of them, or
      what is finer was averaged out; found out from the spectrum, if not given.
    - `gamma` of Eq. 13, also the ratio of the ends of a bin: waves may come in steps of it.

    **Raises:** `ValueError` in one line for heights that are too few, flat, complex, infinite, not
    (n,) or (n, m); distances not above 0; a band that is empty or not in the data; an instrument
    that leaves none.
    """
    z = checked(z)
    dx = spacing("dx", dx)
    dy = dx if dy is None else spacing("dy", dy)
    ratio = float(Surface(2.5, 1e-9, gamma).gamma)
    heights = prepared(z)
    if z.ndim == 1:
        spectra = (profile_spectrum(heights.stretches, dx),)
        length = dx * max(part.size for part in heights.stretches)
        lines = heights.stretches
    else:
        spectra = map_spectra(heights.stretches[0], dx, dy)
        length = min(z.shape[0] * dx, z.shape[1] * dy)
        lines = [*heights.stretches[0].T]
    spectrum = spectra[0]
    top = spectrum.nyquist
    if resolution is not None:
        top = min(top, 1 / (PER_RESOLUTION * spacing("resolution", resolution)))
    if stylus_radius is not None:
        top = min(top, tip_limit(spectrum, length, ratio, spacing("stylus_radius", stylus_radius)))
    steps = (dx, dy)[: z.ndim]
    limit = step_limit(heights.known, steps)
    least = 2 * LOWEST / length
    if band is None:
        usable = top if limit < least else min(top, limit)
        chosen = chosen_band(spectrum, length, ratio, usable)
    else:
        chosen = given_band(band, spectrum, length, ratio, top)
    ends, nature = (chosen.low, chosen.high), chosen.nature
    if folded is not None:
        nature = nature._replace(folded=bool(folded), undecided=False)
    law = fit(spectrum, ends, ratio, **nature.options)
    D, log_G, covariance = _parameters(law, spectrum.kind)
    opinion = structure_function(
        lines,
        dx,
        ends,
        end=None if nature.folded else min(spectrum.nyquist, 2 * top),
        noise=nature.floor * spectrum.nyquist * (1 if z.ndim == 1 else 2 / math.pi),
    )
    errors = np.sqrt(np.diag(covariance))
    flags = [*chosen.notes, *flags_of(law, ends, nature, spectra, ratio)]
    flags += unit_flags(heights.known, steps)
    wanted = min(top, HIGHEST[spectrum.kind] * spectrum.nyquist) if band is None else ends[1]
    flags += level_flags(heights.known, limit, ends[1], wanted, least)
    flags += _flags(D, errors, opinion, z.size, heights)
    return Identification(
        D=D,
        G=_exp(log_G),
        D_standard_error=float(errors[0]),
        ln_G_standard_error=float(errors[1]),
        covariance=covariance,
        G_profile=_profile_roughness(law.p, log_G, ratio),
        gamma=ratio,
        band=ends,
        limit=top,
        folded=nature.folded,
        noise_floor=nature.floor,
        law=law,
        spectrum=spectrum,
        second_opinion=opinion,
        missing=heights.missing,
        outliers=heights.outliers,
        unused=heights.unused,
        flags=tuple(flags),
    )


def _flags(D, errors, opinion, size, heights):
    """What D, its error and the second opinion give reason to say."""
    if not 2 < D < 3:
        yield f"D = {D:.4g} is not between 2 and 3: no surface of this model"
    elif min(D - 2, 3 - D) < errors[0]:
        yield f"D = {D:.4g} is within its error of the end of 2 to 3"
    if errors[1] > _VAGUE:
        yield f"G is hardly known: ln G has a standard error of {errors[1]:.2g}"
    apart = abs(D - opinion.D)
    both = math.hypot(errors[0], opinion.D_standard_error)
    if apart > max(_SIGMAS * both, _DISAGREES):
        yield (
            f"spectrum and structure function disagree: D = {D:.4g} and {opinion.D:.4g}, "
            f"{apart / both:.2g} standard errors apart"
        )
    lost = (heights.missing + heights.outliers) / size
    if lost > _MANY:
        yield f"{lost:.1%} of the heights are missing or outliers"


def _parameters(law: PowerLaw, kind: str):
    """D, ln G and their covariance: p = 7 - 2D, A f_N^p = m(p) G^(2D-4)/2 (a map: without m)."""
    p = law.p

    def log_G(log_A, p):
        share = _log_mean_cosine_power(p) if kind == "profile" else 0.0
        return (log_A + math.log(2) + p * math.log(law.nyquist) - share) / (3 - p)

    h = 1e-6
    slope = np.array(
        [
            [0.0, -0.5],
            [1 / (3 - p), (log_G(law.log_A, p + h) - log_G(law.log_A, p - h)) / (2 * h)],
        ]
    )
    return (7 - p) / 2, log_G(law.log_A, p), slope @ law.covariance[:2, :2] @ slope.T


def _exp(x):
    with np.errstate(over="ignore"):
        return float(np.exp(x))


def _log_mean_cosine_power(p):
    return math.lgamma(p / 2) - math.lgamma((p + 1) / 2) - math.log(math.pi) / 2


def _profile_roughness(p, log_G, gamma):
    """G [m] for which S = G^(2(D_s-1))/(2 ln gamma) f^-(5-2D_s), D_s = D - 1."""
    return _exp(log_G + (_log_mean_cosine_power(p) + math.log(math.log(gamma))) / (3 - p))


def _rows(found: Identification) -> dict[str, str]:
    other, (low, high) = found.second_opinion, found.band
    return {
        "D": f"{found.D:.4f} +- {found.D_standard_error:.4f}",
        "G [m]": f"{found.G:.4g}  (ln G +- {found.ln_G_standard_error:.2g})",
        "G by the profile formula [m]": f"{found.G_profile:.4g}",
        "D by structure function": f"{other.D:.4f} +- {other.D_standard_error:.4f}",
        "band [1/m]": f"{low:.4g} to {high:.4g}  ({found.decades:.2f} decades)",
        "wavelengths [m]": f"{1 / high:.4g} to {1 / low:.4g}",
        "finer waves": "folded in" if found.folded else "not folded in",
        "missing heights": f"{found.missing}",
        "outliers": f"{found.outliers}",
        "unused heights": f"{found.unused}",
    }
