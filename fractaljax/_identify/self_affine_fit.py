"""A self-affine spectrum with a roll-off and a lay, fitted to a measured one.

The power of a map is averaged over cells of ln f and direction, that of a profile over ln f. Each
cell is a gamma variable about the law, with as many degrees of freedom as it has independent waves
(Whittle's likelihood, by Fisher scoring). With s = ln(lay), the lay in the direction psi and

    k^2 = f^2 [cosh s + sinh s cos 2(phi - psi)],

C of a map is the spectrum without lay at k, whose roll-off is the geometric mean of those along and
across. It is regular in (s cos 2 psi, s sin 2 psi), which are fitted, also where there is no lay. A
profile is a cut through a surface without lay, the integral over all waves that it crosses:

    C_1(f) = 2/pi times the integral of S_r(f cosh t) over t > 0.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._base.parts import Record
from .._surface.self_affine import SelfAffine
from .._surface.surface_scatter import SurfaceScatter, truncated_mean
from .fit import PowerLaw, residual_scatter
from .spectrum import HANN_INFLATION, PowerSpectrum, map_power


class Cells(NamedTuple):
    """Means of a measured spectrum over small cells."""

    f: np.ndarray  # 1/m
    angle: np.ndarray | None  # of the waves from the first axis [rad]; None of a profile
    height: np.ndarray  # m^2: mean square height per ln f, f S_r of a map, f C of a profile
    count: np.ndarray  # independent waves


class Level(NamedTuple):
    """The mean square of all heights: much of it is of waves that are too long for the cells."""

    mean_square: float  # m^2, about the plane, or the line of a profile, up to the end of the band
    low: float  # 1/m: frequency of the longest wave
    variance: float  # of ln(mean_square) about that of the process


class SelfAffineFit(Record):
    """A self-affine surface as fitted, and how far it is from the data.

    A roll-off that the measurement does not show is its length, with an infinite error, and no
    waves are longer. A lay within its error of 1 is 1.
    """

    Sq: float  # m, of all waves down to `shortest`
    H: float  # as fitted, perhaps outside (0, 1]
    H_standard_error: float
    rolloff: float  # m, across the lay
    ln_rolloff_error: float  # standard error of ln(rolloff), infinite where it is not reached
    lay: float  # ratio of correlation lengths along and across
    ln_lay_error: float  # standard error of ln(lay), NaN of a profile
    lay_direction: float  # degrees from the first axis of the map
    shortest: float  # m: the shortest wavelength of the band
    scatter: float  # relative scatter of the data about the law, beyond chance
    rings: int  # how many bins of frequency the scatter is from
    level: float  # standard errors by which its Sq is beyond that of the heights
    covariance: Float[np.ndarray, "4 4"]  # of (ln Sq, H, ln rolloff, ln lay)

    @property
    def has_rolloff(self) -> bool:
        """True if the measurement shows where the spectrum becomes flat."""
        return math.isfinite(self.ln_rolloff_error)

    @property
    def fits(self) -> bool:
        """True if H is within three standard errors of (0, 1], and the data scatter little."""
        near = -3 * self.H_standard_error < self.H < 1 + 3 * self.H_standard_error
        return near and self.scatter < 0.5

    @property
    def surface_scatter(self) -> SurfaceScatter:
        """The surface with the scatter of its numbers; H is the mean of its truncated normal."""
        H = self.H if 0 < self.H <= 1 else truncated_mean(self.H, self.H_standard_error, 0, 1)
        C, has_lay = self.covariance, self.lay != 1
        used = np.array([True, True, self.has_rolloff, has_lay])
        share = C[1] / C[1, 1] * (H - self.H) if C[1, 1] > 0 else np.zeros(4)
        Sq = self.Sq * math.exp(share[0])
        names = np.array(["ln Sq", "hurst", "ln rolloff", "ln lay"])[used]
        lay = self.lay if has_lay else None
        longest = None if self.has_rolloff else self.rolloff
        surface = SelfAffine(Sq, H, self.rolloff, self.shortest, longest, lay)
        return SurfaceScatter(surface, tuple(names.tolist()), C[np.ix_(used, used)])

    def pooled(
        self, mean: np.ndarray, covariance: np.ndarray, has_rolloff: bool, shortest: list[float]
    ) -> "SelfAffineFit":
        """That of a process with this mean and covariance of (ln Sq, H, ln rolloff, ln lay)."""
        errors = np.sqrt(np.diagonal(covariance))
        return dataclasses.replace(
            self,
            Sq=math.exp(mean[0]),
            H=float(mean[1]),
            H_standard_error=float(errors[1]),
            rolloff=math.exp(mean[2]),
            ln_rolloff_error=float(errors[2]) if has_rolloff else math.inf,
            lay=math.exp(mean[3]) if errors[3] > 0 else 1.0,
            ln_lay_error=float(errors[3]),
            shortest=min(math.exp(np.mean(np.log(shortest))), math.exp(mean[2])),
            covariance=covariance,
        )

    @property
    def description(self) -> str:
        """The fit in one line."""
        errors = np.sqrt(np.diagonal(self.covariance))
        words = [f"Sq = {self.Sq:.4g} m (ln Sq +- {errors[0]:.2g})"]
        words.append(f"H = {self.H:.3f} +- {self.H_standard_error:.2g}")
        if self.has_rolloff:
            words.append(f"roll-off {self.rolloff:.4g} m (ln +- {self.ln_rolloff_error:.2g})")
        else:
            words.append(f"no roll-off up to {self.rolloff:.4g} m")
        if self.lay != 1:
            at = f"{self.lay_direction:.0f} degrees from x"
            words.append(f"lay {self.lay:.3g} (ln +- {self.ln_lay_error:.2g}) at {at}")
        return ", ".join(words)


def map_cells(
    z: np.ndarray,
    dx: float,
    dy: float,
    band: tuple[float, float],
    *,
    width: float = 0.1,
    sectors: int = 24,
) -> Cells:
    """Cells of `width` in ln f and as many `sectors` of half a turn, of a map without gaps."""
    fx, fy, power, count = map_power(z, dx, dy)
    f = np.hypot(fx[:, None], fy)
    angle = np.arctan2(fy, fx[:, None])
    inside = (f >= band[0] * (1 - 1e-9)) & (f <= band[1] * (1 + 1e-9)) & (count > 0)
    f, angle, power, count = (
        np.broadcast_to(x, inside.shape)[inside] for x in (f, angle, power, count)
    )
    ring = np.floor(np.log(f / band[0]) / width + 1e-9).astype(int)
    sector = np.minimum((angle / np.pi * sectors).astype(int), sectors - 1)
    _, cell = np.unique(ring * sectors + sector, return_inverse=True)
    total = np.bincount(cell, count)

    def mean(values):
        return np.bincount(cell, count * values) / total

    at = np.exp(mean(np.log(f)))
    # The product with f^3.5 is nearly flat.
    height = 2 * np.pi * mean(power * f**3.5) / at**1.5
    return Cells(at, mean(angle), height, total / HANN_INFLATION)


def profile_cells(spectrum: PowerSpectrum, band: tuple[float, float]) -> Cells:
    """The ordinates of a profile's spectrum in a band."""
    inside = (spectrum.f >= band[0] * (1 - 1e-9)) & (spectrum.f <= band[1] * (1 + 1e-9))
    f, power, count = (getattr(spectrum, n)[inside] for n in ("f", "power", "count"))
    return Cells(f, None, f * power, count)


def _log_radial(log_k, log_Sq, H, log_rolloff, log_shortest):
    """ln of the mean square height per ln f without lay, and its slopes by ln Sq, H, ln rolloff.

    Also that by ln k. The spectrum goes on beyond its shortest wave, which a cut needs.
    """
    x, span = log_k + log_rolloff, log_rolloff - log_shortest
    above = x > 0
    part, by_H, decay = _above(H, span)
    total = 0.5 + part
    value = 2 * log_Sq - math.log(total) + np.where(above, -2 * H * x, 2 * x)
    slope = np.where(above, -2 * H, 2.0)
    ones = np.ones_like(x)
    by_rolloff = -decay / total * ones + slope
    return value, [2 * ones, -by_H / total + np.where(above, -2 * x, 0.0), by_rolloff], slope


def _above(H, span):
    """The integral of e^(-2 H x) over x from 0 to `span`, its slope by H, and e^(-2 H span)."""
    with np.errstate(over="ignore"):
        decay = np.exp(-2 * H * span)
    short = abs(H) * span < 1e-4  # series at H = 0
    part = span * (1 - H * span) if short else (1 - decay) / (2 * H)
    return part, -(span**2) if short else (span * decay - part) / H, decay


def _share_above(H, span):
    """Share of the mean square in waves shorter than the roll-off, and the slope of its ln by H."""
    part, by_H, _ = _above(H, span)
    return part / (0.5 + part), 0.5 * by_H / (part * (0.5 + part))


class _Law:
    """The law of cells by ln Sq, H, ln(rolloff), of a map also s cos 2 psi and s sin 2 psi."""

    def __init__(self, cells: Cells, shortest: float):
        self.cells, self.log_shortest = cells, math.log(shortest)
        self.log_f = np.log(cells.f)
        if cells.angle is None:
            # ln cosh t up to where nothing is left; the steps grow.
            t, self.weight = _half_line()
            self.log_k = self.log_f[:, None] + np.log(np.cosh(t))
            self.log_share = -np.log(np.cosh(t))
        else:
            self.axes = np.stack([np.cos(2 * cells.angle), np.sin(2 * cells.angle)])

    def __call__(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """ln of the law and its slopes (cells, parameters)."""
        radial = functools.partial(
            _log_radial, log_Sq=at[0], H=at[1], log_rolloff=at[2], log_shortest=self.log_shortest
        )
        if self.cells.angle is None:
            # f C_1(f) = 2/pi int (k S_r(k)) / cosh t dt at k = f cosh t.
            value, slopes, _ = radial(self.log_k)
            share = np.exp(value + self.log_share - value[:, :1]) * self.weight
            total = share.sum(axis=1)
            mixed = [(share * slope).sum(axis=1) / total for slope in slopes]
            return np.log(2 / math.pi * total) + value[:, 0], np.stack(mixed, axis=1)
        s = np.hypot(*at[3:])
        ratio = math.sinh(s) / s if s > 0 else 1.0
        slope_of_ratio = (math.cosh(s) - ratio) / s**2 if s > 1e-3 else 1 / 3  # over s
        along = at[3:] @ self.axes
        square = math.cosh(s) + ratio * along
        log_k = self.log_f + np.log(square) / 2
        value, slopes, slope = radial(log_k)
        by_lay = [
            (ratio * at[3 + i] + slope_of_ratio * at[3 + i] * along + ratio * self.axes[i])
            / (2 * square)
            for i in (0, 1)
        ]
        # C is a function of k: f^2 C = (f/k)^2 (k^2 C).
        value = value - np.log(square)
        return value, np.stack([*slopes, *((slope - 2) * each for each in by_lay)], axis=1)


class _Leveled:
    """The law of cells, and last that of the mean square of all waves in a band from `low` on."""

    def __init__(self, law: _Law, low: float, high: float, count: int = 48, sectors: int = 12):
        angles = 1 if law.cells.angle is None else sectors
        log_f = math.log(low) + math.log(high / low) * (np.arange(count) + 0.5) / count
        f = np.repeat(np.exp(log_f), angles)
        angle = None
        if law.cells.angle is not None:
            angle = np.tile((np.arange(angles) + 0.5) / angles * math.pi, count)
        self.law, self.all = law, _Law(Cells(f, angle, f, f), math.exp(law.log_shortest))
        self.weight = math.log(high / low) / f.size

    def __call__(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = self.law(at)
        each, slopes = self.all(at)
        share = np.exp(each - each.max())
        total = each.max() + math.log(self.weight * share.sum())
        return np.append(value, total), np.vstack([slope, share @ slopes / share.sum()])


def _half_line(count: int = 64):
    """Nodes t > 0 and weights for functions that are smooth in t and decay as 1/cosh t."""
    x, weight = np.polynomial.legendre.leggauss(count)
    end = 12.0  # e^-12 of the waves are beyond
    return end * (x + 1) / 2, weight * end / 2


def fit_self_affine(
    cells: Cells,
    band: tuple[float, float],
    longest: float,
    *,
    ring: float = 1.5,
    sigmas: float = 3.0,
    starts: int = 8,
    law: PowerLaw | None = None,
    between: np.ndarray | None = None,
    level: Level | None = None,
) -> SelfAffineFit:
    """Fit the cells of a `band` [1/m]; `longest` [m] is the length of the measurement.

    The mean square of all heights, `level`, is one more cell. A scatter common to bins of the ratio
    `ring`, or to sixths of them, is estimated and makes all count less. The roll-off is sought from
    `starts` on; it must lower the deviance by the square of `sigmas`, as the lay must exceed
    `sigmas` of its errors. `between` is the covariance (2, 2) from place to place of (ln A, p) of
    the power `law`.
    """
    model, n = _Law(cells, 1 / band[1]), cells.f.size
    heights, count = cells.height, cells.count
    if level is not None:
        model = _Leveled(model, level.low, band[1])
        heights = np.append(heights, level.mean_square)
        count = np.append(count, 1 / level.variance)
    rings = np.floor(np.log(cells.f / band[0]) / math.log(ring)).astype(int)
    groups = rings
    if cells.angle is not None:
        groups = rings * 6 + np.minimum((cells.angle / np.pi * 6).astype(int), 5)
    free = np.ones(3 if cells.angle is None else 5, bool)
    fixed = free.copy()
    fixed[2] = False
    low, high = math.log(2 / band[1]), math.log(longest)

    def solve(weight, corners, used):
        ends = []
        for corner in corners:
            at = np.zeros(free.size)
            at[1], at[2] = 0.7, corner
            at[0] = 0.5 * np.average(np.log(heights) - model(at)[0], weights=weight)
            ends.append(_fisher(model, heights, weight, at, used, (low, high)))
        return min(ends, key=lambda end: end[1])

    weight, corners = count, np.linspace(low + 0.5, high - 0.2, starts)
    at, _ = solve(weight, corners, free)
    scatter, used_rings = 0.0, 0
    for _ in range(3):
        ratio = cells.height / np.exp(model(at)[0][:n])
        scatter, weight, used_rings = _weights(cells, ratio, rings, groups, free.size)
        if level is not None:
            weight = np.append(weight, 1 / (level.variance + scatter**2))
        at, _ = solve(weight, [*corners[::3], at[2]], free)
    at, deviance = solve(weight, [*corners, at[2]], free)
    without, deviance_without = solve(weight, [high], fixed)
    is_reached = deviance_without - deviance > sigmas**2 and at[2] < high - 1e-6
    used = free if is_reached else fixed
    at = at if is_reached else without
    value, slope = model(at)
    covariance = np.zeros((free.size, free.size))
    some = slope[:, used]
    covariance[np.ix_(used, used)] = np.linalg.pinv(some.T @ (weight[:, None] * some))
    fit = _conclude(
        at, covariance, is_reached, 1 / band[1], scatter, used_rings, sigmas, law, between
    )
    if level is None:
        return fit
    # What is left of a difference has the variance of the datum less that of the fit to it.
    places = 4 * (fit.covariance[0, 0] - covariance[0, 0]) if is_reached else 0.0
    left = 1 / weight[-1] - slope[-1] @ covariance @ slope[-1] + max(places, 0.0)
    error = math.sqrt(max(left, np.finfo(float).eps / weight[-1]))
    return dataclasses.replace(fit, level=float(value[-1] - math.log(level.mean_square)) / error)


def _fisher(model, heights, weight, at, used, ends, steps: int = 40):
    """The parameters `used` at the least deviance, from a start on, and the deviance."""

    def deviance(at):
        value, slope = model(at)
        ratio = heights / np.exp(np.clip(value, -700, 700))
        return 2 * np.sum(weight * (ratio - 1 - np.log(ratio))), ratio, slope

    least, ratio, slope = deviance(at)
    for _ in range(steps):
        some = slope[:, used]
        normal = some.T @ (weight[:, None] * some)
        normal += 1e-9 * np.diag(np.diagonal(normal) + 1e-300)
        step = np.zeros(at.size)
        step[used] = np.linalg.solve(normal, some.T @ (weight * (ratio - 1)))
        step *= min(1.0, 0.7 / np.abs(step).max()) if step.any() else 1.0
        for _ in range(8):
            other = at + step
            other[1] = min(max(other[1], -2.0), 6.0)
            other[2] = min(max(other[2], ends[0]), ends[1])
            value, *rest = deviance(other)
            if value <= least:
                break
            step = step / 2
        else:
            break
        gain, at, least = least - value, other, value
        ratio, slope = rest
        if gain < 1e-6:
            break
    return at, least


def _weights(cells, ratio, rings, groups, parameters):
    """The scatter of rings, the counts of the cells reduced by it, and the number of rings."""
    counted = cells.count
    scatters, less = [], np.ones_like(counted)
    for group in (rings, groups) if cells.angle is not None else (rings,):
        _, which = np.unique(group, return_inverse=True)
        total = np.bincount(which, counted)
        mean = np.bincount(which, counted * ratio) / total
        # A group of few waves scatters skewly: all count, each by its own variance.
        freedom = total.size - min(parameters, 3) + 0.5
        scatters.append(residual_scatter(mean - 1, 1 / total, freedom))
        less = less + total[which] * scatters[-1]
    return math.sqrt(max(scatters)), counted / less, int(np.unique(rings).size)


def _conclude(at, covariance, is_reached, shortest, scatter, rings, sigmas, law, between):
    log_Sq, H, log_rolloff = at[:3]
    log_lay, direction, lay_error = 0.0, 0.0, math.nan
    if at.size == 5:
        log_lay = float(np.hypot(*at[3:]))
        direction = math.degrees(math.atan2(at[4], at[3])) / 2
        unit = at[3:] / log_lay if log_lay > 0 else np.array([1.0, 0.0])
        lay_error = math.sqrt(unit @ covariance[3:, 3:] @ unit)
    has_lay = at.size == 5 and log_lay > sigmas * lay_error
    to = np.zeros((4, at.size))
    to[:3, :3] = np.eye(3)
    if has_lay:
        to[3, 3:] = at[3:] / log_lay
        to[2] -= to[3] / 2
    C = to @ covariance @ to.T
    if between is not None and law is not None:
        slope = _by_power_law(law, H, log_rolloff, math.log(shortest))
        C[:2, :2] += slope @ between @ slope.T
    if not is_reached:  # no waves are longer
        part, by_H = _share_above(H, log_rolloff - math.log(shortest))
        to = np.eye(4)
        to[0, 1] = by_H / 2
        C, log_Sq = to @ C @ to.T, log_Sq + math.log(part) / 2
    log_lay = log_lay if has_lay else 0.0
    return SelfAffineFit(
        Sq=math.exp(log_Sq),
        H=float(H),
        H_standard_error=math.sqrt(C[1, 1]),
        rolloff=math.exp(log_rolloff - log_lay / 2),
        ln_rolloff_error=math.sqrt(C[2, 2]) if is_reached else math.inf,
        lay=math.exp(log_lay),
        ln_lay_error=lay_error,
        lay_direction=direction,
        shortest=shortest * math.exp(-log_lay / 2),
        scatter=scatter,
        rings=rings,
        level=0.0,
        covariance=C,
    )


def _by_power_law(law, H, log_rolloff, log_shortest):
    """Slopes of (ln Sq, H) by (ln A, p) of a power law, at the same roll-off."""
    # ln m at the roll-off moves by dln A - dp ln(f_r/f_N).
    _, (_, by_H, _), _ = _log_radial(np.array(-log_rolloff), 0.0, H, log_rolloff, log_shortest)
    peak = np.array([1.0, log_rolloff + math.log(law.nyquist)])
    H_row = np.array([0.0, 0.5])
    return np.stack([(peak - float(by_H) * H_row) / 2, H_row])
