"""What gives reason to doubt that a spectrum is that of a fractal surface: one line each."""

import math
from collections.abc import Iterator

import numpy as np

from .band import Nature
from .fit import PowerLaw, curvature, fit
from .spectrum import Spectrum

_SIGMAS = 3.0
_BENDS = 0.2  # change of D along the band that is worth a line
_ROUGH = 0.5  # scatter of bins beyond that of their ordinates: peaks rather than a law
_FEW_DECADES = 1.0  # less, and a factor of 2 at one end of the band moves D by more than 0.15
_LONG, _SHORT = 1.0, 1e-12  # m: beyond what instruments scan, and below what they resolve
_STEEP = 30.0  # rms slope
_LAY = 0.25  # in ln of the power: a difference of directions that is worth a line


def flags_of(
    law: PowerLaw,
    band: tuple[float, float],
    nature: Nature,
    spectra: tuple[Spectrum, ...],
    ratio: float,
) -> Iterator[str]:
    """The reasons in a spectrum; of a map, with the spectra along x and along y."""
    yield from _few_decades(band)
    yield from _bend(law, band)
    if math.sqrt(law.scatter) > _ROUGH:
        yield (
            f"not fractal over the band: bins scatter by {math.sqrt(law.scatter):.0%} about the "
            "power law beyond what chance does"
        )
    if nature.undecided:
        yield from _folding(law, band, spectra[0], ratio)
    if len(spectra) > 1:
        yield from _lay(spectra[1:], band, nature, ratio)


def unit_flags(z: np.ndarray, steps: tuple[float, ...]) -> Iterator[str]:
    """Sizes that no instrument measures: heights z [m] in any shape, steps [m] along its axes."""
    rms = float(np.nanstd(z))
    slope = 0.0
    for axis, step in enumerate(steps):
        change = np.diff(z, axis=axis)
        if not np.isnan(change).all():
            slope = max(slope, float(np.sqrt(np.nanmean(change**2))) / step)
    length = max(n * step for n, step in zip(z.shape, steps, strict=True))
    odd = [
        (length > _LONG, f"it is {length:.3g} m long"),
        (min(steps) < _SHORT, f"its points are {min(steps):.3g} m apart"),
        (rms > _LONG, f"its rms height is {rms:.3g} m"),
        (rms < _SHORT, f"its rms height is {rms:.3g} m"),
        (slope > _STEEP, f"its rms slope is {slope:.3g}"),
    ]
    reasons = [words for is_odd, words in odd if is_odd]
    if reasons:
        yield f"the units may be wrong: {', '.join(reasons)}"


def _few_decades(band):
    decades = math.log10(band[1] / band[0])
    if decades < _FEW_DECADES - 1e-9:
        yield f"too few decades: the band spans {decades:.2f}, at least {_FEW_DECADES:g} is wanted"


def _bend(law, band):
    if law.f.size < 5:
        return
    c, error = curvature(law)
    log_ends = np.log(np.array(band) / law.f.mean())
    low, high = 3.5 - (law.p - 2 * c * log_ends) / 2
    if abs(c) > _SIGMAS * error and abs(high - low) > _BENDS:
        yield (
            f"not fractal over the band: the slope bends from D = {low:.3g} at its lower to "
            f"{high:.3g} at its upper end ({abs(c) / error:.2g} standard errors)"
        )


def _folding(law, band, spectrum, ratio):
    """Whether waves finer than two points are folded in cannot be seen, and it would matter."""
    other = fit(spectrum, band, ratio, folded=not law.folded)
    error = math.sqrt(law.covariance[1, 1]) / 2
    if abs(other.p - law.p) / 2 > error:
        yes, no = (other, law) if not law.folded else (law, other)
        yield (
            "waves finer than two points may be folded in: "
            f"D = {3.5 - yes.p / 2:.3f} if so, {3.5 - no.p / 2:.3f} if not; say folded="
        )


def _lay(spectra, band, nature, ratio):
    x, y = (fit(spectrum, band, ratio, **nature.options) for spectrum in spectra)
    bins = min(x.ratio.size, y.ratio.size)
    change = np.log(x.power[-bins:] / y.power[-bins:])
    weight = 1 / (x.error[-bins:] ** 2 + y.error[-bins:] ** 2)
    level = np.sum(weight * change) / np.sum(weight)
    error = 1 / math.sqrt(np.sum(weight))
    if abs(level) > max(_SIGMAS * error, _LAY):
        yield (
            f"anisotropic: waves along x hold {math.exp(level):.3g} times the power of those "
            f"along y ({abs(level) / error:.2g} standard errors)"
        )
    apart = abs(x.p - y.p) / 2
    both = math.hypot(*(math.sqrt(law.covariance[1, 1]) / 2 for law in (x, y)))
    if apart > max(_SIGMAS * both, _BENDS / 2):
        yield f"anisotropic: D = {3.5 - x.p / 2:.3f} along x, {3.5 - y.p / 2:.3f} along y"
