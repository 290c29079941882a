"""A power law through a measured spectrum: gamma quasi-likelihood over logarithmic bins.

The means of bins are fitted, not their logarithms, which few ordinates or discrete waves would
bias. Bins are one ratio gamma wide and averaged over ln f, each ordinate relative to the law: then
every bin holds each wave of Eq. 13 once, wherever in the bin it is.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._base.parts import Record
from .spectrum import PowerSpectrum


class FlatPrior(NamedTuple):
    """Normal prior of an unknown flat share, relative to the law at the Nyquist frequency."""

    mean: float = 0.0
    deviation: float = 0.35  # tuned on synthetic surfaces


class PowerLaw(Record):
    """A (f/f_N)^-p, f_N the Nyquist frequency, beside a flat share, as fitted to bins."""

    log_A: float  # ln of m^3
    p: float
    flat: float  # in units of A
    covariance: Float[np.ndarray, "3 3"]  # of (ln A, p, flat)
    f: Float[np.ndarray, " bins"]  # 1/m
    error: Float[np.ndarray, " bins"]  # relative standard error of each
    ratio: Float[np.ndarray, " bins"]  # of measured and fitted power
    slope: Float[np.ndarray, "bins 3"]  # d(ln of the fit)/d(ln A, p, flat)
    influence: Float[np.ndarray, "3 bins"]  # d(ln A, p, flat)/d(ln of a bin's power)
    scatter: float  # relative variance of a bin beyond that of its ordinates
    deviance: float
    nyquist: float
    aliased: bool
    kind: str = eqx.field(static=True)  # "profile" or "map"

    def __call__(self, f) -> np.ndarray:
        """The fit, flat share included, at frequencies f [1/m]."""
        u = np.asarray(f) / self.nyquist
        flat = self.flat * _level(u, self.kind)
        return np.exp(self.log_A) * (shape(u, self.p, self.aliased) + flat)

    @property
    def power(self) -> np.ndarray:
        """Measured power of the bins [m^3]."""
        return self.ratio * self(self.f)

    @property
    def D(self) -> float:
        """Fractal dimension (7 - p)/2."""
        return (7 - self.p) / 2

    @property
    def D_standard_error(self) -> float:
        """Standard error of D: half of that of p."""
        return float(np.sqrt(self.covariance[1, 1])) / 2


def _level(u, kind):
    """A flat spectrum: over |f|, radial bins grow with f."""
    return np.ones_like(u) if kind == "profile" else u


def shape(u: np.ndarray, p: float, aliased: bool) -> np.ndarray:
    """u^-p, u = f/f_N up to 1; aliased: sum over all integers j of |u + 2j|^-p."""
    return shape_by_p(u, aliased)(p)[0]


def shape_by_p(u: np.ndarray, aliased: bool) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Function of p that returns `shape` and its derivative by p; the rest is computed once."""
    log_u = np.log(u)
    terms, step = 40, 1e-6  # up to Nyquist and p = 8, further terms are below rounding
    even_powers = (u / 2) ** np.arange(0, 2 * terms, 2)[:, None] if aliased else None

    def at(p):
        value = np.exp(-p * log_u)
        slope = -log_u * value
        if even_powers is not None:
            sums = _aliased(p, terms), _aliased(p + step, terms)
            others, change = np.array([sums[0], (sums[1] - sums[0]) / step]) @ even_powers
            value, slope = value + others, slope + change
        return value, slope

    return at


def _aliased(p: float, terms: int) -> np.ndarray:
    """Coefficients of the first even powers of u/2 in the sum over all j but 0 of |u + 2j|^-p.

    (1 + x)^-p + (1 - x)^-p = 2 sum over even k of p(p+1)...(p+k-1)/k! x^k, at x = u/(2j).
    """
    from scipy.special import zeta

    s, k = max(p, 1.02), np.arange(2 * terms)  # the sum diverges at 1
    binomial = np.cumprod(np.append(1.0, (s + k) / (k + 1)))[: 2 * terms : 2]
    return 2 ** (1 - p) * binomial * zeta(s + k[::2])


def bin_edges(band: tuple[float, float], ratio: float) -> np.ndarray:
    """Edges [1/m], one `ratio` apart from the upper end down; the rest is one more bin."""
    low, high = band
    whole = int(np.floor(np.log(high / low) / np.log(ratio) + 1e-9))
    edges = high * ratio ** -np.arange(whole + 1.0)
    if low < edges[-1] * (1 - 1e-9):
        if edges[-1] / low > np.sqrt(ratio) or whole == 0:
            edges = np.append(edges, low)
        else:
            edges[-1] = low
    return edges[::-1]


class Bins:
    """Means over the bins of a band that hold any ordinates."""

    def __init__(self, spectrum: PowerSpectrum, band, ratio):
        low, high = band[0] * (1 - 1e-9), band[1] * (1 + 1e-9)
        inside = (spectrum.f >= low) & (spectrum.f <= high)
        edges = bin_edges(band, ratio)
        self.f, self.power, count, self.weight, self.spread = (
            getattr(spectrum, name)[inside] for name in ("f", "power", "count", "weight", "spread")
        )
        which = np.clip(np.searchsorted(edges, self.f, side="left") - 1, 0, edges.size - 2)
        self.which, self.start = np.unique(which, return_index=True)
        self.total = np.add.reduceat(self.weight, self.start)
        self.variance = np.add.reduceat(self.weight**2 / count, self.start) / self.total**2

    def __call__(self, values):
        return np.add.reduceat(self.weight * values, self.start, axis=-1) / self.total


def fit(
    spectrum: PowerSpectrum,
    band: tuple[float, float],
    ratio: float,
    *,
    aliased: bool = False,
    flat_prior: FlatPrior = FlatPrior(),
    scatter: float | None = None,
    factor: Callable | None = None,
    start: PowerLaw | None = None,
    tol: float = 1e-6,
) -> PowerLaw:
    """The power law of a spectrum over a band [1/m], in bins of `ratio`.

    Waves beyond the Nyquist frequency follow the same law (`aliased`), or are unknown: a flat share
    of either sign, with the prior `flat_prior`. (Aliased power is flat in the band, and so is the
    lack of waves that a profile should cross at an angle.) A given `scatter` is not estimated, so
    that the deviances of laws that share it are comparable. A `factor(f)` returns a and b of
    exp(a + b p), which multiplies the law. Iterations begin at the law `start` and end when ln A, p
    and the flat share change by less than `tol`.
    """
    bins = Bins(spectrum, band, ratio)
    u, widths = bins.f / spectrum.nyquist, bins.spread / bins.f**2
    profile, level = spectrum.kind == "profile", _level(u, spectrum.kind)
    only_shape = shape_by_p(u, aliased)
    constant, by_p = (0.0, 0.0) if factor is None else factor(bins.f)

    def law(p):
        """The law relative to A, and its derivative by p."""
        value, slope = only_shape(p)
        # A window smears by half its mean square width times the relative second derivative.
        curve, bend = (p * (p + 1), 2 * p + 1) if profile else ((p + 1) ** 2, 2 * p + 2)
        smeared = 1 + curve / 2 * widths
        value, slope = value * smeared, slope * smeared + bend / 2 * widths * value
        if factor is not None:
            share = np.exp(constant + by_p * p)
            value, slope = share * value, share * (slope + by_p * value)
        return value, slope

    def relative(at):
        """Measured over fitted power, and the slope of ln(fit), of each bin."""
        log_A, p, flat = at
        only, grown = law(p)
        ratios, *slopes = bins(
            np.array([bins.power / np.exp(log_A), grown, level]) / (only + flat * level)
        )
        return ratios, np.stack([np.ones_like(ratios), *slopes], axis=1)

    mean = np.array([0.0, 0.0, flat_prior.mean])
    prior = np.diag([0.0, 0.0, 1 / flat_prior.deviation**2])

    def solve(at, variance):
        """Fisher scoring."""
        for _ in range(20):  # at most
            ratios, slope = relative(at)
            weighted = slope.T / variance
            score = weighted @ (ratios - 1) - prior @ (at - mean)
            step = np.linalg.solve(weighted @ slope + prior, score)
            step *= min(1.0, 0.7 / np.abs(step[:2]).max())
            at = at + step
            at[1] = min(max(at[1], 0.05), 8.0)
            if at[2] < 0:  # the sum stays positive
                at[2] = max(at[2], -0.8 * (law(at[1])[0] / level).min())
            if np.abs(step).max() < tol:
                break
        return at, *relative(at)

    if start is None:
        at = np.array([np.log(bins(bins.power / law(2.0)[0]).mean()), 2.0, flat_prior.mean])
    else:
        at = np.array([start.log_A, start.p, start.flat])
    estimated, ratios, slope = scatter or 0.0, *relative(at)
    for _ in range(4):  # at most; the scatter hardly changes the law
        at, ratios, slope = solve(at, bins.variance + estimated)
        if scatter is not None:
            break
        before, estimated = (
            estimated,
            residual_scatter(ratios - 1, bins.variance, ratios.size - 2.5),
        )
        if abs(before - estimated) <= 1e-3 * estimated:
            break
    variance = bins.variance + estimated
    data = slope.T / variance @ slope
    inverse = np.linalg.inv(data + prior)
    # The prior of the flat share is wide, but its variance about the mean is 0.15 of that.
    covariance = inverse @ (data + 0.15 * prior) @ inverse
    deviance = 2 * np.sum((ratios - 1 - np.log(np.maximum(ratios, 1e-300))) / variance)
    deviance += ((at[2] - flat_prior.mean) / flat_prior.deviation) ** 2
    log_A, p, flat = map(float, at)
    return PowerLaw(
        log_A=log_A,
        p=p,
        flat=flat,
        covariance=covariance,
        f=np.exp(bins(np.log(bins.f))),
        error=np.sqrt(variance),
        ratio=ratios,
        slope=slope,
        influence=inverse @ (slope.T / variance),
        scatter=estimated,
        deviance=float(deviance),
        nyquist=spectrum.nyquist,
        aliased=aliased,
        kind=spectrum.kind,
    )


def residual_scatter(residual, variance, freedom) -> float:
    """Common variance, added to `variance`, that explains the size of the residuals."""
    from scipy.optimize import root_scalar

    def excess(scatter):
        return np.sum(residual**2 / (variance + scatter)) - freedom

    if freedom <= 0 or excess(0.0) <= 0:
        return 0.0
    most = float(np.sum(residual**2) / freedom)
    return root_scalar(excess, bracket=(0.0, 2 * most), xtol=1e-14 * most).root


def curvature(law: PowerLaw) -> tuple[float, float]:
    """Fitted c of a factor exp(c ln^2 f) on the law, and its standard error.

    The local exponent changes by 2 c ln(f_2/f_1) from one end of the band to the other.
    """
    log_f = np.log(law.f / law.f.mean())
    columns = np.concatenate([law.slope[:, :2], (log_f**2)[:, None]], axis=1)
    variance, residual, scatter = law.error**2 - law.scatter, law.ratio - 1, law.scatter
    normal, coefficients = np.zeros((3, 3)), np.zeros(3)
    for _ in range(3):  # the bend accounts for some of the scatter
        weighted = columns.T / (variance + scatter)
        normal = np.linalg.inv(weighted @ columns)
        coefficients = normal @ weighted @ residual
        scatter = residual_scatter(residual - columns @ coefficients, variance, residual.size - 3)
    left = float(normal[2, 2])  # not positive by rounding where bins are few
    return float(coefficients[2]), float(np.sqrt(left)) if left > 0 else np.inf
