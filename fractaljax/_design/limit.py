"""How far a growth rate can be lowered where its target is out of reach, and what holds it there.

Where the largest growth rate is least, the slopes of the largest growth rates, with weights that
sum to 1, cancel with those of the active requirements and bounds (Karush, Kuhn and Tucker): no
small change lowers all of them. This is a proof for small changes. For large ones the only evidence
is the number of starts that end at the same growth rate. Where the other requirements cannot be met
either, the largest of their residuals is minimised instead, whatever grows.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._base.parts import Record
from .envelope import condition_text
from .evaluator import Evaluation
from .search import Search


class LeastGrowth(Record):
    """The least growth rate that was found with every other requirement met.

    `held_by` are the growth rates, requirements and bounds without which it could be lowered, with
    their multipliers: for growth rates, weights that sum to 1; for the others, the decrease [1/s]
    when one of them, a residual or a share of the bounds, is loosened by 1. `slope` is what these
    leave of the slopes, by designed quantities as shares of their bounds, and `steepest` the
    steepest slope among the largest growth rates [1/s].

    Where no design was found to meet the other requirements, `unmet` are their residuals at the
    design whose largest residual is least, and that residual takes the place of the growth rate in
    `held_by`, `slope`, `steepest` and `agreed`.
    """

    growth_rate: float  # [1/s], over all required modes, laws and conditions
    target: float
    values: Mapping[str, float]  # of the designed quantities
    unmet: Mapping[str, float]  # other requirements that are not met, the worst first
    held_by: Mapping[str, float]
    slope: float
    steepest: float
    agreed: int  # how many starts ended within 1 % of it
    starts: int

    @property
    def met(self) -> bool:
        """True if every other requirement is met."""
        return not self.unmet

    @property
    def margin(self) -> float:
        """The least decay rate of a mode [1/s], negative where one grows."""
        return -self.growth_rate

    @property
    def stationary(self) -> bool:
        """True if no small change lowers it, to first order."""
        return self.slope <= 1e-3 * self.steepest

    def __repr__(self) -> str:
        held = ", ".join(f"{name} ({by:.3g})" for name, by in self.held_by.items())
        cancel = f"the slopes cancel to {self.slope:.2g} of {self.steepest:.3g}"
        there = f"there {condition_text(self.values)}"
        held = f"held by, with multipliers: {held or 'nothing'}"
        agreed = f"{self.agreed} of {self.starts} starts end within 1 % of it"
        can = "no small change lowers it" if self.stationary else "a small change may lower it"
        if self.met:
            what = "least growth rate found, with every other requirement met"
            first = f"{what}: {self.growth_rate:+.6g} 1/s; the target is {self.target:+.6g}"
            return "\n".join([first, there, held, f"{can}: {cancel} 1/s", agreed])
        most, residual = next(iter(self.unmet.items()))
        first = f"no design was found to meet, whatever grows: {', '.join(self.unmet)}"
        least = f"least residual found, of {most}: {residual:.6g}; 0 is asked"
        grows = f"growth rate there: {self.growth_rate:+.6g} 1/s; the target is {self.target:+.6g}"
        return "\n".join([first, least, grows, there, held, f"{can}: {cancel}", agreed])


def least_growth(
    search: Search, paths: list[np.ndarray], evaluation: Evaluation
) -> LeastGrowth | None:
    """What holds the least growth rate at the ends of `Search.least_growth`; None if it has none.

    There is none where no design slides steadily at every condition and law required.
    """
    problem = search.evaluator.problem
    target, scale = float(problem.target), float(problem.growth_scale)
    count = 1 + len(problem.residual_names)
    growing, others = problem.growing[:count], search.others[:count]
    growth, unmet = search.split_residuals(evaluation)
    if not (unmet <= 0).any():
        paths, evaluation = search.least_unmet([path[-1] for path in paths])
        growth, unmet = search.split_residuals(evaluation)
    possible, rates = unmet <= 0, target + scale * np.sinh(growth)
    best = int(np.lexsort((rates, ~possible, np.maximum(unmet, 0) * ~possible))[0])
    u, residuals = paths[best][-1], evaluation.residuals[best]
    if not np.isfinite(rates[best] if possible[best] else unmet[best]):
        return None
    if possible[best]:
        near = 0.01 * max(abs(rates[best]), abs(rates[best] - target), scale)
        agreed = possible & (np.abs(rates - rates[best]) <= near)
        held, slope, steepest = _held_by(search, u, growing, others)
    else:
        agreed = unmet <= 1.01 * unmet[best]
        held, slope, steepest = _held_by(search, u, others, np.zeros_like(others))
    lacking = {
        name: float(residual)
        for name, residual, other in zip(problem.residual_names, residuals, others[1:], strict=True)
        if other and residual > 0
    }
    return LeastGrowth(
        growth_rate=float(rates[best]),
        target=target,
        values={name: float(x) for name, x in problem.quantities(u).items()},
        unmet=dict(sorted(lacking.items(), key=lambda item: -item[1])),
        held_by=held,
        slope=slope,
        steepest=steepest,
        agreed=int(agreed.sum()),
        starts=len(paths),
    )


def _held_by(
    search: Search, u: np.ndarray, aim: np.ndarray, limited: np.ndarray, near: float = 1e-4
) -> Any:
    """Multipliers by name, what they leave of the slopes, and the steepest slope.

    They belong to the largest columns in `aim` (1 + k,), to the active ones in `limited`, and to
    active bounds; slopes of growth rates are in 1/s. A residual or a scaled variable within `near`
    of its limit is active.
    """
    from scipy.optimize import nnls

    problem = search.evaluator.problem
    row, slopes = search.evaluator.rows_for(u)(problem, u)
    names = ["objective", *problem.residual_names]
    row, slopes = row[: len(names)], slopes[: len(names)]
    growing = problem.growing[: len(names)]
    with np.errstate(over="ignore"):  # far from any target
        scale = np.where(growing, float(problem.growth_scale) * np.cosh(row), 1.0)
    slopes = slopes * scale[:, None]
    largest = aim & (row >= row[aim].max() - near)
    others = limited & (np.abs(row) <= near)
    v = len(u)
    low, high = u <= near, u >= 1 - near
    columns = [*slopes[largest], *slopes[others], *-np.eye(v)[low], *np.eye(v)[high]]
    labels = [name for name, here in zip(names, largest, strict=True) if here]
    labels += [name for name, here in zip(names, others, strict=True) if here]
    labels += [
        f"{name} >= lower bound" for name, here in zip(problem.names, low, strict=True) if here
    ]
    labels += [
        f"{name} <= upper bound" for name, here in zip(problem.names, high, strict=True) if here
    ]
    steepest = float(np.linalg.norm(slopes[largest], axis=1).max())
    # Weights of the largest sum to 1, by a row that outweighs all others.
    unit = max(steepest, 1e-300)
    matrix = np.array(columns).T / unit
    weight = 1e4 * (np.arange(matrix.shape[1]) < largest.sum())
    multipliers = nnls(np.vstack([matrix, weight]), np.append(np.zeros(v), 1e4))[0]
    left = float(np.linalg.norm(matrix @ multipliers) * unit)
    held = {name: float(x) for name, x in zip(labels, multipliers, strict=True) if x > 0}
    return held, left, steepest
