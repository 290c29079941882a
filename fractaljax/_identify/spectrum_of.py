"""The power spectrum of a measured map, as the surface of a contact law."""

import math
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike

from .._base.warn import warn_user
from .._surface.heights import height_statistics
from .._surface.measured_spectrum import MeasuredSpectrum
from .measurement import Measurement
from .preparation import prepare_heights
from .source import read_heights
from .spectrum import (
    HANN_INFLATION,
    MapHeights,
    PowerSpectrum,
    map_heights,
    map_spectra,
    remove_plane,
)


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
    directions, from a wave as long as the square root of the map's area down to two steps. The
    waves together have the mean square height of the map about its plane: what the window takes of
    the longest is given back to them. The errors are those of independent waves with random phases
    and, of the longest, the change by what is given back.

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
    prepared = prepare_heights(read.z)
    z = prepared.segments[0]
    spectrum = map_spectra(z, read.dx, read.dy)[0]
    heights = map_heights(z, read.dx, read.dy, prepared.gaps[0])
    top = spectrum.nyquist if shortest is None else min(1 / shortest, spectrum.nyquist)
    table = spectrum_table(spectrum, heights, top, per_bin)
    if table is None:
        side = 1 / heights.step
        raise ValueError(f"shortest must leave two points or more of {side:g} m, got {shortest}")
    for words in gaussian_warnings(z, largest_skewness, largest_kurtosis):
        warn_user(words)
    return MeasuredSpectrum(table.q, table.C, table.error)


class SpectrumTable(NamedTuple):
    """Points of a spectrum, a power of q between each two, as a `MeasuredSpectrum` takes them."""

    q: np.ndarray  # rad/m
    C: np.ndarray  # m^4
    error: np.ndarray  # standard errors of ln C
    mean_square: float  # m^2, of the heights of these waves
    variance: float  # of ln(mean_square) about that of the process, by the number of waves


def spectrum_table(
    spectrum: PowerSpectrum,
    heights: MapHeights,
    high: float,
    per_bin: float = 1.15,
) -> SpectrumTable | None:
    """The spectrum of a map up to `high` [1/m], of which all waves have the map's mean square.

    It begins at the longest wave of the map. Hann's window hides the edges of the map, and with
    them most of the waves that are about as long. What the mean square of the windowed waves lacks,
    or has too much, is given to the bins in proportion to their variance times their share: of all
    changes with that sum it is the most probable, of ln C with independent errors. The change is
    part of the error. None where fewer than two points are left.
    """
    f, power, count = spectrum.f, spectrum.power, spectrum.count
    inside = f <= high * (1 + 1e-9)
    groups = np.floor(np.log(f / f[:1]) / math.log(per_bin) + 0.5)
    start = np.flatnonzero(np.diff(groups[inside], prepend=-1))
    if start.size < 2:
        return None
    above = np.sum((power * spectrum.weight * f)[~inside]) * heights.step
    f, power, count = f[inside], power[inside], count[inside]
    weight = np.add.reduceat(count, start)
    # The mean of ln f, and of the power times f^3, which is nearly flat.
    log_f = np.add.reduceat(count * np.log(f), start) / weight
    flat = np.add.reduceat(count * power * f**3, start) / weight
    log_C = np.log(flat / (2 * math.pi)) - 4 * log_f
    # A bin is known at its mean: on to the ends, to the lower one level.
    slope = (log_C[-1] - log_C[-2]) / (log_f[-1] - log_f[-2])
    log_C[-1] += slope * (math.log(high) - log_f[-1])
    log_f[-1] = math.log(high)
    bins = np.arange(log_f.size)
    if math.log(heights.longest) < log_f[0]:
        log_f, log_C = np.append(math.log(heights.longest), log_f), np.append(log_C[0], log_C)
        bins = np.append(0, bins)

    def shares(log_C):
        m = 2 * math.pi * np.exp(2 * log_f + log_C)
        width = np.diff(log_f)
        around = (np.append(width, 0) + np.append(0, width)) / 2
        return np.bincount(bins, m * around)

    def mean_square(log_C):
        m = 2 * math.pi * np.exp(2 * log_f + log_C)
        return float(np.sum(np.diff(log_f) * _logarithmic_means(m[:-1], m[1:])))

    lean = shares(log_C) / weight
    lean_above = above / max(spectrum.count[~inside].sum(), 1.0)
    largest = max(lean.max(), lean_above)
    lean, lean_above = lean / largest, lean_above / largest

    def total(x):
        return mean_square(log_C + x * lean[bins]) + above * math.exp(x * lean_above)

    change = _root(total, heights.mean_square) * lean
    log_C = log_C + change[bins]
    error = np.hypot(1 / np.sqrt(weight), change)[bins]
    parts = shares(log_C) / np.sum(shares(log_C))
    return SpectrumTable(
        2 * math.pi * np.exp(log_f),
        np.exp(log_C),
        error,
        mean_square(log_C),
        # The map, not only what the window leaves of it, holds this many waves.
        float(np.sum(parts**2 / (weight * HANN_INFLATION))),
    )


def _logarithmic_means(a, b):
    """(b - a)/ln(b/a): the mean of a power between two points, over the logarithm."""
    log = np.log(b / a)
    near = np.abs(log) < np.finfo(float).eps ** (1 / 3)
    return np.where(near, np.sqrt(a * b), (b - a) / np.where(near, 1, log))


def _root(total, wanted):
    """Where the increasing function `total` is `wanted`."""
    from scipy.optimize import brentq

    def excess(x):
        return math.log(total(x) / wanted)

    end = 1.0
    while excess(-end) > 0 or excess(end) < 0:
        end *= 2
    return float(brentq(excess, -end, end))  # type: ignore[arg-type]


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
