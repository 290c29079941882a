"""The surface of a measured profile or map, with standard errors."""

import contextlib
import functools
import math
import os
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .._base.parts import Record, require_kind
from .._base.table import table
from .._surface.measured_spectrum import MeasuredSpectrum
from .._surface.spectrum import Spectrum
from .._surface.surface import Surface
from .._surface.surface_scatter import SurfaceScatter, fractal_scatter
from .analysis import SpectralAnalysis
from .band import check_band, choose_band, highest_frequency
from .fit import PowerLaw
from .gaps import correct_for_gaps
from .measurement import Measurement
from .patches import patch_covariance
from .preparation import Heights, Preprocessing, prepare_heights, spacing
from .quantisation import quantisation_limit
from .self_affine_fit import Level, SelfAffineFit, fit_self_affine, map_cells, profile_cells
from .source import read_heights
from .spectrum import (
    MapHeights,
    PowerSpectrum,
    log_mean_cosine_power,
    map_heights,
    map_spectra,
    profile_spectrum,
    remove_plane,
)
from .spectrum_of import gaussian_warnings, spectrum_table
from .structure_function import StructureFunction, structure_function
from .stylus import tip_limit
from .warnings import (
    DISQUALIFYING,
    WarningThresholds,
    height_warnings,
    quantisation_warnings,
    result_warnings,
    spectrum_warnings,
)


class Identification(Record):
    """The surface of a measurement, with standard errors.

    D and G are those of the power law, G that of Eq. 13, which the contact law uses. `surface` is a
    `Surface` where the spectrum is such a law without a lay and D is at most three standard errors
    outside (2, 3); otherwise a `SelfAffine` with the roll-off and the lay of the measurement; and
    the `MeasuredSpectrum` of a map that neither describes. A law does not describe a map if its Sq
    is not that of the heights, see `SpectralAnalysis.level`, or if the error of D or H is half of
    their domain or more. `scatter` has their errors, as a tolerance.
    """

    D: float  # fractal dimension
    G: float  # m
    D_standard_error: float  # of D
    ln_G_standard_error: float  # of ln G
    covariance: Float[np.ndarray, "2 2"]  # of (D, ln G)
    log_height: float  # ln m(q) of the power law, m in m^2: the mean square height per ln q
    log_height_error: float  # its standard error
    q: float  # rad/m: wavenumber at which ln m(q) is uncorrelated with D
    G_profile: float  # m: by Majumdar's and Bhushan's formula
    gamma: float  # that of Eq. 13
    band: tuple[float, float]  # 1/m
    limit: float  # 1/m: of the instrument, or the Nyquist frequency
    aliased: bool  # True if waves finer than two points are sampled, not averaged out
    noise_floor: float  # m^3
    law: PowerLaw  # the fitted power law
    spectrum: PowerSpectrum  # what is fitted
    structure_function: StructureFunction  # an independent estimate
    self_affine: SelfAffineFit  # a self-affine surface with roll-off and lay
    Sq: float  # m: root mean square of the heights about their plane or line
    level: float  # standard errors by which the Sq of the power law is beyond that of the heights
    measured_spectrum: MeasuredSpectrum | None  # the spectrum of a map as it is; None of a profile
    end: float  # 1/m: up to which the spectrum is that of the surface
    level_error: float  # standard error of the logarithm of the heights as a whole
    analysis: SpectralAnalysis = eqx.field(static=True)  # as it was given
    missing: int  # number of missing heights
    outliers: int  # number of heights taken out as spikes
    unused: int  # number of heights in segments that are too short
    warnings: tuple[str, ...] = eqx.field(static=True)  # what to doubt, one line each

    @property
    def decades(self) -> float:
        """Decades of frequency in the band."""
        return math.log10(self.band[1] / self.band[0])

    @property
    def G_standard_error(self) -> float:
        """Standard error of G [m], to first order; use that of ln G where it is not small."""
        return self.G * self.ln_G_standard_error

    @property
    def surface(self) -> Spectrum:
        """The surface, as a part of a scene. **Raises:** `ValueError` as `scatter`."""
        return self.scatter.surface

    @functools.cached_property
    def scatter(self) -> SurfaceScatter:
        """The surface with the errors of its numbers, which are a tolerance of a design.

        **Raises:** `ValueError` with what to measure instead, where no surface describes it.
        """
        words = [word for word in self.warnings if word.startswith(DISQUALIFYING)]
        if any(word.startswith("too few levels") for word in words):
            raise ValueError(f"{words[0]}: measure with finer steps of height")
        beyond = max(2 - self.D, self.D - 3) / max(self.D_standard_error, 1e-300)
        fit, limit = self.self_affine, self.analysis.level
        errors = self.D_standard_error, fit.H_standard_error
        # A profile has nothing else: the simplest law is handed on then with its own Sq.
        for strict in (True, False) if self.measured_spectrum is None else (True,):
            # The domains of D and H are 1 wide: with such an error they may be anywhere in it.
            is_level = [
                not strict or (abs(by) <= limit and error < 1 / 2)
                for by, error in zip((self.level, fit.level), errors, strict=True)
            ]
            plain = fit.lay == 1 and not (fit.fits and fit.has_rolloff)
            if beyond <= 3 and not words and plain and is_level[0]:
                with contextlib.suppress(ValueError):  # D at 2: a Hurst exponent of 1
                    return self.power_law_scatter
            if fit.fits and is_level[1] and self._has_gradient_of(fit.surface_scatter.surface):
                return fit.surface_scatter
        measured = self.measured_spectrum
        if measured is None:
            raise ValueError(
                f"no surface fits this profile (H = {fit.H:.3g} +- {fit.H_standard_error:.2g}, its "
                f"spectrum scatters by {fit.scatter:.0%} about the law): measure a map, whose "
                "spectrum is taken as it is"
            )
        error = np.array([[self.level_error**2]])
        return SurfaceScatter(measured, ("ln height_factor",), error)

    def _has_gradient_of(self, surface: Spectrum) -> bool:
        """True unless the Sdq of a surface and of the map differ by more than is allowed."""
        if self.measured_spectrum is None:
            return True
        squares = [float(each.moments()[1]) for each in (surface, self.measured_spectrum)]
        return max(squares) <= self.analysis.gradient**2 * min(squares)

    @property
    def power_law_scatter(self) -> SurfaceScatter:
        """The `Surface` of the power law with its errors, whatever the warnings say.

        **Raises:** `ValueError` for D so close to 2 that G is 0 in double precision.
        """
        covariance = np.diag([self.D_standard_error, self.log_height_error]) ** 2
        return fractal_scatter(self.D, self.log_height, self.q, covariance, self.gamma)

    def __repr__(self) -> str:
        other, (low, high) = self.structure_function, self.band
        rows = {
            "D": f"{self.D:.4f} +- {self.D_standard_error:.4f}",
            "G [m]": f"{self.G:.4g}  (ln G +- {self.ln_G_standard_error:.2g})",
            "G by the profile formula [m]": f"{self.G_profile:.4g}",
            "D by structure function": f"{other.D:.4f} +- {other.D_standard_error:.4f}"
            if other.D == other.D
            else "none: no power law of a surface fits it",
            "ln m(q) at q [rad/m]": f"{self.log_height:.4g} +- {self.log_height_error:.2g} at "
            f"{self.q:.4g}",
            "self-affine": self.self_affine.description,
            "band [1/m]": f"{low:.4g} to {high:.4g}  ({self.decades:.2f} decades)",
            "wavelengths [m]": f"{1 / high:.4g} to {1 / low:.4g}",
            "finer waves": "aliased" if self.aliased else "not aliased",
            "missing heights": f"{self.missing}",
            "outliers": f"{self.outliers}",
            "unused heights": f"{self.unused}",
        }
        try:
            rows["surface"] = type(self.surface).__name__
        except ValueError as error:
            rows["surface"] = f"none: {error}"
        return "\n".join([table([""], [rows]), *(f"warning: {each}" for each in self.warnings)])


def identify(
    z: ArrayLike | Measurement | str | os.PathLike | Any,
    dx: float | None = None,
    dy: float | None = None,
    *,
    band: tuple[float, float] | None = None,
    resolution: float | None = None,
    stylus_radius: float | None = None,
    aliased: bool | None = None,
    gamma: float = 1.5,
    preprocessing: Preprocessing = Preprocessing(),
    analysis: SpectralAnalysis = SpectralAnalysis(),
    thresholds: WarningThresholds = WarningThresholds(),
) -> Identification:
    """The surface of a measured profile or map, from its power spectrum.

    D and G are those of Eq. 13, a profile is a cut through it. Beside them a self-affine surface
    with a roll-off, and of a map a lay, is fitted; `Identification.surface` is the simplest that
    describes the measurement. Standard errors of a
    map include its variation from place to place; those of a profile assume that there is none. The
    effect of filled gaps on the spectrum is estimated on surrogates and removed.

    **Arguments:**

    - `z`: heights [m], a profile (n,) or a map (n, m); NaN is missing. Or a `Measurement`, the path
      of a file that `read_measurement` reads without options but dx and dy, or a topography of
      SurfaceTopography: with `heights()`, a `unit`, and `pixel_size` or `positions()`. These have
      dx and dy, which the arguments must not contradict, and `resolution` and `stylus_radius`,
      which the arguments replace.
    - `dx`: distance of points along the first axis [m].
    - `dy`: distance of points along the second axis [m], by default dx.
    - `band`: lowest and highest frequency [1/m] of the fit; chosen by default.
    - `resolution`: lateral resolution [m], or the cut-off wavelength of a Gaussian filter; by
      default none.
    - `stylus_radius`: radius of the tip [m], by default none. It and `resolution` limit a band
      chosen by default.
    - `aliased`: True if waves finer than two points are sampled, and so aliased, False if they are
      averaged out; decided from the spectrum by default.
    - `gamma`: that of Eq. 13, 1.5 by default, also the ratio of the ends of a bin: waves may come
      in steps of it.
    - `preprocessing`, `analysis`, `thresholds`: options of the heights before their spectrum, of
      the spectrum and the band, and of the warnings.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for heights that are too few, flat, complex, infinite or not (n,) or
    (n, m); distances that are missing, not above 0 or not those of z; a band that is empty or
    outside the data, or that the instrument leaves empty; and as `read_measurement` does.
    """
    require_kind("preprocessing", preprocessing, Preprocessing)
    require_kind("analysis", analysis, SpectralAnalysis)
    require_kind("thresholds", thresholds, WarningThresholds)
    read = read_heights(z, dx, dy, preprocessing)
    z, dx, dy = read.z, read.dx, read.dx if read.dy is None else read.dy
    resolution = read.resolution if resolution is None else resolution
    stylus_radius = read.stylus_radius if stylus_radius is None else stylus_radius
    steps = (dx, dy)[: z.ndim]
    ratio = float(Surface(2.5, 1e-9, gamma).gamma)
    heights = prepare_heights(z, preprocessing)
    if z.ndim == 1:
        lines = heights.segments
        length = dx * max(segment.size for segment in lines)
    else:
        lines = [*heights.despiked.T]
        length = min(z.shape[0] * dx, z.shape[1] * dy)

    def estimate_spectra(segments):
        if z.ndim == 1:
            return (profile_spectrum(segments, dx, analysis.tapers),)
        return map_spectra(segments[0], dx, dy)

    raw = spectra = estimate_spectra(heights.segments)
    if any(gap.any() for gap in heights.gaps):
        spectra = correct_for_gaps(spectra, heights.gaps, steps, estimate_spectra)
    spectrum = spectra[0]
    top = spectrum.nyquist
    if resolution is not None:
        top = min(top, 1 / (analysis.resolutions * spacing("resolution", resolution)))
    periods = analysis.fewest_periods
    if stylus_radius is not None:
        radius = spacing("stylus_radius", stylus_radius)
        top = min(top, tip_limit(spectrum, length, ratio, radius, fewest_periods=periods))
    limit, least = quantisation_limit(heights.despiked, steps), 2 * periods / length
    if band is None:
        usable = top if limit < least else min(top, limit)
        chosen = choose_band(spectrum, length, ratio, usable, analysis)
        reach = min(top, highest_frequency(spectrum))
    else:
        chosen = check_band(band, spectrum, length, ratio, top, sigmas=analysis.sigmas)
        reach = chosen.high
    if aliased is not None:
        chosen = chosen._replace(
            noise=chosen.noise._replace(aliased=bool(aliased), undecided=False)
        )
    noise, ends = chosen.noise, (chosen.low, chosen.high)
    law = noise.fit(spectrum, ends, ratio)
    between = None
    if z.ndim == 2:
        between = patch_covariance(heights.segments[0], dx, dy, spectrum, law, ends, ratio)
        covariance = law.covariance + np.pad(between, (0, 1))
        law = eqx.tree_at(lambda law: law.covariance, law, covariance)
    log_G, log_G_profile, covariance = _parameters(law, ratio)
    end = min(top, highest_frequency(spectrum))
    if limit >= least:
        end = min(end, limit)
    if noise.floor:
        end = min(end, noise.crossing)
    wide = ends
    if band is None:  # without the longest waves, which the removed plane has part of
        wide = 3 / length, max(min(end, 2 * chosen.high), 9 / length)
    if z.ndim == 1:
        cells = profile_cells(spectrum, wide)
    else:
        cells = map_cells(heights.segments[0], dx, dy, wide)
        # What the gaps do to the mean over directions.
        change = np.log(spectrum.power / raw[0].power)
        by = np.interp(np.log(cells.f), np.log(spectrum.f), change)
        cells = cells._replace(height=cells.height * np.exp(by))
    log_height, height_error, q = _height(law)
    measured, level_error = None, height_error / 2
    if z.ndim == 1:
        level = _level_of_profile(lines, dx, spectrum, wide[1])
    else:
        of_map = map_heights(heights.segments[0], dx, dy, heights.gaps[0])
        level = _level_of_map(spectrum, of_map, wide[1])
        reached = min(top, noise.crossing) if band is None else chosen.high
        table = spectrum_table(spectrum, of_map, reached, per_bin=1.4)
        if table is not None:
            measured = MeasuredSpectrum(table.q, table.C, table.error, height_factor=1.0)
            level_error = math.hypot(math.sqrt(table.variance) / 2, height_error / 2)
    fit = fit_self_affine(
        cells, wide, length, sigmas=analysis.sigmas, law=law, between=between, level=level
    )
    other = structure_function(
        lines,
        dx,
        ends,
        end=None if noise.aliased else min(spectrum.nyquist, 2 * top),
        noise=noise.floor * spectrum.nyquist * (1 if z.ndim == 1 else 2 / math.pi),
    )
    errors = np.sqrt(np.diag(covariance))
    warnings = [
        *chosen.warnings,
        *spectrum_warnings(law, chosen, spectra, ratio, thresholds),
        *height_warnings(heights.despiked, steps, thresholds),
        *quantisation_warnings(heights.despiked, limit, chosen.high, reach, least, thresholds.held),
        *result_warnings(law.D, errors, other, heights, thresholds),
        *(gaussian_warnings(heights.segments[0]) if z.ndim == 2 else ()),
    ]
    with np.errstate(over="ignore"):
        G, G_profile = map(float, np.exp([log_G, log_G_profile]))
    return Identification(
        D=law.D,
        G=G,
        D_standard_error=float(errors[0]),
        ln_G_standard_error=float(errors[1]),
        covariance=covariance,
        log_height=log_height,
        log_height_error=height_error,
        q=q,
        G_profile=G_profile,
        gamma=ratio,
        band=ends,
        limit=top,
        aliased=noise.aliased,
        noise_floor=noise.floor,
        law=law,
        spectrum=spectrum,
        structure_function=other,
        self_affine=fit,
        Sq=_root_mean_square(heights),
        level=0.0 if level is None else _beyond_level(law, level, wide[1]),
        measured_spectrum=measured,
        end=end,
        level_error=level_error,
        analysis=analysis,
        missing=heights.missing,
        outliers=heights.outliers,
        unused=heights.unused,
        warnings=tuple(warnings),
    )


def _parameters(law: PowerLaw, gamma: float) -> tuple[float, float, np.ndarray]:
    """ln G, ln G by the profile formula, and the covariance of (D, ln G).

    D = (7 - p)/2, and A f_N^p = m(p) G^(3-p)/2 for a profile, without m(p) for a map. The profile
    formula is A f_N^p = G^(2(D_s-1))/(2 ln gamma), D_s = D - 1.
    """
    from scipy.special import digamma

    p, profile = law.p, law.kind == "profile"
    log_m, log_f = log_mean_cosine_power(p), math.log(law.nyquist)
    log_G = (law.log_A + math.log(2) + p * log_f - profile * log_m) / (3 - p)
    by_p = (log_f - profile * (digamma(p / 2) - digamma((p + 1) / 2)) / 2 + log_G) / (3 - p)
    slope = np.array([[0.0, -0.5], [1 / (3 - p), by_p]])
    covariance = slope @ law.covariance[:2, :2] @ slope.T
    return log_G, log_G + (log_m + math.log(math.log(gamma))) / (3 - p), covariance


def _height(law: PowerLaw) -> tuple[float, float, float]:
    """ln m(q), its standard error, and the wavenumber q at which it is uncorrelated with p.

    ln m = ln A - p ln(f/f_N) + ln f, minus ln m(p) of a profile.
    """
    from scipy.special import digamma

    p, C, profile = law.p, law.covariance, law.kind == "profile"
    by_p = -profile * (digamma(p / 2) - digamma((p + 1) / 2)) / 2
    log_ratio = C[0, 1] / C[1, 1] + by_p
    log_f = log_ratio + math.log(law.nyquist)
    height = law.log_A - p * log_ratio + log_f - profile * log_mean_cosine_power(p)
    left = C[0, 0] - C[0, 1] ** 2 / C[1, 1]
    return float(height), math.sqrt(max(left, 0)), 2 * math.pi * math.exp(log_f)


def _root_mean_square(heights: Heights) -> float:
    """Root mean square [m] of measured heights about the plane of a map, the lines of segments."""
    parts = [
        (_without_line(z) if z.ndim == 1 else remove_plane(z))[~gap]
        for z, gap in zip(heights.segments, heights.gaps, strict=True)
    ]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _without_line(z):
    """A segment minus its least-squares line."""
    x = np.arange(z.size) - (z.size - 1) / 2
    z = z - z.mean()
    return z - (x @ z) / (x @ x) * x


def _level_of_map(spectrum: PowerSpectrum, heights: MapHeights, high: float) -> Level | None:
    """That of the waves of a map up to `high` [1/m]."""
    table = spectrum_table(spectrum, heights, high)
    if table is None:
        return None
    return Level(table.mean_square, min(heights.longest, high), table.variance)


def _level_of_profile(
    segments: list[np.ndarray], dx: float, spectrum: PowerSpectrum, high: float
) -> Level:
    """That of the waves of a profile up to `high` [1/m]."""
    squares = np.concatenate([_without_line(z) ** 2 for z in segments])
    # The mean square of an ordinate: they are evenly spaced in f until merged.
    waves = spectrum.power * spectrum.weight * spectrum.f
    inside = spectrum.f <= high * (1 + 1e-9)
    share = waves[inside] / np.sum(waves[inside])
    return Level(
        float(np.mean(squares) * np.sum(waves[inside]) / np.sum(waves)),
        1 / (dx * max(z.size for z in segments)),
        float(np.sum(share**2 / spectrum.count[inside])),
    )


def _beyond_level(law: PowerLaw, level: Level, high: float) -> float:
    """Standard errors by which a power law up to `high` [1/m] has a larger Sq than the heights."""
    # The integral of A (f/f_N)^-p from the longest wave on, and its slopes by ln A and p.
    low, high = (math.log(f / law.nyquist) for f in (level.low, high))
    x, weight = np.polynomial.legendre.leggauss(32)
    x = low + (x + 1) / 2 * (high - low)
    waves = weight * (high - low) / 2 * np.exp((1 - law.p) * x)
    slope = np.array([1.0, -np.sum(waves * x) / np.sum(waves)])
    log_square = law.log_A + math.log(law.nyquist * np.sum(waves))
    variance = level.variance + law.scatter + slope @ law.covariance[:2, :2] @ slope
    return (log_square - math.log(level.mean_square)) / math.sqrt(variance)
