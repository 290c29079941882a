"""Machining scatters D and ln G: quantiles over a fixed quadrature, and chance by sampling.

Both are normal and independent. The nodes of the quadrature are a Fibonacci lattice of a normal
distribution twice as wide, weighted back, so that the tails which decide a quantile are well
resolved; the same nodes serve every surface, so that a quantile is continuous in the surface.
"""

import math
from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import scalar
from ..mechanism.scene import Scene

NAMES = {"D": "D", "G": "ln G"}  # as written in a tolerance

_NODES, _GENERATOR = 55, 34  # neighbouring Fibonacci numbers: the best lattice of that size
_WIDENING = 2.0  # of the distribution that the nodes are drawn from
_REACH = 6.0  # standard deviations that must stay inside the domain of D


def check_tolerance(tolerance: Mapping[str, Any], scene: Scene, bounds: Mapping) -> dict:
    """Standard deviations {"D": ..., "G": ...} of D and ln G; absent where nothing scatters.

    **Raises:** `ValueError` for other names, negative or infinite values, nothing at all, and a
    scatter of D that leaves 2 < D < 3 within six standard deviations.
    """
    if not isinstance(tolerance, Mapping):
        raise TypeError(f"tolerance must be a mapping, got {tolerance!r}")
    if not tolerance or not set(tolerance) <= set(NAMES.values()):
        names = ", ".join(map(str, tolerance)) or "none"
        raise ValueError(f"tolerance must be of D, ln G or both, got {names}")
    checked = {
        short: float(scalar(f"tolerance of {name}", tolerance[name], at_least=0))
        for short, name in NAMES.items()
        if name in tolerance
    }
    D = float(scene.contact.surface.D)
    low, high = bounds.get("D", (D, D))
    most = min(low - 2, 3 - high) / _REACH
    if checked.get("D", 0.0) >= most:
        raise ValueError(
            f"tolerance of D must be below {most:.6g}, so that D stays inside 2 and 3, "
            f"got {checked['D']!r}"
        )
    checked = {name: sigma for name, sigma in checked.items() if sigma > 0}
    if not checked:
        raise ValueError("tolerance must be above 0 for D or ln G, got 0 for all")
    return checked


def nodes(dimensions: int) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal deviates (n, dimensions), 1 or 2 of them, and their weights (n,)."""
    inverse = np.vectorize(NormalDist().inv_cdf)
    i = np.arange(_NODES)
    columns = [(i + 0.5) / _NODES, ((_GENERATOR * i) % _NODES + 0.5) / _NODES]
    z = np.stack([inverse(column) for column in columns[:dimensions]], axis=1)
    # Zero mean and unit covariance exactly.
    z = z - z.mean(axis=0)
    root = np.linalg.cholesky(z.T @ z / _NODES)
    z = np.linalg.solve(root, z.T).T
    weights = np.exp(-(z**2).sum(axis=1) * (_WIDENING**2 - 1) / 2)
    return z * _WIDENING, weights / weights.sum()


def quantile(values: jax.Array, weights: jax.Array, level) -> jax.Array:
    """The weighted `level`-quantile of values (n, ...) with weights (n,).

    The mean of the quantile function over level +- (1 - level)/2: continuous in the values, with a
    derivative that mixes those of several nodes.
    """
    half = (1 - level) / 2
    order = jnp.argsort(values, axis=0)
    below = jnp.cumsum(weights[order], axis=0)
    # Sums to 1 exactly where it must, whatever the rounding of the weights.
    below = below / below[-1:]
    reached = jnp.clip((below - level + half) / (2 * half), 0, 1)
    share = jnp.diff(reached, axis=0, prepend=jnp.zeros_like(reached[:1]))
    return jnp.sum(share * jnp.take_along_axis(values, order, axis=0), axis=0)


def draw(tolerance: Mapping[str, float], count: int, seed: int) -> dict[str, np.ndarray]:
    """Shifts (count,) of D and ln G drawn at random, by name."""
    deviates = np.random.default_rng([seed, 0]).standard_normal((count, len(tolerance)))
    return {name: sigma * z for (name, sigma), z in zip(tolerance.items(), deviates.T, strict=True)}


def proportion(hits: int, count: int) -> tuple[float, float]:
    """A proportion and its standard error, which is not zero where all or nothing was hit."""
    smoothed = (hits + 1) / (count + 2)
    return hits / count, math.sqrt(smoothed * (1 - smoothed) / count)
