"""The band of frequencies over which a measured spectrum is that of its surface."""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from .fit import FLAT_DEVIATION, PowerLaw, fit
from .spectrum import Spectrum, log_mean_cosine_power

LOWEST = 5  # periods in the length: below, tilt has been taken out and the window is too wide
# Share of the Nyquist frequency: above, finer waves are aliased, or missing where a profile should
# cross them at an angle.
HIGHEST = {"profile": 0.5, "map": 0.6}
PER_RESOLUTION = 4  # periods of the resolution: a Gaussian filter leaves 96 percent of the height
_BEND = 9.0  # fall of the deviance that makes a bend or a noise floor credible
_ALIASED = 2.0  # likewise for aliasing, which takes no further parameter
_FEWEST = 12  # frequencies in a given band, ordinates within 2 percent being one
_POOR = 0.25  # scatter of a law too poor to locate a bend
_CORNERS = 12  # frequencies tried for a bend
_LEAST_END = 0.8  # of the Nyquist frequency: waves that end further down are a roll-off
_MANY = 5  # bins: with as many, a part of one more is left out
_FINE = 1.1  # ratio of a bin at the very top
_NOTHING = 0.3  # of the law: with less in it, the surface's waves end below Nyquist
_ROUGH = 1e-4  # tolerance of laws that are compared
_UNKNOWN = 1e6  # standard deviation of an unknown flat share


class NoiseModel(NamedTuple):
    """Noise and aliasing beside the power law."""

    aliased: bool = False  # waves beyond the Nyquist frequency
    undecided: bool = False  # the spectrum does not tell whether aliased
    floor: float = 0.0  # m^3: white noise, at the Nyquist frequency
    crossing: float = math.inf  # 1/m: where the law falls to twice the floor
    flat_mean: float = 0.0  # prior of the flat share, in units of the law at Nyquist
    flat_deviation: float = FLAT_DEVIATION

    def fit(self, spectrum: Spectrum, band, ratio: float, **options: Any) -> PowerLaw:
        """`fit` under this model."""
        options |= {"flat_mean": self.flat_mean, "flat_deviation": self.flat_deviation}
        return fit(spectrum, band, ratio, aliased=self.aliased, **options)


class Band(NamedTuple):
    """Ends of the band, and what set them."""

    low: float  # 1/m
    high: float  # 1/m
    noise: NoiseModel
    warnings: tuple[str, ...]


def check_band(band: Any, spectrum: Spectrum, length: float, ratio: float, top: float) -> Band:
    """The user's band [1/m]. **Raises:** `ValueError` if it is empty or outside the data."""
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
    if inside < _FEWEST:
        raise ValueError(f"band must hold {_FEWEST} frequencies of the data, it holds {inside}")
    warnings = ()
    if high > top * (1 + 1e-9):
        warnings = (f"the band goes beyond the instrument's limit of {top:.4g} 1/m",)
    return Band(low, high, noise_model(spectrum, (low, most), ratio), warnings)


def chosen_band(spectrum: Spectrum, length: float, ratio: float, top: float) -> Band:
    """The widest band over which the spectrum is a power law.

    `top` [1/m] is the instrument's limit. A noise floor ends the band where the law falls to twice
    the floor. A plateau begins it at three times its corner, a roll-off ends it at a quarter.
    """
    low, high = LOWEST / length, min(HIGHEST[spectrum.kind] * spectrum.nyquist, top)
    if high < 2 * low:
        raise ValueError(
            f"the instrument's limit of {high:.6g} 1/m leaves no band above {low:.6g} 1/m"
        )
    noise = noise_model(spectrum, (low, min(spectrum.nyquist, top)), ratio)
    warnings = []
    if noise.floor:
        high = min(high, max(noise.crossing, 3 * low))
        warnings.append(f"noise floor of {noise.floor:.3g} m^3: the band ends at {high:.3g} 1/m")
    kind, corner = _bend(spectrum, (low, high), ratio, noise)
    if kind is _plateau:
        low = min(3 * corner, high / 3)
        warnings.append(f"plateau below {corner:.3g} 1/m: the band begins at {low:.3g} 1/m")
    elif kind is _roll_off:
        high = max(corner / PER_RESOLUTION, 3 * low)
        warnings.append(f"roll-off above {corner:.3g} 1/m: the band ends at {high:.3g} 1/m")
    bins = math.floor(math.log(high / low) / math.log(ratio) + 1e-9)
    if bins >= _MANY:  # a part of a bin may hold a discrete wave, or none
        low = high * ratio**-bins
    return Band(low, high, noise, tuple(warnings))


def noise_model(spectrum: Spectrum, band: tuple[float, float], ratio: float) -> NoiseModel:
    """Noise, aliasing, or neither, by a band up to the Nyquist or the instrument's frequency."""
    profile = spectrum.kind == "profile"

    law_of = functools.partial(fit, spectrum, band, tol=_ROUGH)
    cases = [(False, 0.3), (False, _UNKNOWN), *([(True, 0.1)] if profile else [])]
    laws = [law_of(ratio, aliased=aliased, flat_deviation=of) for aliased, of in cases]
    least = min(law.scatter for law in laws)
    plain, noisy, *rest = [
        law_of(ratio, aliased=aliased, flat_deviation=of, scatter=least, start=law)
        for (aliased, of), law in zip(cases, laws, strict=True)
    ]
    aliased = rest[0] if rest else plain
    gain = plain.deviance - aliased.deviance
    if min(plain.deviance, aliased.deviance) - noisy.deviance > _BEND and noisy.flat > 0:
        crossing = spectrum.nyquist * (2 * noisy.flat) ** (-1 / (noisy.p + (not profile)))
        floor = noisy.flat * math.exp(noisy.log_A)
        return NoiseModel(floor=floor, crossing=crossing, flat_deviation=_UNKNOWN)
    fine = law_of(_FINE, flat_deviation=0.1)
    occupied = np.flatnonzero(fine.ratio >= _NOTHING)
    if profile and band[1] == spectrum.nyquist and occupied.size and occupied[-1] < fine.f.size - 1:
        # Finer waves are missing wherever the profile crosses them. The last discrete wave stands
        # for all up to half a step of gamma above it.
        end = max(float(fine.f[occupied[-1]]) * math.sqrt(ratio) / spectrum.nyquist, _LEAST_END)
        return NoiseModel(flat_mean=-missing_share(plain.p) * end**-plain.p)
    return NoiseModel(
        aliased=gain > _ALIASED or (gain > 0 and plain.p < 1 < aliased.p),
        undecided=profile and abs(gain) < _ALIASED,
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


def _roll_off(f, corner):
    """Factor of `fit` for a Gaussian filter, which halves amplitudes at its cut-off."""
    return np.maximum(-((f / corner) ** 2) * math.log(4), math.log(1e-6)), 0.0


def _bend(spectrum, band, ratio, noise):
    """The plateau or roll-off that lowers the deviance most, and its frequency [1/m], or None."""
    low, high = band
    law_of = functools.partial(noise.fit, spectrum, band, ratio, tol=_ROUGH)
    straight = law_of()
    best, bend = _BEND, (None, 0.0)
    for kind, corners in (
        (_roll_off, np.geomspace(4 * low, 1.5 * high, _CORNERS)),
        (_plateau, np.geomspace(1.2 * low, high / 4, _CORNERS)),
    ):
        if straight.scatter < _POOR:
            gains = [_gain(straight, *kind(straight.f, c)) for c in corners]
            corners = corners[[int(np.argmax(gains))]]
        bent = [(law_of(factor=functools.partial(kind, corner=c)), c) for c in corners]
        law, corner = min(bent, key=lambda pair: (pair[0].scatter, pair[0].deviance))
        plain = law_of(scatter=law.scatter, start=straight)
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
