"""The band of frequencies over which a measured spectrum is that of its surface."""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from .fit import BEYOND, PowerLaw, fit
from .spectrum import Spectrum

LOWEST = 5  # periods in the length: below, tilt has been taken out and the window is too wide
# Of the Nyquist frequency: above, finer waves are folded in, or missing where they should cross a
# profile at an angle.
HIGHEST = {"profile": 0.5, "map": 0.6}
PER_RESOLUTION = 4  # periods of the resolution: a Gaussian filter leaves 96 percent of the height
_BEND = 9.0  # by how much the deviance must fall before a bend or a floor is believed
_FOLDING = 2.0  # likewise before waves above Nyquist are, which takes no further number
_FEWEST = 12  # frequencies in a band that is given, ordinates within 2 percent being one
_POOR = 0.25  # scatter of a law so far off that it does not tell where a bend would be
_LEAST_END = 0.8  # of the Nyquist frequency: waves that end further down are a roll-off
_MANY = 5  # bins, of which a part of one more can be spared
_FINE = 1.1  # ratio of a bin at the very top
_NOTHING = 0.3  # of the law in it: the surface's waves end below the Nyquist frequency
_UNKNOWN = 1e6  # standard deviation of a flat share of which nothing is known


class Nature(NamedTuple):
    """What a spectrum holds beside a power law."""

    folded: bool  # waves finer than two points
    undecided: bool  # folded or not
    floor: float  # m^3: white noise, at the Nyquist frequency
    meets: float  # 1/m: where the law falls to twice the floor
    expected: float  # flat share, in units of the law at Nyquist
    beyond: float  # its standard deviation

    @property
    def options(self) -> dict[str, Any]:
        """As `fit` takes them."""
        return {"folded": self.folded, "expected": self.expected, "beyond": self.beyond}


class Band(NamedTuple):
    """Ends of the band, and what set them."""

    low: float  # 1/m
    high: float  # 1/m
    nature: Nature
    notes: tuple[str, ...]


def given_band(band: Any, spectrum: Spectrum, length: float, ratio: float, top: float) -> Band:
    """A band [1/m] as asked for. **Raises:** `ValueError` if it is empty or not in the data."""
    try:
        low, high = (float(end) for end in band)
    except (TypeError, ValueError):
        raise ValueError(f"band must be two frequencies (low, high) in 1/m, got {band!r}") from None
    least, most = 2 / length, spectrum.nyquist
    if not (least <= low < high <= most):
        raise ValueError(
            f"band must rise and lie between {least:.6g} and {most:.6g} 1/m, what the data hold, "
            f"got {low:.6g} to {high:.6g}"
        )
    inside = np.sum((spectrum.f >= low) & (spectrum.f <= high))
    if inside < _FEWEST:
        raise ValueError(f"band must hold {_FEWEST} frequencies of the data, it holds {inside}")
    notes = ()
    if high > top * (1 + 1e-9):
        notes = (f"the band goes beyond the instrument's limit of {top:.4g} 1/m",)
    return Band(low, high, nature_of(spectrum, (low, most), ratio), notes)


def chosen_band(spectrum: Spectrum, length: float, ratio: float, top: float) -> Band:
    """The widest band in which nothing but a power law is seen.

    `top` [1/m] is the instrument's limit. A floor of noise ends the band where the law falls to
    twice the floor, a plateau begins it at three times the frequency of its corner, and a roll-off
    ends it at a quarter of its own.
    """
    low, high = LOWEST / length, min(HIGHEST[spectrum.kind] * spectrum.nyquist, top)
    if high < 2 * low:
        raise ValueError(
            f"the instrument's limit of {high:.6g} 1/m leaves no band above {low:.6g} 1/m"
        )
    nature = nature_of(spectrum, (low, min(spectrum.nyquist, top)), ratio)
    if nature.floor:
        high = min(high, max(nature.meets, 3 * low))
    notes = []
    if nature.floor:
        notes.append(f"noise floor of {nature.floor:.3g} m^3: the band ends at {high:.3g} 1/m")
    kind, corner = _bend(spectrum, (low, high), ratio, nature)
    if kind is _bent:
        low = min(3 * corner, high / 3)
        notes.append(f"plateau below {corner:.3g} 1/m: the band begins at {low:.3g} 1/m")
    elif kind is _rolled:
        high = max(corner / PER_RESOLUTION, 3 * low)
        notes.append(f"roll-off above {corner:.3g} 1/m: the band ends at {high:.3g} 1/m")
    bins = math.floor(math.log(high / low) / math.log(ratio) + 1e-9)
    if bins >= _MANY:  # part of one may hold a discrete wave, or none, where the law has a part
        low = high * ratio**-bins
    return Band(low, high, nature, tuple(notes))


def nature_of(spectrum: Spectrum, band: tuple[float, float], ratio: float) -> Nature:
    """Noise, folding, or neither: from a band that goes up to the Nyquist frequency, if it may.

    Noise must lower the deviance by 9, for it takes a number more; folding by 2.
    """
    profile = spectrum.kind == "profile"

    def laws(scatter):
        plain = fit(spectrum, band, ratio, beyond=0.3, scatter=scatter)
        noisy = fit(spectrum, band, ratio, beyond=_UNKNOWN, scatter=scatter)
        folds = plain
        if profile:
            folds = fit(spectrum, band, ratio, folded=True, beyond=0.1, scatter=scatter)
        return plain, noisy, folds

    plain, noisy, folds = laws(min(law.scatter for law in laws(None)))
    gain = plain.deviance - folds.deviance
    if min(plain.deviance, folds.deviance) - noisy.deviance > _BEND and noisy.flat > 0:
        meets = spectrum.nyquist * (2 * noisy.flat) ** (-1 / (noisy.p + (not profile)))
        return Nature(False, False, noisy.flat * math.exp(noisy.log_A), meets, 0.0, _UNKNOWN)
    fine = fit(spectrum, band, _FINE, beyond=0.1)
    seen = np.flatnonzero(fine.ratio >= _NOTHING)
    if profile and band[1] == spectrum.nyquist and seen.size and seen[-1] < fine.f.size - 1:
        # The surface has no finer waves: those it has not are missing wherever it is crossed. The
        # last of discrete waves stands for all up to half a step of gamma above it.
        end = max(float(fine.f[seen[-1]]) * math.sqrt(ratio) / spectrum.nyquist, _LEAST_END)
        missing = -_missing_share(plain.p) * end**-plain.p
        return Nature(False, False, 0.0, math.inf, missing, BEYOND)
    folded = gain > _FOLDING or (gain > 0 and plain.p < 1 < folds.p)
    undecided = profile and abs(gain) < _FOLDING
    return Nature(folded, undecided, 0.0, math.inf, 0.0, BEYOND)


def _missing_share(p: float) -> float:
    """What a cut lacks where no wave is finer than Nyquist's: flat, in units of the law there.

    A wave of frequency k is seen at f = k |cos a|, so what is seen at f from beyond k is the part
    s < f/k of the mean of s^(p-1) over a: to first order 2/(p B(p/2, 1/2)) (f/k)^p of it.
    """
    p = min(max(p, 1.0), 3.0)
    beta = math.gamma(p / 2) * math.gamma(0.5) / math.gamma((p + 1) / 2)
    return 2 / (p * beta)


def _bent(f, p, corner):
    """A law that is level below its corner."""
    return (1 + (corner / f) ** 2) ** (-p / 2)


def _rolled(f, _, corner):
    """Heights through a Gaussian filter, which halves their amplitude at the cut-off."""
    return np.maximum(4.0 ** -((f / corner) ** 2), 1e-6)


def _bend(spectrum, band, ratio, nature):
    """The bend that a spectrum shows beyond doubt and its frequency [1/m], or (None, 0)."""
    low, high = band
    straight = fit(spectrum, band, ratio, **nature.options)
    best, found = _BEND, (None, 0.0)
    for kind, corners in (
        (_rolled, np.geomspace(4 * low, 1.5 * high, 12)),
        (_bent, np.geomspace(1.2 * low, high / 4, 12)),
    ):
        if straight.scatter < _POOR:
            gains = [_gain(straight, kind(straight.f, straight.p, c)) for c in corners]
            corners = corners[[int(np.argmax(gains))]]
        laws = [
            fit(spectrum, band, ratio, **nature.options, reshape=functools.partial(kind, corner=c))
            for c in corners
        ]
        law, corner = min(
            zip(laws, corners, strict=True), key=lambda pair: (pair[0].scatter, pair[0].deviance)
        )
        same = fit(spectrum, band, ratio, **nature.options, scatter=law.scatter)
        if same.deviance - law.deviance > best:
            best, found = same.deviance - law.deviance, (kind, float(corner))
    return found


def _gain(law: PowerLaw, factor):
    """What the deviance would fall by, to first order, if a fitted law had such a factor."""
    weight = 1 / (law.error**2 - law.scatter)
    change = np.log(np.maximum(factor, 1e-300))
    normal = law.slope.T @ (weight[:, None] * law.slope) + 1e-9 * np.eye(3)
    change = change - law.slope @ np.linalg.solve(normal, law.slope.T @ (weight * change))
    along = np.sum(weight * change * (law.ratio - 1))
    return max(along, 0.0) ** 2 / max(np.sum(weight * change**2), 1e-30)
