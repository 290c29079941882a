"""The nearest surface that does not squeal.

A design moves D and ln G, scaled to [0, 1] by their bounds. Every requirement is a function that
is at most 0 where it is met, continuous and informative on both sides of every regime boundary:
a fully plastic joint knows by ln(a_l/a_e) how far it is from carrying load elastically. A lattice
of surfaces is judged at once; the most promising and an even spread of the others walk together,
first by Adam on a penalty, then by sequential quadratic programming (`search.py`), and the best
of all that meet every requirement, evaluated afresh, is the answer.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .parts import number, require_scalar, substitute
from .report import comparison_table
from .scene import Scene
from .search import search
from .stability import growth_rate, growth_rate_of

DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}

_LATTICE = {1: 1024, 2: 48}  # surfaces a side, judged to choose the starts
_ACTIVE = 100  # a requirement met by less than this many times the slack is called active


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
    growth_rate: float  # [1/s]
    active: tuple[str, ...]  # requirements met with nothing to spare
    violated: tuple[str, ...]  # requirements not met, none unless infeasible
    result: DesignResult  # a member of DesignResult
    history: Mapping[str, np.ndarray]  # one row a step on the way to `scene`
    bounds: Mapping[str, tuple[float, float]]
    target: float  # largest growth rate allowed [1/s]
    K_n_min: float  # least normal stiffness allowed [N/m]
    friction_slope: bool

    @property
    def outcome(self) -> str:
        """The result in words."""
        return DesignResult[self.result]

    def __repr__(self) -> str:
        lines = [comparison_table(self.initial, self.scene, self.friction_slope, self.active)]
        lines += [f"not met: {name}" for name in self.violated]
        return "\n".join([*lines, self.outcome])


class _Request(eqx.Module):
    """The numbers of a design, so that one compiled program serves every scene of a kind."""

    scene: Scene
    low: jax.Array  # bounds of the variables: D, ln G
    high: jax.Array
    start: jax.Array  # the scene's own surface, scaled
    target: jax.Array
    growth_scale: jax.Array
    K_n_min: jax.Array
    area_ratio_min: jax.Array
    slip_ratio_max: jax.Array
    value_shift: jax.Array
    value_scale: jax.Array


@dataclasses.dataclass(frozen=True)
class _Problem:
    """What a design asks, hashable: the structure its programs are compiled for."""

    variables: tuple[str, ...]
    objective: Callable[[Scene], Any] | None
    constraints: tuple[Callable[[Scene], Any], ...]
    tangential_law: bool
    friction_slope: bool

    @property
    def model_requirements(self) -> int:
        """How many requirements, the first, keep the joint inside the model."""
        return 1 + self.tangential_law

    def scene(self, request: _Request, u) -> Scene:
        x = request.low + u * (request.high - request.low)
        values = {n: jnp.exp(x[i]) if n == "G" else x[i] for i, n in enumerate(self.variables)}
        return substitute(request.scene, values)

    def value(self, request: _Request, u):
        """The objective; without one, the squared distance from the scene's own surface."""
        if self.objective is None:
            return jnp.sum((u - request.start) ** 2)
        return self.objective(self.scene(request, u))

    def requirements(self, request: _Request, u) -> dict[str, jax.Array]:
        """Each at most 0 where it is met, of order one, and continuous everywhere.

        Those that keep the joint inside the model come first and weigh ten times the others, so
        that a request that cannot be met ends where the model holds.
        """
        scene = self.scene(request, u)
        state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
        growth = growth_rate_of(scene, state.K_n, state.K_t, self.friction_slope)
        wanted = {
            "a_l >= area_ratio_min a_e": 2
            * (jnp.log(request.area_ratio_min) - state.log_area_ratio)
        }
        if self.tangential_law:
            wanted["Q_e <= slip_ratio_max mu_s P"] = 10 * (
                state.slip_ratio - request.slip_ratio_max
            )
        wanted["growth_rate <= target"] = jnp.arcsinh(
            (growth - request.target) / request.growth_scale
        )
        wanted["K_n >= K_n_min"] = (request.K_n_min - state.K_n) / jnp.where(
            request.K_n_min > 0, request.K_n_min, 1
        )
        for constraint in self.constraints:
            wanted[_name(constraint)] = jnp.asarray(constraint(scene))
        return wanted


def _name(function) -> str:
    return getattr(function, "__name__", repr(function))


@functools.partial(jax.jit, static_argnums=0)
def _linearise(problem: _Problem, request: _Request, us):
    """Objective and requirements (n, 1 + k) of the surfaces us (n, v), and their Jacobian."""

    def both(u):
        value = (problem.value(request, u) - request.value_shift) / request.value_scale
        stacked = jnp.stack([value, *problem.requirements(request, u).values()])
        return stacked, stacked

    def one(u):
        jacobian, stacked = jax.jacfwd(both, has_aux=True)(u)
        return stacked, jacobian

    return jax.vmap(one)(us)


def _model(problem: _Problem, request: _Request, batch: int):
    """`_linearise` as a function of NumPy arrays of any length, through one compiled shape."""

    def linearise(us):
        pieces = []
        for i in range(0, len(us), batch):
            piece = us[i : i + batch]
            padded = np.concatenate([piece, np.repeat(piece[-1:], batch - len(piece), axis=0)])
            both = _linearise(problem, request, jnp.asarray(padded, request.low.dtype))
            pieces.append([np.asarray(x, float)[: len(piece)] for x in both])
        stacked, jacobian = (np.concatenate(x) for x in zip(*pieces, strict=True))
        return stacked[:, 0], stacked[:, 1:], jacobian[:, 0], jacobian[:, 1:]

    return linearise


def design(
    scene: Scene,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    objective: Callable[[Scene], Any] | None = None,
    target: float | None = None,
    K_n_min: float | None = None,
    constraints: Sequence[Callable[[Scene], Any]] = (),
    *,
    area_ratio_min: float = 2.0,
    slip_ratio_max: float = 0.9,
    friction_slope: bool = True,
    starts: int = 128,
    progress: bool = True,
) -> Design:
    """Find by gradients the surface inside `bounds` that is best and meets every requirement.

    Best is, without an `objective`, nearest to the scene's own surface: the least
    d^2 = (dD/(D_hi - D_lo))^2 + (d ln G/(ln G_hi - ln G_lo))^2. An objective is any function of a
    scene that `jax` can differentiate, and is minimised.

    The requirements: growth rate <= `target` [1/s], by default -min(xi_i omega_i)/2; K_n >=
    `K_n_min` [N/m], by default the scene's own; a_l >= `area_ratio_min` a_e; Q_e <=
    `slip_ratio_max` mu_s P (not with a given stiffness ratio); every function of a scene in
    `constraints` <= 0, of order one; and the bounds, on D and G [m] or on one of them, the other
    then staying as it is. `starts` surfaces are improved side by side.

    The same arguments give the same design. A request that cannot be met is a result, not an
    error: see `Design.result`, `Design.violated`.

    **Raises:** `ValueError` for a contact that is not fractal, for bounds on anything else, empty,
    inverted or without the scene's own surface, and for options outside their domain.
    """
    request, problem, bounds = _pose(
        scene,
        DEFAULT_BOUNDS if bounds is None else bounds,
        objective,
        target,
        K_n_min,
        tuple(constraints),
        area_ratio_min,
        slip_ratio_max,
        friction_slope,
    )
    if int(starts) != starts or starts < 1:
        raise ValueError(f"starts must be a whole number of at least 1, got {starts!r}")
    starts = int(starts)
    own = np.asarray(request.start, float)[None]
    _, excess, _, _ = _model(problem, request, starts)(own)
    if objective is None and excess.max() <= 0:
        return _conclude(problem, request, bounds, own, DesignResult.unchanged)
    request, us = _choose_starts(problem, request, starts)
    ends, path_to = search(_model(problem, request, starts), us, _slack(request), progress)
    values, excess, _, _ = _model(problem, request, starts)(ends)
    # Without a value, as where an objective of the limit cycle finds none, a surface is no answer.
    worst = np.where(np.isnan(values), np.inf, np.nan_to_num(excess.max(axis=1), nan=np.inf))
    if (worst <= 0).any():
        values = np.where(worst <= 0, values, np.inf)
        least = values.min()
        # Many starts end in one place: show the walk from the scene's own surface, the first of
        # them, if it is among those, so that the path begins where the reader does.
        best = int(np.flatnonzero(values <= least + 1e-6 * abs(least))[0])
        result = DesignResult.found
    else:
        # Inside the model if that is possible, and there as close as can be to all the rest.
        inside = np.nan_to_num(excess[:, : problem.model_requirements].max(axis=1), nan=np.inf)
        best = int(np.lexsort((worst, np.maximum(inside, 0)))[0])
        result = DesignResult.infeasible
    return _conclude(problem, request, bounds, path_to(best), result)


def _pose(
    scene,
    bounds,
    objective,
    target,
    K_n_min,
    constraints,
    area_ratio_min,
    slip_ratio_max,
    friction_slope,
):
    """Check the arguments of `design` and turn them into numbers and structure."""
    require_scalar(scene)
    if not scene.contact.fractal:
        raise ValueError("design needs a FractalContact: a FixedContact has no surface to change")
    if not bounds or not set(bounds) <= set(DEFAULT_BOUNDS):
        raise ValueError(f"bounds must be on D, G or both, got {', '.join(bounds) or 'none'}")
    surface = scene.contact.surface
    low, high, own, checked = [], [], [], {}
    for name in sorted(bounds):
        scale = jnp.log if name == "G" else jnp.asarray
        ends = [float(number(f"{name} bound", end)) for end in bounds[name]]
        for end in ends:
            scene.replace(**{name: end})  # refuses an end outside the domain of the model
        value = float(getattr(surface, name))
        if not (len(ends) == 2 and ends[0] < ends[1]):
            raise ValueError(f"bounds on {name} must be (lower, upper), got {bounds[name]!r}")
        if not ends[0] <= value <= ends[1]:
            raise ValueError(
                f"{name} must lie inside its bounds [{ends[0]:g}, {ends[1]:g}], got {value:g}"
            )
        low.append(scale(ends[0]))
        high.append(scale(ends[1]))
        own.append(scale(getattr(surface, name)))
        checked[name] = (ends[0], ends[1])
    low, high, own = jnp.stack(low), jnp.stack(high), jnp.stack(own)

    oscillator = scene.oscillator
    decay = jnp.minimum(oscillator.xi_1 * oscillator.omega_1, oscillator.xi_2 * oscillator.omega_2)
    slowest = jnp.minimum(oscillator.omega_1, oscillator.omega_2)
    state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
    numbers = dict(
        low=low,
        high=high,
        start=(own - low) / (high - low),
        target=-decay / 2 if target is None else number("target", target),
        growth_scale=jnp.maximum(decay, 1e-4 * slowest),
        K_n_min=state.K_n if K_n_min is None else number("K_n_min", K_n_min, at_least=0),
        area_ratio_min=number("area_ratio_min", area_ratio_min, at_least=1),
        slip_ratio_max=number("slip_ratio_max", slip_ratio_max, above=0, at_most=1),
        value_shift=jnp.zeros_like(low[0]),
        value_scale=jnp.ones_like(low[0]),
    )
    # In the precision of the scene, whatever that of the arguments.
    dtype = surface.D.dtype
    request = _Request(scene, **{name: jnp.asarray(x, dtype) for name, x in numbers.items()})
    problem = _Problem(
        tuple(checked),
        objective,
        constraints,
        scene.contact.stiffness_ratio is None,
        bool(friction_slope),
    )
    return request, problem, checked


def _slack(request: _Request) -> float:
    """By how much requirements are overfulfilled, so that rounding cannot undo them."""
    return max(1e-6, 10 * float(jnp.finfo(request.low.dtype).eps) ** 0.5)


def _lattice(variables: int):
    per_side = _LATTICE[variables]
    side = (np.arange(per_side) + 0.5) / per_side
    axes = np.meshgrid(*[side] * variables, indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def _choose_starts(problem, request, starts):
    """The scene's own surface, the most promising of a lattice, and an even spread of the rest."""
    lattice = _lattice(len(problem.variables))
    values, excess, _, _ = _model(problem, request, starts)(lattice)
    finite = np.isfinite(values)
    if problem.objective is not None and finite.any():
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
    promising, rest = ranked[: starts // 2], np.sort(ranked[starts // 2 :])
    even = rest[np.linspace(0, len(rest) - 1, starts - starts // 2).astype(int)][1:]
    own = np.asarray(request.start, float)[None]
    return request, np.concatenate([own, lattice[promising], lattice[even]])[:starts]


@functools.partial(jax.jit, static_argnums=0)
def _describe(problem, request, us):
    """The rows of a history: what each of the surfaces us (n, variables) is worth."""

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


def _conclude(problem, request, bounds, path, result) -> Design:
    """Evaluate the end of `path` afresh and say what became of every requirement."""
    path = jnp.asarray(path, request.low.dtype)
    history = {
        name: np.asarray(column) for name, column in _describe(problem, request, path).items()
    }
    final = request.scene
    if result != DesignResult.unchanged:
        # exp(ln G) and the scaling back may end a rounding beyond a bound.
        ends = {name: np.clip(history[name][-1], *bounds[name]) for name in problem.variables}
        final = final.replace(**ends)
    requirements = problem.requirements(request, path[-1])
    excess = {name: float(value) for name, value in requirements.items()}
    for name, place in zip(problem.variables, path[-1].tolist(), strict=True):
        excess |= {f"{name} >= lower bound": -place, f"{name} <= upper bound": place - 1}
    violated = tuple(name for name, value in excess.items() if value > 0)
    return Design(
        scene=final,
        initial=request.scene,
        value=float(history["objective"][-1]),
        growth_rate=float(growth_rate(final, problem.friction_slope)),
        active=tuple(n for n, x in excess.items() if -_ACTIVE * _slack(request) <= x <= 0),
        violated=violated,
        result=result if not violated else DesignResult.infeasible,
        history=history,
        bounds=bounds,
        target=float(request.target),
        K_n_min=float(request.K_n_min),
        friction_slope=problem.friction_slope,
    )
