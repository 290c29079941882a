"""The band of frequencies over which a measured spectrum is that of its surface."""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from .analysis import SpectralAnalysis
from .fit import FlatPrior, PowerLaw, fit
from .spectrum import PowerSpectrum, log_mean_cosine_power


class NoiseModel(NamedTuple):
    """Noise and aliasing beside the power law."""

    aliased: bool = False  # waves beyond the Nyquist frequency
    undecided: bool = False  # the spectrum does not tell whether aliased
    floor: float = 0.0  # m^3: white noise, at the Nyquist frequency
    crossing: float = math.inf  # 1/m: where the law falls to twice the floor
    flat_prior: FlatPrior = FlatPrior()

    def fit(self, spectrum: PowerSpectrum, band, ratio: float, **options: Any) -> PowerLaw:
        """`fit` under this model."""
        return fit(
            spectrum, band, ratio, aliased=self.aliased, flat_prior=self.flat_prior, **options
        )


class Band(NamedTuple):
    """Ends of the band, and what set them."""

    low: float  # 1/m
    high: float  # 1/m
    noise: NoiseModel
    warnings: tuple[str, ...]


def highest_frequency(spectrum: PowerSpectrum) -> float:
    """The upper end of a band that nothing else limits, a share of the Nyquist frequency.

    Above it finer waves are aliased, or missing where a profile should cross them at an angle.
    """
    return (0.5 if spectrum.kind == "profile" else 0.6) * spectrum.nyquist


def check_band(
    band: Any,
    spectrum: PowerSpectrum,
    length: float,
    ratio: float,
    top: float,
    *,
    sigmas: float = SpectralAnalysis.sigmas,
    fewest: int = 12,
) -> Band:
    """The user's band [1/m], with at least `fewest` frequencies; `sigmas` as in `noise_model`.

    **Raises:** `ValueError` if it is empty or outside the data.
    """
    try:
        low, high = (float(end) for end in band)
    except (TypeError, ValueError):
        raise ValueError(f"band must be two frequencies (low, high) in 1/m, got {band!r}") from None
    least, most = 2 / length, spectrum.nyquist
    if not (least <= low < high <= most):
        raise ValueError(
            f"band must rise and lie between {least:.6g} and {most:.6g} 1/m, the data's range, "
            f"got {low:.6g} to {high:.6g}"
        )
    inside = np.sum((spectrum.f >= low) & (spectrum.f <= high))
    if inside < fewest:
        raise ValueError(f"band must hold {fewest} frequencies of the data, it holds {inside}")
    warnings = ()
    if high > top * (1 + 1e-9):
        warnings = (f"the band goes beyond the instrument's limit of {top:.4g} 1/m",)
    return Band(low, high, noise_model(spectrum, (low, most), ratio, sigmas), warnings)


def choose_band(
    spectrum: PowerSpectrum,
    length: float,
    ratio: float,
    top: float,
    analysis: SpectralAnalysis = SpectralAnalysis(),
) -> Band:
    """The widest band over which the spectrum is a power law.

    `top` [1/m] is the instrument's limit. A noise floor ends the band where the law falls to twice
    the floor. A plateau begins it at three times its corner, a roll-off ends it at its
    corner over `analysis.resolutions`.
    """
    low, high = analysis.fewest_periods / length, min(highest_frequency(spectrum), top)
    if high < 2 * low:
        raise ValueError(
            f"the instrument's limit of {high:.6g} 1/m leaves no band above {low:.6g} 1/m"
        )
    noise = noise_model(spectrum, (low, min(spectrum.nyquist, top)), ratio, analysis.sigmas)
    warnings = []
    if noise.floor:
        high = min(high, max(noise.crossing, 3 * low))
        warnings.append(f"noise floor of {noise.floor:.3g} m^3: the band ends at {high:.3g} 1/m")
    kind, corner = _bend(spectrum, (low, high), ratio, noise, analysis.sigmas)
    if kind in (_plateau, _plateau_of_map):
        low = min(3 * corner, high / 3)
        warnings.append(f"plateau below {corner:.3g} 1/m: the band begins at {low:.3g} 1/m")
    elif kind is _roll_off:
        high = max(corner / analysis.resolutions, 3 * low)
        warnings.append(f"roll-off above {corner:.3g} 1/m: the band ends at {high:.3g} 1/m")
    bins = math.floor(math.log(high / low) / math.log(ratio) + 1e-9)
    if bins >= 5:  # enough to spare a part of a bin, which may hold a discrete wave, or none
        low = high * ratio**-bins
    return Band(low, high, noise, tuple(warnings))


def noise_model(
    spectrum: PowerSpectrum,
    band: tuple[float, float],
    ratio: float,
    sigmas: float = SpectralAnalysis.sigmas,
) -> NoiseModel:
    """Noise, aliasing, or neither, by a band up to the Nyquist or the instrument's frequency.

    A noise floor must lower the deviance by the square of `sigmas`.
    """
    profile = spectrum.kind == "profile"

    fit_law = functools.partial(fit, spectrum, band, tol=1e-4)  # enough for a comparison
    unknown = FlatPrior(deviation=1e6)
    cases = [(False, FlatPrior(deviation=0.3)), (False, unknown)]
    if profile:
        cases.append((True, FlatPrior(deviation=0.1)))
    laws = [fit_law(ratio, aliased=aliased, flat_prior=prior) for aliased, prior in cases]
    least = min(law.scatter for law in laws)
    plain, noisy, *rest = [
        fit_law(ratio, aliased=aliased, flat_prior=prior, scatter=least, start=law)
        for (aliased, prior), law in zip(cases, laws, strict=True)
    ]
    aliased = rest[0] if rest else plain
    gain = plain.deviance - aliased.deviance
    if min(plain.deviance, aliased.deviance) - noisy.deviance > sigmas**2 and noisy.flat > 0:
        crossing = spectrum.nyquist * (2 * noisy.flat) ** (-1 / (noisy.p + (not profile)))
        floor = noisy.flat * math.exp(noisy.log_A)
        return NoiseModel(floor=floor, crossing=crossing, flat_prior=unknown)
    fine = fit_law(1.1, flat_prior=FlatPrior(deviation=0.1))  # in narrow bins
    occupied = np.flatnonzero(fine.ratio >= 0.3)  # the waves end where less than this is left
    if profile and band[1] == spectrum.nyquist and occupied.size and occupied[-1] < fine.f.size - 1:
        # Finer waves are missing wherever the profile crosses them. The last discrete wave stands
        # for all up to half a step of gamma above it. Waves that end below 0.8 of the Nyquist
        # frequency are a roll-off.
        end = max(float(fine.f[occupied[-1]]) * math.sqrt(ratio) / spectrum.nyquist, 0.8)
        return NoiseModel(flat_prior=FlatPrior(-missing_share(plain.p) * end**-plain.p))
    decisive = 2.0  # change of the deviance; aliasing takes no further parameter
    return NoiseModel(
        aliased=gain > decisive or (gain > 0 and plain.p < 1 < aliased.p),
        undecided=profile and abs(gain) < decisive,
    )


def missing_share(p: float) -> float:
    """Power that a profile lacks without waves beyond Nyquist: flat, relative to the law there.

    A wave of frequency k appears at f = k |cos a|, so waves beyond k contribute at f the part
    s < f/k of the mean of s^(p-1) over a: to first order 2/(pi p m(p)) (f/k)^p of it.
    """
    p = min(max(p, 1.0), 3.0)
    return 2 / (math.pi * p) * math.exp(-log_mean_cosine_power(p))


def _plateau(f, corner):
    """Factor of `fit` for a law that is level below its corner: (1 + (corner/f)^2)^(-p/2)."""
    return 0.0, -np.log1p((corner / f) ** 2) / 2


def _plateau_of_map(f, corner):
    """As `_plateau`, of a spectrum over |f|, which rises as f where that over the plane is flat."""
    share = -np.log1p((corner / f) ** 2) / 2
    return share, share


def _roll_off(f, corner):
    """Factor of `fit` for a Gaussian filter, which halves amplitudes at its cut-off."""
    return np.maximum(-((f / corner) ** 2) * math.log(4), math.log(1e-6)), 0.0


def _bend(spectrum, band, ratio, noise, sigmas):
    """The plateau or roll-off that lowers the deviance most, and its frequency [1/m], or None."""
    low, high = band
    fit_law = functools.partial(noise.fit, spectrum, band, ratio, tol=1e-4)
    straight = fit_law()
    best, bend = sigmas**2, (None, 0.0)
    flat = _plateau if spectrum.kind == "profile" else _plateau_of_map
    for kind, first, last in ((_roll_off, 4 * low, 1.5 * high), (flat, 1.2 * low, high / 4)):
        corners = np.geomspace(first, last, 12)
        if straight.scatter < 0.25:  # otherwise the law is too poor to locate a bend by its slopes
            gains = [_gain(straight, *kind(straight.f, c)) for c in corners]
            corners = corners[[int(np.argmax(gains))]]
        bent = [(fit_law(factor=functools.partial(kind, corner=c)), c) for c in corners]
        law, corner = min(bent, key=lambda pair: (pair[0].scatter, pair[0].deviance))
        plain = fit_law(scatter=law.scatter, start=straight)
        gain = plain.deviance - law.deviance
        if gain > best:
            best, bend = gain, (kind, float(corner))
    return bend


def _gain(law: PowerLaw, constant, by_p):
    """Fall of the deviance, to first order, if the law had the factor exp(constant + by_p p)."""
    weight = 1 / (law.error**2 - law.scatter)
    change = constant + by_p * law.p
    normal = law.slope.T @ (weight[:, None] * law.slope) + 1e-9 * np.eye(3)
    change = change - law.slope @ np.linalg.solve(normal, law.slope.T @ (weight * change))
    along = np.sum(weight * change * (law.ratio - 1))
    return max(along, 0.0) ** 2 / max(np.sum(weight * change**2), 1e-30)
