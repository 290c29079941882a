"""How a design moves with all that it holds fixed, and what its requirements cost.

At an optimum the slope of the Lagrangian is zero and the active residuals are. Both stay so while
the active set does: a linear system gives the change of the design and of the multipliers. (A. V.
Fiacco, "Introduction to sensitivity and stability analysis in nonlinear programming", 1983, section
3.2.) Its matrix takes second derivatives, which are differences of the Jacobians that the
search has compiled.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import numpy as np

from .._base.parts import Record
from .._base.table import aligned
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import replaced, target_quantities, unit, value_of
from .._mechanism.structure import Structure
from .evaluator import Evaluator, OnAverage
from .problem import DesignProblem


class Sensitivity(Record):
    """How a design moves with each quantity that it holds fixed: `sensitivity["D"]["P"]` is dD/dP.

    SI units. What follows the mechanism by default follows it here too: the target, and a K_n_min
    that is the mechanism's own. All is of the requirements that are active: the slopes change where
    these do, which `ranges` foretell by them.
    """

    slopes: Mapping[str, Mapping[str, float]]  # by designed, then by held quantity
    # d(value)/d(residual) of each active requirement and bound: what tightening it would cost.
    multipliers: Mapping[str, float]
    ranges: Mapping[str, tuple[float, float]]  # of each held quantity, for the same active set
    x: Mechanism = eqx.field(repr=False)  # the mechanism designed

    def __getitem__(self, name: str) -> Mapping[str, float]:
        return self.slopes[name]

    def __repr__(self) -> str:
        held = {name: float(value_of(self.x, name)) for name in self.ranges}
        changes = {
            name: {each: 0.01 * held[each] * slope for each, slope in slopes.items()}
            for name, slopes in self.slopes.items()
        }
        sizes = {name: abs(float(value_of(self.x, name))) or 1.0 for name in changes}
        weight = {
            each: max(abs(changes[name][each]) / sizes[name] for name in sizes) for each in held
        }
        lines = [["", *(f"{name} by 1 % more" for name in changes), "same requirements active"]]
        for each in sorted(weight, key=lambda name: -weight[name])[:6]:
            title = f"{each} [{unit(self.x, each)}]".replace(" [-]", "")
            low, high = self.ranges[each]
            cells = [f"{changes[name][each]:+.3g}" for name in changes]
            lines.append([f"{title} = {held[each]:.6g}", *cells, f"{low:.4g} to {high:.4g}"])
        costs = ", ".join(f"{name}: {cost:.3g}" for name, cost in self.multipliers.items())
        return "\n".join([aligned(lines), f"multipliers: {costs or 'none'}"])


def design_sensitivity(
    x: Mechanism,
    designed: Mechanism,
    state: Callable[[Mechanism], DesignProblem],
    evaluator: Evaluator,
) -> Sensitivity | None:
    """How the design of x moves; `state` states the problem of another x.

    None where it cannot be told: where the conditions of an optimum do not hold, as at a kink, and
    where a requirement is at its worst inside of an envelope, at a condition that would move too.
    """
    problem = evaluator.problem
    u = problem.scaled(designed)
    rows = evaluator.rows_for(u)
    # What stands for a growth rate is not evaluated over an envelope.
    columns = np.flatnonzero(problem.named_columns)[1:]
    if not problem.conditions:
        columns = np.flatnonzero(problem.limited)
    row, jacobian = rows(problem, u)
    c, A = row[columns], jacobian[columns]
    optimal = _multipliers(jacobian[0], c, A, u)
    if optimal is None:
        return None
    multipliers, low, high = optimal
    active, free = multipliers > 0, ~((low > 0) | (high > 0))
    if problem.conditions and not isinstance(evaluator, OnAverage):
        places = evaluator.evaluate(u[None]).places[0][columns][active, 1:]
        if ((places > 0) & (places < 1)).any():
            return None

    def slopes(problem, u) -> np.ndarray:
        """The slope of the Lagrangian (v,) and the residuals (k,)."""
        row, jacobian = rows(problem, u)
        return np.concatenate([jacobian[0] + multipliers @ jacobian[columns], row[columns]])

    v, k = len(u), int(active.sum())
    # A step: of a variable in its bounds, of a quantity as a share of it.
    size = float(np.finfo(problem.low.dtype).eps) ** 0.25
    H = np.zeros((v, v))
    for j, direction in enumerate(np.eye(v)):
        for step, weight in ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12)):
            H[:, j] += weight / size * slopes(problem, u + step * size * direction)[:v]
    H = np.where(np.outer(free, free), H, np.diag(1.0 - free))
    K = np.block([[H, (A[active] * free).T], [A[active] * free, np.zeros((k, k))]])
    values = {name: float(value_of(designed, name)) for name in problem.names}
    span = np.asarray(problem.high - problem.low, float).tolist()
    changes: dict[str, dict[str, float]] = {name: {} for name in problem.names}
    ranges, quantities = {}, x.stored_quantities()
    for name in _held(x, problem):
        by = _difference(lambda x: slopes(state(x), u), x, name, size)
        if by is None:
            continue
        by_slope, by_c = by[:v], by[v:]
        right = -np.concatenate([by_slope * free, by_c[active]])
        solution = np.linalg.lstsq(K, right, rcond=None)[0]
        du, dm = solution[:v] * free, solution[v:]
        for i, each in enumerate(problem.names):
            unit_size = span[i] * (values[each] if problem.logarithmic[i] else 1.0)
            changes[each][name] = float(unit_size * du[i])
        # Each is at most 0; where the first becomes 0, other requirements are active.
        numbers = np.concatenate([c[~active], -multipliers[active], -u[free], u[free] - 1])
        rates = [by_c[~active] + A[~active] @ du, -dm, -du[free], du[free]]
        begin, end = _range(float(value_of(x, name)), numbers, np.concatenate(rates))
        ranges[name] = (max(begin, 0.0) if quantities[name].log else begin), end
    costs = _named(problem, columns, multipliers, jacobian)
    bounds = [*zip(problem.names, low, high, strict=True)]
    costs |= {f"{name} >= lower bound": float(m) for name, m, _ in bounds if m > 0}
    costs |= {f"{name} <= upper bound": float(m) for name, _, m in bounds if m > 0}
    return Sensitivity(slopes=changes, multipliers=costs, ranges=ranges, x=designed)


def _multipliers(
    slope, c, A, u, near: float = 1e-5
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Multipliers of residuals (k,), of lower and of upper bounds (v,); None if they do not fit.

    A residual or a bound within `near` of its limit may be active.
    """
    from scipy.optimize import nnls

    v, active = len(u), np.abs(c) <= near
    low, high = u <= near, u >= 1 - near
    matrix = np.concatenate([A[active], -np.eye(v)[low], np.eye(v)[high]]).T
    size = float(np.abs(slope).max())
    solution = np.zeros(matrix.shape[1])
    if size > 0:
        solution = nnls(matrix, -slope / size)[0] * size if matrix.size else solution
        if np.linalg.norm(matrix @ solution + slope) > 1e-3 * size:
            return None
    by_c, by_low, by_high = np.zeros(len(c)), np.zeros(v), np.zeros(v)
    first, second = int(active.sum()), int(active.sum() + low.sum())
    by_c[active], by_low[low], by_high[high] = (
        solution[:first],
        solution[first:second],
        solution[second:],
    )
    return by_c, by_low, by_high


def _held(x: Mechanism, problem: DesignProblem) -> list[str]:
    """The quantities that neither the design nor the envelope moves."""
    quantities = x.stored_quantities()
    names = [name for name in quantities if quantities[name].value is not None]
    if isinstance(x, Structure):  # a plain name is that of several joints
        names = [name for name in names if "." in name or name in x.parameters]
    varied = {
        each
        for name in (*problem.names, *problem.conditions)
        for each in target_quantities(x, name)
    }
    return [name for name in names if name not in varied]


def _difference(
    function: Callable[[Any], np.ndarray], x: Mechanism, name: str, size: float
) -> np.ndarray | None:
    """The derivative of a function of x by a quantity; None where x may not have another one."""
    value = float(value_of(x, name))
    step = size * (abs(value) or 1.0)
    # Second order is enough, for there are many quantities.
    central, one_sided = {-1: -0.5, 1: 0.5}, {0: -1.5, 1: 2.0, 2: -0.5}
    for steps, sign in ((central, 1), (one_sided, 1), (one_sided, -1)):
        try:
            changed = {n: replaced(x, {name: value + sign * n * step}) for n in steps}
        except ValueError:  # outside its domain
            continue
        parts = [w / (sign * step) * function(changed[n]) for n, w in steps.items()]
        return np.sum(parts, axis=0)
    return None


def _range(value: float, numbers: np.ndarray, rates: np.ndarray) -> tuple[float, float]:
    """From where to where, around a value, numbers that are at most 0 there stay so."""
    with np.errstate(divide="ignore", invalid="ignore"):
        changes = -np.minimum(numbers, 0) / rates  # that make each number 0
    least = changes[rates < 0].max(initial=-np.inf)
    return value + float(least), value + float(changes[rates > 0].min(initial=np.inf))


def _named(problem: DesignProblem, columns, multipliers, jacobian) -> dict[str, float]:
    """Multipliers by requirement: those of smooth residuals as of the growth rates they stand for.

    Where a growth rate is at its target, both have slopes of one direction.
    """
    names, growing = problem.residual_names, problem.growth_columns
    costs: dict[str, float] = {}
    for column, multiplier in zip(columns.tolist(), multipliers.tolist(), strict=True):
        if not multiplier > 0:
            continue
        if problem.named_columns[column]:
            name = names[column - 1]
        else:
            slope, rates = jacobian[column], jacobian[growing]
            sizes = np.maximum((rates**2).sum(axis=1), np.finfo(float).tiny)
            along = rates @ slope / np.sqrt(sizes)
            best = int(along.argmax())
            name = names[growing.start + best - 1]
            multiplier *= float(along[best] / np.sqrt(sizes[best]))
        costs[name] = costs.get(name, 0.0) + multiplier
    return costs
