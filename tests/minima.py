"""Problems on [0, 1]^2 with known minima, for every solver: (f, c, solution), c at most 0.

In operations that NumPy and JAX share.
"""

from collections.abc import Callable
from typing import Any

MINIMA: list[tuple[Callable[[Any], Any], Callable[[Any], tuple], tuple[float, float]]] = [
    # Outside a circle, nearest to a point inside it: along the radius.
    (
        lambda u: (u[0] - 0.6) ** 2 + (u[1] - 0.5) ** 2,
        lambda u: (0.09 - (u[0] - 0.5) ** 2 - (u[1] - 0.5) ** 2,),
        (0.8, 0.5),
    ),
    # Two curves meet in a corner, where residuals are far from order one.
    (
        lambda u: u[0] + 2 * u[1],
        lambda u: (1e3 * (0.25 - u[0] * u[1]), 1e3 * (u[0] ** 2 - 0.36)),
        (0.6, 0.25 / 0.6),
    ),
    # The bounds alone decide.
    (lambda u: u[0] - u[1], lambda u: (-1 + 0 * u[0],), (0.0, 1.0)),
    # Nothing decides: a smooth minimum inside.
    (
        lambda u: (u[0] - 0.3) ** 2 + 5 * (u[1] - 0.7 - u[0] ** 2 / 2) ** 2,
        lambda u: (-1 + 0 * u[0],),
        (0.3, 0.745),
    ),
]
