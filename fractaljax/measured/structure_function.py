"""The structure function V(tau) = <(z(x + tau) - z(x))^2> of a profile: a second opinion.

Of a spectrum C f^-p, 1 < p < 3, it is 2 C int_0^inf f^-p (1 - cos 2 pi f tau) df, which is

    V = pi C (2 pi tau)^(p-1)/(Gamma(p) sin(pi (p-1)/2))

Tilt adds a term in tau^2, and removing it takes away from V. So what is measured is that of second
differences, W(tau) = <(z(x + tau) - 2 z(x) + z(x - tau))^2> = 4 V(tau) - V(2 tau), blind to tilt.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln

from ..surface.surfaces import Surface
from .spectrum import mean_cosine_power

_BLOCKS = 10  # for the standard error
_SHARED = 1.4  # by which blocks agree too well: waves longer than one are in several
_TINY = 1e-300  # m^2
_SHORTEST, _SHARE, _LAGS = 4, 12, 12  # lags from 4 points to a twelfth of the length, 12 of them


def theoretical_structure_function(surface: Surface, tau) -> jax.Array:
    """V [m^2] of a profile at distances tau [m] > 0, any shape: a power law, exponent 6 - 2D."""
    p = 7 - 2 * surface.D
    log_C = (2 * surface.D - 4) * jnp.log(surface.G) - math.log(2)
    turn = jnp.exp((p - 1) * jnp.log(2 * jnp.pi * tau) + log_C - gammaln(p))
    return jnp.pi * mean_cosine_power(p) * turn / jnp.sin(jnp.pi * (p - 1) / 2)


class StructureFunction(NamedTuple):
    """The second opinion: what the structure function alone says."""

    tau: np.ndarray  # m
    W: np.ndarray  # m^2, of second differences
    D: float
    G: float  # m
    D_standard_error: float  # approximate: ten blocks, each left out once


def structure_function(
    lines: list[np.ndarray],
    dx: float,
    band: tuple[float, float],
    *,
    end: float | None,
    noise: float = 0.0,
) -> StructureFunction:
    """Of lines without gaps, `dx` [m] apart in each: D and G from distances within a band [1/m].

    Heights that hold nothing above the frequency `end` [1/m] lack what lies there at every
    distance, 2 C end^(1-p)/(p-1) in V; None, if points were taken of a profile that has it all.
    White noise of mean square `noise` [m^2] is taken out.
    """
    shortest = max(math.ceil(1 / (band[1] * dx) - 1e-9), _SHORTEST)
    longest = min(max(z.size for z in lines) // _SHARE, int(0.4 / (band[0] * dx)))
    longest = max(longest, 2 * shortest)
    lags = np.unique(np.rint(np.geomspace(shortest, longest, _LAGS)).astype(int))
    sums, counts = np.zeros((2, _BLOCKS, lags.size))
    for z in lines:
        for j, lag in enumerate(lags[2 * lags < z.size - _BLOCKS]):
            squares = (z[2 * lag :] - 2 * z[lag:-lag] + z[: -2 * lag]) ** 2
            edges = np.arange(_BLOCKS) * squares.size // _BLOCKS
            sums[:, j] += np.add.reduceat(squares, edges)
            counts[:, j] += np.diff(edges, append=squares.size)
    tau = lags * dx
    W = np.maximum(sums.sum(axis=0) / counts.sum(axis=0) - 6 * noise, _TINY)
    p, log_C = _law(tau, W, end)
    without = [np.delete(x, i, axis=0).sum(axis=0) for i in range(_BLOCKS) for x in (sums, counts)]
    others = [
        _law(tau, np.maximum(total / count - 6 * noise, _TINY), end)[0]
        for total, count in zip(without[::2], without[1::2], strict=True)
    ]
    error = _SHARED * math.sqrt((_BLOCKS - 1) * np.var(others)) / 2
    return StructureFunction(tau, W, (7 - p) / 2, _roughness(p, log_C), error)


def _law(tau, W, end):
    """p and ln C by least squares of ln W over ln tau, each lag as long as its step."""
    p = np.linspace(1.005, 2.995, 400)[:, None]
    turn = np.exp((p - 1) * np.log(2 * np.pi * tau)) * np.pi * (4 - 2 ** (p - 1))
    shape = turn / (np.exp(_log_gamma(p)) * np.sin(np.pi * (p - 1) / 2))
    if end is not None:
        shape = shape - 6 * end ** (1 - p) / (p - 1)
    away = np.log(W) - np.log(np.maximum(shape, 1e-300))
    misfit = away.var(axis=1)
    best = int(np.clip(np.argmin(misfit), 1, p.size - 2))
    before, here, after = misfit[best - 1 : best + 2]
    curvature = before - 2 * here + after
    shift = np.clip((before - after) / (2 * curvature), -1, 1) if curvature > 0 else 0.0
    found = float(p[best, 0] + shift * (p[1, 0] - p[0, 0]))
    log_C = away.mean(axis=1)
    return found, float(np.interp(found, p[:, 0], log_C))


_log_gamma = np.vectorize(math.lgamma)


def _roughness(p, log_C):
    """G [m] of a profile's C = m(p) G^(3-p)/2."""
    log_m = math.lgamma(p / 2) - math.lgamma((p + 1) / 2) - math.log(math.pi) / 2
    with np.errstate(over="ignore"):
        return float(np.exp((log_C + math.log(2) - log_m) / (3 - p)))
