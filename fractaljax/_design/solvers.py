"""The solver that lands a design on its requirements."""

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
    from scipy.optimize import minimize

    fun, jac = (lambda z: -constraints(z)[0]), (lambda z: -constraints(z)[1])
    limits = {"type": "ineq", "fun": fun, "jac": jac}
    more: Any = {"method": "SLSQP", "options": {"ftol": 1e-12, "maxiter": 100}}
    return minimize(objective, start, jac=True, bounds=bounds, constraints=limits, **more).x
