"""A power law through a measured spectrum: gamma quasi-likelihood over logarithmic bins.

The means of bins are fitted, not their logarithms, which few ordinates or discrete waves would
bias. Bins are one ratio gamma wide and averaged over ln f, each ordinate beside the law: then every
bin holds each wave of Eq. 13 once, and it does not matter where in the bin it lies.
"""

from typing import NamedTuple

import numpy as np

from .spectrum import Spectrum

BEYOND = 0.35  # standard deviation of the unknown flat share, in units of the law at Nyquist
_SPREAD = 0.15  # of the prior's variance: what the flat share is taken to scatter by
_ROUNDS = 4  # of estimating the scatter anew
_STEPS = 20


class PowerLaw(NamedTuple):
    """ln A and p of A (f/f_N)^-p, f_N the Nyquist frequency, and how well they are known."""

    log_A: float  # ln of m^3
    p: float
    flat: float  # flat share beside the law, in units of A
    covariance: np.ndarray  # of (ln A, p, flat)
    f: np.ndarray  # of the bins, 1/m
    power: np.ndarray  # m^3, as it would be at f
    error: np.ndarray  # relative standard error of each
    ratio: np.ndarray  # of measured and fitted power
    slope: np.ndarray  # d(ln of the fit)/d(parameters), (bins, 3)
    scatter: float  # relative variance of a bin beyond that of its ordinates
    deviance: float
    nyquist: float
    folded: bool
    kind: str  # "profile" or "map"

    def __call__(self, f) -> np.ndarray:
        """The fit, flat share included, at frequencies f [1/m]."""
        u = np.asarray(f) / self.nyquist
        return np.exp(self.log_A) * (
            shape(u, self.p, self.folded) + self.flat * _level(u, self.kind)
        )


def _level(u, kind):
    """A flat spectrum: over |f|, rings grow with f."""
    return np.ones_like(u) if kind == "profile" else u


def shape(u: np.ndarray, p: float, folded: bool) -> np.ndarray:
    """u^-p, u = f/f_N; folded: with all that lies above the Nyquist frequency, sum |u + 2j|^-p."""
    if not folded:
        return u**-p
    return u**-p + 2**-p * (_hurwitz(p, 1 + u / 2) + _hurwitz(p, 1 - u / 2))


def _hurwitz(p, a):
    """sum_{j >= 0} (j + a)^-p, p > 1, by Euler's and Maclaurin's formula."""
    first = 8
    p = max(p, 1.02)  # below, the sum has no end: nothing such can be folded
    head = sum((a + j) ** -p for j in range(first))
    b = a + first
    tail = b ** (1 - p) / (p - 1) + b**-p / 2 + p * b ** (-p - 1) / 12
    return head + tail - p * (p + 1) * (p + 2) * b ** (-p - 3) / 720


def bin_edges(band: tuple[float, float], ratio: float) -> np.ndarray:
    """Edges [1/m] from the upper end of the band down, one `ratio` each; the rest is one more."""
    low, high = band
    whole = int(np.floor(np.log(high / low) / np.log(ratio) + 1e-9))
    edges = high * ratio ** -np.arange(whole + 1.0)
    if low < edges[-1] * (1 - 1e-9):
        if edges[-1] / low > np.sqrt(ratio) or whole == 0:
            edges = np.append(edges, low)
        else:
            edges[-1] = low
    return edges[::-1]


def curvature(law: PowerLaw) -> tuple[float, float]:
    """c of a factor exp(c ln^2 f) that the bins ask for, and its standard error.

    The local exponent runs by 2 c ln(f_2/f_1) from one end of the band to the other.
    """
    log_f = np.log(law.f / law.f.mean())
    columns = np.concatenate([law.slope[:, :2], (log_f**2)[:, None]], axis=1)
    variance, residual = law.error**2 - law.scatter, law.ratio - 1
    scatter = law.scatter
    for _ in range(3):  # what the bend explains is no scatter
        weight = 1 / (variance + scatter)
        normal = np.linalg.inv(columns.T @ (weight[:, None] * columns))
        found = normal @ columns.T @ (weight * residual)
        scatter = _scatter(residual - columns @ found, variance, residual.size - 3)
    variance = float(normal[2, 2])  # of few bins rounding may leave nothing
    return float(found[2]), float(np.sqrt(variance)) if variance > 0 else np.inf


class _Bins:
    """Means over the bins of a band."""

    def __init__(self, spectrum: Spectrum, band, ratio):
        edges = bin_edges(band, ratio)
        f = spectrum.f
        inside = (f >= band[0] * (1 - 1e-9)) & (f <= band[1] * (1 + 1e-9))
        which = np.clip(np.searchsorted(edges, f[inside], side="left") - 1, 0, edges.size - 2)
        _, self.start = np.unique(which, return_index=True)
        self.f, self.power = f[inside], spectrum.power[inside]
        self.weight, self.spread = spectrum.weight[inside], spectrum.spread[inside]
        self.total = np.add.reduceat(self.weight, self.start)
        squares = np.add.reduceat(self.weight**2 / spectrum.count[inside], self.start)
        self.variance = squares / self.total**2
        self.centre = np.exp(self(np.log(self.f)))

    def __call__(self, values):
        return np.add.reduceat(self.weight * values, self.start) / self.total


def fit(
    spectrum: Spectrum,
    band: tuple[float, float],
    ratio: float,
    *,
    folded: bool = False,
    beyond: float = BEYOND,
    expected: float = 0.0,
    scatter: float | None = None,
    reshape=None,
) -> PowerLaw:
    """The power law of a spectrum over a band [1/m], in bins of `ratio`.

    What lies beyond the Nyquist frequency is folded in as a law that goes on (`folded`), or it is
    unknown: a flat share, of either sign, `expected` with the standard deviation `beyond` in units
    of the law at Nyquist. (Flat across the band are both the power folded down and that missing
    where waves beyond Nyquist, crossed at an angle, should be seen.) A `scatter` that is given is
    not estimated: deviances of several laws can be compared where they share it.
    """
    bins = _Bins(spectrum, band, ratio)
    u = bins.f / spectrum.nyquist
    level = _level(u, spectrum.kind)
    curve = (lambda p: p * (p + 1)) if spectrum.kind == "profile" else (lambda p: (p + 1) ** 2)

    def law(p):
        smeared = 1 + curve(p) / 2 * bins.spread / bins.f**2
        extra = 1.0 if reshape is None else reshape(bins.f, p)
        return shape(u, p, folded) * smeared * extra

    def residuals(at):
        log_A, p, flat = at
        q = law(p)
        whole = q + flat * level
        grown = (law(p + 1e-6) - q) / 1e-6
        ratios = bins(bins.power / np.exp(log_A) / whole)
        return ratios, np.stack([np.ones_like(ratios), bins(grown / whole), bins(level / whole)], 1)

    mean = np.array([0.0, 0.0, expected])
    prior = np.diag([0.0, 0.0, 1 / beyond**2])
    at = np.array([0.0, 2.0, expected])
    at[0] = np.log(bins(bins.power / law(2.0)).mean())
    given, scatter = scatter, scatter or 0.0
    for _ in range(_ROUNDS):
        weight = 1 / (bins.variance + scatter)
        for _ in range(_STEPS):
            ratios, slope = residuals(at)
            information = slope.T @ (weight[:, None] * slope) + prior
            step = np.linalg.solve(
                information, slope.T @ (weight * (ratios - 1)) - prior @ (at - mean)
            )
            step *= min(1.0, 0.7 / np.abs(step[:2]).max())
            at = at + step
            at[1] = np.clip(at[1], 0.05, 8.0)
            at[2] = max(at[2], -0.8 * (law(at[1]) / level).min())
            if np.abs(step).max() < 1e-6:
                break
        ratios, slope = residuals(at)
        if given is not None:
            break
        before, scatter = scatter, _scatter(ratios - 1, bins.variance, ratios.size - 2.5)
        if abs(before - scatter) <= 1e-3 * scatter:
            break
    weight = 1 / (bins.variance + scatter)
    data = slope.T @ (weight[:, None] * slope)
    inverse = np.linalg.inv(data + prior)
    # The flat share is held by a wide prior, but scatters about its mean by less.
    covariance = inverse @ (data + _SPREAD * prior) @ inverse
    safe = np.maximum(ratios, 1e-300)
    deviance = 2 * float(weight @ (ratios - 1 - np.log(safe))) + (at[2] - expected) ** 2 / beyond**2
    found = PowerLaw(
        float(at[0]),
        float(at[1]),
        float(at[2]),
        covariance,
        bins.centre,
        ratios,
        np.sqrt(bins.variance + scatter),
        ratios,
        slope,
        scatter,
        deviance,
        spectrum.nyquist,
        folded,
        spectrum.kind,
    )
    return found._replace(power=ratios * found(bins.centre))


def _scatter(residual, variance, freedom):
    """The common variance beside `variance` that makes the residuals as large as they are."""

    def excess(scatter):
        return np.sum(residual**2 / (variance + scatter)) - freedom

    if freedom <= 0 or excess(0.0) <= 0:
        return 0.0
    low, high = 0.0, np.sum(residual**2) / freedom
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high
