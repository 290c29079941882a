"""The nearest surface that is stable against small disturbances.

A design moves D and ln G, scaled to [0, 1] by their bounds. Every requirement is a function that
is at most 0 where it is met, continuous and informative on both sides of every regime boundary:
a fully plastic joint knows by ln(a_l/a_e) how far it is from carrying load elastically. A lattice
of surfaces is judged at once; the most promising and an even spread of the others walk together,
first by Adam on a penalty, then by sequential quadratic programming (`search.py`), and the best
of all that meet every requirement, evaluated afresh, is the answer. With an envelope or a
tolerance fewer of them walk, and for longer where the worst condition moves (`worst_case.py`).
"""

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import brief, flag
from ..mechanism.scene import Scene
from ..modes.stability import growth_rate, growth_rate_of, require_computable
from ..report import comparison_table, table
from ..surface.roughness import Roughness, roughness
from ..surface.topography import Topographies, topography
from . import constraints as limits, tolerance as scatter
from .envelope import Envelope, condition_text
from .search import STEPS, search
from .task import DEFAULT_BOUNDS, Task, pose
from .worst_case import Verdict

_ROBUST_STEPS = 30, 25
_ACTIVE = 100  # a requirement met by less than this many times the slack is called active
_SAMPLES = 100_000  # surfaces drawn for the probability of squeal
_ROWS = 64  # of a history, described at once
_WAVELENGTHS = (1e-3, 1e-6)  # [m], of the roughness that is reported


class DesignResult(eqx.Enumeration):
    """How a design ended; an outcome, raised by nobody."""

    found = "found: the best surface that meets every requirement"
    unchanged = "unchanged: the given surface meets every requirement already"
    infeasible = "infeasible: no surface inside the bounds was found to meet every requirement"


@dataclasses.dataclass(frozen=True, repr=False)
class Design:
    """What `design` returns; numbers in SI units, arrays as NumPy. Printed, it is a table."""

    scene: Scene  # with the designed surface; if infeasible, with the best one found
    initial: Scene
    value: float  # the objective at `scene`: by default d^2, the squared scaled distance
    growth_rate: float  # [1/s], of `scene` itself
    active: tuple[str, ...]  # requirements met with nothing to spare
    violated: tuple[str, ...]  # requirements not met, none unless infeasible
    result: DesignResult  # a member of DesignResult
    history: Mapping[str, np.ndarray]  # one row a step on the way to `scene`, as `initial` is
    bounds: Mapping[str, tuple[float, float]]
    target: float  # largest growth rate allowed [1/s]
    K_n_min: float  # least normal stiffness allowed [N/m]
    friction_slope: bool
    starts: int  # surfaces improved side by side, 0 if unchanged
    failed_starts: int  # how many of them ended without meeting every requirement
    options: Mapping[str, Any]  # the arguments of `design`, for another run
    growth_rates: tuple[float, float] | None = None  # as required, before and after [1/s]
    worst: Mapping[str, float] | None = None  # condition of the most pressing requirement
    worst_of: Mapping[str, Mapping[str, float]] | None = None  # of every requirement
    squeal_probability: float | None = None  # of surfaces as machined
    squeal_probability_error: float | None = None  # its standard error
    initial_squeal_probability: float | None = None

    @property
    def outcome(self) -> str:
        """The result in words."""
        return DesignResult[self.result]

    @property
    def wavelengths(self) -> tuple[float, float]:
        """Longest and shortest [m] that roughness counts: of a limit on Sq, or 1 mm and 1 um."""
        for asked in self.options["constraints"]:
            if isinstance(asked, limits.Roughness):
                return float(asked.L), float(asked.L_s)
        return _WAVELENGTHS

    def roughness(self, L=None, L_s=None) -> tuple[Roughness, Roughness]:
        """Sq [m], Sa [m] and Sdq of the given and of the designed surface, as `roughness` says.

        Over wavelengths from L to L_s [m], by default those of `wavelengths`.
        """
        longest, shortest = self.wavelengths
        band = longest if L is None else L, shortest if L_s is None else L_s
        before, after = (roughness(s.contact.surface, *band) for s in (self.initial, self.scene))
        return before, after

    def topographies(self, n: int = 1024, *, L=None, L_s=None, M=10, key=None) -> Topographies:
        """Both surfaces on a grid of n x n points with the same phases: one sees what changed.

        L and L_s [m] are by default those of `wavelengths`, but L_s no less than 2 L/n, and `key`
        that of the design's seed; the rest, and errors, as `topography`.
        """
        longest, shortest = self.wavelengths
        L = longest if L is None else L
        key = jax.random.key(self.options["seed"]) if key is None else key
        if L_s is None and 2 * L / n < shortest:
            L_s = shortest
        before, after = (
            np.asarray(topography(scene.contact.surface, L, n, key=key, L_s=L_s, M=M))
            for scene in (self.initial, self.scene)
        )
        return Topographies(before, after, float(L) / n)

    def save(self, path: str | os.PathLike) -> None:
        """Write scenes, options, results and history to a TOML file, for `repeat_design`.

        **Raises:** `OSError` if the file cannot be written.
        """
        from .design_file import save_design

        save_design(self, path)

    def __repr__(self) -> str:
        shown = self.initial, self.scene, self.friction_slope, self.active, self.wavelengths
        L, L_s = self.wavelengths
        lines = [comparison_table(*shown), f"Sq and Sdq: wavelengths from {L:g} to {L_s:g} m"]
        lines += self._under_conditions()
        lines += [f"not met: {name}" for name in self.violated]
        return "\n".join([*lines, self.outcome, self._promise()])

    def _promise(self) -> str:
        """What the growth rate says of the designed surface, and what it does not."""
        growth = self.growth_rate if self.growth_rates is None else self.growth_rates[1]
        if not growth < 0:
            return "not stable: small disturbances grow"
        return "stable against small disturbances; a larger kick may still end in squeal"

    def _under_conditions(self) -> list[str]:
        """What the envelope and the tolerance make of it, before and after, and the worst."""
        if self.growth_rates is None:
            return []
        envelope, tolerance = self.options["envelope"], self.options["tolerance"]
        words, rows = [], [{}, {}]
        if envelope is not None:
            words.append(f"over {Envelope.of(envelope)}")
        if tolerance is not None:
            words.append(
                "where " + ", ".join(f"{n} scatters by {s:g}" for n, s in tolerance.items())
            )
        for row, growth in zip(rows, self.growth_rates, strict=True):
            row["growth rate as required [1/s]"] = f"{growth:+.6g}"
        if self.squeal_probability is not None:
            error = f" +- {self.squeal_probability_error:.1g}"
            rows[0]["probability of squeal"] = f"{self.initial_squeal_probability:.3g}"
            rows[1]["probability of squeal"] = f"{self.squeal_probability:.3g}{error}"
        lines = ["", "; ".join(words), table(["before", "after"], rows)]
        if self.worst is not None:
            lines.append(f"worst at {condition_text(self.worst)}")
        return lines


def design(
    scene: Scene,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    objective: Callable[[Scene], Any] | None = None,
    target: float | None = None,
    K_n_min: float | None = None,
    constraints: Sequence[Callable[[Scene], Any]] = (),
    *,
    envelope: Envelope | Mapping[str, Any] | None = None,
    risk: str | tuple[str, float] = "worst",
    tolerance: Mapping[str, float] | None = None,
    quantile: float = 0.95,
    area_ratio_min: float = 2.0,
    slip_ratio_max: float = 0.9,
    friction_slope: bool = True,
    starts: int | None = None,
    lattice: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Design:
    """Find by gradients the surface inside `bounds` that is best and meets every requirement.

    The growth rate that it bounds is that of small disturbances: a surface with growth rate < 0 is
    stable against those, and a larger kick may still end in a limit cycle (see `attractors`).
    Best is, without an `objective`, nearest to the scene's own surface: the least
    d^2 = (dD/(D_hi - D_lo))^2 + (d ln G/(ln G_hi - ln G_lo))^2. An objective is any function of a
    scene that `jax` can differentiate, and is minimised.

    The requirements: growth rate <= `target` [1/s], by default -min(xi_i omega_i)/2; K_n >=
    `K_n_min` [N/m], by default the scene's own; a_l >= `area_ratio_min` a_e; Q_e <=
    `slip_ratio_max` mu_s P (not with a given stiffness ratio); every function of a scene in
    `constraints` <= 0, of order one, as those of `fractaljax.constraints` are; and the bounds, on
    D and G [m] or on one of them, the other then staying as it is.

    With an `envelope`, a range (lower, upper) or samples of any quantities of the scene by name
    (see `Envelope`), every requirement holds, and an objective is taken, over all its conditions:
    `risk="worst"`, at the worst; `"smooth"` or ("smooth", T), a log-sum-exp of temperature T
    that is at least the worst; ("cvar", alpha), the mean of the worst 1 - alpha of them.
    With a `tolerance`, the standard deviations of {"D": ..., "ln G": ...} as machined, every
    requirement holds, and an objective is taken, at its `quantile`, at each condition of the
    envelope by itself. `Design.squeal_probability` counts 100,000 surfaces drawn with `seed`,
    each at a condition drawn evenly from the envelope.

    `starts` surfaces, by default 16, or 12 with an envelope or a tolerance, are improved side by
    side. They are chosen from `lattice` surfaces a side, by default 48 (1024 for one variable), or
    24 (256): fewer where an objective is expensive. The same arguments give the same design. A
    request that cannot be met is a result, not an error: see `Design.result`, `Design.violated`.

    **Raises:** `ValueError` for a contact that is not fractal, for bounds on anything else, empty,
    inverted or without the scene's own surface, for an envelope of anything that the scene lacks
    or the design moves, and for options outside their domain.
    """
    bounds = DEFAULT_BOUNDS if bounds is None else bounds
    for name, mapping in (("bounds", bounds), ("tolerance", tolerance)):
        if not isinstance(mapping, Mapping) and mapping is not None:
            raise TypeError(f"{name} must be a mapping, got {brief(mapping)}")
    if objective is not None and not callable(objective):
        raise TypeError(f"objective must be a function of a scene, got {brief(objective)}")
    if not isinstance(constraints, (list, tuple)) or not all(map(callable, constraints)):
        raise TypeError(
            f"constraints must be a list of functions of a scene, got {brief(constraints)}"
        )
    progress = flag("progress", progress)
    options = dict(
        bounds=dict(bounds),
        objective=objective,
        target=target,
        K_n_min=K_n_min,
        constraints=tuple(constraints),
        envelope=None if envelope is None else Envelope.of(envelope),
        risk=risk,
        tolerance=None if tolerance is None else dict(tolerance),
        quantile=quantile,
        area_ratio_min=area_ratio_min,
        slip_ratio_max=slip_ratio_max,
        friction_slope=flag("friction_slope", friction_slope),
        starts=starts,
        lattice=lattice,
        seed=seed,
    )
    task = pose(scene, options)
    count = task.lattice ** len(task.problem.variables)
    if task.starts > count:
        raise ValueError(f"starts must be at most the {count} of the lattice, got {task.starts}")
    require_computable(scene, task.problem.friction_slope)
    own = np.asarray(task.request.start, float)[None]
    before = task.judge(1).verdict(own)
    if objective is None and before.worst[0] <= 0:
        return _conclude(task, before, before, own, DesignResult.unchanged, 0, 0)
    task, us = _choose_starts(task)
    judge = task.judge(len(us))
    steps = _ROBUST_STEPS if task.robust else STEPS
    ends, path_to = search(judge.linearise, us, task.slack, progress, steps, judge.refine)
    after = judge.verdict(ends)
    if (after.worst <= 0).any():
        values = np.where(after.worst <= 0, after.values, np.inf)
        least = values.min()
        # Many starts end in one place: show the walk from the scene's own surface, the first of
        # them, if it is among those, so that the path begins where the reader does.
        best = int(np.flatnonzero(values <= least + 1e-6 * abs(least))[0])
        result = DesignResult.found
    else:
        # Inside the model if that is possible, and there as close as can be to all the rest.
        inside = after.excess[:, : task.problem.model_requirements].max(axis=1)
        inside = np.maximum(np.nan_to_num(inside, nan=np.inf), 0)
        best = int(np.lexsort((after.worst, inside))[0])
        result = DesignResult.infeasible
    failed = int((after.worst > 0).sum())
    return _conclude(task, before, after.of(best), path_to(best), result, len(us), failed)


def _choose_starts(task: Task) -> tuple[Task, np.ndarray]:
    """The scene's own surface, the most promising of a lattice, and an even spread of the rest."""
    request, starts, variables = task.request, task.starts, len(task.problem.variables)
    lattice = task.surfaces()
    surveyed = task.judge(starts).survey(lattice)
    values, excess = surveyed[:, 0], surveyed[:, 1:]
    finite = np.isfinite(values)
    if task.problem.objective is not None and finite.any():
        low, shift, high = np.quantile(values[finite], [0.1, 0.5, 0.9])
        scale = (high - low) or 1.0
        values = (values - shift) / scale
        request = dataclasses.replace(
            request,
            value_shift=jnp.asarray(shift, request.low.dtype),
            value_scale=jnp.asarray(scale, request.low.dtype),
        )
    merit = np.where(finite, values + 10 * np.maximum(excess, 0).sum(axis=1), np.inf)
    ranked = np.argsort(merit, kind="stable")
    # With few starts, one for each basin comes first.
    basins = _least_of_neighbours(merit.reshape((task.lattice,) * variables)).ravel()
    ranked = np.concatenate([ranked[basins[ranked]], ranked[~basins[ranked]]])
    promising, rest = ranked[: starts // 2], np.sort(ranked[starts // 2 :])
    even = rest[np.linspace(0, len(rest) - 1, starts - starts // 2).astype(int)][1:]
    own = np.asarray(request.start, float)[None]
    us = np.concatenate([own, lattice[promising], lattice[even]])[:starts]
    return dataclasses.replace(task, request=request), us


def _least_of_neighbours(merit):
    """Where a table is finite and no neighbour, diagonals included, has less."""
    padded = np.pad(merit, 1, constant_values=np.inf)
    shifts = np.ndindex(*(3,) * merit.ndim)
    around = [
        padded[tuple(slice(i, i + n) for i, n in zip(s, merit.shape, strict=True))] for s in shifts
    ]
    return np.isfinite(merit) & (merit <= np.min(around, axis=0))


@functools.partial(jax.jit, static_argnums=0)
def _describe(problem, request, us):
    """The rows of a history: what each of the surfaces us (n, variables) is worth as it is."""

    def row(u):
        scene = problem.scene(request, u)
        state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
        columns = {
            "D": scene.contact.surface.D,
            "G": scene.contact.surface.G,
            "objective": problem.value(request, u),
            "growth_rate": growth_rate_of(scene, state.K_n, state.K_t, problem.friction_slope),
            "K_n": state.K_n,
            "K_t": state.K_t,
            "log_area_ratio": state.log_area_ratio,
        }
        if state.slip_ratio is not None:
            columns["slip_ratio"] = state.slip_ratio
        return columns

    return jax.vmap(row)(us)


@functools.partial(jax.jit, static_argnums=0)
def _squeals(problem, request, u, conditions, shifts):
    """How many of the surfaces shifted from u squeal, each at its condition (n, names)."""

    def one(condition, shift):
        scene = problem.scene(request, u, condition, shift)
        return growth_rate(scene, problem.friction_slope) > 0

    return jnp.sum(jax.vmap(one)(conditions, shifts))


def _squeal_probability(task: Task, u) -> tuple[float, float]:
    """Of surfaces as machined, at conditions drawn evenly; and its standard error."""
    envelope, seed = task.options["envelope"], task.options["seed"]
    dtype = task.request.low.dtype
    conditions = (
        np.zeros((_SAMPLES, 0))
        if envelope is None
        else envelope.values(envelope.drawn(_SAMPLES, seed))
    )
    shifts = scatter.draw(task.tolerance, _SAMPLES, seed)
    drawn = jax.tree.map(lambda x: jnp.asarray(x, dtype), (conditions, shifts))
    hits = _squeals(task.problem, task.request, jnp.asarray(u, dtype), *drawn)
    return scatter.proportion(int(hits), _SAMPLES)


def _conclude(
    task: Task, before: Verdict, after: Verdict, path, result, starts: int, failed: int
) -> Design:
    """Say what became of every requirement at the end of `path`."""
    problem, request = task.problem, task.request
    path = np.asarray(path, request.low.dtype)
    # Padded, or every length would be compiled anew.
    padding = np.repeat(path[-1:], -len(path) % _ROWS, axis=0)
    described = _describe(problem, request, np.concatenate([path, padding]))
    history = {name: np.asarray(column)[: len(path)] for name, column in described.items()}
    final = request.scene
    if result != DesignResult.unchanged:
        # exp(ln G) and the scaling back may end a rounding beyond a bound.
        ends = {name: np.clip(history[name][-1], *task.bounds[name]) for name in problem.variables}
        final = final.replace(**ends)
    names = problem.names(request)
    excess = dict(zip(names, after.excess[0].tolist(), strict=True))
    for name, place in zip(problem.variables, path[-1].tolist(), strict=True):
        excess |= {f"{name} >= lower bound": -place, f"{name} <= upper bound": place - 1}
    violated = tuple(name for name, value in excess.items() if not value <= 0)
    shift, scale = float(request.value_shift), float(request.value_scale)
    more = {}
    if task.robust:
        growth = names.index("growth_rate <= target")
        more["growth_rates"] = tuple(
            float(request.target + request.growth_scale * np.sinh(verdict.excess[0, growth]))
            for verdict in (before, after)
        )
    if after.places is not None:
        envelope = task.options["envelope"]
        at = [envelope.condition(place) for place in after.places[0, 1:]]
        more["worst_of"] = dict(zip(names, at, strict=True))
        more["worst"] = at[int(np.argmax(after.excess[0]))]
    if task.tolerance:
        ends = request.start, path[-1]
        (first, _), (last, error) = (_squeal_probability(task, u) for u in ends)
        more["initial_squeal_probability"] = first
        more |= {"squeal_probability": last, "squeal_probability_error": error}
    return Design(
        scene=final,
        initial=request.scene,
        value=float(after.values[0]) * scale + shift,
        growth_rate=float(growth_rate(final, problem.friction_slope)),
        active=tuple(n for n, x in excess.items() if -_ACTIVE * task.slack <= x <= 0),
        violated=violated,
        result=result if not violated else DesignResult.infeasible,
        history=history,
        bounds=task.bounds,
        target=float(request.target),
        K_n_min=float(request.K_n_min),
        friction_slope=problem.friction_slope,
        starts=starts,
        failed_starts=failed,
        options=task.options,
        **more,
    )
