"""A surface with its scatter: of a measurement, of several, or of a drawing.

The scatter is that of numbers which are nearly independent of each other. Of a `Surface` they are D
and ln m(q), m being the mean square height per ln q at the wavenumber q at which it is uncorrelated
with D: ln G hangs on D so strongly that its error says little of the surface. With f = q/(2 pi),

    ln m(q) = (2D - 4) ln G + (2D - 6) ln f - ln 2,
    ln G = [ln m(q) + ln 2 + (6 - 2D) ln f]/(2D - 4)
"""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._base.parts import Record
from .spectrum import Spectrum
from .surface import Surface

HEIGHT = "m(q)"  # stands for the height of a fractal surface in the names of what scatters


class SurfaceScatter(Record):
    """A surface and the scatter of its numbers, which `Tolerance.of` and `design` take.

    Normal; a fractal dimension and a Hurst exponent are truncated to their domains.
    """

    surface: Spectrum  # where nothing scatters
    names: tuple[str, ...] = eqx.field(static=True)  # of what scatters, "ln " for a logarithm
    covariance: Float[np.ndarray, "k k"]  # of what is named, in SI units
    q: float | None = None  # rad/m: wavenumber of "ln m(q)", if that is named

    @property
    def standard_deviations(self) -> dict[str, float]:
        """By name: {"D": ..., "ln m(q)": ...}."""
        return dict(zip(self.names, np.sqrt(np.diagonal(self.covariance)).tolist(), strict=True))

    def __repr__(self) -> str:
        scatter = ", ".join(f"{n} +- {s:.2g}" for n, s in self.standard_deviations.items())
        at = "" if self.q is None else f", q = {self.q:.4g} rad/m"
        return f"{self.surface!r}\nscatter: {scatter}{at}"


def log_height(D: float, log_G: float, q: float) -> float:
    """ln m(q) of a fractal surface, m in m^2, at the wavenumber q [rad/m]."""
    return (2 * D - 4) * log_G + (2 * D - 6) * math.log(q / (2 * math.pi)) - math.log(2)


def log_roughness(D: float, log_m: float, q: float) -> float:
    """ln G of a fractal surface with ln m(q) at the wavenumber q [rad/m]."""
    log_f = math.log(q / (2 * math.pi))
    return (log_m + math.log(2) + (6 - 2 * D) * log_f) / (2 * D - 4)


def truncated_mean(value: float, error: float, low: float, high: float) -> float:
    """The mean of a normal distribution cut off at `low` and `high`."""
    from scipy.stats import truncnorm

    if error == 0:
        return min(max(value, low), high)
    ends = [(end - value) / error for end in (low, high)]
    return float(np.asarray(truncnorm.mean(*ends, loc=value, scale=error)))


def fractal_scatter(
    D: float, log_m: float, q: float, covariance: np.ndarray, gamma: float
) -> SurfaceScatter:
    """The surface of D and ln m(q) [m^2] at q [rad/m], with the covariance (2, 2) of the two.

    Where D is outside (2, 3), or so close to 2 that G is 0 in double precision, it is the mean of
    its normal distribution truncated to (2, 3), and ln m follows it by the covariance.

    **Raises:** `ValueError` where there is no such surface.
    """
    most = math.log(np.finfo(float).max)
    inside = 2 < D < 3 and abs(log_roughness(D, log_m, q)) < most
    if not inside:
        error = math.sqrt(covariance[0, 0])
        mean = truncated_mean(D, error, 2, 3)
        if error > 0:
            log_m += covariance[0, 1] / covariance[0, 0] * (mean - D)
        D = mean
    log_G = log_roughness(D, log_m, q) if 2 < D < 3 else math.inf
    if not abs(log_G) < most:
        raise ValueError(f"no fractal surface has D = {D:.6g} and this height")
    surface = Surface(D, math.exp(log_G), gamma)
    return SurfaceScatter(surface, ("D", f"ln {HEIGHT}"), covariance, q)
