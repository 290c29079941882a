"""A design problem in a solver's form: an objective and constraints with their slopes."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .problem import UNKNOWN


@dataclasses.dataclass
class Functions:
    """Minimise f subject to c <= 0: what a solver calls, with one evaluation at each point.

    The largest of the columns in `aim` of rows (m, 1 + k) is minimised, by an additional variable
    (`extra`) where there are several; the columns in `limited` are met with some slack, so that
    rounding cannot violate them.
    """

    rows_at: Callable
    aim: np.ndarray  # (1 + k,), True for columns to minimise
    limited: np.ndarray  # (1 + k,), True for columns to keep at most 0
    slack: float | np.ndarray  # (1 + k,)
    scale: float  # of the objective
    extra: bool
    evaluated: list[np.ndarray] = dataclasses.field(
        default_factory=list
    )  # where rows were evaluated
    _cache: dict[bytes, Any] = dataclasses.field(default_factory=dict)

    def at(self, z):
        """Rows and their Jacobians at z, which is u (v,) or, with the extra variable, (u, t)."""
        u = np.clip(z[:-1] if self.extra else z, 0, 1)
        if u.tobytes() not in self._cache:
            rows, jacobians = finite(*self.rows_at(u))
            scale = np.where(np.arange(rows.shape[1]) == 0, self.scale, 1)
            self._cache[u.tobytes()] = rows / scale, jacobians / scale[:, None]
            self.evaluated.append(u.copy())
        return self._cache[u.tobytes()]

    def objective(self, z):
        """Value and gradient."""
        if self.extra:
            return z[-1], np.eye(len(z))[-1]
        rows, jacobians = self.at(z)
        return rows[0, 0], jacobians[0, 0].copy()  # solvers write into it

    def constraints(self, z):
        """Residuals and their Jacobian, compressed where they are not of order one."""
        (rows, jacobians), v = self.at(z), len(z) - self.extra
        c = (rows + self.slack)[:, self.limited].ravel()
        c, slopes = compressed(c, jacobians[:, self.limited].reshape(-1, v))
        if self.extra:
            aimed, aim_slopes = rows[:, self.aim].ravel(), jacobians[:, self.aim].reshape(-1, v)
            c = np.append(c, aimed - z[-1])
            by_t = np.append(np.zeros(len(slopes)), -np.ones(len(aimed)))
            slopes = np.column_stack([np.concatenate([slopes, aim_slopes]), by_t])
        return c, slopes


def finite(rows: Any, slopes: Any, xp: Any = np) -> tuple[Any, Any]:
    """Rows with finite numbers in place of undefined ones, and slopes with zeros.

    `xp` is NumPy, or JAX's where they are traced.
    """
    rows = xp.nan_to_num(rows, nan=UNKNOWN, posinf=UNKNOWN, neginf=-UNKNOWN)
    return rows, xp.nan_to_num(slopes, posinf=0, neginf=0)


def compressed(c: Any, slopes: Any, xp: Any = np) -> tuple[Any, Any]:
    """Residuals (k,) and slopes (k, v), by logarithms where they are beyond order one."""
    size = xp.maximum(xp.abs(c), 1)
    return xp.where(size > 1, xp.sign(c) * (1 + xp.log(size)), c), slopes / size[:, None]
