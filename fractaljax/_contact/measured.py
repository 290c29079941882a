"""A contact law interpolated from a measurement."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, ScalarLike

from .._base.parts import (
    Numbers,
    array_like,
    concrete,
    flag,
    is_traced,
    number,
    quantity,
    require_kind,
    scalar,
)
from .._base.warn import warn_user
from .boundary_element import BoundaryElementResult, boundary_element
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
        z: Float[ArrayLike, "nx ny"] | Any,
        dx: ScalarLike | None,
        material: Material,
        P: ArrayLike,
        area: ScalarLike,
        stiffness_ratio: ArrayLike | None = None,
        *,
        dy: ScalarLike | None = None,
        prepare: bool | None = None,
        pressures: Sequence[float] | None = None,
        plastic: bool = False,
    ) -> "MeasuredContact":
        """The law of a measured map, pressed on a flat by boundary elements.

        It needs no statistics, so that surfaces with plateaus or deep grooves are right too, as far
        as the map is large enough: its highest hill carries the smallest loads. On a larger area
        the map is repeated side by side; opposite edges are taken to meet.

        The table ends where all of the map touches, or where `plastic` at the hardness. A warning
        says if P is outside it, if boundary elements did not converge at a pressure, which is then
        left out, and if heights were taken for spikes.

        **Arguments:**

        - `z`: (nx, ny) [m], NaN where missing, or what `spectrum_of` takes: a `Measurement`, the
          path of a file, a topography of SurfaceTopography.
        - `dx`: grid spacing [m] along the first axis, or None for what z says.
        - `material`: of the pair; E alone counts unless `plastic`.
        - `P`: normal load of the joint [N].
        - `area`: nominal area of the joint [m^2].
        - `stiffness_ratio`: K_t/K_n, by default Mindlin's (2 - 2 nu)/(2 - nu).
        - `dy`: grid spacing [m] along the second axis, by default what z says, else dx.
        - `prepare`: True takes out spikes, gaps and the least-squares plane, as
          `prepare_measurement` does; False presses the heights as they are. By default an array
          without gaps is pressed as it is, with a warning if most of it is a tilt, and everything
          else is prepared. The plane of all heights, grooves included, may leave a plateau askew:
          level such a map by its plateau.
        - `pressures`: rising nominal pressures [Pa] of the table. By default 12 from 1e-3 to .5
          E Sdq, and below them, each at least a quarter of the next, down to the P of the joint, as
          long as two points touch.
        - `plastic`: True lets no pressure exceed the hardness; False by default.

        **Raises:** `ValueError` for a profile, for heights and steps as `spectrum_of` does, for a
        map smaller than 16 x 16, unless area > 0, and for pressures of which fewer than two leave
        gaps; `RuntimeError` if boundary elements converge at fewer than two; `OSError` if a file
        cannot be read.
        """
        from .._identify.prepare_measurement import prepared, read_map, tilt_share

        require_kind("material", material, Material)
        P, area = number("P", P, above=0), scalar("area", area, above=0)
        ratio = mindlin_ratio(material.nu) if stiffness_ratio is None else stiffness_ratio
        ratio = number("stiffness_ratio", ratio, at_least=0)
        if is_traced((z, dx, dy, material, area)):
            raise TypeError("z, steps, material and area must be known when a program is traced")
        prepare = None if prepare is None else flag("prepare", prepare)
        z, plastic = array_like("z", z), flag("plastic", plastic)
        read = read_map(z, dx, dy)
        if prepare is None:
            prepare = bool(read.missing) or not hasattr(z, "dtype")
            if not prepare and (share := tilt_share(read)) > 0.5:
                warn_user(
                    f"a plane is {share:.0%} of the mean square of z, and makes it softer: "
                    "from_heights(..., prepare=True) takes it out"
                )
        if prepare:
            read, spikes = prepared(read)
            if spikes:
                warn_user(
                    f"{spikes} of {read.z.size} heights were taken for spikes and filled: if they "
                    "are hills, from_heights(..., prepare=False) presses them too"
                )
        elif read.missing:
            raise ValueError(
                f"z must be finite with prepare=False, got {read.missing} NaN: prepare=True fills "
                "them"
            )
        press = _Press(read, material, plastic)
        if pressures is None:
            rows = _rows_down_to(press, concrete(P), float(area))
        else:
            chosen = _column("pressures", pressures)
            if not (np.diff(chosen) > 0).all():
                raise ValueError(f"pressures must rise, got {chosen}")
            rows = press.rows(chosen)
        press.warn()
        loads = [row.pressure * float(area) for row in rows]
        law = cls(loads, [row.stiffness * float(area) for row in rows], P, ratio)
        for words in _outside(concrete(P), loads):
            warn_user(words)
        return law

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


class _Row(NamedTuple):
    """A nominal pressure, and the stiffness per nominal area there."""

    pressure: float  # [Pa]
    stiffness: float  # [N/m^3]
    points: int  # how many touch


class _Press:
    """A map pressed on a flat; it notes the pressures [Pa] at which there is no solution."""

    def __init__(self, read: Any, material: Material, plastic: bool):
        self.read, self.material, self.plastic = read, material, plastic
        self.nominal = read.dx * read.dy * read.z.size  # [m^2]
        self.failed: list[float] = []

    def at(self, pressure: float) -> _Row | None:
        """The row of a pressure; None at full contact, or above what the surface carries."""
        pressed = boundary_element(
            self.read.z,
            self.read.dx,
            self.material,
            pressure * self.nominal,
            plastic=self.plastic,
            aspect=self.read.dy / self.read.dx,
            throw=False,
        )
        stiffness = float(pressed.K_n) / self.nominal
        too_soft = bool(pressed.result == BoundaryElementResult.too_soft)
        if too_soft or not math.isfinite(stiffness):
            return None
        if bool(pressed.result != BoundaryElementResult.converged):
            self.failed.append(pressure)
        return _Row(pressure, stiffness, int((pressed.pressure > 0).sum()))

    def rows(self, pressures: Sequence[float]) -> list[_Row]:
        """The rows of rising pressures up to full contact, less those that did not converge.

        **Raises:** `ValueError` or `RuntimeError` if fewer than two are left.
        """
        found = list(itertools.takewhile(bool, map(self.at, pressures)))
        rows = [row for row in found if row is not None and row.pressure not in self.failed]
        if len(rows) >= 2:
            return rows
        if self.failed:
            raise RuntimeError(
                f"boundary elements converged at {len(rows)} of {len(found)} pressures and two are "
                "needed: give other pressures, or a part of the map"
            )
        below = " and are below the hardness" if self.plastic else ""
        raise ValueError(
            f"pressures must be two or more that leave gaps between the surfaces{below}"
        )

    def warn(self) -> None:
        """Say which pressures the table leaves out."""
        if self.failed:
            words = ", ".join(f"{pressure:.3g}" for pressure in sorted(self.failed))
            warn_user(
                f"boundary elements did not converge at {words} Pa: the table leaves out these "
                "nominal pressures, and interpolates"
            )


def _rows_down_to(press: _Press, P: np.ndarray | None, area: float) -> list[_Row]:
    """The rows of the default pressures, and of smaller ones down to that of the smallest P."""
    steps = press.read.dx, press.read.dy
    slopes = (np.diff(press.read.z, axis=axis) / step for axis, step in enumerate(steps))
    Sdq = math.sqrt(sum(np.mean(slope**2) for slope in slopes))
    if Sdq == 0:
        raise ValueError("z has no roughness: it is constant")
    pressures = np.geomspace(1e-3, 0.5, 12) * float(press.material.E) * Sdq
    rows = press.rows(pressures.tolist())
    lowest = np.inf if P is None else P.min() / area
    if lowest >= pressures[0]:
        return rows
    count = math.ceil(math.log(pressures[0] / lowest) / math.log(4))
    for pressure in np.geomspace(pressures[0], lowest, count + 1)[1:].tolist():
        row = press.at(pressure)
        # The stiffness of a single point is that of the grid.
        if row is None or row.points < 2:
            break
        if pressure not in press.failed:
            rows = [row, *rows]
    return rows


def _outside(P: np.ndarray | None, loads: Sequence[float]) -> Iterator[str]:
    """A warning for loads below the table, and one for loads above it."""
    if P is None:
        return
    continues = "there K_n continues as the power law of that end"
    if P.min() < loads[0] * (1 - 1e-9):
        yield f"P = {P.min():.4g} N is below the table, from {loads[0]:.4g} N: {continues}"
    if P.max() > loads[-1] * (1 + 1e-9):
        yield f"P = {P.max():.4g} N is above the table, up to {loads[-1]:.4g} N: {continues}"


def _column(name: str, values) -> tuple[float, ...]:
    column = [number(f"{name}[{i}]", x, above=0) for i, x in enumerate(values)]
    if any(concrete(x) is None for x in column):
        raise TypeError(f"{name} must be known when a program is traced")
    return tuple(map(float, column))
