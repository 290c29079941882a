"""From screened starts to the best designs, under one condition or the worst of many.

The worst case is sought by exchange: a design is optimised for a few working conditions; then the
worst of the whole envelope are sought, for each requirement, and where they are worse than the
working ones they join them, and it is optimised again. (A. G. Blankenship and J. E. Falk,
"Infinitely constrained optimization problems", 1976.)
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .design_search import DesignSearch
from .evaluator import Evaluation, Evaluator, OnAverage
from .functions import Functions, compressed, finite
from .joint_limits import make_joint_limits, restore_joint_limits
from .lockstep import run_in_lockstep
from .problem import DesignProblem
from .rows import linearise
from .solvers import Solver
from .starts import renew_starts
from .trust_region import Local, Stages, TrustRegion, minimise_in_trust_region


class SearchResult(NamedTuple):
    """How a search ended."""

    path: np.ndarray  # (s, v), to the best end
    evaluation: Evaluation  # of that
    starts: int
    failed: int
    least_growth: Any = None  # `limit.LeastGrowth`, where the growth rate is too large


def _restore_feasibility(functions: Functions, start: np.ndarray, steps: int) -> np.ndarray:
    """A design (v,) near `start` with the least sum of squares of its unmet requirements."""
    from scipy.optimize import least_squares

    def unmet(u):
        return np.maximum(functions.constraints(u)[0], 0)

    def slopes(u):
        residuals, jacobian = functions.constraints(u)
        return jacobian * (residuals > 0)[:, None]

    more: Any = {"jac": slopes, "bounds": (0, 1), "max_nfev": steps}
    return least_squares(unmet, np.clip(start, 1e-3, 1 - 1e-3), **more).x


@dataclasses.dataclass(frozen=True)
class Search:
    """Solves from many starts side by side."""

    evaluator: Evaluator
    solver: Solver | None  # None: in a trust region, for designs of many joints
    scale: float = 1.0  # of the objective
    rough: DesignProblem | None = None  # where steps in a trust region begin (`few_modes.py`)
    options: DesignSearch = DesignSearch()
    stages: Stages = Stages()  # of steps in a trust region

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
        """The path (s, v) to the best end, its evaluation, and how many starts (n, v) failed.

        Where ends are equally good the first path is taken: the initial design leads the starts.
        The last result is that of `least_growth`, if all failed.
        """
        problem, lowest = self.evaluator.problem, None
        paths, evaluation = self._solve_from(starts, progress)
        plain = problem.cuts is None and problem.cycles is None
        if (evaluation.worst > 0).all():
            if plain and problem.modes:
                # Each path of a structure takes long. With all else met no other design is as
                # close to the target.
                near = paths[int(evaluation.worst.argmin())][-1]
                lowest = self.least_growth([*starts, near])
                growth, unmet = self.split_residuals(lowest[1])
                least = int(np.where(unmet <= 0, growth, np.inf).argmin())
                if unmet[least] <= 0 < growth[least]:
                    return lowest[0][least], lowest[1].select(least), len(starts), lowest
            if lowest is None or not (lowest[1].worst <= 0).any():
                paths, evaluation = self._approach_feasibility(paths, evaluation)
        failed = evaluation.worst > 0
        if failed.all():
            model = evaluation.residuals[:, : problem.model_residuals]
            best = int(np.lexsort((evaluation.worst, model.max(axis=1, initial=0)))[0])
            if lowest is None and plain:
                lowest = self.least_growth([*starts, paths[best][-1]])
            met = np.zeros(0, bool) if lowest is None else lowest[1].worst <= 0
            if lowest is None or not met.any():
                return paths[best], evaluation.select(best), len(starts), lowest
            # There is a design that meets all after all.
            chosen = np.flatnonzero(met).tolist()
            continued = self._minimise([lowest[0][i] for i in chosen])
            paths = [self._cut_at_best(path) for path in continued]
            evaluation = self._evaluate_ends(paths)
            failed = evaluation.worst > 0
        values = np.where(failed, np.inf, evaluation.values)
        best = int(np.flatnonzero(values <= values.min() + 1e-8 * abs(values.min()))[0])
        path, end, count = (
            paths[best],
            evaluation.select(best),
            max(len(starts) - int((~failed).sum()), 0),
        )
        # A solver may have stopped early: once more from where it is. What is better is often near.
        paths = [path] if self.solver else [np.array([*path, u]) for u in self._renew(path[-1])]
        paths = self._minimise(paths, stages=[(self, self.stages.fine, len(paths))])
        ended = self._evaluate_ends(paths)
        values = np.where(ended.worst > 0, np.inf, ended.values)
        best = int(values.argmin())
        if values[best] < end.values[0]:
            path, end = paths[best], ended.select(best)
        return path, end, count, None

    def _renew(self, u: np.ndarray) -> list[np.ndarray]:
        """The best end (v,) of paths that begin near the best so far, and the one before it.

        The first is u. All are of the rough problem. Rounds go on for as long as they gain.
        """
        rough, options, value, ends, idle = self._rough_search, self.options, np.inf, [u], 0
        for i in range(options.renewals):
            starts = renew_starts(rough.evaluator.problem, ends[0], options.renewed_starts, i)
            paths = [start[None] for start in (starts if i else [u, *starts])]
            stages = [(rough, self.stages.near, len(paths))]
            stages.append((rough, self.stages.settled, options.renewed_paths))
            ended = np.array([path[-1] for path in rough._minimise(paths, stages=stages)])
            evaluation = rough.evaluator.evaluate(ended)
            values = np.where(evaluation.worst > 0, np.inf, evaluation.values)
            best, has_value, rtol = int(values.argmin()), np.isfinite(value), options.renewal_gain
            gained = values[best] < (value - rtol * abs(value) if has_value else value)
            agree = bool(has_value and np.isclose(values, value, rtol=rtol, atol=0).sum() >= 2)
            idle = 0 if gained else idle + 1 + agree
            if values[best] < value:
                value, ends = float(values[best]), [ended[best], *ends][: options.finished_paths]
            if idle >= options.idle_renewals:
                break
        return ends

    def _solve_from(self, starts, progress):
        """The paths from all starts, and the evaluation of their ends."""
        problem = self.evaluator.problem
        paths = self._minimise([start[None] for start in starts], progress=progress)
        evaluation = self._evaluate_ends(paths)
        lost = np.flatnonzero(evaluation.worst > 0)
        # In one or two variables the lattice of starts leaves nothing to restore.
        if self.solver and len(lost) and len(problem.names) > 2:
            # Far from many requirements a solver may stop: first to where all are met.
            restored = self._minimise([starts[i][None] for i in lost], restored=True)
            for i, path in zip(lost, restored, strict=True):
                paths[i] = path
            evaluation = self._evaluate_ends(paths)
        return paths, evaluation

    def _approach_feasibility(self, paths, evaluation):
        """Paths to designs that violate as little as possible, and the evaluation of their ends.

        They go inside the model, if that is possible, and there as close to the rest as possible.
        """
        problem = self.evaluator.problem
        model = np.arange(len(problem.residual_names)) < problem.model_residuals
        # Into the model, on to the rest of the requirements, and if they hold to the objective.
        for violated in (model, ~model, None):
            outside = (evaluation.residuals[:, model] > 0).any(axis=1)
            going = evaluation.worst <= 0 if violated is None else outside == (violated is model)
            chosen = np.flatnonzero(going)
            continued = self._minimise([paths[i] for i in chosen], violated)
            for i, path in zip(chosen, continued, strict=True):
                paths[i] = path
            evaluation = self._evaluate_ends(paths)
        return paths, evaluation

    def _cut_at_best(self, path: np.ndarray) -> np.ndarray:
        """A path (s, v) up to the best design on it that meets every requirement, if any does."""
        evaluation = self.evaluator.evaluate(path)
        values = np.where(evaluation.worst <= 0, evaluation.values, np.inf)
        return path[: int(values.argmin()) + 1] if np.isfinite(values).any() else path

    def least_growth(self, starts: Sequence[np.ndarray]) -> tuple[list[np.ndarray], Evaluation]:
        """Paths (s, v) to the least growth rate with all else met, and how they end.

        The largest of all growth rates is minimised, whatever the target.
        """
        growing, others = self.evaluator.problem.growing, self.others
        paths = self._continue([start[None] for start in starts], growing, others)
        if self.solver is None:
            return paths, self._evaluate_ends(paths)
        lost = np.flatnonzero(self.split_residuals(self._evaluate_ends(paths))[1] > 0).tolist()
        restored = [starts[i][None] for i in lost]
        restored = self._continue(restored, growing, others, restored=True)
        for i, path in zip(lost, restored, strict=True):
            paths[i] = path
        return paths, self._evaluate_ends(paths)

    def least_unmet(self, starts: Sequence[np.ndarray]) -> tuple[list[np.ndarray], Evaluation]:
        """As `least_growth`, to the least of the largest other residual, whatever grows."""
        others = self.others
        paths = self._continue([start[None] for start in starts], others, np.zeros_like(others))
        return paths, self._evaluate_ends(paths)

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

    def _evaluate_ends(self, paths) -> Evaluation:
        return self.evaluator.evaluate(np.array([path[-1] for path in paths]))

    def _minimise(self, paths, violated=None, progress=False, restored=False, stages=None):
        """Paths (s, v) continued to the least objective that meets every requirement.

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
        return self._continue(paths, aim, limited, progress, restored, stages)

    def _continue(self, paths, aim, limited, progress=False, restored=False, stages=None):
        """Paths continued to the least of the columns in `aim` with those in `limited` met.

        In a trust region only the most promising go on to the end. Each of `stages` is a search,
        its steps, and how many paths go through it.
        """
        from tqdm import tqdm

        def run(search, paths, setting):
            with tqdm(total=len(paths), desc="design", unit="start", disable=not progress) as bar:

                def task(path, ask):
                    result = search._continue_one(path, aim, limited, ask, setting)
                    bar.update()
                    return result

                tasks = [functools.partial(task, path) for path in paths]
                results = run_in_lockstep(tasks, search._answer)
            if search is self:
                return results
            # A path shows what was evaluated in the whole problem.
            pairs = zip(paths, results, strict=True)
            return [(np.concatenate([path, rough[-1:]]), merit) for path, (rough, merit) in pairs]

        if self.solver:
            return [path for path, _ in run(self, paths, restored)]
        if stages is None:
            rough, steps, options = self._rough_search, self.stages, self.options
            stages = [(rough, steps.rough, len(paths))]
            stages.append((rough, steps.settled, options.settled_paths))
            # From the end of the rough problem it is not far: fewer need go on.
            stages.append((self, steps.fine, options.finished_paths))
        results = [(path, 0.0) for path in paths]
        for search, steps, count in stages:
            best = np.argsort([merit for _, merit in results], kind="stable")[:count].tolist()
            continued = run(search, [results[i][0] for i in best], steps)
            for i, result in zip(best, continued, strict=True):
                results[i] = result
        return [path for path, _ in results]

    @property
    def _rough_search(self) -> "Search":
        """The search in the rough problem, if there is one."""
        if self.rough is None:
            return self
        evaluator = dataclasses.replace(self.evaluator, problem=self.rough)
        return dataclasses.replace(self, evaluator=evaluator, rough=None)

    def _continue_one(self, path, aim, limited, ask, setting):
        """One path, continued by asking for rows and for new conditions, and its merit.

        `setting` is whether the solver begins where all is met, or steps in a trust region.
        """
        path, working = list(path), self.evaluator.working
        extra, merit = not aim[0] or self.evaluator.minimax, 0.0
        for _ in range(self.options.exchange_rounds):

            def rows_at(u, working=working):
                return ask((self._linearise, u, working))

            functions = Functions(rows_at, aim, limited, self.slack, self.scale, extra)
            if self.solver:
                end = self._run_solver(functions, path[-1], setting)
            else:
                end, merit = self._run_trust_region(functions, path[-1], setting, working, ask)
            path += [*functions.evaluated, end]
            new = ask((self.evaluator.exchange, path[-1], working))
            if not len(new):
                break
            working = np.concatenate([working, new])
        return np.array(path), merit

    def _run_solver(self, functions: Functions, start: np.ndarray, restored: bool) -> np.ndarray:
        """Where the solver ends, perhaps from the nearest design that violates all the least."""
        v, bounds = len(start), np.tile([0.0, 1.0], (len(start), 1))
        if restored:
            plain = dataclasses.replace(functions, extra=False)
            start = _restore_feasibility(plain, start, self.options.restoring_steps)
        if functions.extra:
            largest = functions.at(np.append(start, 0))[0][:, functions.aim].max()
            start = np.append(start, largest)
            bounds = np.append(bounds, [[-np.inf, np.inf]], axis=0)
        solver: Any = self.solver
        z = solver(functions.objective, functions.constraints, start, bounds)
        return np.clip(np.asarray(z, float)[:v], 0, 1)

    def _run_trust_region(self, functions: Functions, start, steps: TrustRegion, working, ask):
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
        end = minimise_in_trust_region(at, limits, start, curvature, steps, penalty, met)
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
        return [self.evaluator.average(*piece) for piece in _evaluate_each(linearised, us, working)]

    def _limits(self, us, working):
        """Residuals of joints and their slopes, of each of us (n, v) at its working conditions."""
        pieces = _evaluate_each(self._limits_of_joints, us, working)
        return [(r.ravel(), slopes.reshape(-1, us.shape[1])) for r, slopes in pieces]

    @functools.cached_property
    def _limits_of_joints(self):
        return make_joint_limits(self.evaluator.problem)


def _evaluate_each(function, us, working) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values and slopes of each of us (n, v) at its own conditions (m, c), in one call."""
    counts = [len(conditions) for conditions in working]
    arrays = function(np.repeat(us, counts, axis=0), np.concatenate(working))[:2]
    pieces = (np.split(x, np.cumsum(counts)[:-1]) for x in arrays)
    return list(zip(*pieces, strict=True))
