"""What a design asks of a surface, as numbers that one compiled program judges.

Requirements are functions of a scene that are at most 0 where they are met. Where D and ln G
scatter, each of them is its quantile over the scatter; over an envelope, each must hold at every
condition, or on a smooth or an expected-shortfall average of the worst of them.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.batches import in_batches
from ..base.parts import substitute
from ..mechanism.scene import Scene
from ..modes.stability import growth_rate_of
from .constraints import Constraint
from .tolerance import quantile

_SHARPNESS = 1e-3  # of the smooth maximum that stands for the worst objective in the search


class Scatter(eqx.Module):
    """The quadrature over what machining makes of a surface, and the quantile it is taken at."""

    shifts: dict[str, jax.Array]  # (n,) of D and of ln G
    weights: jax.Array  # (n,)
    level: jax.Array


class Request(eqx.Module):
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
    constraints: tuple[Constraint | None, ...] = ()  # None where the problem has a plain function
    scatter: Scatter | None = None
    risk: Any = None  # (n,) weights of the ordered conditions, or () a temperature


@dataclasses.dataclass(frozen=True)
class Problem:
    """What a design asks, hashable: the structure its programs are compiled for."""

    variables: tuple[str, ...]
    objective: Callable[[Scene], Any] | None
    functions: tuple[Callable[[Scene], Any] | None, ...]  # None where the request has a Constraint
    tangential_law: bool
    friction_slope: bool
    conditions: tuple[str, ...] = ()  # quantities of the envelope, as the columns of its values
    risk: str = "worst"

    @property
    def model_requirements(self) -> int:
        """How many requirements, the first, keep the joint inside the model."""
        return 1 + self.tangential_law

    def names(self, request: Request) -> list[str]:
        """The requirements, as results show them and in the order of `requirements`."""
        own = [
            _name(function) if constraint is None else constraint.name
            for constraint, function in zip(request.constraints, self.functions, strict=True)
        ]
        slip = ["Q_e <= slip_ratio_max mu_s P"] if self.tangential_law else []
        model = ["a_l >= area_ratio_min a_e", *slip]
        return [*model, "growth_rate <= target", "K_n >= K_n_min", *own]

    def scene(self, request: Request, u, condition=None, shift=None) -> Scene:
        """The scene at scaled variables u, a condition (names,) and a shift of D and ln G."""
        x = request.low + u * (request.high - request.low)
        values = {n: jnp.exp(x[i]) if n == "G" else x[i] for i, n in enumerate(self.variables)}
        if condition is not None:
            values |= {name: condition[i] for i, name in enumerate(self.conditions)}
        moved = substitute(request.scene, values)
        if shift is not None:
            surface = moved.contact.surface
            scattered = {
                "D": lambda by: surface.D + by,
                "G": lambda by: surface.G * jnp.exp(by),
            }
            moved = substitute(moved, {name: scattered[name](by) for name, by in shift.items()})
        return moved

    def value(self, request: Request, u, condition=None, shift=None):
        """The objective; without one, the squared distance from the scene's own surface."""
        if self.objective is None:
            return jnp.sum((u - request.start) ** 2)
        return self.objective(self.scene(request, u, condition, shift))

    def requirements(self, request: Request, u, condition=None, shift=None) -> list[jax.Array]:
        """Each at most 0 where it is met, of order one, and continuous everywhere.

        Those that keep the joint inside the model come first and weigh ten times the others, so
        that a request that cannot be met ends where the model holds. The growth rate itself is
        required, not the smooth `margin`: both lead to the same optima (docs/model.md).
        """
        scene = self.scene(request, u, condition, shift)
        state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
        growth = growth_rate_of(scene, state.K_n, state.K_t, self.friction_slope)
        wanted = [2 * (jnp.log(request.area_ratio_min) - state.log_area_ratio)]
        if self.tangential_law:
            wanted.append(10 * (state.slip_ratio - request.slip_ratio_max))
        wanted.append(jnp.arcsinh((growth - request.target) / request.growth_scale))
        wanted.append(
            (request.K_n_min - state.K_n) / jnp.where(request.K_n_min > 0, request.K_n_min, 1)
        )
        for constraint, function in zip(request.constraints, self.functions, strict=True):
            asked = function if constraint is None else constraint
            assert asked is not None  # one or the other
            wanted.append(jnp.asarray(asked(scene)))
        return wanted

    def at(self, request: Request, u, condition=None):
        """Objective and requirements (1 + k,) at one condition: quantiles where D, ln G scatter.

        The default objective is the distance of the surface as ordered, without scatter.
        """

        def numbers(shift):
            value = (self.value(request, u, condition, shift) - request.value_shift) / (
                request.value_scale
            )
            return jnp.stack([value, *self.requirements(request, u, condition, shift)])

        scatter = request.scatter
        if scatter is None:
            return numbers(None)
        scattered = jax.vmap(numbers)(scatter.shifts)
        stacked = quantile(scattered, scatter.weights, scatter.level)
        return stacked if self.objective is not None else stacked.at[0].set(scattered[0, 0])

    def over(self, request: Request, u, conditions=None):
        """Objective (1,) and requirements (k,) over conditions (m, names), as one array.

        For the worst of them, one requirement (k m) for each condition; the largest objective is
        smoothed. Else averages over the conditions, which are equally likely.
        """
        if conditions is None:
            return self.at(request, u)
        each = jax.vmap(lambda condition: self.at(request, u, condition))(conditions)
        if self.risk == "worst":
            value = each[0, 0] if self.objective is None else _soft(each[:, 0], _SHARPNESS)
            return jnp.concatenate([value[None], each[:, 1:].ravel()])
        return self.averaged(request, each)

    def averaged(self, request: Request, each):
        """The columns of (m, 1 + k) taken over m conditions as the risk says."""
        if self.risk == "worst":
            return each.max(axis=0)
        if self.risk == "smooth":
            average = jax.vmap(lambda column: _soft(column, request.risk))(each.T)
        else:
            average = jnp.sort(each, axis=0).T @ request.risk
        return average if self.objective is not None else average.at[0].set(each[0, 0])


def _name(function) -> str:
    return getattr(function, "__name__", repr(function))


def _soft(values, temperature):
    """temperature ln sum exp(values/temperature): at least the largest, and smooth."""
    return temperature * jax.nn.logsumexp(values / temperature)


def expected_shortfall(count: int, alpha: float) -> np.ndarray:
    """Weights (count,) of ordered, equally likely values: the mean of the worst 1 - alpha."""
    edges = np.clip(np.arange(count + 1) / count, alpha, 1)
    return np.diff(edges) / (1 - alpha)


@functools.partial(jax.jit, static_argnums=0)
def _linearise(problem: Problem, request: Request, us, conditions=None):
    """What `Problem.over` gives for surfaces us (n, v), and its Jacobian."""

    def one(u, conditions):
        def both(u):
            stacked = problem.over(request, u, conditions)
            return stacked, stacked

        jacobian, stacked = jax.jacfwd(both, has_aux=True)(u)
        return stacked, jacobian

    return jax.vmap(one)(us, conditions)


@functools.partial(jax.jit, static_argnums=0)
def _judge(problem: Problem, request: Request, us, conditions):
    """What `Problem.at` gives for surfaces us (n, v), each at a condition (n, names) of its own."""
    return jax.vmap(lambda u, condition: problem.at(request, u, condition))(us, conditions)


@dataclasses.dataclass(frozen=True)
class Model:
    """A problem and its numbers, as functions of NumPy arrays."""

    problem: Problem
    request: Request
    batch: int  # surfaces linearised at once
    pairs: int = 128  # of surface and condition judged at once

    def linearise(self, us, conditions=None):
        """Objective (n,), requirements (n, k), and their Jacobians (n, v) and (n, k, v)."""
        program = functools.partial(_linearise, self.problem, self.request)
        both = in_batches(program, self.batch, *self._given(us, conditions))
        stacked, jacobian = (np.asarray(x, float) for x in both)
        return stacked[:, 0], stacked[:, 1:], jacobian[:, 0], jacobian[:, 1:]

    def judge(self, us, conditions):
        """Objective and requirements (n, 1 + k) of surface i at condition i."""
        program = functools.partial(_judge, self.problem, self.request)
        return np.asarray(in_batches(program, self.pairs, *self._given(us, conditions)), float)

    def _given(self, *arrays):
        """Those that are there, in the precision of the request."""
        return [x.astype(self.request.low.dtype) for x in arrays if x is not None]

    def judge_all(self, us, conditions):
        """Objective and requirements (n, m, 1 + k) of every surface at every condition."""
        n, m = len(us), len(conditions)
        flat = self.judge(np.repeat(us, m, axis=0), np.tile(conditions, (n, 1)))
        return flat.reshape(n, m, -1)

    def averaged(self, each):
        """The columns of (n, m, 1 + k) taken over m conditions as the risk says."""
        over = functools.partial(self.problem.averaged, self.request)
        return np.asarray(jax.vmap(over)(jnp.asarray(each, self.request.low.dtype)), float)
