"""The starts of a basin: in a box, in a ball or an ellipsoid, or an explicit list."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.parts import number, scalar, whole
from .._base.programs import exported_jit
from .hybrid import HybridSystem


@exported_jit
def _centre(system: HybridSystem) -> tuple[Array, Array]:
    """The equilibrium without an excitation (2n,), and the units (2n,)."""
    return system.mechanism_state(system.equilibrium()), system.units


def starts_of(system, n, low, high, starts, seed, radius) -> Float[np.ndarray, "k 2n"]:
    """The starts [m, m/s] in a box, in a ball, or as listed."""
    box, listed = low is not None or high is not None, np.ndim(starts) > 0
    if box + listed + (radius is not None) != 1:
        raise ValueError(
            "give one of: low and high, radius, or starts of shape (k, 2n); radius=5 is usual"
        )
    if listed:
        points = np.asarray(number("starts", jnp.asarray(starts, dtype=float)))
        if points.ndim != 2 or points.shape[1] != 2 * n or not len(points):
            raise ValueError(f"starts must have shape (k, {2 * n}), got {points.shape}")
        return points
    count = whole("starts", starts, 1, 1_000_000)  # more would take days
    if radius is not None:
        centre, axes = ellipsoid(system, kick_size("radius", radius, n))
        return centre + _in_unit_ball(count, 2 * n, seed) * axes
    corners = [_corner("low", low, n), _corner("high", high, n)]
    if (corners[0] > corners[1]).any():
        raise ValueError(f"low must be at most high, got {corners[0]} and {corners[1]}")
    # A fixed coordinate takes no dimension of the points.
    moves = corners[0] < corners[1]
    share = np.zeros((count, 2 * n))
    share[:, moves] = _sobol(count, int(moves.sum()), seed)
    return corners[0] + share * (corners[1] - corners[0])


def kick_size(name: str, size: Any, n: int) -> float | list[float]:
    """A radius in units of V/omega and V, or the semi-axes (2n,) [m, m/s] of an ellipsoid."""
    if not isinstance(size, (list, tuple)) and not np.ndim(size):
        return float(scalar(name, size, above=0))
    axes = [float(scalar(name, axis, above=0)) for axis in size]
    if len(axes) != 2 * n:
        raise ValueError(f"{name} must have {2 * n} semi-axes, got {len(axes)}")
    return axes


def ellipsoid(system: HybridSystem, size: float | list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Centre and semi-axes (2n,) [m, m/s] of kicks of a size, as `kick_size` gives it."""
    centre, units = map(np.asarray, _centre(system))
    return centre * units, np.array(size) if isinstance(size, list) else size * units


def _corner(name: str, value: Any, n: int) -> np.ndarray:
    if value is None:
        raise ValueError("a box needs both low and high")
    corner = np.asarray(number(name, jnp.asarray(value, dtype=float)))
    if corner.shape != (2 * n,):
        raise ValueError(f"{name} must have shape ({2 * n},), got {corner.shape}")
    return corner


def _sobol(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Points (count, dimensions) that fill the unit cube evenly."""
    from scipy.stats import qmc

    if not dimensions:
        return np.zeros((count, 0))
    sobol: Any = qmc.Sobol  # SciPy 1.15 renamed `seed`, and takes both names
    points = sobol(dimensions, seed=seed)
    # The first of a power of two, for which Sobol's points are balanced.
    return points.random_base2((count - 1).bit_length())[:count]


def _in_unit_ball(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Points (count, dimensions) evenly in the unit ball."""
    from scipy.special import ndtri

    u = _sobol(count, dimensions + 1, seed)
    direction = ndtri(np.clip(u[:, 1:], 1e-12, 1 - 1e-12))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * u[:, :1] ** (1 / dimensions)
