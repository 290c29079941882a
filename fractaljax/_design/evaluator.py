"""Objective and requirements of designs, under one condition or the worst or average of many."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .._base.parts import brief, scalar
from .envelope import SINGLE_CONDITION, Envelope, WorstCaseSearch
from .problem import DesignProblem
from .rows import evaluate, linearise, paired

Rows = Callable[[DesignProblem, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Objective and residuals of n designs, and the places where each is at its worst."""

    rows: np.ndarray  # (n, 1 + k)
    places: np.ndarray  # (n, 1 + k, 1 + ranges)

    @property
    def values(self) -> np.ndarray:
        """The objective (n,)."""
        return self.rows[:, 0]

    @property
    def residuals(self) -> np.ndarray:
        """(n, k), at most 0 where met."""
        return self.rows[:, 1:]

    @property
    def worst(self) -> np.ndarray:
        """The largest residual (n,); infinite where it or the objective is undefined."""
        return np.where(np.isfinite(self.values), self.residuals.max(axis=1), np.inf)

    def select(self, i: int) -> "Evaluation":
        """The evaluation of one design, still with a leading axis."""
        return Evaluation(self.rows[i : i + 1], self.places[i : i + 1])


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """Evaluates requirements and objective of designs at the worst conditions of an envelope."""

    problem: DesignProblem
    envelope: Envelope = SINGLE_CONDITION
    options: WorstCaseSearch = WorstCaseSearch()

    @property
    def likely(self) -> np.ndarray:
        """Conditions (m, c) that are a first guess at the worst."""
        return self.envelope.values(self.envelope.likely(self.options.likely, self.options.corners))

    @property
    def working(self) -> np.ndarray:
        """The conditions (m, c) for which a design is first optimised."""
        return self.likely

    @property
    def minimax(self) -> bool:
        """True if the objective is the largest of its values at many conditions."""
        return self.problem.objective is not None and self.envelope is not SINGLE_CONDITION

    def screen(self, us: np.ndarray) -> np.ndarray:
        """Approximate objective and residuals (n, 1 + k) of us (n, v), for the choice of starts."""
        # Cycles are followed from the starts only.
        rough = dataclasses.replace(self, problem=self.problem.with_fields(cycles=None))
        return rough._at_all(us, self.likely).max(axis=1)[:, self.problem.named_columns]

    def evaluate(self, us: np.ndarray) -> Evaluation:
        """Evaluate designs us (n, v) over all conditions."""
        grid = self.envelope.grid(self.options.points)
        each = self._at_all(us, self.envelope.values(grid))
        each = each[:, :, self.problem.named_columns]
        places, rows = grid[each.argmax(axis=1)], each.max(axis=1)
        near = rows > -self.options.margin
        near[:, 0] = self.problem.objective is not None
        which, column = np.nonzero(near)

        def residual(places, i):
            return self._at(us[which[i]], self.envelope.values(places))[
                np.arange(len(i)), column[i]
            ]

        places[near], rows[near] = self.envelope.climb(
            residual, places[near], rows[near], self.options
        )
        return Evaluation(rows, places)

    def average(self, rows: np.ndarray, jacobians: np.ndarray):
        """The rows and Jacobians that a design must satisfy, from rows (m, 1 + k) at conditions."""
        return rows, jacobians

    def rows_for(self, u: np.ndarray) -> Rows:
        """The row (1 + k,) that counts, and its Jacobian, as a function of problem and design.

        Each column is at the condition that is worst for it in the design u (v,).
        """
        places = self.envelope.values(self.evaluate(u[None]).places[0])
        conditions, which = np.unique(places, axis=0, return_inverse=True)
        which = which.ravel()
        if (
            self.envelope is SINGLE_CONDITION
        ):  # one condition of all columns, also of those without a name
            which = np.zeros(len(self.problem.named_columns), int)
        columns = np.arange(len(which))

        def rows(problem, u):
            values, jacobians, _ = linearise(problem, *paired(u[None], conditions))
            return values[which, columns], jacobians[which, columns]

        return rows

    def exchange(self, us: np.ndarray, working: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Conditions (m, c) at which each of us (n, v) is worse than at all its working ones."""
        evaluation, new = self.evaluate(us), []
        counts = [len(conditions) for conditions in working]
        working_rows = self._at(np.repeat(us, counts, axis=0), np.concatenate(working))
        working_rows = working_rows[:, self.problem.named_columns]
        pieces = np.split(working_rows, np.cumsum(counts)[:-1])
        for rows, places, piece in zip(evaluation.rows, evaluation.places, pieces, strict=True):
            worse = rows > piece.max(axis=0) + self.options.excess
            worse[1:] &= rows[1:] > 0
            new.append(self.envelope.values(np.unique(places[worse], axis=0)))
        return new

    def _at(self, us, conditions):
        """Rows (n, 1 + k) of designs (n, v), each at a condition; infinite where undefined."""
        rows = evaluate(self.problem, us, conditions)
        return np.where(np.isnan(rows), np.inf, rows)

    def _at_all(self, us, conditions):
        """Rows (n, m, 1 + k) of every design at every condition."""
        rows = self._at(*paired(us, conditions))
        return rows.reshape(len(us), len(conditions), -1)


@dataclasses.dataclass(frozen=True)
class OnAverage(Evaluator):
    """An average of each requirement over fixed, equally likely conditions.

    `risk` is the temperature T of T ln sum exp(r/T), which is at least the largest residual, or
    weights (m,) of the ordered residuals.
    """

    places: np.ndarray = dataclasses.field(kw_only=True)
    risk: float | np.ndarray = dataclasses.field(kw_only=True)

    @property
    def working(self):
        return self.envelope.values(self.places)

    @property
    def minimax(self):
        return False

    def evaluate(self, us):
        each = self._at_all(us, self.working)
        rows = np.stack([self._average(rows)[0] for rows in each])
        return Evaluation(rows, self.places[each.argmax(axis=1)])

    def average(self, rows, jacobians):
        row, weights = self._average(rows)
        return row[None], np.einsum("mk,mkv->kv", weights, jacobians)[None]

    def rows_for(self, u):
        def rows(problem, u):
            values, jacobians, _ = linearise(problem, *paired(u[None], self.working))
            row, slopes = self.average(values, jacobians)
            return row[0], slopes[0]

        return rows

    def exchange(self, us, working):
        return [conditions[:0] for conditions in working]

    def _average(self, rows):
        """The average (1 + k,) of rows (m, 1 + k), and its derivative (m, 1 + k) by them."""
        row, weights = averaged(rows, self.risk)
        if self.problem.objective is None:
            row[0], weights[:, 0] = rows[0, 0], np.arange(len(rows)) == 0
        return row, weights


def make_evaluator(problem: DesignProblem, envelope: Envelope | None, risk: Any) -> Evaluator:
    """The evaluator of designs over the conditions of an envelope, with `risk` as in `design`."""
    match risk:
        case "worst":
            return Evaluator(problem, envelope or SINGLE_CONDITION)
        case "smooth":
            kind, number = "smooth", 0.02
        case ("smooth" as kind, temperature):
            number = float(scalar("temperature of risk", temperature, above=0))
        case ("cvar" as kind, alpha):
            number = float(scalar("alpha of risk", alpha, at_least=0, below=1))
        case _:
            raise ValueError(
                'risk must be "worst", "smooth", ("smooth", T) or ("cvar", alpha), got '
                + brief(risk)
            )
    if envelope is None:
        raise ValueError(f"risk {risk!r} needs an envelope")
    if kind == "smooth":
        return OnAverage(problem, envelope, places=envelope.coarse_grid(), risk=number)
    places = envelope.cells()
    weights = expected_shortfall(len(places), number)
    return OnAverage(problem, envelope, places=places, risk=weights)


def averaged(rows: np.ndarray, risk: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The average (k,) of rows (m, k) as in `OnAverage`, and their weights (m, k)."""
    if np.ndim(risk):
        weights = np.empty_like(rows)
        np.put_along_axis(weights, rows.argsort(axis=0), np.asarray(risk)[:, None], axis=0)
        with np.errstate(invalid="ignore"):  # infinite rows of weight 0
            return np.where(weights > 0, weights * rows, 0).sum(axis=0), weights
    largest = rows.max(axis=0)
    finite = np.isfinite(largest)  # an infinite value outweighs all others
    below = np.where(finite, rows, 0) - np.where(finite, largest, 0)
    shares = np.where(finite, np.exp(below / risk), ~(rows < largest))
    total = shares.sum(axis=0)
    return largest + risk * np.log(total), shares / total


def expected_shortfall(count: int, alpha: float) -> np.ndarray:
    """Weights (count,) of ordered, equally likely values: the mean of the worst 1 - alpha."""
    edges = np.clip(np.arange(count + 1) / count, alpha, 1)
    return np.diff(edges) / (1 - alpha)
