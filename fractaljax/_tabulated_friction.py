"""A friction law interpolated from a measurement."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from ._base.files import read_bounded
from ._base.parts import (
    Numbers,
    brief,
    concrete,
    is_traced,
    nan_where,
    number,
    ordered,
    quantity,
)
from ._base.singular import safe_divide
from ._base.toml import naming
from ._friction import WithStatic


def _table_field(note: str) -> Any:
    """A field that holds an array of one law, not of a batch of laws."""
    return eqx.field(metadata={"note": note, "table": True, "absent": True})


@final
class TabulatedFriction(WithStatic, law="tabulated"):
    """Measured friction: mu(speed) through the points of a table, as a dynamometer gives it.

    Between the points it is a monotone cubic (Fritsch and Carlson, SIAM J. Numer. Anal. 17, 238,
    1980, with the slopes of Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 300, 1984), which
    rises and falls only where the table does. Beyond the last speed, and below the first one unless
    that is 0, the coefficient is constant. Its mu_m is the least coefficient of the table.

    The table may have a pressure and a temperature as further axes. It is interpolated along them
    in the same way, and is constant beyond their ends. `pressure` and `temperature` are then
    quantities of the law, which do not follow from the load of the contact.

    **Arguments:**

    - `speeds`: (n,) sliding speeds [m/s], two or more, rising, the first one at least 0.
    - `coefficients`: (n,) friction coefficients [-] there, above 0; (n, p), (n, T) or (n, p, T)
      with pressures, with temperatures or with both.
    - `mu_s`: static friction coefficient [-], at least that at vanishing speed; by default equal to
      it.
    - `pressures`: (p,) nominal pressures [Pa], two or more, rising and above 0; by default there is
      no such axis.
    - `temperatures`: (T,) temperatures [K], two or more, rising and above 0; by default there is no
      such axis.
    - `pressure`: nominal pressure [Pa] at which the law holds; needed with `pressures`.
    - `temperature`: temperature [K] at which the law holds; needed with `temperatures`.

    The law is differentiable by every number in it.

    **Raises:** `ValueError` for a table that is not so, a mu_s below the coefficient at vanishing
    speed, a pressure or a temperature without its axis, and an axis without it; `TypeError` for
    anything but numbers. For a traced law every number is NaN instead of a value outside its
    domain.
    """

    speeds: Float[Array, " n"] = _table_field("m/s, sliding speeds, rising")
    coefficients: Float[Array, "n ..."] = _table_field(
        "-, friction coefficients there, by speed, pressure and temperature"
    )
    static: Numbers | None = quantity("-", "static friction coefficient", name="mu_s", absent=True)
    pressures: Float[Array, " p"] | None = _table_field("Pa, pressures, if they are an axis")
    temperatures: Float[Array, " T"] | None = _table_field("K, temperatures, if they are an axis")
    pressure: Numbers | None = quantity(
        "Pa", "nominal pressure at which friction is", log=True, absent=True
    )
    temperature: Numbers | None = quantity("K", "temperature at which friction is", absent=True)

    def __init__(
        self,
        speeds: Sequence[ArrayLike] | ArrayLike,
        coefficients: Sequence[Any] | ArrayLike,
        mu_s: ArrayLike | None = None,
        pressures: Sequence[ArrayLike] | ArrayLike | None = None,
        temperatures: Sequence[ArrayLike] | ArrayLike | None = None,
        pressure: ScalarLike | None = None,
        temperature: ScalarLike | None = None,
    ):
        self.speeds = _axis("speeds", speeds, at_least=0)
        self.coefficients = _array("coefficients", coefficients, above=0)
        self.pressures, self.pressure = _condition("pressure", pressures, pressure)
        self.temperatures, self.temperature = _condition("temperature", temperatures, temperature)
        axes = [self.speeds, self.pressures, self.temperatures]
        shape = tuple(len(axis) for axis in axes if axis is not None)
        if self.coefficients.shape != shape:
            raise ValueError(
                f"coefficients must have shape {shape}, one axis each for speeds"
                f"{'' if pressures is None else ', pressures'}"
                f"{'' if temperatures is None else ', temperatures'}, got {self.coefficients.shape}"
            )
        self.static = None
        if mu_s is not None:
            static = number("mu_s", mu_s, above=0)
            self.static = ordered("mu_s", static, "mu(0)", self.kinetic_limit())

    @classmethod
    def from_csv(
        cls, path: str | os.PathLike, mu_s: ArrayLike | None = None
    ) -> "TabulatedFriction":
        """The law in a text file of two columns, speed and coefficient, in this order.

        Columns are separated by semicolons, tabs, commas or spaces; unless commas separate, a
        comma is a decimal comma. Lines before the first one of numbers, and those that begin with
        #, are titles. Speeds are in m/s, unless a title names mm/s, cm/s, km/h or another unit of
        length per s, min or h.

        **Arguments:**

        - `path`: the file.
        - `mu_s`: static friction coefficient [-], by default that at vanishing speed.

        **Raises:** `ValueError` that begins with the name of the file and says which line is not
        two numbers, or what else is wrong in it; `OSError` if it cannot be read.
        """
        with naming(path):
            text = _decoded(read_bounded(Path(path)))
            speeds, coefficients = np.array(_rows(text)).T
            return cls(speeds * _speed_unit(text), coefficients, mu_s)

    @property
    def knots(self):
        """The speeds of the table, where one cubic follows another."""
        return self.speeds

    @property
    def mu_m(self):
        """The least friction coefficient of the table, at its pressure and temperature."""
        if not self._conditions:
            return jnp.min(self.coefficients)
        return jnp.vectorize(lambda *at: jnp.min(self._column(*at)))(*self._conditions)

    def mu(self, speed):
        speed = jnp.asarray(speed, jnp.result_type(speed, self.coefficients))
        return jnp.vectorize(self._mu)(speed, *self._conditions)

    def _mu(self, speed, *conditions) -> Float[Array, ""]:
        at = _inside(self.speeds, speed)
        return monotone_cubic(self.speeds, self._column(*conditions), at)

    def in_motion(self):
        column = self._column(*self._conditions)
        slopes = monotone_slopes(self.speeds, column)
        return _Cubics(speeds=self.speeds, column=column, slopes=slopes, static=self.static)

    @property
    def _conditions(self) -> list[Numbers]:
        """The pressure and the temperature, as far as they are axes."""
        return [at for at in (self.pressure, self.temperature) if at is not None]

    def _column(self, *conditions) -> Float[Array, " n"]:
        """The coefficients at every speed of the table, at one pressure and temperature."""
        table = self.coefficients
        axes = [axis for axis in (self.pressures, self.temperatures) if axis is not None]
        for axis, at in reversed([*zip(axes, conditions, strict=True)]):
            at = jnp.clip(at, axis[0], axis[-1])  # constant beyond the ends
            rows = table.reshape(-1, len(axis))
            columns = jax.vmap(monotone_cubic, (None, 0, None))(axis, rows, at)
            table = columns.reshape(table.shape[:-1])
        return table


@final
class _Cubics(WithStatic):
    """A table at one pressure and temperature, with the slopes that each step of a motion needs."""

    speeds: Float[Array, " n"]
    column: Float[Array, " n"]
    slopes: Float[Array, " n"]
    static: Numbers | None

    @property
    def knots(self):
        return self.speeds

    def mu(self, speed):
        at = _inside(self.speeds, jnp.asarray(speed))
        table = self.speeds, self.column, self.slopes
        if self.speeds.ndim == 1:
            return cubics_at(*table, at)
        # In a motion of many lanes they are the last axis of all, perhaps after those of segments.
        shape = jnp.broadcast_shapes(at.shape, self.speeds.shape[1:])
        missing = (1,) * (len(shape) + 1 - self.speeds.ndim)
        table = (jnp.reshape(x, (len(x), *missing, *x.shape[1:])) for x in table)
        table = (jnp.broadcast_to(x, (len(x), *shape)).reshape(len(x), -1) for x in table)
        at = jnp.broadcast_to(at, shape).reshape(-1)
        return jax.vmap(cubics_at, (1, 1, 1, 0))(*table, at).reshape(shape)


def _inside(speeds: Float[Array, " n"], speed: Array) -> Array:
    """The speed, or that of the end of a table beyond it; below 0 the first cubic goes on."""
    first, last = speeds[0], speeds[-1]
    # A step may overshoot to below 0.
    return jnp.where((speed < first) & (first > 0), first, jnp.where(speed > last, last, speed))


def monotone_cubic(x: Float[Array, " n"], y: Float[Array, " n"], at: Array) -> Array:
    """The monotone cubic through the points (x, y) at places of any shape; end cubics go on."""
    return cubics_at(x, y, monotone_slopes(x, y), at)


def cubics_at(x: Float[Array, " n"], y, slopes, at: Array) -> Array:
    """Cubics through points (x, y) with these slopes, at places of any shape; end cubics go on."""
    k = jnp.clip(jnp.searchsorted(x, at, side="right", method="compare_all") - 1, 0, len(x) - 2)
    h = (x[1:] - x[:-1])[k]
    t = (at - x[k]) / h
    low, high = (1 + 2 * t) * (1 - t) ** 2, t**2 * (3 - 2 * t)
    bends = slopes[k] * (1 - t) - slopes[k + 1] * t
    return y[k] * low + y[k + 1] * high + h * t * (1 - t) * bends


def monotone_slopes(x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    """Slopes at the points of a table with which a cubic rises and falls only where the table does.

    Inside, a weighted harmonic mean of the slopes on both sides, or 0 where these differ in sign;
    at the ends, that of the parabola through three points, limited.
    """
    h = x[1:] - x[:-1]
    secants = (y[1:] - y[:-1]) / h
    if len(x) == 2:
        return jnp.concatenate([secants, secants])
    before, after = secants[:-1], secants[1:]
    product = before * after
    weighted = (2 * h[1:] + h[:-1]) * after + (h[1:] + 2 * h[:-1]) * before
    mean = safe_divide(3 * (h[1:] + h[:-1]) * product, weighted, jnp.zeros_like(product))
    inner = jnp.where(product > 0, mean, 0)
    first = _end_slope(h[0], h[1], secants[0], secants[1])
    last = _end_slope(h[-1], h[-2], secants[-1], secants[-2])
    return jnp.concatenate([first[None], inner, last[None]])


def _end_slope(h, next_h, secant, next_secant) -> Array:
    """The slope at the end of a table, by its last secant and the one before."""
    slope = ((2 * h + next_h) * secant - h * next_secant) / (h + next_h)
    steep = (jnp.sign(secant) != jnp.sign(next_secant)) & (jnp.abs(slope) > 3 * jnp.abs(secant))
    slope = jnp.where(steep, 3 * secant, slope)
    return jnp.where(jnp.sign(slope) == jnp.sign(secant), slope, 0)


# --- checks -----------------------------------------------------------------------------------


def _array(name: str, values: Any, **domain: float) -> Array:
    """Numbers in nested lists or an array, some perhaps traced, as an array."""
    if isinstance(values, (list, tuple)):
        try:
            values = jnp.asarray(values) if is_traced(values) else np.asarray(values)
        except (ValueError, TypeError):
            message = f"{name} must be rows of numbers of one length, got {brief(values)}"
            raise ValueError(message) from None
    return number(name, values, **domain)


def _axis(name: str, values: Any, **domain: float) -> Array:
    """An axis (k,) of a table: two numbers or more, rising."""
    axis = _array(name, values, **domain)
    if axis.ndim != 1 or len(axis) < 2:
        raise ValueError(f"{name} must be a list of two numbers or more, got shape {axis.shape}")
    stored = concrete(axis)
    if stored is None:
        return nan_where(jnp.any(axis[1:] <= axis[:-1]), axis)
    if not (np.diff(stored) > 0).all():
        k = int(np.argmin(np.diff(stored)))
        raise ValueError(f"{name} must rise, got {stored[k]:g} before {stored[k + 1]:g}")
    return axis


def _condition(name: str, axis: Any, value: Any) -> tuple[Array | None, Numbers | None]:
    """The axis of a condition and its value, both or neither."""
    if (axis is None) != (value is None):
        missing, present = (f"{name}s", name) if axis is None else (name, f"{name}s")
        raise ValueError(f"{missing} must be given with {present}: {missing}=...")
    if axis is None:
        return None, None
    return _axis(f"{name}s", axis, above=0), number(name, value, above=0)


# --- files ------------------------------------------------------------------------------------

# A length per time, or a unit that is none.
_SPEED = re.compile(r"(?<![^\W\d])(\w*m)\s*/\s*(s|min|h)\b|\b(rpm|rad/s|mph|kn|ft/s|in/s)\b")


def _decoded(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _speed_unit(text: str) -> float:
    """The unit of speed [m/s] in the titles; m/s if there is none."""
    units = dict.fromkeys(match.group(0) for match in _SPEED.finditer(text))
    if not units:
        return 1.0
    lengths = {"km": 1e3, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
    match = _SPEED.fullmatch(next(iter(units)))
    assert match is not None
    if len(units) > 1 or match[1] not in lengths:
        raise ValueError(
            f"the unit of the speeds must be a length per s, min or h, such as m/s or km/h, got "
            f"{' and '.join(units)}"
        )
    return lengths[match[1]] / {"s": 1.0, "min": 60.0, "h": 3600.0}[match[2]]


def _rows(text: str) -> list[tuple[float, ...]]:
    """The two numbers of each line after the titles."""
    rows, separator = [], None
    for at, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if not rows:
            readable = [s for s in (";", "\t", ",", None) if _pair(line, s) is not None]
            if not readable:
                continue
            separator = readable[0]
        pair = _pair(line, separator)
        if pair is None:
            raise ValueError(f"line {at} must be a speed and a coefficient, got {brief(line)}")
        rows.append(pair)
    if len(rows) < 2:
        few = f"it must hold two lines of a speed and a coefficient, got {len(rows)}"
        wide = [line for line in text.splitlines() if _columns(line) > 2]
        if wide:
            few += (
                f", and {brief(wide[0])} has more columns: temperatures and pressures are "
                "arguments of TabulatedFriction"
            )
        raise ValueError(few)
    return rows


def _columns(line: str) -> int:
    """How many numbers a line has."""
    cells = re.split(r"[;,\s]+", line.strip())
    try:
        return len([float(cell) for cell in cells if cell])
    except ValueError:
        return 0


def _pair(line: str, separator: str | None) -> tuple[float, ...] | None:
    """The two numbers of a line, or None; spreadsheets may write separators behind them."""
    cells = line.strip().split(separator)
    while separator is not None and len(cells) > 2 and not cells[-1].strip():
        cells.pop()
    if separator != ",":
        cells = [cell.replace(",", ".") for cell in cells]
    try:
        return tuple(map(float, cells)) if len(cells) == 2 else None
    except ValueError:
        return None
