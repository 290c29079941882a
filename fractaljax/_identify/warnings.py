"""Warnings: reasons to doubt an identification, one line each."""

import dataclasses
import itertools
import math
from collections.abc import Iterator

import numpy as np

from .._base.options import require_number
from .band import Band
from .fit import PowerLaw, curvature, fit
from .preparation import Heights
from .quantisation import QuantisationTest, differences, rounding
from .spectrum import PowerSpectrum
from .structure_function import StructureFunction

DISQUALIFYING = ("not fractal", "too few levels")  # of warnings that void D and G


@dataclasses.dataclass(frozen=True)
class WarningThresholds:
    """Thresholds beyond which `identify` warns of a measurement or of its result.

    **Fields:**

    - `decades`: fewest decades of frequency in the band. With fewer than one, a factor of 2 at one
      end of the band moves D by more than 0.15.
    - `sigmas`: standard errors that a bend, a difference between directions, and one between the
      spectrum and the structure function must exceed.
    - `bend`: change of D along the band; half of it between D along x and along y.
    - `scatter`: relative scatter of the bins about the law, beyond that of their ordinates.
    - `anisotropy`: difference of ln(power) between waves along x and along y.
    - `disagreement`: difference between D by the spectrum and by the structure function.
    - `ln_G_error`: standard error of ln G.
    - `missing`: share of the heights that are missing or outliers.
    - `clipped`: share of the heights that equal the largest or the smallest one.
    - `held`: share of the heights, beyond chance, that equal a neighbour or are in line with two.
    - `jump`: robust standard deviations of a difference between neighbours.

    An infinite threshold, or 0 decades, silences its warning.

    **Raises:** `ValueError` or `TypeError` for a threshold that is no number or below 0.
    """

    decades: float = 1.0
    sigmas: float = 3.0
    bend: float = 0.2
    scatter: float = 0.5
    anisotropy: float = 0.25
    disagreement: float = 0.05
    ln_G_error: float = 2.0
    missing: float = 0.02
    clipped: float = 0.005
    held: float = 0.01
    jump: float = 10.0

    def __post_init__(self):
        for name, value in vars(self).items():
            require_number(name, value, 0)


def spectrum_warnings(
    law: PowerLaw,
    band: Band,
    spectra: tuple[PowerSpectrum, ...],
    ratio: float,
    thresholds: WarningThresholds = WarningThresholds(),
) -> Iterator[str]:
    """Warnings about a spectrum and its fit; for a map, also about the spectra along x and y."""
    ends = band.low, band.high
    decades = math.log10(band.high / band.low)
    least = thresholds.decades
    if decades < least - 1e-9:
        yield f"too few decades: the band spans {decades:.2f}, at least {least:g} is wanted"
    if law.f.size >= 5:
        c, error = curvature(law)
        low, high = law.D + c * np.log(np.array(ends) / law.f.mean())
        if abs(c) > thresholds.sigmas * error and abs(high - low) > thresholds.bend:
            yield (
                f"not fractal over the band: the slope bends from D = {low:.3g} at its lower to "
                f"{high:.3g} at its upper end ({abs(c) / error:.2g} standard errors)"
            )
    if math.sqrt(law.scatter) > thresholds.scatter:  # peaks rather than a law
        yield (
            f"not fractal over the band: bins scatter by {math.sqrt(law.scatter):.0%} about the "
            "power law, more than chance explains"
        )
    if band.noise.undecided:
        other = fit(spectra[0], ends, ratio, aliased=not law.aliased)
        if abs(other.D - law.D) > law.D_standard_error:
            yes, no = (law, other) if law.aliased else (other, law)
            yield (
                "waves finer than two points may be aliased: "
                f"D = {yes.D:.3f} if so, {no.D:.3f} if not; set aliased="
            )
    if len(spectra) > 1:
        along_x, along_y = (band.noise.fit(each, ends, ratio) for each in spectra[1:])
        yield from _anisotropy(along_x, along_y, thresholds)


def _anisotropy(x: PowerLaw, y: PowerLaw, thresholds: WarningThresholds):
    bins = min(x.ratio.size, y.ratio.size)
    change = np.log(x.power[-bins:] / y.power[-bins:])
    weight = 1 / (x.error[-bins:] ** 2 + y.error[-bins:] ** 2)
    level, error = np.average(change, weights=weight), 1 / math.sqrt(weight.sum())
    if abs(level) > max(thresholds.sigmas * error, thresholds.anisotropy):
        yield (
            f"anisotropic: waves along x have {math.exp(level):.3g} times the power of those "
            f"along y ({abs(level) / error:.2g} standard errors)"
        )
    both = math.hypot(x.D_standard_error, y.D_standard_error)
    if abs(x.D - y.D) > max(thresholds.sigmas * both, thresholds.bend / 2):
        yield f"anisotropic: D = {x.D:.3f} along x, {y.D:.3f} along y"


def height_warnings(
    z: np.ndarray, steps: tuple[float, ...], thresholds: WarningThresholds = WarningThresholds()
) -> Iterator[str]:
    """Warnings about sizes that no instrument measures, clipped heights and jumps.

    z (n,) or (n, m) with NaN for gaps, `steps` [m] between points along its axes.
    """
    rms, slope = float(np.nanstd(z)), 0.0
    for axis, step in enumerate(steps):
        change = differences(np.moveaxis(z, axis, 0), 1)
        if change.size:
            slope = max(slope, float(np.sqrt(np.mean(change**2))) / step)
    length = max(n * step for n, step in zip(z.shape, steps, strict=True))
    # No instrument scans more than a metre, resolves less than a picometre or follows such slopes.
    odd = [
        (length > 1, f"it is {length:.3g} m long"),
        (min(steps) < 1e-12, f"its points are {min(steps):.3g} m apart"),
        (not 1e-12 <= rms <= 1, f"its rms height is {rms:.3g} m"),
        (slope > 30, f"its rms slope is {slope:.3g}"),
    ]
    if any(is_odd for is_odd, _ in odd):
        yield f"the units may be wrong: {', '.join(words for is_odd, words in odd if is_odd)}"
    levels = np.unique(z[~np.isnan(z)])
    for what, end, next_one in (("largest", *levels[[-1, -2]]), ("smallest", *levels[:2])):
        count, others = np.sum(z == end), np.sum(z == next_one)
        # By chance there may be some, but not five times as many as at the next level.
        if count >= max(5 * others, 5, thresholds.clipped * z.size):
            yield f"clipped: {count / z.size:.1%} of the heights are the {what} one, {end:.4g} m"
    for axis in range(z.ndim):
        change = np.diff(np.moveaxis(z, axis, 0), axis=0)
        if z.ndim == 2:  # the mean over a line
            change = change[np.isfinite(change).any(axis=1)]
            change = np.nanmean(change, axis=1)
        change = change[np.isfinite(change)]
        jumps = np.abs(change - np.median(change)) if change.size else np.zeros(1)
        usual = 1.4826 * np.median(jumps)
        if jumps.max() > thresholds.jump * usual > 0:
            yield (
                f"a jump of {jumps.max():.3g} m, {jumps.max() / usual:.2g} times the usual change: "
                "are these two scans?"
            )
            return


def quantisation_warnings(
    z: np.ndarray,
    limit: float,
    high: float,
    reach: float,
    lowest: float,
    held: float = WarningThresholds.held,
) -> Iterator[str]:
    """Warnings about heights z whose steps matter above `limit` [1/m], in a band up to `high`.

    Without steps the band would extend to `reach`. No band is left where `limit` is below `lowest`.
    Where the steps do not matter, a share `held` of the heights may still be held or interpolated.
    """
    finite = z[~np.isnan(z)]
    levels = np.unique(finite)
    heights = "heights are quantised, clipped or interpolated"
    if 2 * levels.size < finite.size:
        heights = (
            f"heights have only {levels.size} levels (step {np.median(np.diff(levels)):.3g} m)"
        )
    if limit < lowest:
        yield f"too few levels: {heights}, D and G are meaningless"
    elif limit < high * (1 - 1e-9):
        yield f"{heights}: D and G are in doubt, the band goes beyond {limit:.3g} 1/m"
    elif limit < reach * (1 - 1e-9):
        yield f"{heights}: the band ends at {high:.3g} 1/m"
    elif limit == math.inf:
        yield from _held(z, held)


def _held(z, most, fewest=QuantisationTest.fewest):
    """Warning if more than a share `most` of the heights equal or continue their neighbours.

    There must be at least `fewest` differences.
    """
    for axis, order in itertools.product(range(z.ndim), (2, 1)):
        changes = np.abs(differences(np.moveaxis(z, axis, 0), order))
        if changes.size < fewest:
            continue
        exact = max(1e-9 * changes.max(), rounding(z))
        rest = np.sort(changes[changes > exact])
        flat = 1 - rest.size / changes.size
        same = np.searchsorted(rest, rest + exact, "right") - np.arange(rest.size)
        if flat - same.max(initial=0) / changes.size > most and rest.size < changes.size - 3:
            alike = "in line with their neighbours" if order == 2 else "equal to their neighbour"
            yield f"{flat:.1%} of the heights are {alike}: clipped, held or interpolated"
            return


def result_warnings(
    D: float,
    errors: np.ndarray,
    other: StructureFunction,
    heights: Heights,
    thresholds: WarningThresholds = WarningThresholds(),
) -> Iterator[str]:
    """Warnings about D, the standard errors, the second estimate, and lost heights."""
    if not 2 < D < 3:
        yield f"D = {D:.4g} is not between 2 and 3: no surface of this model"
    elif min(D - 2, 3 - D) < errors[0]:
        yield f"D = {D:.4g} is within its standard error of 2 or 3"
    if errors[1] > thresholds.ln_G_error:
        yield f"G is poorly known: ln G has a standard error of {errors[1]:.2g}"
    both = math.hypot(errors[0], other.D_standard_error)
    if abs(D - other.D) > max(thresholds.sigmas * both, thresholds.disagreement):
        yield (
            f"spectrum and structure function disagree: D = {D:.4g} and {other.D:.4g}, "
            f"{abs(D - other.D) / both:.2g} standard errors apart"
        )
    lost = (heights.missing + heights.outliers) / heights.despiked.size
    if lost > thresholds.missing:
        yield f"{lost:.1%} of the heights are missing or outliers"
