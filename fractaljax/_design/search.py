"""From screened starts onto the constraints, under one condition or the worst of many.

The worst case is found by exchange: a design is solved for a few working conditions; then the worst
of the whole envelope are sought, for each requirement, and where they are worse than the working
ones they join them, and it is solved again. (A. G. Blankenship and J. E. Falk, "Infinitely
constrained optimization problems", 1976.)
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .evaluator import Evaluation, Evaluator, OnAverage
from .functions import Functions, compressed, finite
from .joint_limits import make_joint_limits, restore_joint_limits
from .lockstep import in_lockstep
from .problem import DesignProblem
from .rows import linearise
from .solvers import Solver
from .starts import designs_near
from .trust_region import FINE, NEAR, ROUGH, SETTLED, Accuracy, Local, in_trust_region

_ROUNDS = 12  # of the exchange
_FEW = 2  # variables, in which a lattice of starts leaves nothing to restore
_RESTORING = 30  # steps from a start to where all requirements are met
# How many of many ways in a trust region go on, and how many of these to the end at once.
_KEPT, _KEPT_NEAR, _AT_ONCE = 8, 4, 2
_AGAIN, _AROUND = 12, 12  # rounds of new starts near the best end of such ways, and how many
# Gain of the objective that counts in such rounds; what is as good as the best; how many rounds
# without a gain are the last. One
# with several ends that agree with the best counts twice.
_GAINED, _AGREE, _IDLE, _SEVERAL = 1e-3, 1e-3, 3, 2


class Found(NamedTuple):
    """What a search ended with."""

    path: np.ndarray  # (s, v), to the best end
    evaluation: Evaluation  # of that
    starts: int
    failed: int
    least_growth: Any = None  # `limit.LeastGrowth`, where the growth rate is too large


def _least_violated(functions: Functions, start: np.ndarray) -> np.ndarray:
    """A design (v,) near `start` with the least sum of squares of its unmet requirements."""
    from scipy.optimize import least_squares

    def unmet(u):
        return np.maximum(functions.constraints(u)[0], 0)

    def slopes(u):
        residuals, jacobian = functions.constraints(u)
        return jacobian * (residuals > 0)[:, None]

    more: Any = {"jac": slopes, "bounds": (0, 1), "max_nfev": _RESTORING}
    return least_squares(unmet, np.clip(start, 1e-3, 1 - 1e-3), **more).x


@dataclasses.dataclass(frozen=True)
class Search:
    """Solves from many starts side by side."""

    evaluator: Evaluator
    solver: Solver | None  # None: in a trust region, for designs of many joints
    scale: float = 1.0  # of the objective
    rough: DesignProblem | None = None  # where steps in a trust region begin (`few_modes.py`)

    @property
    def slack(self) -> np.ndarray:
        """By how much (1 + k,) requirements are overfulfilled, so that rounding cannot undo them.

        Nor can a condition between those that an envelope was searched at.
        """
        problem = self.evaluator.problem
        slack = max(1e-6 if problem.robust else 1e-9, problem.rounding)
        # What stands for a growth rate far below the frequency varies with the square of both.
        return np.where(problem.named_columns, slack, 0.01 * slack)

    def best(self, starts: np.ndarray, progress: bool):
        """The way (s, v) to the best end of all, what it is, and how many starts (n, v) failed.

        The first of those whose ends are equally good: the given design leads the starts, and its
        way begins where the reader does. Last, ways and ends of `least_growth`, if all failed.
        """
        problem, lowest = self.evaluator.problem, None
        paths, evaluation = self._landed(starts, progress)
        plain = problem.cuts is None and problem.cycles is None
        if (evaluation.worst > 0).all():
            if plain and problem.modes:
                # Each landing of a structure takes long. With all else met no other design is as
                # close to the target.
                near = paths[int(evaluation.worst.argmin())][-1]
                lowest = self.least_growth([*starts, near])
                growth, unmet = self.split_residuals(lowest[1])
                least = int(np.where(unmet <= 0, growth, np.inf).argmin())
                if unmet[least] <= 0 < growth[least]:
                    return lowest[0][least], lowest[1].of(least), len(starts), lowest
            if lowest is None or not (lowest[1].worst <= 0).any():
                paths, evaluation = self._closest(paths, evaluation)
        failed = evaluation.worst > 0
        if failed.all():
            model = evaluation.residuals[:, : problem.model_residuals]
            best = int(np.lexsort((evaluation.worst, model.max(axis=1, initial=0)))[0])
            if lowest is None and plain:
                lowest = self.least_growth([*starts, paths[best][-1]])
            met = np.zeros(0, bool) if lowest is None else lowest[1].worst <= 0
            if lowest is None or not met.any():
                return paths[best], evaluation.of(best), len(starts), lowest
            # There is a design that meets all after all.
            chosen = np.flatnonzero(met).tolist()
            landed = self._land([lowest[0][i] for i in chosen])
            paths = [self._to_best(path) for path in landed]
            evaluation = self._ends(paths)
            failed = evaluation.worst > 0
        values = np.where(failed, np.inf, evaluation.values)
        best = int(np.flatnonzero(values <= values.min() + 1e-8 * abs(values.min()))[0])
        path, end, count = (
            paths[best],
            evaluation.of(best),
            max(len(starts) - int((~failed).sum()), 0),
        )
        # A solver may have stopped early: once more from where it is. What is better is often near.
        ways = [path] if self.solver else [np.array([*path, u]) for u in self._near(path[-1])]
        ways = self._land(ways, stages=[(self, FINE, len(ways))])
        ended = self._ends(ways)
        values = np.where(ended.worst > 0, np.inf, ended.values)
        best = int(values.argmin())
        if values[best] < end.values[0]:
            path, end = ways[best], ended.of(best)
        return path, end, count, None

    def _near(self, u: np.ndarray) -> list[np.ndarray]:
        """The best end (v,) of ways that begin near the best so far, and the one before it.

        The first is u. All in the rough problem, for as long as rounds gain.
        """
        rough, value, ends, idle = self._roughly, np.inf, [u], 0
        for again in range(_AGAIN):
            starts = designs_near(rough.evaluator.problem, ends[0], _AROUND, again)
            ways = [start[None] for start in (starts if again else [u, *starts])]
            stages = [(rough, NEAR, len(ways)), (rough, SETTLED, _KEPT_NEAR)]
            ended = np.array([way[-1] for way in rough._land(ways, stages=stages)])
            evaluation = rough.evaluator.evaluate(ended)
            values = np.where(evaluation.worst > 0, np.inf, evaluation.values)
            best, has_value = int(values.argmin()), bool(np.isfinite(value))
            gained = values[best] < (value - _GAINED * abs(value) if has_value else value)
            alike = has_value and np.isclose(values, value, rtol=_AGREE, atol=0).sum() >= _SEVERAL
            idle = 0 if gained else idle + 1 + alike
            if values[best] < value:
                value, ends = float(values[best]), [ended[best], *ends][:_AT_ONCE]
            if idle >= _IDLE:
                break
        return ends

    def _landed(self, starts, progress):
        """The ways from all starts, and what their ends are."""
        problem = self.evaluator.problem
        paths = self._land([start[None] for start in starts], progress=progress)
        evaluation = self._ends(paths)
        lost = np.flatnonzero(evaluation.worst > 0)
        if self.solver and len(lost) and len(problem.names) > _FEW:
            # Far from many requirements a solver may stop: first to where all are met.
            landed = self._land([starts[i][None] for i in lost], restored=True)
            for i, path in zip(lost, landed, strict=True):
                paths[i] = path
            evaluation = self._ends(paths)
        return paths, evaluation

    def _closest(self, paths, evaluation):
        """Ways of which none ends where all is met, on to as close as can be, and their ends.

        Inside the model, if that is possible, and there as close as can be to all the rest.
        """
        problem = self.evaluator.problem
        model = np.arange(len(problem.residual_names)) < problem.model_residuals
        # Into the model, on to the rest of the requirements, and if they hold to the objective.
        for violated in (model, ~model, None):
            outside = (evaluation.residuals[:, model] > 0).any(axis=1)
            going = evaluation.worst <= 0 if violated is None else outside == (violated is model)
            chosen = np.flatnonzero(going)
            landed = self._land([paths[i] for i in chosen], violated)
            for i, path in zip(chosen, landed, strict=True):
                paths[i] = path
            evaluation = self._ends(paths)
        return paths, evaluation

    def _to_best(self, path: np.ndarray) -> np.ndarray:
        """A way (s, v) up to the best design on it that meets every requirement, if any does."""
        evaluation = self.evaluator.evaluate(path)
        values = np.where(evaluation.worst <= 0, evaluation.values, np.inf)
        return path[: int(values.argmin()) + 1] if np.isfinite(values).any() else path

    def least_growth(self, starts: Sequence[np.ndarray]) -> tuple[list[np.ndarray], Evaluation]:
        """Ways (s, v) to the least growth rate with all else met, and what their ends are.

        The largest of all growth rates is minimised, whatever the target.
        """
        growing, others = self.evaluator.problem.growing, self.others
        paths = self._ways([start[None] for start in starts], growing, others)
        if self.solver is None:
            return paths, self._ends(paths)
        lost = np.flatnonzero(self.split_residuals(self._ends(paths))[1] > 0).tolist()
        again = [starts[i][None] for i in lost]
        for i, way in zip(lost, self._ways(again, growing, others, restored=True), strict=True):
            paths[i] = way
        return paths, self._ends(paths)

    def least_unmet(self, starts: Sequence[np.ndarray]) -> tuple[list[np.ndarray], Evaluation]:
        """As `least_growth`, to the least of the largest other residual, whatever grows."""
        others = self.others
        paths = self._ways([start[None] for start in starts], others, np.zeros_like(others))
        return paths, self._ends(paths)

    def split_residuals(self, evaluation: Evaluation) -> tuple[np.ndarray, np.ndarray]:
        """The largest residuals (n,) of growth rates, and of all other requirements."""
        k = evaluation.rows.shape[1]
        masks = self.evaluator.problem.growing, self.others
        growing, others = (evaluation.rows[:, mask[:k]] for mask in masks)
        return growing.max(axis=1), others.max(axis=1, initial=-np.inf)

    @property
    def others(self) -> np.ndarray:
        """Which columns of a row are requirements, but of growth rates."""
        others = self.evaluator.problem.named_columns & ~self.evaluator.problem.growing
        others[0] = False  # the objective
        return others

    def _ends(self, paths) -> Evaluation:
        return self.evaluator.evaluate(np.array([path[-1] for path in paths]))

    def _land(self, paths, violated=None, progress=False, restored=False, stages=None):
        """Ways (s, v) continued to the least objective that meets every requirement.

        With some requirements (k,) marked as violated, to the least of their largest residual that
        meets those before them. If `restored`, by the nearest design that violates all the least.
        """
        problem = self.evaluator.problem
        is_named = problem.named_columns
        columns = np.arange(len(is_named))
        aim, limited = columns == 0, problem.limited
        if violated is not None:
            aim[is_named] = np.append(False, violated)
            limited = is_named & (columns > 0) & (columns < aim.argmax())
        elif problem.least_growth:
            # The largest of many modes has kinks where they change places; each has none.
            aim = ~is_named
        return self._ways(paths, aim, limited, progress, restored, stages)

    def _ways(self, paths, aim, limited, progress=False, restored=False, stages=None):
        """Ways continued to the least of the columns in `aim` with those in `limited` met.

        Of many in a trust region the most promising alone go on to the end: of `stages`, each is a
        search, how accurate, and how many go through it.
        """
        from tqdm import tqdm

        def run(search, paths, how):
            with tqdm(total=len(paths), desc="design", unit="start", disable=not progress) as bar:

                def task(path, ask):
                    way = search._continued(path, aim, limited, ask, how)
                    bar.update()
                    return way

                tasks = [functools.partial(task, path) for path in paths]
                ways = in_lockstep(tasks, search._answer)
            if search is self:
                return ways
            # A way shows what was evaluated in the whole problem.
            ends = zip(paths, ways, strict=True)
            return [(np.concatenate([path, way[-1:]]), merit) for path, (way, merit) in ends]

        if self.solver:
            return [path for path, _ in run(self, paths, restored)]
        if stages is None:
            rough = self._roughly
            # From the end of the rough problem it is not far: fewer need go on.
            stages = [(rough, ROUGH, len(paths)), (rough, SETTLED, _KEPT), (self, FINE, _AT_ONCE)]
        ways = [(path, 0.0) for path in paths]
        for search, accuracy, count in stages:
            best = np.argsort([merit for _, merit in ways], kind="stable")[:count].tolist()
            ended = run(search, [ways[i][0] for i in best], accuracy)
            for i, end in zip(best, ended, strict=True):
                ways[i] = end
        return [path for path, _ in ways]

    @property
    def _roughly(self) -> "Search":
        """The search in the rough problem, if there is one."""
        if self.rough is None:
            return self
        evaluator = dataclasses.replace(self.evaluator, problem=self.rough)
        return dataclasses.replace(self, evaluator=evaluator, rough=None)

    def _continued(self, path, aim, limited, ask, how):
        """One way, continued by asking for rows and for new conditions, and its merit."""
        path, working = list(path), self.evaluator.working
        extra, merit = not aim[0] or self.evaluator.minimax, 0.0
        for _ in range(_ROUNDS):

            def rows_at(u, working=working):
                return ask((self._linearise, u, working))

            functions = Functions(rows_at, aim, limited, self.slack, self.scale, extra)
            if self.solver:
                end = self._solved(functions, path[-1], how)
            else:
                end, merit = self._stepped(functions, path[-1], how, working, ask)
            path += [*functions.evaluated, end]
            new = ask((self.evaluator.exchange, path[-1], working))
            if not len(new):
                break
            working = np.concatenate([working, new])
        return np.array(path), merit

    def _solved(self, functions: Functions, start: np.ndarray, restored: bool) -> np.ndarray:
        """Where the solver ends, perhaps from the nearest design that violates all the least."""
        v, bounds = len(start), np.tile([0.0, 1.0], (len(start), 1))
        if restored:
            start = _least_violated(dataclasses.replace(functions, extra=False), start)
        if functions.extra:
            largest = functions.at(np.append(start, 0))[0][:, functions.aim].max()
            start = np.append(start, largest)
            bounds = np.append(bounds, [[-np.inf, np.inf]], axis=0)
        solver: Any = self.solver
        z = solver(functions.objective, functions.constraints, start, bounds)
        return np.clip(np.asarray(z, float)[:v], 0, 1)

    def _stepped(self, functions: Functions, start, accuracy: Accuracy, working, ask):
        """Where steps in a trust region end, and what is left there to lower.

        The limits of joints are those at the working conditions (m, c).
        """
        problem, extra, v = self.evaluator.problem, functions.extra, len(start)
        functions = dataclasses.replace(functions, extra=False)
        exact = problem.joint_columns
        # An average over conditions is of rows; and where a limit is the aim it is not yet met.
        average = isinstance(self.evaluator, OnAverage)
        keep = not average and bool(functions.limited[exact].all())
        aimed, limited = functions.aim & extra, functions.limited & ~(exact & keep)

        def at(u):
            rows, slopes = functions.at(u)
            unmet = (rows + functions.slack)[:, limited].ravel()
            return Local(
                0.0 if extra else float(rows[0, 0]),
                np.zeros(v) if extra else slopes[0, 0],
                rows[:, aimed].ravel(),
                slopes[:, aimed].reshape(-1, v),
                *compressed(unmet, slopes[:, limited].reshape(-1, v)),
            )

        slack = self.slack.max()

        def limits(u):
            if not keep:
                return np.zeros(0), np.zeros((0, v))
            residuals, slopes = ask((self._limits, u, working))
            residuals, slopes = finite(residuals, slopes)
            return compressed(residuals + slack, slopes)

        if keep and limits(start)[0].max() > 0:
            start = restore_joint_limits(problem, start[None], working)[0]
        # A distance gives up little for a growth rate.
        distance = not extra and problem.objective is None
        curvature, penalty = (2.0 / self.scale, 2.0) if distance else (0.0, 10.0)
        met = float(np.min(np.broadcast_to(functions.slack, limited.shape)[limited], initial=1) / 2)
        end = in_trust_region(at, limits, start, curvature, accuracy, penalty, met)
        return end, at(end).merit(1.0)

    def _answer(self, questions):
        """What (method, design (v,), working conditions (m, c)) ask, each method once for all.

        What takes no eigenvalues first: more tasks then ask together for what does.
        """
        methods = [self._linearise, self.evaluator.exchange]
        if any(question[0] == self._limits for question in questions.values()):
            methods = [self._limits]
        replies: dict[int, Any] = {}
        for method in methods:
            tasks = [i for i, question in questions.items() if question[0] == method]
            if tasks:
                us, working = zip(*(questions[i][1:] for i in tasks), strict=True)
                replies |= zip(tasks, method(np.array(us), working), strict=True)
        return replies

    def _linearise(self, us, working):
        """Rows and Jacobians of each of us (n, v) at its working conditions."""
        linearised = functools.partial(linearise, self.evaluator.problem)
        return [self.evaluator.average(*piece) for piece in _at_each(linearised, us, working)]

    def _limits(self, us, working):
        """Residuals of joints and their slopes, of each of us (n, v) at its working conditions."""
        pieces = _at_each(self._limits_of_joints, us, working)
        return [(r.ravel(), slopes.reshape(-1, us.shape[1])) for r, slopes in pieces]

    @functools.cached_property
    def _limits_of_joints(self):
        return make_joint_limits(self.evaluator.problem)


def _at_each(function, us, working) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values and slopes of each of us (n, v) at its own conditions (m, c), in one call."""
    counts = [len(conditions) for conditions in working]
    arrays = function(np.repeat(us, counts, axis=0), np.concatenate(working))[:2]
    pieces = (np.split(x, np.cumsum(counts)[:-1]) for x in arrays)
    return list(zip(*pieces, strict=True))
