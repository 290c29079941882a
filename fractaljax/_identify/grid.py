"""Positions of measured heights as places on a grid of equal steps."""

import math

import numpy as np


def equal_steps(x: np.ndarray, *, jitter: float = 0.1) -> tuple[float, np.ndarray]:
    """The step of increasing positions x (n,), and how many steps each is from the first.

    Points may be left out, and positions may be rounded to few decimals, or be off by a share
    `jitter` of a step.

    **Raises:** `ValueError` where positions do not increase, or are not on such a grid.
    """
    if x.size < 2:
        raise ValueError(f"there must be at least 2 positions, got {x.size}")
    steps = np.diff(x)
    if not (steps > 0).all():
        at = int(np.argmin(steps > 0))
        raise ValueError(
            f"positions must rise or fall throughout, got {x[at]:.6g} and then {x[at + 1]:.6g} m"
            " (decimal commas need semicolons or tabs between columns)"
        )
    counts = np.rint(steps / np.quantile(steps, 0.5, method="lower"))
    k = np.concatenate([[0], np.cumsum(counts)])
    dx, spread = _line(x, k)
    fits = counts.min() > 0 and k[-1] < 2 * x.size and spread <= 2 * jitter * dx
    if not fits or k[-1] > 1.01 * x.size:  # many left out, or positions that were rounded
        every = np.arange(x.size)
        rounded_dx, spread = _line(x, every)
        if spread <= 1.1 * _rounding(x, rounded_dx, jitter):
            return rounded_dx, every
    if not fits:
        raise ValueError(
            f"positions are not equidistant, steps are {steps.min():.6g} to {steps.max():.6g} m:"
            " resample them at equal steps first"
        )
    return dx, k.astype(int)


def _line(x, k) -> tuple[float, float]:
    """Slope of the least-squares line of x over k, and the range of the residuals."""
    k, x = k - k.mean(), x - x.mean()
    slope = x @ k / (k @ k)
    return float(slope), float(np.ptp(x - slope * k))


def _rounding(x, dx, least) -> float:
    """Power of ten from `least` to 2 steps of which all positions are multiples, or 0."""
    coarse, fine = (math.floor(math.log10(share * dx)) for share in (2, least))
    for quantum in 10.0 ** np.arange(coarse, fine - 1, -1):
        if np.abs(x / quantum - np.rint(x / quantum)).max() < 1e-6:
            return quantum
    return 0.0


def profile_on_grid(x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, float]:
    """Heights z at rising or falling x (n,) at equal steps, NaN where left out, and the step."""
    if x.size > 1 and x[0] > x[-1]:
        x, z = x[::-1], z[::-1]
    dx, k = equal_steps(x)
    heights = np.full(k[-1] + 1, np.nan)
    heights[k] = z
    return heights, dx


def map_on_grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Heights at points (x, y) of a rectangular grid, in any order, as a map, with its steps."""
    (dx, i), (dy, j) = _axis(x), _axis(y)
    shape = int(i.max()) + 1, int(j.max()) + 1
    if np.unique(i * shape[1] + j).size < z.size:
        raise ValueError("two points have the same position")
    if 2 * z.size < shape[0] * shape[1]:
        raise ValueError(
            f"the points are not on a rectangular grid: {z.size} of {shape[0]} x {shape[1]}"
        )
    heights = np.full(shape, np.nan)
    heights[i, j] = z
    return heights, dx, dy


def _axis(x):
    """The step between the distinct positions among x, and the index of each x."""
    order = np.argsort(x, kind="stable")
    steps = np.diff(x[order])
    group = np.concatenate([[0], np.cumsum(steps > 0.3 * steps.max(initial=0))])
    dx, k = equal_steps(np.bincount(group, x[order]) / np.bincount(group))
    index = np.empty(x.size, int)
    index[order] = k[group]
    return dx, index
