"""Descent from many starts side by side, by any optimiser of optax, on an exact penalty.

The merit of a design is its objective and `penalty` times the sum of what is unmet, at the
conditions that count. Steps end at the bounds. A solver corrects what is left unmet: a descent only
has to end in the right basin.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .evaluator import Evaluator
from .functions import compressed, finite
from .rows import linearise, paired


def descend(
    evaluator: Evaluator,
    starts: np.ndarray,
    optimiser: Any,
    limited: np.ndarray,
    scale: float,
    steps: int,
    penalty: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """The best designs on the paths of an optimiser from starts (n, v), and their merit (n,).

    `optimiser` is an `optax.GradientTransformation`, `limited` (1 + k,) marks the columns of a row
    that are requirements, and `scale` is that of the objective. `penalty` is that of residuals.
    """
    dtype, conditions = evaluator.problem.low.dtype, evaluator.working
    update = jax.jit(optimiser.update)
    us, n = np.asarray(starts, float), len(starts)
    state = optimiser.init(jnp.asarray(us, dtype))
    best, lowest = us, np.full(n, np.inf)
    for step in range(steps + 1):
        rows, slopes, _ = linearise(evaluator.problem, *paired(us, conditions))
        merit, gradient = _merit(evaluator, rows, slopes, n, limited, scale, penalty)
        better = merit < lowest
        best, lowest = np.where(better[:, None], us, best), np.where(better, merit, lowest)
        if step < steps:
            changes, state = update(jnp.asarray(gradient, dtype), state, jnp.asarray(us, dtype))
            us = np.clip(us + np.asarray(changes, float), 0, 1)
    return best, lowest


def _merit(evaluator, rows, slopes, n, limited, scale, penalty):
    """The merit (n,) of designs and its slope (n, v), from rows at all their conditions."""
    merits, gradients = [], []
    for row, slope in zip(np.split(rows, n), np.split(slopes, n), strict=True):
        row, slope = finite(*evaluator.average(row, slope))
        worst = int(row[:, 0].argmax())
        c, by_u = compressed(row[:, limited].ravel(), slope[:, limited].reshape(-1, slope.shape[2]))
        unmet = np.maximum(c, 0)
        merits.append(row[worst, 0] / scale + penalty * unmet.sum())
        gradients.append(slope[worst, 0] / scale + penalty * (unmet > 0) @ by_u)
    return np.array(merits), np.array(gradients)


def select_distinct(
    us: np.ndarray, merit: np.ndarray, count: int, distance: float = 0.02
) -> np.ndarray:
    """At most `count` of us (n, v), the best first, farther from one another than `distance`."""
    chosen: list[np.ndarray] = []
    for i in np.argsort(merit, kind="stable"):
        if all(np.abs(us[i] - u).max() > distance for u in chosen) and len(chosen) < count:
            chosen.append(us[i])
    return np.array(chosen)
