"""A contact law interpolated from a measurement."""

from collections.abc import Sequence
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, ScalarLike

from .._base.parts import Numbers, concrete, number, quantity, scalar
from .boundary_element import boundary_element
from .contact import Contact
from .material import Material, mindlin_ratio


@final
class MeasuredContact(Contact, law="measured"):
    """Measured stiffness: K_n(P) through the points of a table, and K_t = stiffness_ratio K_n.

    ln K_n is a monotone cubic of ln P between `loads` [N] (Fritsch and Carlson, SIAM J. Numer.
    Anal. 17, 238, 1980), with the `stiffnesses` [N/m] measured there; beyond the first and the last
    load it continues as the power law of that end. The table is structure: it has no derivatives.
    The joint has a load curve if that power is from 0 to below 1 at the first load; else it would
    not open at a finite gap.

    **Raises:** `ValueError` unless P > 0, stiffness_ratio >= 0, and the table has two rows or more,
    increasing loads above 0, and as many stiffnesses above 0; `TypeError` for a traced table.
    """

    loads: tuple[float, ...] = eqx.field(static=True, metadata={"note": "N, of the measurement"})
    stiffnesses: tuple[float, ...] = eqx.field(static=True, metadata={"note": "N/m, K_n there"})
    P: Numbers = quantity("N", "normal load", log=True)
    stiffness_ratio: Numbers = quantity("-", "K_t/K_n")

    def __init__(
        self,
        loads: Sequence[float] | ArrayLike,
        stiffnesses: Sequence[float] | ArrayLike,
        P: ArrayLike,
        stiffness_ratio: ArrayLike,
    ):
        self.loads = _column("loads", loads)
        self.stiffnesses = _column("stiffnesses", stiffnesses)
        if len(self.loads) < 2 or len(self.loads) != len(self.stiffnesses):
            raise ValueError(
                "loads and stiffnesses must be two or more and as many, got "
                f"{len(self.loads)} and {len(self.stiffnesses)}"
            )
        if not (np.diff(self.loads) > 0).all():
            raise ValueError(f"loads must rise, got {self.loads}")
        self.P = number("P", P, above=0)
        self.stiffness_ratio = number("stiffness_ratio", stiffness_ratio, at_least=0)

    @classmethod
    def from_heights(
        cls,
        heights: Float[ArrayLike, "nx ny"],
        dx: ScalarLike,
        material: Material,
        P: ArrayLike,
        area: ScalarLike,
        stiffness_ratio: ArrayLike | None = None,
        *,
        pressures: Sequence[float] | None = None,
        plastic: bool = False,
    ) -> "MeasuredContact":
        """The law of a measured map, pressed on a flat by boundary elements.

        It needs no statistics, so that surfaces with plateaus or deep grooves are right too, as far
        as the map is large enough: its highest hill carries the smallest loads. On a larger area
        the map is repeated side by side.

        **Arguments:**

        - `heights`: (nx, ny) [m], level and without gaps; opposite edges are taken to meet.
        - `dx`: grid spacing [m], the same in x and y.
        - `material`: of the pair; E alone counts unless `plastic`.
        - `P`: normal load of the joint [N].
        - `area`: nominal area of the joint [m^2].
        - `stiffness_ratio`: K_t/K_n, by default Mindlin's (2 - 2 nu)/(2 - nu).
        - `pressures`: rising nominal pressures [Pa] of the table; by default 12 from 1e-3 to .5
          E Sdq, less if all of the map touches before.
        - `plastic`: True lets no pressure exceed the hardness; False by default.

        **Raises:** as `boundary_element`; `ValueError` unless area > 0, and for pressures of which
        fewer than two leave gaps.
        """
        heights, dx = number("heights", heights), scalar("dx", dx, above=0)
        area = scalar("area", area, above=0)
        nominal = float(dx) ** 2 * heights.size
        if pressures is None:
            slopes = (np.diff(heights, axis=axis) / float(dx) for axis in (0, 1))
            Sdq = float(np.sqrt(sum(np.mean(slope**2) for slope in slopes)))
            pressures = list(np.geomspace(1e-3, 0.5, 12) * float(material.E) * Sdq)
        loads, stiffnesses = [], []
        for pressure in pressures:
            pressed = boundary_element(heights, dx, material, pressure * nominal, plastic=plastic)
            if not np.isfinite(pressed.K_n):
                break
            loads.append(pressure * float(area))
            stiffnesses.append(float(pressed.K_n) * float(area) / nominal)
        if len(loads) < 2:
            raise ValueError("pressures must be two or more that leave gaps between the surfaces")
        ratio = mindlin_ratio(material.nu) if stiffness_ratio is None else stiffness_ratio
        return cls(loads, stiffnesses, P, ratio)

    @property
    def opening_exponent(self):
        """The exponent of the power law below the first load."""
        slope = float(self._curve().derivative()(np.log(self.loads[0])))
        return slope if 0 <= slope < 1 else None

    @property
    def load_borders(self):
        """The loads of the table [N], between which K_n(P) is smooth."""
        return self.loads

    def _curve(self):
        """ln K_n over ln P."""
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(np.log(self.loads), np.log(self.stiffnesses))

    def stiffness(self, mu_s, mu_m):
        x, y, curve = np.log(self.loads), np.log(self.stiffnesses), self._curve()
        first, last = curve.derivative()(x[[0, -1]])
        # Columns are cubics of the distance from the left end of an interval.
        cubics = np.column_stack([[0, 0, first, y[0]], curve.c, [0, 0, last, y[-1]]])
        at = jnp.log(self.P)
        interval = jnp.searchsorted(jnp.asarray(x, at.dtype), at)
        a, b, c, d = jnp.asarray(cubics, at.dtype)[:, interval]
        t = at - jnp.asarray(x[[0, *range(len(x))]], at.dtype)[interval]
        K_n = jnp.exp(((a * t + b) * t + c) * t + d)
        return K_n, self.stiffness_ratio * K_n


def _column(name: str, values) -> tuple[float, ...]:
    column = [number(f"{name}[{i}]", x, above=0) for i, x in enumerate(values)]
    if any(concrete(x) is None for x in column):
        raise TypeError(f"{name} must be known when a program is traced")
    return tuple(map(float, column))
