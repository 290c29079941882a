"""Trade-offs: the designs at which one objective cannot fall unless another one rises.

The second objective becomes a requirement, at most a limit. A family of limits between its least
value and its value where the first objective is least gives the front (epsilon-constraint).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._base.parts import Record, brief, flag, scalar, whole
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import replaced
from .constraints import Constraint
from .design import Design, default_solver, design, designs_to_screen, state_problem
from .evaluator import Evaluator
from .problem import DesignProblem
from .rows import describe
from .search import Search


class Front(Record):
    """What `pareto` returns, ordered from the least first to the least second objective."""

    first: np.ndarray  # (n,), in the units of the objectives
    second: np.ndarray  # (n,)
    quantities: Mapping[str, np.ndarray]  # (n,) each: D and G of a surface, all that is designed
    names: tuple[str, str]  # of the two objectives
    ends: tuple[Design, Design]  # the designs for either objective alone
    failed: int  # members of the family without a design that meets every requirement

    def scene(self, i: int) -> Any:
        """The scene or structure of member `i`, from 0."""
        values = {name: column[i] for name, column in self.quantities.items()}
        return replaced(self.ends[0].initial, values)

    @property
    def D(self) -> np.ndarray:
        """(n,)"""
        return self.quantities["D"]

    @property
    def G(self) -> np.ndarray:
        """(n,) [m]"""
        return self.quantities["G"]


class _Second(Constraint):
    """The second objective as a requirement, in units of its range."""

    scale: Float[Array, ""]
    objective: Callable[[Any], Any] = eqx.field(static=True)

    symbol: ClassVar[str] = "second objective"
    domain: ClassVar[dict[str, float]] = {}

    def __init__(self, objective, at_most, scale):
        super().__init__(at_most=at_most)
        self.objective, self.scale = objective, scalar("scale", scale, above=0)

    def measure(self, scene):
        return self.objective(scene)

    def above(self, value):
        return (value - self.at_most) / self.scale


def pareto(
    x: Mechanism,
    first: Callable[[Any], Any],
    second: Callable[[Any], Any],
    *,
    points: int = 16,
    names: Sequence[str] = ("first objective", "second objective"),
    progress: bool = True,
    **options: Any,
) -> Front:
    """The front of two objectives, both functions of a scene or structure that are minimised.

    **Arguments:**

    - `x`: the scene or structure, as in `design`.
    - `first`, `second`: functions of a mechanism that `jax` can differentiate.
    - `points`: members of the front, with its two ends; 16 by default, at least three.
    - `names`: of the two objectives, for tables and pictures.
    - `progress`: shows a bar.
    - `options`: those of `design`, except `objective`, `starts`, `envelope`, `risk` and
      `quiet_within`: bounds, target, K_n_min, constraints, tolerance and so on hold for every
      member.

    **Returns:** a `Front`.

    **Raises:** `ValueError` for fewer than three points, where no design meets the requirements,
    for objectives without a trade-off, and as `design`.
    """
    from tqdm import tqdm

    points = whole("points", points, 3, 1000)
    if not (isinstance(names, (tuple, list)) and len(names) == 2):
        raise TypeError(f"names must be those of both objectives, got {brief(names)}")
    for name, objective in zip(("first", "second"), (first, second), strict=True):
        if not callable(objective):
            raise TypeError(f"{name} must be a function of a scene, got {brief(objective)}")
    progress = flag("progress", progress)
    refused = {"objective", "starts", "envelope", "risk", "quiet_within"} & set(options)
    if refused:
        raise ValueError(f"pareto does not take {', '.join(sorted(refused))}")
    arguments: dict[str, Any] = {**options, "progress": False}
    ends = design(x, objective=first, **arguments), design(x, objective=second, **arguments)
    for name, end in zip(names, ends, strict=True):
        if end.violated:
            raise ValueError(
                f"no design meets every requirement, seen at the least {name}: "
                f"{', '.join(end.violated)}"
            )
    made: dict[str, Any] = {**ends[0].options}

    def problem_at(limit: float, scale: float) -> DesignProblem:
        constraints: Any = (*made["constraints"], _Second(second, limit, scale))
        return state_problem(x, made | {"constraints": constraints})

    problem = problem_at(0.0, 1.0)
    places = np.stack([problem.scaled(end.scene) for end in ends])
    rows = Evaluator(problem).evaluate(places).rows
    (high, low), scale = rows[:, -1].tolist(), float(np.ptp(rows[:, 0])) or 1.0
    # Ends are found to the solver's tolerance; at either of equal ends both objectives are least.
    if not high > low or _equal(high, low) or _equal(*rows[:, 0].tolist()):
        raise ValueError(f"the least {names[0]} and the least {names[1]} are one design")
    _, designs = designs_to_screen(problem, None, made["lattice"])
    screening = Evaluator(problem).evaluate(designs)
    solver = made["solver"] or default_solver(problem)
    members = []
    for share in tqdm(np.linspace(1, 0, points), desc="pareto", disable=not progress):
        limit = low + share * (high - low)
        residuals = np.column_stack(
            [screening.residuals[:, :-1], (screening.residuals[:, -1] - limit) / (high - low)]
        )
        merit = screening.values / scale + 10 * np.maximum(residuals, 0).sum(axis=1)
        promising = designs[np.argsort(np.nan_to_num(merit, nan=np.inf), kind="stable")]
        between = share * places[0] + (1 - share) * places[1]
        starts = np.concatenate([places, between[None], promising[:3]])
        evaluator = Evaluator(problem_at(limit, high - low))
        search = Search(evaluator, solver, scale, options=made["search"])
        path, *_ = search.best(starts, progress=False)
        # The last limit leaves no room for the slack: there is the second end alone.
        us = np.stack([path[-1], *places])
        ends_here = evaluator.evaluate(us)
        meets = ends_here.worst <= 0
        if meets.any():
            u = us[np.where(meets, ends_here.values, np.inf).argmin()]
            members.append((*Evaluator(problem).evaluate(u[None]).rows[0, (0, -1)].tolist(), u))
    best = sorted(
        (member for member in members if not any(_beats(other, member) for other in members)),
        key=lambda member: member[0],
    )
    first_values, second_values, us = (np.array(column) for column in zip(*best, strict=True))
    numbers = describe(problem, us)
    shown = [name for name in ("D", "G", *problem.names) if name in numbers]
    return Front(
        first=first_values,
        second=second_values,
        quantities={name: numbers[name] for name in shown},
        names=(names[0], names[1]),
        ends=ends,
        failed=points - len(members),
    )


def _equal(one: float, other: float) -> bool:
    """True if two values of an objective differ by no more than its error."""
    return abs(one - other) <= 1e-6 * max(abs(one), abs(other))


def _beats(other, member) -> bool:
    """True if `other` is as good in the first objective and better in the second."""
    return other[0] <= member[0] and other[1] < member[1]
