"""The solver that lands a design on its requirements."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

Solver = Callable[[Callable, Callable, np.ndarray, np.ndarray], np.ndarray]


def slsqp(objective: Callable, constraints: Callable, start: np.ndarray, bounds: np.ndarray):
    """The default solver: SciPy's sequential quadratic programming.

    Any other has this signature: `objective(z)` gives a value and its gradient (n,),
    `constraints(z)` residuals (k,), at most 0 where met, and their Jacobian (k, n); `start` (n,),
    `bounds` (n, 2). It returns a point (n,).
    """
    fun, jac = (lambda z: -constraints(z)[0]), (lambda z: -constraints(z)[1])
    limits = {"type": "ineq", "fun": fun, "jac": jac}
    return minimise(objective, start, bounds, limits, 100)


def minimise(
    objective: Callable, start: np.ndarray, bounds: Any, constraints: Any, steps: int, ftol=1e-12
):
    """The point (n,) at which SLSQP ends; `objective` gives value and gradient."""
    from scipy.optimize import minimize

    more: Any = {"method": "SLSQP", "options": {"ftol": ftol, "maxiter": steps}}
    with warnings.catch_warnings():
        # Before SciPy 1.16 a step may leave a bound by rounding, and says so.
        warnings.filterwarnings("ignore", "Values in x were outside bounds", RuntimeWarning)
        end = minimize(objective, start, jac=True, bounds=bounds, constraints=constraints, **more)
    return end.x
