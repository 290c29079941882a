"""The structure function V(tau) = <(z(x + tau) - z(x))^2> of a profile: a second estimate.

For a spectrum C f^-p, 1 < p < 3, it is 2 C int_0^inf f^-p (1 - cos 2 pi f tau) df, which is

    V = pi C (2 pi tau)^(p-1)/(Gamma(p) sin(pi (p-1)/2))

Tilt adds a term in tau^2. Second differences, W(tau) = <(z(x + tau) - 2 z(x) + z(x - tau))^2>
= 4 V(tau) - V(2 tau), are blind to tilt, so W is measured.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from .._base.parts import Record
from .spectrum import log_mean_cosine_power


class StructureFunction(Record):
    """D and G by the structure function alone: NaN where no power law of a surface fits it."""

    tau: Float[np.ndarray, " lags"]  # m
    W: Float[np.ndarray, " lags"]  # m^2, of second differences
    D: float
    G: float  # m
    D_standard_error: float  # approximate, by the jackknife over ten blocks


def second_differences(p: float, tau: np.ndarray, end: float | None = None) -> np.ndarray:
    """W/C at distances tau [m] for C f^-p, up to the frequency `end` [1/m] if there is one."""
    from scipy.special import gammaln

    V = math.pi * (2 * math.pi * tau) ** (p - 1) / math.sin(math.pi * (p - 1) / 2)
    W = (4 - 2 ** (p - 1)) * V / math.exp(gammaln(p))
    return W if end is None else W - 6 * end ** (1 - p) / (p - 1)


def structure_function(
    lines: list[np.ndarray],
    dx: float,
    band: tuple[float, float],
    *,
    end: float | None,
    noise: float = 0.0,
    blocks: int = 10,
) -> StructureFunction:
    """D and G of lines, NaN where missing, dx [m] apart, from distances within a band [1/m].

    Heights may have no waves above the frequency `end` [1/m]. White noise of mean square `noise`
    [m^2] is subtracted. Twelve lags go from four points to a twelfth of the length. The standard
    error comes from the jackknife over `blocks` of each line.
    """
    shortest = max(math.ceil(1 / (band[1] * dx) - 1e-9), 4)
    longest = min(max(z.size for z in lines) // 12, int(0.4 / (band[0] * dx)))
    longest = max(longest, 2 * shortest)
    lags = np.unique(np.rint(np.geomspace(shortest, longest, 12)).astype(int))
    sums, counts = np.zeros((2, blocks, lags.size))
    for z in lines:
        for j, lag in enumerate(lags[2 * lags < z.size - blocks]):
            squares = (z[2 * lag :] - 2 * z[lag:-lag] + z[: -2 * lag]) ** 2
            edges, finite = np.arange(blocks) * squares.size // blocks, ~np.isnan(squares)
            sums[:, j] += np.add.reduceat(np.where(finite, squares, 0), edges)
            counts[:, j] += np.add.reduceat(finite, edges, dtype=float)
    tau = lags * dx

    def estimate(used):
        W = _positive(sums[used].sum(axis=0) / counts[used].sum(axis=0) - 6 * noise)
        return W, *_fit(tau, W, end, bounds)

    bounds = 1.005, 2.995  # of p: at 1 and 3 the integral diverges
    every = np.arange(blocks)
    W, p, log_C = estimate(every)
    if min(abs(p - bound) for bound in bounds) < 1e-4:
        return StructureFunction(tau, W, math.nan, math.nan, math.nan)
    others = [estimate(np.delete(every, i))[1] for i in every]
    # Waves longer than a block are in several blocks, which agree too well without the factor 1.4.
    error = 1.4 * math.sqrt((blocks - 1) * np.var(others)) / 2
    with np.errstate(over="ignore"):  # C = m(p) G^(3-p)/2
        G = float(np.exp((log_C + math.log(2) - log_mean_cosine_power(p)) / (3 - p)))
    return StructureFunction(tau, W, (7 - p) / 2, G, error)


def _positive(W):
    """W [m^2] where it has a logarithm, else a tiny number."""
    return np.maximum(W, 1e-300)


def _fit(tau, W, end, bounds) -> tuple[float, float]:
    """p and ln C by least squares of ln W over ln tau, with equal weights."""
    from scipy.optimize import fminbound

    def difference(p):
        return np.log(W) - np.log(_positive(second_differences(p, tau, end)))

    p: Any = fminbound(lambda p: difference(p).var(), *bounds, xtol=1e-9)
    return float(p), float(difference(p).mean())
