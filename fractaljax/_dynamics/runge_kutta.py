"""One explicit Runge-Kutta step with the coefficients of a diffrax solver.

diffrax integrates many steps in sequence. Here an orbit is cut into segments of one step each,
which all advance at once.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def runge_kutta(tableau, field: Callable, y, h, *, error: bool = False) -> Any:
    """The state after a step h of dy/dt = field(y); y of any shape, h broadcasts with it.

    With `error`, also the difference from the embedded method of lower order.

    `tableau` is that of an explicit diffrax solver. The stages are a loop, which compiles several
    times faster than stages written out.
    """
    shape = jnp.broadcast_shapes(y.shape, jnp.shape(h))
    y, h = jnp.broadcast_to(y, shape), jnp.broadcast_to(h, shape)
    stages, rows = len(tableau.b_sol), _matrix(tableau)

    def weighted(weights, slopes):
        return jnp.tensordot(weights, slopes, 1, precision="highest")

    def stage(slopes, now):
        i, row = now
        slope = field(y + h * weighted(row, slopes))
        return jax.lax.dynamic_update_index_in_dim(slopes, slope, i, 0), None

    none = jnp.zeros((stages, *y.shape), y.dtype)
    slopes, _ = jax.lax.scan(stage, none, (jnp.arange(stages), jnp.asarray(rows, y.dtype)))
    end = y + h * weighted(jnp.asarray(tableau.b_sol, y.dtype), slopes)
    return (end, h * weighted(jnp.asarray(tableau.b_error, y.dtype), slopes)) if error else end


def stability_polynomial(tableau) -> np.ndarray:
    """Coefficients, from that of z^0 on, of a step's factor for dy/dt = a y, where z = a h."""
    rows, power, coefficients = _matrix(tableau), np.ones(len(tableau.b_sol)), [1.0]
    for _ in rows:
        coefficients.append(float(tableau.b_sol @ power))
        power = rows @ power
    return np.array(coefficients)


def _matrix(tableau) -> np.ndarray:
    """The coefficients (stages, stages) of a stage's state by the slopes before it."""
    rows = np.zeros((len(tableau.b_sol),) * 2)
    for i, row in enumerate(tableau.a_lower):
        rows[i + 1, : len(row)] = row
    return rows
