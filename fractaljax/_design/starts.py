"""Designs that are screened, and those of them from which a search starts."""

import numpy as np

from .._base.ranges import low_discrepancy
from .joint_limits import restore_joint_limits
from .problem import DesignProblem


def spread_designs(lattice: int, variables: int) -> np.ndarray:
    """Scaled designs (n, v): a lattice, in more than two variables a low-discrepancy set."""
    if variables > 2:
        return low_discrepancy(lattice**2, variables)
    side = (np.arange(lattice) + 0.5) / lattice
    axes = np.meshgrid(*[side] * variables, indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def draw_designs(
    problem: DesignProblem, centre: np.ndarray, count: int, shares: tuple[float, ...], seed: int
) -> np.ndarray:
    """Designs (count, v) drawn from the bounds, drawn to a centre (v,), and inside of all joints.

    In turn they are in boxes around the centre of such shares of the bounds. The joints are under
    the conditions that `problem` has itself.
    """
    drawn = np.random.default_rng(seed).random((count, len(centre)))
    share = np.resize(shares, count)[:, None]
    condition = np.asarray(problem.nominal_condition)[None]
    return restore_joint_limits(problem, centre + share * (drawn - centre), condition)


def renew_starts(
    problem: DesignProblem, best: np.ndarray, count: int, round_number: int
) -> np.ndarray:
    """Designs (count, v) for a round of new starts: around the best (v,), inside of all joints.

    Where the objective is the distance from the given design, what is better is nearer to that:
    every other round is on the line to it.
    """
    if problem.objective is not None or round_number % 2 == 0:
        # Two of three are closer.
        return draw_designs(problem, best, count, 8 * (0.06,) + 4 * (0.15,), round_number)
    start = np.asarray(problem.start, float)
    drawn = np.random.default_rng([round_number, 1]).uniform(-1, 1, (count, len(start)))
    # Draws scatter about the line by 0.3 of its length.
    size = 0.3 * float(np.sqrt(3 * np.mean((best - start) ** 2)))
    offset = np.resize((0.8, 0.6, 0.4), count)[:, None] * (best - start)
    condition = np.asarray(problem.nominal_condition)[None]
    return restore_joint_limits(problem, np.clip(start + offset + size * drawn, 0, 1), condition)


def choose_starts(start: np.ndarray, designs: np.ndarray, rows: np.ndarray, count: int):
    """Starts (count, v) and the scale of the objective.

    The given design first, then the most promising of distinct basins, then an even spread.
    """
    from scipy.spatial import KDTree

    values, finite, scale = rows[:, 0], np.isfinite(rows[:, 0]), 1.0
    if finite.any():
        low, high = np.quantile(values[finite], [0.1, 0.9])
        scale = float(high - low) or 1.0
    merit = values / scale + 10 * np.maximum(rows[:, 1:], 0).sum(axis=1)
    merit = np.where(finite, merit, np.inf)
    variables = designs.shape[1]
    neighbours = min(3**variables if variables < 3 else 4 * variables, len(designs))
    near = KDTree(designs).query(designs, neighbours)[1].reshape(len(designs), -1)
    basin = np.isfinite(merit) & (merit <= merit[near].min(axis=1))
    ranked = np.argsort(merit, kind="stable")
    ranked = np.concatenate([ranked[basin[ranked]], ranked[~basin[ranked]]])
    promising, rest = ranked[: count // 2], np.sort(ranked[count // 2 :])
    even = rest[np.linspace(0, len(rest) - 1, count - count // 2).astype(int)][1:]
    return np.concatenate([start[None], designs[promising], designs[even]])[:count], scale
