"""Designs by the many: their rows, Jacobians and descriptions, by compiled programs."""

import functools
from typing import TYPE_CHECKING

import jax
import numpy as np

from .._base.batches import in_batches
from .._base.programs import exported_jit

if TYPE_CHECKING:
    from .problem import DesignProblem


def linearise(problem: "DesignProblem", us: np.ndarray, conditions: np.ndarray):
    """Rows (n, 1 + k), their Jacobians (n, 1 + k, v), and what describes designs us (n, v).

    Each design is at a condition (n, c).
    """
    rows, jacobians, numbers = rows_in_batches(linearised, problem, us, conditions)
    rows, jacobians = rows.astype(float), jacobians.astype(float)
    if problem.cycles is not None:
        problem.cycles.fill(problem, us, rows, jacobians)
        numbers = numbers | {"objective": rows[:, 0]}
    return rows, jacobians, numbers


def evaluate(problem: "DesignProblem", us: np.ndarray, conditions: np.ndarray) -> np.ndarray:
    """Objective and residuals (n, 1 + k) of designs us (n, v), each at a condition (n, c)."""
    if not problem.robust:
        return linearise(problem, us, conditions)[0]  # compiled already
    return rows_in_batches(evaluated, problem, us, conditions).astype(float)


def describe(problem: "DesignProblem", us: np.ndarray) -> dict[str, np.ndarray]:
    """Quantities and results (n,) of designs us (n, v), as they are, without scatter."""
    nominal = problem.with_fields(scatter=None)
    return linearise(nominal, *paired(us, np.asarray(problem.nominal_condition)[None]))[2]


def paired(us: np.ndarray, conditions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each of us (n, v) at every one of conditions (m, c): (n m, v) and (n m, c)."""
    return np.repeat(us, len(conditions), axis=0), np.tile(conditions, (len(us), 1))


def rows_in_batches(program, problem, us, conditions):
    """A compiled program of a problem, designs (b, v) and conditions (b, c), for (n, v) of them."""
    problem = problem.with_fields(cycles=None, grid=None)
    dtype = problem.low.dtype
    pairs = np.asarray(us, dtype), np.asarray(conditions, dtype)
    batch = 32
    if problem.modes:
        # Structures take so long that filling up a batch costs more than a call.
        batch = 8 if problem.x.n <= 16 else 1
    return in_batches(functools.partial(program, problem), batch, *pairs)


@exported_jit
def linearised(problem: "DesignProblem", us, conditions):
    """What `linearise` compiles."""

    def one(u, condition):
        def row(u):
            row, numbers = problem.at(u, condition)
            return row, (row, numbers)

        jacobian, (value, numbers) = jax.jacfwd(row, has_aux=True)(u)
        return value, jacobian, numbers

    return jax.vmap(one)(us, conditions)


@exported_jit
def evaluated(problem: "DesignProblem", us, conditions):
    return jax.vmap(lambda u, condition: problem.at(u, condition)[0])(us, conditions)
