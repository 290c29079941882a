"""The power spectrum of a measured map, as the surface of a contact law."""

import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from .._base.warn import warn_user
from .._surface.heights import height_statistics
from .._surface.measured_spectrum import MeasuredSpectrum
from .measurement import Measurement
from .preparation import prepare_heights
from .source import read_heights
from .spectrum import PowerSpectrum, map_spectra, remove_plane


def spectrum_of(
    z: ArrayLike | Measurement | str | os.PathLike | Any,
    dx: float | None = None,
    dy: float | None = None,
    *,
    per_bin: float = 1.15,
    shortest: float | None = None,
    largest_skewness: float = 1.0,
    largest_kurtosis: float = 8.0,
) -> MeasuredSpectrum:
    """The spectrum of a map of heights, with its standard errors, as a `PerssonContact` takes it.

    The least-squares plane is removed and Hann's window taken along both axes; C is the mean over
    directions, from the longest wave that the shorter side holds down to two steps. The errors are
    those of independent waves with random phases.

    **Arguments:**

    - `z`: heights (n, m) [m], NaN where missing, or what `identify` takes: a `Measurement`, the
      path of a file, a topography of SurfaceTopography.
    - `dx`, `dy`: steps [m] along the first and the second axis; dy is dx by default.
    - `per_bin`: ratio of the wavenumbers of neighbouring points of the table, 1.15 by default.
    - `shortest`: wavelength [m] at which the spectrum ends, by default two steps: waves that the
      instrument does not resolve, and noise, are below.
    - `largest_skewness`, `largest_kurtosis`: beyond |Ssk| of 1 or Sku of 8 there is a warning that
      the heights are not Gaussian: laws that need no more than a spectrum can then be off by
      several times, and `MeasuredContact.from_heights` is the way.

    **Raises:** `ValueError` for a profile, for heights and steps as `identify` does, and for a
    `shortest` that leaves fewer than two points.
    """
    read = read_heights(z, dx, dy)
    if read.z.ndim != 2 or read.dy is None:
        raise ValueError(
            f"z must be a map (n, m), got shape {read.z.shape}; identify takes profiles"
        )
    heights = prepare_heights(read.z).segments[0]
    spectrum = map_spectra(heights, read.dx, read.dy)[0]
    longest = min(read.z.shape[0] * read.dx, read.z.shape[1] * read.dy)
    top = spectrum.nyquist if shortest is None else 1 / shortest
    table = spectrum_table(spectrum, 0.999 / longest, top, per_bin)
    if table is None:
        raise ValueError(f"shortest must leave two points or more of {longest:g} m, got {shortest}")
    for words in gaussian_warnings(heights, largest_skewness, largest_kurtosis):
        warn_user(words)
    return MeasuredSpectrum(*table)


def spectrum_table(
    spectrum: PowerSpectrum, low: float, high: float, per_bin: float = 1.15
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """q [rad/m], C [m^4] and the errors of ln C of a map from `low` to `high` [1/m].

    None where fewer than two points are left.
    """
    inside = (spectrum.f >= low) & (spectrum.f <= high * (1 + 1e-9))
    f, power, count = spectrum.f[inside], spectrum.power[inside], spectrum.count[inside]
    groups = np.floor(np.log(f / f[:1]) / math.log(per_bin) + 0.5)
    start = np.flatnonzero(np.diff(groups, prepend=-1))
    if start.size < 2:
        return None
    weight = np.add.reduceat(count, start)
    # The mean of ln f, and of the power times f^3, which is nearly flat.
    f_mean = np.exp(np.add.reduceat(count * np.log(f), start) / weight)
    flat = np.add.reduceat(count * power * f**3, start) / weight
    C = flat / f_mean**3 / (2 * math.pi * f_mean)
    return 2 * math.pi * f_mean, C, 1 / np.sqrt(weight)


def gaussian_warnings(
    z: np.ndarray, largest_skewness: float = 1.0, largest_kurtosis: float = 8.0
) -> Iterator[str]:
    """A warning about the heights of a map that are far from Gaussian."""
    heights = height_statistics(remove_plane(z))
    Ssk, Sku = float(heights.skewness), float(heights.kurtosis)
    if abs(Ssk) > largest_skewness or Sku > largest_kurtosis:
        yield (
            f"heights are far from Gaussian (Ssk {Ssk:.2g}, Sku {Sku:.2g}): a law that has only"
            " their spectrum can be off by several times; use MeasuredContact.from_heights"
        )
