"""Solvers that land a design on its requirements: SLSQP, as it is and in steps."""

from collections.abc import Callable
from typing import Any

import numpy as np

Solver = Callable[[Callable, Callable, np.ndarray, np.ndarray], np.ndarray]

_STEP, _STEPS, _STEP_ITERATIONS = 0.25, 12, 10  # of a design among many joints, in its bounds


def slsqp(objective: Callable, constraints: Callable, start: np.ndarray, bounds: np.ndarray):
    """The default solver: SciPy's sequential quadratic programming.

    Any other has this signature: `objective(z)` gives a value and its gradient (n,),
    `constraints(z)` residuals (k,), at most 0 where met, and their Jacobian (k, n); `start` (n,),
    `bounds` (n, 2). It returns a point (n,).
    """
    return _slsqp(objective, constraints, start, bounds).x


def slsqp_in_steps(
    objective: Callable, constraints: Callable, start: np.ndarray, bounds: np.ndarray
):
    """`slsqp` within a box about the design, which goes along with it.

    Far from the requirements of many joints their slopes promise too much: without a box most
    starts end where joints are plastic, which have no slope that leads back.
    """
    z = np.asarray(start, float)
    for _ in range(_STEPS):
        box = _box(z, bounds)
        found = _slsqp(objective, constraints, z, box, _STEP_ITERATIONS, 1e-8)
        stuck, z = np.abs(found.x - z).max() < 1e-8, found.x
        held = (z <= box[:, 0]) & (box[:, 0] > bounds[:, 0])
        held |= (z >= box[:, 1]) & (box[:, 1] < bounds[:, 1])
        if stuck or (found.success and not held.any()):
            break
    return _slsqp(objective, constraints, z, _box(z, bounds)).x


def _box(z: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Bounds no further from z than a step; what has none, such as a largest residual, is free."""
    step = np.where(np.isfinite(bounds).all(axis=1), _STEP, np.inf)
    return np.stack([np.maximum(bounds[:, 0], z - step), np.minimum(bounds[:, 1], z + step)], 1)


def _slsqp(objective, constraints, start, bounds, iterations=100, ftol=1e-12) -> Any:
    from scipy.optimize import minimize

    fun, jac = (lambda z: -constraints(z)[0]), (lambda z: -constraints(z)[1])
    limits = {"type": "ineq", "fun": fun, "jac": jac}
    more: Any = {"method": "SLSQP", "options": {"ftol": ftol, "maxiter": iterations}}
    return minimize(objective, start, jac=True, bounds=bounds, constraints=limits, **more)
