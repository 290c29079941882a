"""Trade-offs: the surfaces on which one objective cannot fall unless another one rises.

The second objective becomes a requirement, at most a limit; a family of limits between its least
and the value it has where the first objective is least gives the front (epsilon-constraint). All
members of the family are searched side by side, as one batch of the same program.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import brief, flag, number, whole
from ..mechanism.scene import Scene
from .constraints import Constraint
from .design import Design, design
from .search import search
from .task import Task, pose
from .worst_case import OneCondition

_WALKERS = 8  # surfaces improved for each member of the front
_POINTS_MAX = 1000


@dataclasses.dataclass(frozen=True)
class Front:
    """What `pareto` returns, ordered from the least first to the least second objective."""

    first: np.ndarray  # (n,), in the units of the objectives
    second: np.ndarray  # (n,)
    D: np.ndarray  # (n,)
    G: np.ndarray  # (n,) [m]
    names: tuple[str, str]
    ends: tuple[Design, Design]  # the designs for either objective alone
    failed: int  # members of the family without a surface that meets every requirement

    def scene(self, i: int) -> Scene:
        """The scene with the surface of member i."""
        return self.ends[0].initial.replace(D=self.D[i], G=self.G[i])


class _Second(Constraint):
    """The second objective as a requirement, in units of its range: the search limits it."""

    at_least: None
    at_most: jax.Array
    scale: jax.Array
    objective: Callable[[Scene], Any] = eqx.field(static=True)

    symbol: ClassVar[str] = "second objective"
    unit: ClassVar[str] = ""

    def __init__(self, objective, at_most=0.0, scale=1.0):
        self.at_least, self.objective = None, objective
        self.at_most = number("second objective", at_most)
        self.scale = number("range of the second objective", scale, above=0)

    def measure(self, scene):
        return self.objective(scene)

    def surplus(self, value):
        return (value - self.at_most) / self.scale


def pareto(
    scene: Scene,
    first: Callable[[Scene], Any],
    second: Callable[[Scene], Any],
    *,
    points: int = 16,
    names: tuple[str, str] = ("first objective", "second objective"),
    progress: bool = True,
    **options: Any,
) -> Front:
    """The front of two objectives, both functions of a scene that are minimised.

    `options` are those of `design`, but for `objective`, `starts` and `envelope`: bounds, target,
    K_n_min, constraints, tolerance and so on hold for every member.

    **Raises:** `ValueError` for fewer than three points, where no surface meets the requirements,
    for objectives without a trade-off, and as `design`.
    """
    points = whole("points", points, 3, _POINTS_MAX)
    if not (isinstance(names, (tuple, list)) and len(names) == 2):
        raise TypeError(f"names must be those of both objectives, got {brief(names)}")
    for name, objective in zip(("first", "second"), (first, second), strict=True):
        if not callable(objective):
            raise TypeError(f"{name} must be a function of a scene, got {brief(objective)}")
    progress = flag("progress", progress)
    refused = sorted({"objective", "starts", "envelope", "risk"} & set(options))
    if refused:
        raise ValueError(f"pareto does not take {', '.join(refused)}")
    asked: Mapping[str, Any] = {**options, "progress": False}
    ends = tuple(design(scene, objective=objective, **asked) for objective in (first, second))
    for name, end in zip(names, ends, strict=True):
        if end.violated:
            raise ValueError(
                f"no surface meets every requirement, seen at the least {name}: "
                f"{', '.join(end.violated)}"
            )
    own = ends[0].options["constraints"]
    asked = {**ends[0].options, "objective": first, "starts": _WALKERS * points}
    task = pose(scene, {**asked, "constraints": (*own, _Second(second))})
    places = np.stack([_place(task, end) for end in ends])
    at_ends = task.judge(len(places)).survey(places)
    high, low = (float(x) for x in at_ends[:, -1])
    if not high > low:
        raise ValueError(f"the least {names[0]} and the least {names[1]} are one surface")
    limited = _Second(second, low, high - low)
    task = pose(scene, {**asked, "constraints": (*own, limited)})
    task, us, members = _family(task, places, points)
    model = task.judge(len(us)).model
    judge = OneCondition(model, np.repeat(members, _WALKERS))
    found, _ = search(judge.linearise, us, task.slack, progress)
    # Beside its walkers every member may have the ends: the last limit leaves room for one alone.
    each, shared = found.reshape(points, _WALKERS, -1), np.tile(places, (points, 1, 1))
    found = np.concatenate([each, shared], axis=1).reshape(-1, places.shape[1])
    limits = np.repeat(members, _WALKERS + len(places))
    verdict = OneCondition(model, limits).verdict(found)
    return _front(task, verdict, found, limits, limited, names, ends)


def _place(task: Task, best: Design) -> np.ndarray:
    """The scaled variables of a design."""
    request, surface = task.request, best.scene.contact.surface
    values = {"D": float(surface.D), "G": float(np.log(surface.G))}
    x = np.array([values[name] for name in task.problem.variables])
    low, high = np.asarray(request.low, float), np.asarray(request.high, float)
    return np.clip((x - low) / (high - low), 0, 1)


def _family(task: Task, places, points: int):
    """The task scaled for search, starts (points walkers, v), and the limit of each member."""
    request = task.request
    lattice = task.surfaces()
    surveyed = task.judge(task.starts).survey(np.concatenate([places, lattice]))
    shift, scale = surveyed[0, 0], abs(surveyed[1, 0] - surveyed[0, 0]) or 1.0
    scaled = dataclasses.replace(
        request,
        value_shift=jnp.asarray(shift, request.low.dtype),
        value_scale=jnp.asarray(scale, request.low.dtype),
    )
    task = dataclasses.replace(task, request=scaled)
    values, excess = (surveyed[2:, 0] - shift) / scale, surveyed[2:, 1:]
    members = np.linspace(1, 0, points)  # in units of the second objective's range
    starts = []
    for limit in members:
        over = np.maximum(np.column_stack([excess[:, :-1], excess[:, -1] - limit]), 0)
        merit = np.nan_to_num(values + 10 * over.sum(axis=1), nan=np.inf)
        promising = lattice[np.argsort(merit, kind="stable")[: _WALKERS - 3]]
        between = limit * places[0] + (1 - limit) * places[1]
        starts.append(np.concatenate([places, between[None], promising]))
    us = np.concatenate(starts)
    return task, us, members


def _front(task: Task, verdict, us, limits, limited: _Second, names, ends) -> Front:
    """The best of each member, without those that another one beats in both."""
    shift, scale = float(task.request.value_shift), float(task.request.value_scale)
    first = verdict.values * scale + shift
    second = (verdict.excess[:, -1] + limits) * float(limited.scale) + float(limited.at_most)
    best, failed = [], 0
    for member in np.arange(len(us)).reshape(-1, _WALKERS + len(ends)):
        holding = member[verdict.worst[member] <= 0]
        if len(holding):
            best.append(holding[first[holding].argmin()])
        else:
            failed += 1
    kept = [
        i
        for i in best
        if not any(first[j] <= first[i] and second[j] < second[i] for j in best if j != i)
    ]
    kept = sorted(kept, key=lambda i: first[i])
    request, variables = task.request, task.problem.variables
    low_u, high_u = np.asarray(request.low, float), np.asarray(request.high, float)
    x = low_u + us[kept] * (high_u - low_u)
    surface = request.scene.contact.surface
    columns = {name: np.full(len(kept), float(getattr(surface, name))) for name in ("D", "G")}
    for name, column in zip(variables, x.T, strict=True):
        columns[name] = np.exp(column) if name == "G" else column
    return Front(first[kept], second[kept], columns["D"], columns["G"], names, ends, failed)
