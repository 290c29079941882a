"""Requirements on the joints of designs, which take no eigenvalues."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from .._base.batches import in_batches
from .._base.programs import exported_jit
from .joints import joint_states
from .problem import UNKNOWN, DesignProblem
from .rows import paired
from .tolerance import quantile

Limits = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def make_joint_limits(problem: DesignProblem) -> Limits:
    """A function of designs (n, v): their residuals (n, r) of joints alone, and Jacobians.

    Each design is at a condition (n, c). Stiffness enters by its logarithm, which changes evenly
    over many steps of a design. Flattening the problem once, not at each call, halves its time.
    """
    leaves, structure = jax.tree.flatten(problem)
    program = functools.partial(_limits_of_joints, leaves, structure=structure)
    dtype = problem.low.dtype

    def limits(us, conditions):
        # Batches are small, for a step in a trust region evaluates few designs at once.
        return in_batches(program, 8, np.asarray(us, dtype), np.asarray(conditions, dtype))

    return limits


def restore_joint_limits(
    problem: DesignProblem,
    us: np.ndarray,
    conditions: np.ndarray,
    margin: float = 0.01,
    steps: int = 40,
) -> np.ndarray:
    """Designs near us (n, v) with every joint inside its limits, as far as possible.

    They go as far inside as `margin`, a residual, in at most `steps`.

    The limits apply at all conditions (m, c). With many joints a random design nearly always has
    one outside, where growth rates are meaningless. The limits take no eigenvalues. The method is
    that of Levenberg and Marquardt.
    """
    limits, (n, v) = make_joint_limits(problem), us.shape

    def violation(us):
        residuals, slopes = limits(*paired(us, conditions))
        residuals, slopes = residuals.reshape(n, -1), slopes.reshape(n, -1, v)
        r = np.clip(np.nan_to_num(residuals, nan=UNKNOWN) + margin, 0, UNKNOWN)
        return r, np.nan_to_num(slopes) * (r > 0)[:, :, None]

    (r, slopes), damping = violation(us), np.ones(len(us))
    for _ in range(steps):
        if not r.any():
            break
        normal = np.einsum("nkv,nkw->nvw", slopes, slopes)
        normal += damping[:, None, None] * np.eye(us.shape[1])
        step = np.linalg.solve(normal, np.einsum("nkv,nk->nv", slopes, r)[:, :, None])[:, :, 0]
        trial = np.clip(us - step, 0, 1)
        other, other_slopes = violation(trial)
        better = (other**2).sum(axis=1) < (r**2).sum(axis=1)
        us = np.where(better[:, None], trial, us)
        r = np.where(better[:, None], other, r)
        slopes = np.where(better[:, None, None], other_slopes, slopes)
        damping = np.clip(np.where(better, damping / 5, damping * 3), 1e-6, 1e6)
    return us


@functools.partial(exported_jit, static_argnames="structure")
def _limits_of_joints(leaves, us, conditions, structure):
    problem: DesignProblem = jax.tree.unflatten(structure, leaves)

    def required(u, condition, shift=None):
        joints = problem.mechanism_at(u, condition, shift).joints_by_name()
        model, stiff = problem.joint_residuals(
            joint_states({name: joints[name] for name in problem.contacts})
        )
        return jnp.stack([*model, *stiff])

    def residuals(u, condition):
        if problem.scatter is None:
            values = required(u, condition)
        else:
            values = jax.vmap(lambda shift: required(u, condition, shift))(problem.scatter.shifts)
            values = quantile(values, problem.scatter.weights, problem.scatter.level)
        model, stiff = jnp.split(values, [problem.model_residuals])
        both = jnp.concatenate([model, -jnp.log1p(-stiff)])
        return both, both

    def one(u, condition):
        slopes, values = jax.jacfwd(residuals, has_aux=True)(u, condition)
        return values, slopes

    return jax.vmap(one)(us, conditions)
