"""Power spectra of the surface of Eq. 13, and of measured heights.

Eq. 13 has waves of mean square L^2 (G/L)^(2D-4) ln(gamma)/2 gamma^(2(D-3)n), one set of them every
ln(gamma) of ln f: ln(gamma) and L cancel. On average over directions

    map      S_r(f) = G^(2D-4)/2 f^-p,           p = 7 - 2D     (of f = |(f_x, f_y)|)
    profile  C(f)   = m(p) G^(2D-4)/2 f^-p,      m(p) = mean of |cos|^(p-1)

both one-sided: the variance is their integral over f > 0, f in 1/m.
"""

import math
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .._base.parts import Record
from .._surface.surface import Surface
from .analysis import SpectralAnalysis

HANN_INFLATION = (35 / 18) ** 2  # variance of a mean over modes, Hann's window along both axes


def log_mean_cosine_power(p):
    """ln m(p), m = Gamma(p/2)/(sqrt(pi) Gamma((p+1)/2)): the mean of |cos a|^(p-1) over a."""
    from scipy.special import gammaln

    return gammaln(p / 2) - gammaln((p + 1) / 2) - math.log(math.pi) / 2


def theoretical_spectrum(surface: Surface, f: ArrayLike, kind: str = "profile") -> np.ndarray:
    """One-sided spectrum [m^3] of a "profile", or over |f| of a "map", at f [1/m] > 0."""
    p = 7 - 2 * float(surface.D)
    log_radial = (3 - p) * math.log(surface.G) - p * np.log(f) - math.log(2)
    return np.exp(log_radial + (log_mean_cosine_power(p) if kind == "profile" else 0.0))


class PowerSpectrum(Record):
    """Ordinates of a measured spectrum in rising order of frequency."""

    f: Float[np.ndarray, " k"]  # 1/m
    power: Float[np.ndarray, " k"]  # m^3, one-sided; of a map over |f|
    count: Float[np.ndarray, " k"]  # independent ordinates that each one stands for
    weight: Float[np.ndarray, " k"]  # share in an average over ln f
    spread: Float[np.ndarray, " k"]  # 1/m^2: mean square width of the window about each
    kind: str = eqx.field(static=True)  # "profile" or "map"
    nyquist: float  # 1/m


def profile_spectrum(
    segments: list[np.ndarray], dx: float, tapers: int = SpectralAnalysis.tapers
) -> PowerSpectrum:
    """Spectrum of contiguous segments of one profile, by sine tapers (Riedel, Sidorenko 1995)."""
    parts = [_segment_spectrum(z, dx, tapers) for z in segments]
    f, power, count, spread = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _merge_ordinates(f, power, count, count / f, spread, "profile", 0.5 / dx)


def _segment_spectrum(z, dx, count):
    n = z.size
    order, t = np.arange(1, count + 1), (np.arange(n) + 0.5) / n
    tapers = np.sin(np.pi * order[:, None] * t) * math.sqrt(2 / n)
    # The line goes through the ends, not by least squares: sine tapers leak any offset at the ends.
    z = z - np.linspace(z[0], z[-1], n)
    power = 2 * dx * (np.abs(np.fft.rfft(tapers * z)) ** 2).mean(axis=0)
    # Wide bins scatter as the square of the mean taper does, narrow ones by the taper's width.
    inflation = n * np.sum((tapers**2).mean(axis=0) ** 2)
    width = np.mean(order**2) / 4 / (n * dx) ** 2
    f = np.fft.rfftfreq(n, dx)[1:]
    return f, power[1:], np.full(f.size, 1 / inflation), np.full(f.size, width)


def _merge_ordinates(f, power, count, weight, spread, kind, nyquist) -> PowerSpectrum:
    """Merge ordinates within two percent of each other, between which no law differs."""
    order = np.argsort(f, kind="stable")
    f, power, count, weight, spread = (x[order] for x in (f, power, count, weight, spread))
    start = np.flatnonzero(np.diff(np.floor(np.log(f / f[0]) / 0.02 + 0.5), prepend=-1))
    total = np.add.reduceat(weight, start)

    def mean(values):
        return np.add.reduceat(weight * values, start) / total

    count = total**2 / np.add.reduceat(weight**2 / count, start)
    return PowerSpectrum(
        np.exp(mean(np.log(f))), mean(power), count, total, mean(spread), kind, nyquist
    )


def map_power(z: np.ndarray, dx: float, dy: float) -> tuple[np.ndarray, ...]:
    """f_x (n,), f_y (m/2+1,), two-dimensional power [m^4] and count per mode, Hann's window."""
    n, m = z.shape
    rows, columns = (np.sin(np.pi * (np.arange(k) + 0.5) / k) ** 2 for k in (n, m))
    z = remove_plane(z) * rows[:, None] * columns
    power = dx * dy * np.abs(np.fft.rfft2(z)) ** 2 / ((rows @ rows) * (columns @ columns))
    fx, fy = np.fft.fftfreq(n, dx), np.fft.rfftfreq(m, dy)
    # A mode and its mirror image are one, and both are listed where f_y is 0 or Nyquist's.
    count = np.ones(fy.size)
    count[0] = 0.5
    if m % 2 == 0:
        count[-1] = 0.5
    return fx, fy, power, count


def remove_plane(z):
    """A map minus its least-squares plane."""
    x, y = (np.arange(n) - (n - 1) / 2 for n in z.shape)
    z = z - z.mean()
    along_x = x @ z.sum(axis=1) / (z.shape[1] * (x @ x))
    along_y = y @ z.sum(axis=0) / (z.shape[0] * (y @ y))
    return z - along_x * x[:, None] - along_y * y


class MapHeights(NamedTuple):
    """What a window hides of a map."""

    mean_square: float  # m^2, about the plane, of the waves up to the Nyquist frequency
    longest: float  # 1/m, of a wave as long as the square root of the area
    step: float  # 1/m, between the ordinates of its spectrum


def map_heights(z: np.ndarray, dx: float, dy: float, gap: np.ndarray) -> MapHeights:
    """The mean square of a map without its filled gaps, and its frequencies."""
    fx, fy, power, count = map_power(z, dx, dy)
    heights = power * count
    heights[0, 0] = 0
    beyond = np.hypot(fx[:, None], fy) > 0.5 / max(dx, dy)
    # In the corners of the plane of frequencies, where not all directions are.
    corners = float(np.sum(heights[beyond]) / np.sum(heights))
    mean_square = float(np.var(remove_plane(z)[~gap])) * (1 - corners)
    lengths = z.shape[0] * dx, z.shape[1] * dy
    return MapHeights(mean_square, 1 / math.sqrt(lengths[0] * lengths[1]), 1 / min(lengths))


def map_spectra(z: np.ndarray, dx: float, dy: float) -> tuple[PowerSpectrum, ...]:
    """Spectra of a map without gaps: of all waves, of waves nearer to x, and nearer to y.

    Each is a sum over radial bins one frequency step wide, divided by their area. 2 pi |f| times
    a mean over modes would not work: their number varies, and a discrete wave is in few of them.
    """
    fx, fy, power, count = map_power(z, dx, dy)
    lengths = z.shape[0] * dx, z.shape[1] * dy
    step, nyquist, f = 1 / min(lengths), 0.5 / max(dx, dy), np.hypot(fx[:, None], fy)
    bins = int(nyquist / step)
    index = np.rint(f / step).astype(int).ravel()
    area = np.pi * np.arange(1, bins + 1) * step**2 * lengths[0] * lengths[1]
    width = np.mean([1 / (3 * length**2) for length in lengths])

    def radial(chosen, share):
        weight = (count * chosen).ravel()
        modes, frequencies, powers = (
            np.bincount(index, weight * values.ravel())[1 : bins + 1]
            for values in (np.ones_like(f), f, f * power)
        )
        at, power_at = frequencies / modes, 2 * np.pi * powers / (share * area)
        spread = np.full(bins, width)
        return _merge_ordinates(
            at, power_at, modes / HANN_INFLATION, 1 / at, spread, "map", nyquist
        )

    near_x = np.abs(fx[:, None]) > fy
    return radial(np.ones_like(near_x), 1.0), radial(near_x, 0.5), radial(~near_x, 0.5)
