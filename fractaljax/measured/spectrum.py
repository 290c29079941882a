"""Power spectra of the surface of Eq. 13, and those of measured heights.

A wave of Eq. 13 has the mean square L^2 (G/L)^(2D-4) ln(gamma)/2 gamma^(2(D-3)n), and there is one
set of them every ln(gamma) of ln f: ln(gamma) cancels, and so does L. In the mean over directions

    map      S_r(f) = G^(2D-4)/2 f^-p,           p = 7 - 2D     (of f = |(f_x, f_y)|)
    profile  C(f)   = m(p) G^(2D-4)/2 f^-p,      m(p) = mean of |cos|^(p-1)

both one-sided: the variance is their integral over f > 0, f in 1/m.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln

from ..surface.surfaces import Surface

_TAPERS = 3  # of a profile: two thirds of the variance that Hann's window leaves
_NEAR = 0.02  # in ln f


def mean_cosine_power(p) -> jax.Array:
    """m(p) = Gamma(p/2)/(sqrt(pi) Gamma((p+1)/2)): |cos a|^(p-1) in the mean over a. Any shape."""
    return jnp.exp(gammaln(p / 2) - gammaln((p + 1) / 2)) / math.sqrt(math.pi)


def theoretical_spectrum(surface: Surface, f, kind: str = "profile") -> jax.Array:
    """One-sided spectrum [m^3] of a profile, or over |f| of a "map", at frequencies f [1/m] > 0.

    Any shape that broadcasts. **Raises:** `ValueError` for another kind.
    """
    if kind not in ("profile", "map"):
        raise ValueError(f"kind must be 'profile' or 'map', got {kind!r}")
    p = 7 - 2 * surface.D
    radial = jnp.exp((2 * surface.D - 4) * jnp.log(surface.G) - p * jnp.log(f)) / 2
    return mean_cosine_power(p) * radial if kind == "profile" else radial


class Spectrum(NamedTuple):
    """Ordinates of a measured spectrum in rising order of frequency, arrays (k,)."""

    f: np.ndarray  # 1/m
    power: np.ndarray  # m^3, one-sided; of a map over |f|
    count: np.ndarray  # independent ordinates that each one stands for
    weight: np.ndarray  # share in an average over ln f
    spread: np.ndarray  # 1/m^2: mean square width of the window about each
    kind: str  # "profile" or "map"
    nyquist: float  # 1/m


def profile_spectrum(stretches: list[np.ndarray], dx: float) -> Spectrum:
    """Of stretches of one profile, each without gaps: sine tapers (Riedel, Sidorenko 1995)."""
    parts = [_stretch_spectrum(z, dx) for z in stretches]
    f, power, count, spread = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _merged(f, power, count, count / f, spread, "profile", 0.5 / dx)


def _merged(f, power, count, weight, spread, kind, nyquist) -> Spectrum:
    """Ordinates closer than two percent become one: no law can tell them apart."""
    order = np.argsort(f, kind="stable")
    f, power, count, weight, spread = (x[order] for x in (f, power, count, weight, spread))
    cell = np.floor(np.log(f / f[0]) / _NEAR + 0.5)
    start = np.flatnonzero(np.diff(cell, prepend=-1))
    total = np.add.reduceat(weight, start)

    def mean(values):
        return np.add.reduceat(weight * values, start) / total

    variance = np.add.reduceat(weight**2 / count, start) / total**2
    return Spectrum(
        np.exp(mean(np.log(f))), mean(power), 1 / variance, total, mean(spread), kind, nyquist
    )


def _stretch_spectrum(z, dx):
    n = z.size
    z = remove_line(z)
    t = (np.arange(n) + 0.5) / n
    tapers = np.sin(np.pi * np.arange(1, _TAPERS + 1)[:, None] * t) * math.sqrt(2 / n)
    power = 2 * dx * (np.abs(np.fft.rfft(tapers * z)) ** 2).mean(axis=0)
    # Wide bins scatter as the mean taper's own square does, narrow ones by the taper's width.
    inflation = n * np.sum((tapers**2).mean(axis=0) ** 2)
    width = np.mean(np.arange(1, _TAPERS + 1) ** 2) / 4 / (n * dx) ** 2
    f = np.fft.rfftfreq(n, dx)[1:]
    return f, power[1:], np.full(f.size, 1 / inflation), np.full(f.size, width)


def remove_line(z: np.ndarray) -> np.ndarray:
    """A profile less the line through its ends: a taper of sines leaks what the ends stand out."""
    return z - np.linspace(z[0], z[-1], z.size)


def remove_plane(z: np.ndarray) -> np.ndarray:
    """A map less its plane of least squares."""
    x, y = (np.arange(n) - (n - 1) / 2 for n in z.shape)
    z = z - z.mean()
    along_x = x @ z.sum(axis=1) / (z.shape[1] * (x @ x))
    along_y = y @ z.sum(axis=0) / (z.shape[0] * (y @ y))
    return z - along_x * x[:, None] - along_y * y


def map_power(z: np.ndarray, dx: float, dy: float) -> tuple[np.ndarray, ...]:
    """f_x (n,), f_y (m/2+1,), two-dimensional power [m^4] and count per mode, Hann's window."""
    n, m = z.shape
    rows, columns = (np.sin(np.pi * (np.arange(k) + 0.5) / k) ** 2 for k in (n, m))
    z = remove_plane(z) * rows[:, None] * columns
    norm = (rows @ rows) * (columns @ columns)
    power = dx * dy * np.abs(np.fft.rfft2(z)) ** 2 / norm
    fx, fy = np.fft.fftfreq(n, dx), np.fft.rfftfreq(m, dy)
    # A mode and its mirror image are one: on the axis f_y = 0 (and at Nyquist) both are there.
    count = np.ones(fy.size)
    count[0] = 0.5
    if m % 2 == 0:
        count[-1] = 0.5
    return fx, fy, power, count


def map_spectra(z: np.ndarray, dx: float, dy: float) -> tuple[Spectrum, ...]:
    """Of a map without gaps: of all waves, of those nearer to x, and of those nearer to y."""
    fx, fy, power, count = map_power(z, dx, dy)
    along_x = np.abs(fx[:, None]) > fy
    lengths = z.shape[0] * dx, z.shape[1] * dy
    nyquist = 0.5 / max(dx, dy)
    everywhere = np.ones_like(along_x)
    return tuple(
        _rings(fx, fy, power, count * chosen, share, lengths, nyquist)
        for chosen, share in ((everywhere, 1.0), (along_x, 0.5), (~along_x, 0.5))
    )


def _rings(fx, fy, power, count, share, lengths, nyquist) -> Spectrum:
    """Sums over (a share of) rings one frequency step wide, beside the step.

    Not means times 2 pi |f|: the number of modes in a ring goes up and down, and a discrete wave
    lies in few of them.
    """
    f = np.hypot(fx[:, None], fy)
    step = 1 / min(lengths)
    ring = np.rint(f / step).astype(int).ravel()
    rings = int(nyquist / step)
    weight = count.ravel()
    sums = [
        np.bincount(ring, weight * values.ravel())[1 : rings + 1]
        for values in (np.ones_like(f), f, f * power)
    ]
    modes, frequencies, powers = sums
    inflation = 3.7809  # (35/18)^2, Hann's in both directions
    width = np.mean([1 / (3 * length**2) for length in lengths])
    f = frequencies / modes
    expected = share * np.pi * np.arange(1, rings + 1) * step**2 * lengths[0] * lengths[1]
    return _merged(
        f,
        2 * np.pi * powers / expected,
        modes / inflation,
        1 / f,
        np.full(f.size, width),
        "map",
        nyquist,
    )
