"""Ways to solve a design task, each with a trace of the designs it looked at and when.

Every method starts from scaled variables (v,); a grid, which has no start, is shifted by it
instead, so that no method owes its answer to where the optimum happens to lie.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import fractaljax as fj
from fractaljax.optimise.requirements import Model

from ..timing import compiled
from .tasks import (
    AREA_RATIO_MIN,
    GROWTH_SCALE,
    SLIP_RATIO_MAX,
    TARGET,
    DesignTask,
    by_loop,
    by_package,
    least_stiffness,
)

MEETS = 1e-9  # largest requirement that counts as met
_PENALTY = 100.0  # of the exact penalty, as in `fj.design`
_CHUNK = 4096  # designs of a grid judged in one call
_ZOOM, _LEVELS = 4.0, 12  # a zoomed grid shrinks by this, so many times
_PLACES = 16  # that a scattered method starts from
_STRIDES = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0]) % 1  # between them: they fill the bounds evenly
_RESTARTS = 4  # of Nelder-Mead, from where it ended

Rows = Callable[[np.ndarray], np.ndarray]


class Trace:
    """Designs (n, v) that a method looked at, the seconds when it had, and its answer."""

    def __init__(self):
        self.seen: list[tuple[float, np.ndarray]] = []
        self.evaluations = 0  # of one design at one condition
        self.answer: np.ndarray | None = None
        self._start = time.perf_counter()

    def add(self, us: np.ndarray, evaluations: int) -> None:
        """Look at designs now."""
        self.seen.append((time.perf_counter() - self._start, np.array(us)))
        self.evaluations += evaluations

    def end(self, answer: np.ndarray) -> "Trace":
        """The method's answer (v,), now."""
        self.add(answer[None], 0)
        self.answer = answer
        return self


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to solve a task: `solve(start)` gives its trace."""

    name: str
    family: str  # of its style in the picture
    solve: Callable[[np.ndarray], Trace]
    compile_s: float | None  # before the first call; None where the first call compiles, 0 nowhere
    runs: int | None = None  # at most so many starts


# ---------------------------------------------------------------------------------------------
# fj.design
# ---------------------------------------------------------------------------------------------


def by_design(task: DesignTask, start: np.ndarray) -> Trace:
    """`fj.design` as its users call it, from the surface at `start`."""
    scene = fj.brake_scene().replace(**task.quantities(start))
    trace, linearise, judge = Trace(), Model.linearise, Model.judge

    def linearised(self, us, conditions=None):
        found = linearise(self, us, conditions)
        trace.add(us, len(us) * (1 if conditions is None else conditions.shape[1]))
        return found

    def judged(self, us, conditions):
        trace.evaluations += len(us)
        return judge(self, us, conditions)

    with (
        mock.patch.object(Model, "linearise", linearised),
        mock.patch.object(Model, "judge", judged),
    ):
        found = fj.design(
            scene,
            dict(task.bounds),
            fj.growth_rate,
            TARGET,
            least_stiffness(),
            envelope=dict(task.conditions) or None,
            area_ratio_min=AREA_RATIO_MIN,
            slip_ratio_max=SLIP_RATIO_MAX,
            progress=False,
        )
    surface = found.scene.contact.surface
    return trace.end(task.scaled({"D": float(surface.D), "G": float(surface.G)}))


# ---------------------------------------------------------------------------------------------
# SciPy's optimisers
# ---------------------------------------------------------------------------------------------


def scaled_row(task: DesignTask, row: np.ndarray) -> np.ndarray:
    """A row, or its derivatives, with the objective of order one."""
    factors = np.ones(len(row))
    factors[0] = 1 if task.nearest else 1 / GROWTH_SCALE
    return (row.T * factors).T


def nelder_mead(
    task: DesignTask, judge: Rows, start: np.ndarray, trace: Trace | None = None
) -> Trace:
    """Nelder and Mead's simplex on an exact penalty, started again from its own answers."""
    trace = Trace() if trace is None else trace

    def merit(u):
        row = scaled_row(task, judge(u))
        trace.add(u[None], task.condition_count)
        return row[0] + _PENALTY * np.maximum(row[1:], 0).sum()

    u, best = start, np.inf
    for _ in range(_RESTARTS):
        found = scipy.optimize.minimize(
            merit,
            u,
            method="Nelder-Mead",
            bounds=[(0, 1)] * len(u),
            options={"xatol": 1e-9, "fatol": 1e-9, "maxfev": 1000, "adaptive": len(u) > 2},
        )
        u, gained, best = found.x, best - found.fun, found.fun
        if gained < 1e-9:
            break
    return trace.end(u)


def slsqp(
    task: DesignTask,
    judge: Rows,
    jacobian: Rows | None,
    start: np.ndarray,
    trace: Trace | None = None,
) -> Trace:
    """Sequential quadratic programming; without a Jacobian by SciPy's differences."""
    trace, known = Trace() if trace is None else trace, {}

    def row_at(u):
        if known.get("u") != u.tobytes():
            known.update(u=u.tobytes(), row=scaled_row(task, judge(u)))
            trace.add(u[None], task.condition_count)
        return known["row"]

    def slopes_at(u):
        if known.get("v") != u.tobytes():
            assert jacobian is not None
            known.update(v=u.tobytes(), slopes=scaled_row(task, jacobian(u)))
            trace.evaluations += task.condition_count
        return known["slopes"]

    exact = jacobian is not None
    constraint: dict[str, Any] = {"type": "ineq", "fun": lambda u: -row_at(u)[1:]}
    if exact:
        constraint["jac"] = lambda u: -slopes_at(u)[1:]
    found = scipy.optimize.minimize(
        lambda u: row_at(u)[0],
        start,
        method="SLSQP",
        jac=(lambda u: slopes_at(u)[0]) if exact else None,
        bounds=[(0, 1)] * len(start),
        constraints=[constraint],
        options={"ftol": 1e-12, "maxiter": 200},
    )
    return trace.end(np.clip(found.x, 0, 1))


def scattered(task: DesignTask, solve: Callable[..., Trace], judge: Rows, *rest: Any) -> Trace:
    """The best that another method finds from many places; its start, the first, comes last."""
    *more, start = rest
    trace, ends = Trace(), []
    for i in range(_PLACES):
        place = (start + i * _STRIDES[: len(start)]) % 1
        ends.append(solve(task, judge, *more, place, trace).answer)
    us = np.array(ends)
    rows = np.array([judge(u) for u in us])
    trace.evaluations += len(us) * task.condition_count
    return trace.end(better((np.inf, np.inf, start), us, rows)[2])


# ---------------------------------------------------------------------------------------------
# Grids
# ---------------------------------------------------------------------------------------------


def shifted_grid(side: int, start: np.ndarray):
    """Chunks (n, v) of a grid of side^v designs inside the bounds, shifted by `start`."""
    axes = [(np.arange(side) + u) / side for u in start]
    points = itertools.product(*axes)
    while chunk := list(itertools.islice(points, _CHUNK)):
        yield np.array(chunk)


def better(best: tuple, us: np.ndarray, rows: np.ndarray) -> tuple:
    """The better of `best` and designs us (n, v): (violation, objective, design)."""
    violation = np.maximum(rows[:, 1:].max(axis=1), MEETS)
    violation = np.where(np.isnan(violation), np.inf, violation)
    i = np.lexsort((rows[:, 0], violation))[0]
    found = violation[i], rows[i, 0], us[i]
    return found if found[:2] < best[:2] else best


def grid(task: DesignTask, judge_many: Rows, side: int, start: np.ndarray) -> Trace:
    """The best of a grid."""
    trace, best = Trace(), (np.inf, np.inf, start)
    for us in shifted_grid(side, start):
        best = better(best, us, judge_many(us))
        trace.add(best[2][None], len(us) * task.condition_count)
    return trace.end(best[2])


def zoomed_grid(task: DesignTask, judge_many: Rows, side: int, start: np.ndarray) -> Trace:
    """A grid about the best of a grid, smaller and smaller."""
    trace, best = Trace(), (np.inf, np.inf, start)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(_LEVELS):
        for us in shifted_grid(side, start):
            us = low + us * (high - low)
            best = better(best, us, judge_many(us))
            trace.add(best[2][None], len(us) * task.condition_count)
        half = (high - low) / (2 * _ZOOM)
        low, high = np.maximum(best[2] - half, 0), np.minimum(best[2] + half, 1)
    return trace.end(best[2])


# ---------------------------------------------------------------------------------------------
# All of them
# ---------------------------------------------------------------------------------------------


def in_chunks(program: Callable, us: np.ndarray) -> np.ndarray:
    """Rows of designs (n, v) by a program that takes `_CHUNK` of them."""
    found = []
    for i in range(0, len(us), _CHUNK):
        chunk = us[i : i + _CHUNK]
        padded = np.resize(chunk, (_CHUNK, us.shape[1]))
        found.append(np.asarray(program(jnp.asarray(padded)))[: len(chunk)])
    return np.concatenate(found)


def methods(
    task: DesignTask, sides: dict[str, tuple[int, ...]], loop_runs: int
) -> tuple[list[Method], Rows]:
    """Every method for a task, its programs compiled apart, and what judges any designs (n, v).

    `sides` are those of the grids, `loop_runs` the most starts of a method on the loop.
    """
    judge, variables = by_package(task), len(task.bounds)
    one, one_s = compiled(judge, jnp.zeros(variables))
    slopes, slopes_s = compiled(jax.jacfwd(judge), jnp.zeros(variables))
    many, many_s = compiled(jax.vmap(judge), jnp.zeros((_CHUNK, variables)))
    loop, rows = by_loop(task), functools.partial(in_chunks, many)

    def program(u):
        return np.asarray(one(u))

    def jacobian(u):
        return np.asarray(slopes(u))

    def loop_many(us):
        return np.array([loop(u) for u in us])

    def method(name, family, solve, *arguments, compile_s: float | None = 0.0, runs=None):
        return Method(name, family, functools.partial(solve, task, *arguments), compile_s, runs)

    found = []
    if set(task.bounds) == {"D", "G"}:
        found.append(method("fj.design", "design", by_design, compile_s=None))
    found += [
        method("SLSQP, package", "slsqp", slsqp, program, jacobian,
               compile_s=one_s + slopes_s),
        method("SLSQP, loop", "slsqp loop", slsqp, loop, None, runs=loop_runs),
        method(f"SLSQP from {_PLACES} places, package", "scattered", scattered, slsqp, program,
               jacobian, compile_s=one_s + slopes_s),
        method(f"SLSQP from {_PLACES} places, loop", "scattered loop", scattered, slsqp, loop, None,
               runs=loop_runs),
        method("Nelder-Mead, package", "simplex", nelder_mead, program, compile_s=one_s),
        method("Nelder-Mead, loop", "simplex loop", nelder_mead, loop, runs=loop_runs),
        method(f"Nelder-Mead from {_PLACES} places, package", "simplices", scattered, nelder_mead,
               program, compile_s=one_s),
        method(f"Nelder-Mead from {_PLACES} places, loop", "simplices loop", scattered, nelder_mead,
               loop, runs=loop_runs),
    ]  # fmt: skip
    for side in sides["package"]:
        name = f"grid of {side}^{variables}, package"
        found.append(method(name, "grid", grid, rows, side, compile_s=many_s))
    for side in sides["zoom"]:
        name = f"zoomed grid of {side}^{variables}, package"
        found.append(method(name, "zoom", zoomed_grid, rows, side, compile_s=many_s))
    for side in sides["loop"]:
        name = f"grid of {side}^{variables}, loop"
        found.append(method(name, "grid loop", grid, loop_many, side, runs=loop_runs))
    return found, rows
