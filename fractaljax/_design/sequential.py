"""Sequential quadratic programming in a trust region, in JAX, for many designs side by side.

The merit is f + rho sum_i max(0, c_i), an exact penalty: for rho above the multipliers its minimum
is the constrained one. A step that fails by the curvature of the residuals is tried once more with
these corrected to second order. (R. Fletcher, "Practical methods of optimization", 1987, sections
12.4 and 14.4.)
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .quadratic_step import quadratic_step


@dataclasses.dataclass(frozen=True)
class SequentialOptions:
    """How sequential quadratic programming chooses its steps; lengths are of scaled variables.

    **Fields:**

    - `radius`: radius of the trust region at first.
    - `largest_radius`: its largest radius.
    - `acceptance`: share of the promised gain above which a step is taken.
    - `agreement`: share above which the radius doubles.
    - `penalty`: penalty of residuals at first.
    - `penalty_factor`: by how much it grows where a minimum of the merit leaves residuals.
    - `largest_penalty`: the penalty beyond which it does not grow.
    - `closeness`: power of eps, the length of a step after which none follows.
    """

    radius: float = 0.25
    largest_radius: float = 0.5
    acceptance: float = 0.05
    agreement: float = 0.7
    penalty: float = 10.0
    penalty_factor: float = 10.0
    largest_penalty: float = 1e6
    closeness: float = 0.65


class Row(NamedTuple):
    """Objective and residuals at a design, with slopes."""

    f: Float[Array, ""]
    c: Float[Array, " k"]
    g: Float[Array, " v"]
    A: Float[Array, "k v"]
    more: Array  # further numbers of the design

    def merit(self, rho) -> Array:
        return self.f + rho * jnp.sum(jnp.maximum(self.c, 0))


class _State(NamedTuple):
    u: Float[Array, " v"]
    here: Row
    B: Float[Array, "v v"]
    radius: Float[Array, ""]
    rho: Float[Array, ""]
    bend: Float[Array, " k"]  # correction of the residuals to second order, 0 where there is none
    promised: Float[Array, ""]  # by the step that is being corrected
    multipliers: Float[Array, " k"]
    done: Bool[Array, ""]


def sequential(
    row: Callable[[Array], Row],
    start: Float[Array, " v"],
    curvature: float,
    steps: int,
    options: SequentialOptions = SequentialOptions(),
) -> tuple[Float[Array, " v"], Row, Float[Array, " k"]]:
    """The design in [0, 1]^v near `start` with the least f that has c <= 0, its row, multipliers.

    `curvature` is that of f, or a guess; steps are `row`'s evaluations.
    """
    eps = jnp.finfo(start.dtype).eps

    def body(step, state: _State) -> _State:
        u, here, B, radius, rho, bend = state[:6]
        # The first step goes nowhere: the row is compiled once.
        low, high = jnp.maximum(-u, -radius), jnp.minimum(1 - u, radius)
        corrected = jnp.any(bend != 0)
        d, multipliers = quadratic_step(here.g, B, here.c + bend, here.A, rho, low, high)
        trial = jnp.where(step == 0, u, jnp.clip(u + d, 0, 1))
        d = trial - u
        there = row(trial)
        model = here.c + here.A @ d
        lowered = -(here.g @ d + d @ B @ d / 2)
        lowered += rho * jnp.sum(jnp.maximum(here.c, 0) - jnp.maximum(model, 0))
        promised = jnp.where(corrected, state.promised, lowered)
        gained = here.merit(rho) - there.merit(rho)
        size = 1 + jnp.abs(here.merit(rho))
        # Differences of the merit below its rounding have no meaning: such steps are taken.
        tiny = promised <= 1e2 * eps * size
        ratio = jnp.where(tiny, 1.0, gained / jnp.where(promised > 0, promised, 1))
        ratio = jnp.where(jnp.isfinite(gained), ratio, -1.0)
        accepted = (ratio > options.acceptance) & ~(tiny & (gained < -1e3 * eps * size)) | (
            step == 0
        )
        worse = jnp.sum(jnp.maximum(there.c, 0)) > jnp.sum(jnp.maximum(model, 0))
        again = ~accepted & ~corrected & worse
        length = jnp.max(jnp.abs(d))
        radius = jnp.where(
            accepted,
            jnp.where((ratio > options.agreement) & (length > 0.9 * radius), 2 * radius, radius),
            jnp.where(again, radius, jnp.minimum(radius, length) / 3),
        )
        B = jnp.where(accepted & (step > 0), _update_curvature(B, here, there, multipliers, d), B)
        # At a minimum of the merit that leaves residuals the penalty is too small.
        converged = (accepted & (length <= eps**options.closeness)) | (radius <= 4 * eps)
        harder = (
            converged
            & (step > 0)
            & (jnp.sum(jnp.maximum(here.c, 0)) > 0)
            & (rho < options.largest_penalty)
        )
        new = _State(
            u=jnp.where(accepted, trial, u),
            here=jax.tree.map(lambda x, old: jnp.where(accepted, x, old), there, here),
            B=B,
            radius=jnp.where(harder, 0.1, jnp.minimum(radius, options.largest_radius)),
            rho=jnp.where(harder, options.penalty_factor * rho, rho),
            bend=jnp.where(again, there.c - model, 0),
            promised=promised,
            multipliers=jnp.where(accepted, multipliers, state.multipliers),
            done=converged & ~harder & (step > 0),
        )
        return jax.tree.map(lambda x, old: jnp.where(state.done, old, x), new, state)

    shapes = jax.eval_shape(row, start)
    first = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    zero, k = jnp.zeros_like(start[0]), first.c
    B = curvature * jnp.eye(len(start), dtype=start.dtype)
    state = _State(
        start, first, B, zero + options.radius, zero + options.penalty, k, zero, k, zero > 0
    )
    end = jax.lax.fori_loop(0, steps, body, state)
    return end.u, end.here, end.multipliers


def _update_curvature(B, here: Row, there: Row, multipliers, d) -> Array:
    """The curvature of the Lagrangian after a step, by the damped formula of BFGS (Powell)."""
    y = there.g - here.g + (there.A - here.A).T @ multipliers
    Bd = B @ d
    dBd = d @ Bd
    dy = d @ y
    theta = jnp.where(dy < 0.2 * dBd, 0.8 * dBd / jnp.where(dBd > dy, dBd - dy, 1), 1.0)
    y = theta * y + (1 - theta) * Bd
    dy = d @ y
    ok = (dBd > 0) & (dy > 0)
    new = B - jnp.outer(Bd, Bd) / jnp.where(ok, dBd, 1) + jnp.outer(y, y) / jnp.where(ok, dy, 1)
    return jnp.where(ok & jnp.isfinite(new).all(), new, B)
