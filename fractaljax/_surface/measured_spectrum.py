"""A surface by a table of its power spectrum."""

import math
from collections.abc import Sequence
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import Numbers, brief, concrete, number, quantity
from .spectrum import Pieces, Spectrum, fit_roll_off


@final
class MeasuredSpectrum(Spectrum, law="measured"):
    """A surface by a table of its power spectrum, a power of q between the points.

    **Arguments:**

    - `q`: (k,) wavenumbers [rad/m], two or more, rising and above 0: structure, known at trace
      time. There are no waves beyond the first and the last.
    - `C`: (k,) two-sided power spectrum of the heights [m^4] there, the mean over directions, above
      0: the integral of C q/(2 pi) over q is Sq^2. Differentiable by every entry.
    - `ln_C_error`: (k,) standard errors of ln C, if they are known; None by default.
    - `height_factor`: factor of all heights, above 0, which scatters and can be designed; None
      (default) is 1.

    **Raises:** `ValueError` for a table that is not so; `TypeError` for traced wavenumbers.
    """

    q: tuple[float, ...] = eqx.field(static=True, metadata={"note": "rad/m, wavenumbers"})
    C_table: tuple[Numbers, ...] = eqx.field(
        metadata={"name": "C", "note": "m^4, power spectrum of the heights there"}
    )

    ln_C_error: tuple[float, ...] | None = eqx.field(
        static=True, metadata={"note": "standard errors of ln C"}
    )
    height_factor: Numbers | None = quantity("-", "factor of all heights", log=True)

    def __init__(
        self,
        q: Sequence[float] | ArrayLike,
        C: Sequence[ArrayLike] | ArrayLike,
        ln_C_error: Sequence[float] | ArrayLike | None = None,
        height_factor: ArrayLike | None = None,
    ):
        rows = [number(f"q[{i}]", x, above=0) for i, x in enumerate(_entries("q", q))]
        if any(concrete(x) is None for x in rows):
            raise TypeError("q must be known when a program is traced")
        self.q = tuple(map(float, rows))
        self.C_table = tuple(number(f"C[{i}]", x, above=0) for i, x in enumerate(_entries("C", C)))
        if len(self.q) < 2 or len(self.q) != len(self.C_table):
            counts = f"{len(self.q)} and {len(self.C_table)}"
            raise ValueError(f"q and C must be two or more and as many, got {counts}")
        if ln_C_error is not None:
            errors = enumerate(_entries("ln_C_error", ln_C_error))
            ln_C_error = tuple(float(number(f"ln_C_error[{i}]", x, at_least=0)) for i, x in errors)
            if len(ln_C_error) != len(self.q):
                raise ValueError(f"ln_C_error must be {len(self.q)}, got {len(ln_C_error)}")
        self.ln_C_error = ln_C_error
        if height_factor is not None:
            height_factor = number("height_factor", height_factor, above=0)
        self.height_factor = height_factor
        if not (np.diff(self.q) > 0).all():
            raise ValueError(f"q must rise, got {brief(self.q)}")

    def _logs(self):
        """ln q and ln C of the table, with the factor of the heights."""
        log_C = jnp.log(jnp.stack(self.C_table, axis=-1))
        if self.height_factor is not None:
            log_C = log_C + 2 * jnp.log(self.height_factor)
        return np.log(self.q), log_C

    def m(self, q):
        q = jnp.asarray(q)
        x, log_C = self._logs()
        C = jnp.exp(jnp.interp(jnp.log(q), jnp.asarray(x, log_C.dtype), log_C))
        inside = (q >= self.q[0] * (1 - 1e-9)) & (q <= self.q[-1] * (1 + 1e-9))  # but for rounding
        return jnp.where(inside, q**2 * C / (2 * math.pi), 0)

    def times(self, factor):
        table = tuple(C * factor**2 for C in self.C_table)
        return eqx.tree_at(lambda x: x.C_table, self, table)

    def pieces(self, longest=None, count=64):
        x, log_C = self._logs()
        x = jnp.asarray(x, log_C.dtype)
        slopes = jnp.diff(log_C) / jnp.diff(x)
        # Where waves are too long the pieces have no width.
        low = x[0] if longest is None else jnp.clip(jnp.log(2 * math.pi / longest), x[0], x[-1])
        edges = jnp.maximum(x, low)
        log_m = log_C[:-1] + slopes * (edges - x)[:-1] + 2 * edges[:-1]
        return Pieces(jnp.exp(edges), jnp.exp(log_m) / (2 * math.pi), slopes + 4)

    def moments(self):
        waves = self.pieces()
        return waves.moment(0), waves.moment(2), waves.moment(4)

    def roll_off(self):
        x, log_C = self._logs()
        q = jnp.exp(jnp.asarray(x, log_C.dtype))
        return fit_roll_off(q, q**2 * jnp.exp(log_C))


def _entries(name: str, values) -> list:
    try:
        return list(values)
    except TypeError:
        raise ValueError(f"{name} must have shape (k,), got {brief(values)}") from None
