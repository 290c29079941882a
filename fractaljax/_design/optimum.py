"""The best design of one problem as a pure function, and how it moves with the problem.

Designs of a low-discrepancy set are screened; from the most promising distinct ones sequential
quadratic programming lands on the requirements (`sequential.py`), and the best end that meets all
of them is the answer. Its derivatives are implicit: those of the conditions of Karush, Kuhn and
Tucker that it solves. (A. V. Fiacco, "Introduction to sensitivity and stability analysis in
nonlinear programming", 1983, section 3.2.)
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._base.parts import Record, nan_where
from .._base.ranges import low_discrepancy
from .functions import compressed, finite
from .problem import DesignProblem
from .result import DesignResult, is_met
from .sequential import Row, sequential


class Optimum(Record):
    """The best design of one problem, or of a batch of them."""

    u: Float[Array, " v"]  # scaled variables
    quantities: dict[str, Float[Array, ""]]  # the designed quantities in SI units
    value: Float[Array, ""]  # the objective; by default the squared scaled distance
    growth_rate: Float[Array, ""]  # [1/s]
    residuals: Float[Array, " k"]  # at most 0 where a requirement is met
    result: Any  # a member of `DesignResult`


def optimum(problem: DesignProblem, starts: int, lattice: int, steps: int) -> Optimum:
    """The best design from `starts` of `lattice` screened designs, each in at most `steps`.

    Differentiable by the numbers of the problem, in both modes; NaN without a design.
    """
    frozen = jax.lax.stop_gradient(problem)
    u, multipliers, result = jax.lax.stop_gradient(_search(frozen, starts, lattice, steps))
    u = _implicit(problem, u, multipliers, is_met(result))
    u = nan_where(result == DesignResult.undetermined, u)
    row, numbers = problem.at(u, problem.nominal_condition)
    if problem.scatter is not None:
        numbers = problem.with_fields(scatter=None).at(u, problem.nominal_condition)[1]
    named = row[problem.named_columns]
    return Optimum(
        u=u,
        quantities=problem.quantities(u),
        value=named[0],
        growth_rate=numbers["growth_rate"],
        residuals=named[1:],
        result=result,
    )


def _search(problem: DesignProblem, starts: int, lattice: int, steps: int):
    """The best design (v,), the multipliers of its residuals, and the result."""
    limited, is_named = problem.limited, problem.named_columns
    slack = max(1e-9, problem.rounding)
    slack = jnp.where(is_named[limited], slack, 0.01 * slack).astype(problem.low.dtype)
    start = jnp.clip(problem.start, 0, 1)

    def row_of(u):
        return problem.at(u, problem.nominal_condition)[0]

    us = jnp.asarray(low_discrepancy(lattice, len(start)), start.dtype)
    us = jnp.concatenate([start[None], us])
    rows = jax.vmap(lambda u: row_of(u)[is_named])(us)
    screened = jnp.all(jnp.isfinite(rows), axis=1)
    scale: Any = jnp.ones_like(start[0])
    if problem.objective is not None:
        values = jnp.where(screened, rows[:, 0], jnp.nan)
        scale = jnp.nanquantile(values, 0.9) - jnp.nanquantile(values, 0.1)
        scale = jnp.where(scale > 0, scale, 1)
    merit = rows[:, 0] / scale + 10 * jnp.sum(jnp.maximum(rows[:, 1:], 0), axis=1)
    merit = jnp.where(screened, merit, jnp.inf)
    first = us[_select_distinct(us, merit, starts)]

    def linearised(u) -> Row:
        def values(u):
            row = row_of(u)
            return row, row

        slopes, row = jax.jacfwd(values, has_aux=True)(u)
        named = row[is_named]
        row, slopes = finite(row, slopes, jnp)
        c, A = compressed(row[limited] + slack, slopes[limited], jnp)
        return Row(row[0] / scale, c, slopes[0] / scale, A, named)

    curvature = 2.0 if problem.objective is None else 1.0
    ends, ended, multipliers = jax.vmap(lambda u: sequential(linearised, u, curvature, steps))(
        first
    )
    named = ended.more
    has_number = jnp.all(jnp.isfinite(named), axis=1)
    worst = jnp.where(has_number, jnp.max(named[:, 1:], axis=1, initial=-jnp.inf), jnp.inf)
    met = worst <= 0
    best = jnp.where(
        jnp.any(met),
        jnp.argmin(jnp.where(met, named[:, 0], jnp.inf)),
        jnp.argmin(worst),
    )
    u, multipliers = ends[best], multipliers[best] * scale
    unchanged: Any = jnp.zeros_like(met[0])
    if problem.objective is None:
        unchanged = screened[0] & jnp.all(rows[0, 1:] <= 0)
        u = jnp.where(unchanged, problem.start, u)
        multipliers = jnp.where(unchanged, 0, multipliers)
    result = DesignResult.where(jnp.any(met), DesignResult.found, DesignResult.infeasible)
    result = DesignResult.where(unchanged, DesignResult.unchanged, result)
    none = ~(jnp.any(screened) | jnp.any(has_number))
    return u, multipliers, DesignResult.where(none, DesignResult.undetermined, result)


def _select_distinct(us, merit, count: int, distance: float = 0.15) -> Array:
    """The numbers (count,) of designs: the given one, and the best ones by `distance` or more."""
    chosen = [jnp.zeros((), int)]
    for _ in range(count - 1):
        best = jnp.argmin(merit)
        chosen.append(best)
        near = jnp.max(jnp.abs(us - us[best][None]), axis=1) < distance
        merit = jnp.where(near, jnp.inf, merit)
    return jnp.stack(chosen)


@jax.custom_jvp
def _implicit(problem: DesignProblem, u, multipliers, is_optimal: Bool[Array, ""]):
    """u itself, which follows its problem as the conditions of an optimum say."""
    return u


@_implicit.defjvp
def _implicit_jvp(primals, tangents):
    problem, u, multipliers, is_optimal = primals
    limited = problem.limited

    def values(problem, u):
        row = problem.at(u, problem.nominal_condition)[0]
        return row[0], row[limited]

    def by_design(u):
        return jax.jacfwd(lambda u: values(problem, u))(u)

    def by_problem(u):
        return jax.jvp(lambda problem: values(problem, u), (problem,), (tangents[0],))[1]

    f_slope, A = by_design(u)
    shifts = by_problem(u)[1]
    near_bound = 1e-6
    # Rounding leaves requirements a multiplier that are not active.
    active = multipliers > 1e-7 * jnp.max(multipliers)
    near = max(near_bound, 10 * problem.rounding)
    active = active & (values(problem, u)[1] >= -near)
    slope = f_slope + jnp.where(active, multipliers, 0) @ A
    # A variable that a bound holds does not move, and a requirement that is not active holds none.
    held = ((u <= near_bound) & (slope > 0)) | ((u >= 1 - near_bound) & (slope < 0))
    A = jnp.where(active[:, None] & ~held[None], A, 0)
    # Where more is active than there are variables, a part so small picks one of the multipliers.
    lower = jnp.diag(jnp.where(active, -1e-12, 1.0)).astype(u.dtype)
    # Multipliers of the search are only as exact as its last step.
    right = A @ jnp.where(held, 0, f_slope)
    weights = -jnp.linalg.solve(A @ A.T - lower, right[:, None])[:, 0]

    def lagrangian_slopes(u):
        """Its slope by the design, and its change with the problem."""
        (f_slope, A), (f, c) = by_design(u), by_problem(u)
        return f_slope + weights @ A, f + weights @ c

    H, forces = _differences(lagrangian_slopes, u)
    H = jnp.where(held[:, None] | held[None], jnp.eye(len(u), dtype=u.dtype), H)
    K = jnp.block([[H, A.T], [A, lower]])
    right = jnp.concatenate([jnp.where(held, 0, -forces), jnp.where(active, -shifts, 0)])
    u_tangent = jnp.linalg.solve(K, right[:, None])[: len(u), 0]
    return u, nan_where(~is_optimal, u_tangent)


def _differences(function: Callable[[Array], Any], u: Float[Array, " v"]) -> Any:
    """As `jax.jacfwd(function)(u)`, by differences of fourth order.

    Eigenvalues of structures have no second derivatives; and those of scenes, which have, would
    take five times as long to compile.
    """
    step = jnp.finfo(u.dtype).eps ** 0.2  # rounding, eps/h, is as small as the rest, h^4
    steps, weights = np.array([-2, -1, 1, 2]), np.array([1, -8, 8, -1]) / 12
    points = u[None, None] + step * steps[:, None, None] * np.eye(len(u))[None]
    values = jax.vmap(jax.vmap(function))(points.astype(u.dtype))
    weights = jnp.asarray(weights / step, u.dtype)
    return jax.tree.map(lambda x: jnp.moveaxis(jnp.tensordot(weights, x, 1), 0, -1), values)
