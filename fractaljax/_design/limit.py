"""How far a growth rate can be lowered where its target is out of reach, and what holds it there.

At a least largest growth rate the slopes of those that are largest, with weights that sum to 1,
and of the requirements and bounds that are met with nothing to spare cancel (Karush, Kuhn and
Tucker): no small change lowers all of them. This is a proof for small changes. For large ones
there is only how many starts end at the same growth rate.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._base.parts import Record
from .envelope import condition_text
from .problem import linearise
from .search import Evaluation, Evaluator, OnAverage, Search

_ACTIVE = 1e-4  # a residual, or a scaled variable, is at its limit within this
_AGREE = 0.01  # of a growth rate
_LEVEL = 1e-3  # of the steepest slope: as good as none


class LeastGrowth(Record):
    """The least growth rate that was found with every other requirement met.

    `held_by` are the growth rates, requirements and bounds without which it could be lowered, with
    their multipliers: of growth rates, weights that sum to 1; of others, by how many 1/s it falls
    where one of them, a residual or a share of the bounds, is loosened by 1. `slope` is what these
    leave of the slopes, by designed quantities as shares of their bounds, and `steepest` the
    steepest slope among the growth rates that are largest [1/s].
    """

    growth_rate: float  # [1/s], of all modes, laws and conditions that are required
    target: float
    values: Mapping[str, float]  # of the designed quantities
    met: bool  # whether the other requirements are
    held_by: Mapping[str, float]
    slope: float
    steepest: float
    agreed: int  # how many starts ended within 1 % of it
    starts: int

    @property
    def margin(self) -> float:
        """The least decay rate of a mode [1/s], negative where one grows."""
        return -self.growth_rate

    @property
    def stationary(self) -> bool:
        """Whether no small change lowers it, to first order."""
        return self.slope <= _LEVEL * self.steepest

    def __repr__(self) -> str:
        others = "every other requirement met" if self.met else "others not met either"
        held = ", ".join(f"{name} ({by:.3g})" for name, by in self.held_by.items())
        can = "no small change lowers it" if self.stationary else "a small change may lower it"
        return "\n".join(
            [
                f"least growth rate found, with {others}: {self.growth_rate:+.6g} 1/s; "
                f"the target is {self.target:+.6g}",
                f"there {condition_text(self.values)}",
                f"held by, with multipliers: {held or 'nothing'}",
                f"{can}: the slopes cancel to {self.slope:.2g} of {self.steepest:.3g} 1/s",
                f"{self.agreed} of {self.starts} starts end within 1 % of it",
            ]
        )


def least_growth(search: Search, paths: list[np.ndarray], found: Evaluation) -> LeastGrowth:
    """What holds the least growth rate at the ends of `Search.least_growth`."""
    evaluator = search.evaluator
    problem = evaluator.problem
    growing = search.growing[: found.rows.shape[1]]
    scale = float(problem.growth_scale)
    rates = float(problem.target) + scale * np.sinh(found.rows[:, growing].max(axis=1))
    unmet = found.residuals[:, ~growing[1:]].max(axis=1, initial=-np.inf)
    possible = unmet <= 0
    best = int(np.lexsort((rates, ~possible, np.maximum(unmet, 0) * ~possible))[0])
    u = paths[best][-1]
    near = _AGREE * max(abs(rates[best]), abs(rates[best] - float(problem.target)), scale)
    held, slope, steepest = _held_by(evaluator, u, growing)
    return LeastGrowth(
        growth_rate=float(rates[best]),
        target=float(problem.target),
        values={name: float(x) for name, x in problem.quantities(u).items()},
        met=bool(possible[best]),
        held_by=held,
        slope=slope,
        steepest=steepest,
        agreed=int((possible == possible[best])[np.abs(rates - rates[best]) <= near].sum()),
        starts=len(paths),
    )


def _held_by(evaluator: Evaluator, u: np.ndarray, growing: np.ndarray) -> Any:
    """Multipliers by name, what they leave of the slopes, and the steepest slope [1/s]."""
    from scipy.optimize import nnls

    problem = evaluator.problem
    row, slopes = _linearised(evaluator, u)
    names = ["objective", *problem.residual_names]
    row, slopes = row[: len(names)], slopes[: len(names)]
    with np.errstate(over="ignore"):  # far from any target
        scale = np.where(growing, float(problem.growth_scale) * np.cosh(row), 1.0)
    slopes = slopes * scale[:, None]
    largest = growing & (row >= row[growing].max() - _ACTIVE)
    others = ~growing & (np.abs(row) <= _ACTIVE)
    others[0] = False
    v = len(u)
    low, high = u <= _ACTIVE, u >= 1 - _ACTIVE
    columns = [*slopes[largest], *slopes[others], *-np.eye(v)[low], *np.eye(v)[high]]
    known = [name for name, here in zip(names, largest, strict=True) if here]
    known += [name for name, here in zip(names, others, strict=True) if here]
    known += [
        f"{name} >= lower bound" for name, here in zip(problem.names, low, strict=True) if here
    ]
    known += [
        f"{name} <= upper bound" for name, here in zip(problem.names, high, strict=True) if here
    ]
    steepest = float(np.linalg.norm(slopes[largest], axis=1).max())
    # Weights of the largest growth rates sum to 1, by a row that outweighs all others.
    unit = max(steepest, 1e-300)
    matrix = np.array(columns).T / unit
    weight = 1e4 * (np.arange(matrix.shape[1]) < largest.sum())
    multipliers = nnls(np.vstack([matrix, weight]), np.append(np.zeros(v), 1e4))[0]
    left = float(np.linalg.norm(matrix @ multipliers) * unit)
    held = {name: float(x) for name, x in zip(known, multipliers, strict=True) if x > 0}
    return held, left, steepest


def _linearised(evaluator: Evaluator, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The row (1 + k,) that counts at a design, and its derivatives (1 + k, v)."""
    problem = evaluator.problem
    if isinstance(evaluator, OnAverage):
        conditions = evaluator.working
        us = np.repeat(u[None], len(conditions), axis=0)
        row, slopes = evaluator.average(*linearise(problem, us, conditions)[:2])
        return row[0], slopes[0]
    places = evaluator.evaluate(u[None]).places[0]  # of each column, its worst
    conditions, which = np.unique(evaluator.envelope.values(places), axis=0, return_inverse=True)
    us = np.repeat(u[None], len(conditions), axis=0)
    rows, slopes = linearise(problem, us, conditions)[:2]
    columns = np.arange(len(places))
    which = which.ravel()
    return rows[which, columns], slopes[which, columns]
