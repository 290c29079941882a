"""The load curve of a joint: its normal force N as a function of the approach u of its bodies.

dN/du = K_n(N) with N = P at u = 0, and N = 0 where the joint is open. In units of the load,
n = N/P and e = K_n(P) u/P, the approach is an integral, e(n) = integral of K_n(P)/K_n(n P) dn from
1 to n, and the curve its inverse.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from numpy.polynomial import chebyshev

from .._base.parts import Numbers


@dataclasses.dataclass(frozen=True)
class LoadCurveGrid:
    """How a load curve is divided into pieces, and its table into rows.

    With the defaults the curve is accurate to rounding, and the table as `tabulated` says.

    **Fields:**

    - `least`, `most`: loads over P between which the pieces lie; one more reaches down to 0. It is
      accurate where K_n is a power of the load, as it is at 1/256 for most laws.
    - `steepest`: e-folds of load and stiffness together above P beyond which there are no pieces:
      towards full contact the stiffness grows without limit.
    - `below`, `above`: pieces on either side of P. A joint that opens passes every load below P,
      but few loads above it.
    - `degree`: degree of the series of e in each piece, which spans about an e-fold.
    - `rows`: rows of the table in each piece.
    - `row_degree`: degree of their polynomials, which a motion evaluates at every step: more rows
      cost memory, a higher degree time.
    """

    least: float = 1 / 256
    most: float = 1024.0
    steepest: float = 14.0
    below: int = 16
    above: int = 8
    degree: int = 16
    rows: int = 32
    row_degree: int = 7


class LoadCurve(eqx.Module):
    """N/P of a joint as a function of e = K_n(P) u/P: 1 with slope 1 at 0, 0 where it is open.

    In each piece of n = N/P the approach is a Chebyshev series in ln n, but in the first one, from
    n = 0, a series in n^(1/power), in which it is smooth.
    """

    power: Float[Array, ""]  # N/P begins as that power of the distance e + opening
    logs: Float[Array, " p"]  # ln n where each piece ends
    slopes: Float[Array, "p k"]  # of the approach by the share of the piece, Chebyshev series
    approach: Float[Array, "p k+1"]  # within the piece
    ends: Float[Array, " p"]  # e where each piece ends; one of them is 0 itself
    opening: Float[Array, ""]  # the joint opens at e = -opening
    top: Float[Array, ""]  # slope at the end of the last piece, and beyond

    def __call__(self, e: Numbers) -> Numbers:
        """N/P at e, of any shape."""
        at, end = e.ravel(), self.ends[-1]
        load = jnp.exp(self._log_load(jnp.minimum(at, end)))
        load = load + self.top * jnp.maximum(at - end, 0)
        return jnp.where(at <= -self.opening, 0, load).reshape(e.shape)  # NaN stays NaN

    def _log_load(self, e) -> Array:
        """ln n at e (j,), by Newton's method."""
        piece = jnp.minimum(jnp.searchsorted(self.ends, e), len(self.ends) - 1)
        start = jnp.where(piece > 0, self.ends[piece - 1], -self.opening)
        slopes, approach = self.slopes[piece], self.approach[piece]
        terms = approach.shape[1]
        width = jnp.sum(approach, axis=1)
        least = jnp.where(piece > 0, -0.1, jnp.finfo(e.dtype).eps ** 2)
        share = jnp.maximum((e - start) / width, least)

        def newton_step(z, _):
            T = _polynomials(2 * z - 1, terms)
            off = jnp.sum(approach * T, axis=1) / width - share
            slope = jnp.sum(slopes * T[:, :-1], axis=1) / width
            # Not at 0 and 1 exactly, where a border of two pieces would lose its derivative.
            return jnp.clip(z - off / slope, least, 1.1), None

        # Six steps reach rounding under Persson's law; four more are for steeper ones.
        z, _ = jax.lax.scan(newton_step, share, length=10)
        low, high = self.logs[piece - 1], self.logs[piece]
        return jnp.where(
            piece > 0,
            low + (high - low) * z,
            high + self.power * jnp.log(jnp.where(piece > 0, 1, z)),
        )


class LoadTable(eqx.Module):
    """A load curve for motions, which evaluate it at every step: rows of polynomials in e.

    Rows follow the load, not the approach, which may change by far more below P than near it.
    Leaves may have further axes for lanes.
    """

    opening: Float[Array, ""]  # the joint opens at e = -opening
    table: Float[Array, "k r"]  # start of each row, middle, half width inverted, coefficients
    last: Float[Array, "3"]  # e, N/P and its slope at the end of the last row
    group_size: int = eqx.field(static=True)  # rows in a group, which divides their number

    def __call__(self, e: Numbers) -> Numbers:
        """N/P at e, a number for each lane."""
        end, load, slope = self.last
        inside = jnp.clip(e, -self.opening, end)
        row = self._row(jax.lax.stop_gradient(inside))[None, None]
        _, middle, scale, value, *others = jnp.take_along_axis(self.table, row, axis=1)[:, 0]
        x = (inside - middle) * scale
        for coefficient in others:
            value = value * x + coefficient
        value = jnp.where(e < end, jnp.maximum(value, 0), load + slope * (e - end))
        return jnp.where(e <= -self.opening, 0, value)  # NaN stays NaN

    def _row(self, e) -> Array:
        """The row of e, by its group of rows and its place in the group."""
        size = self.group_size
        starts = jax.lax.stop_gradient(self.table[0])
        groups = starts.reshape(-1, size, *starts.shape[1:])
        group = jnp.maximum(jnp.sum(groups[:, 0] <= e[None], axis=0) - 1, 0)
        starts_in_group = jnp.take_along_axis(groups, group[None, None], axis=0)[0]
        return group * size + jnp.maximum(jnp.sum(starts_in_group <= e[None], axis=0) - 1, 0)


@functools.partial(jax.jit, static_argnames="grid")
def tabulated(curve: LoadCurve, grid: LoadCurveGrid = LoadCurveGrid()) -> LoadTable:
    """The table of a load curve.

    It deviates by less than 1e-11 of P or N, or by 1e-9 of P at loads below P where K_n(P) is a
    million times that of small loads, in full contact.
    """
    nodes = _chebyshev_nodes(grid.row_degree)
    to_powers = np.linalg.inv(np.vander(nodes))  # highest first
    at = jax.lax.stop_gradient(_row_borders(curve, grid.rows))
    middle, half = (at[1:] + at[:-1]) / 2, (at[1:] - at[:-1]) / 2
    e = middle[:, None] + half[:, None] * jnp.asarray(nodes, at.dtype)[None]
    load = curve(jnp.append(e.ravel(), at[-1]))
    powers = jnp.asarray(to_powers, at.dtype) @ load[:-1].reshape(e.shape).T
    table = jnp.concatenate([at[None, :-1], middle[None], 1 / half[None], powers])
    return LoadTable(curve.opening, table, jnp.stack([at[-1], load[-1], curve.top]), grid.rows)


def _row_borders(curve: LoadCurve, rows: int) -> Array:
    """e where the rows of the table meet (r + 1,): equal shares of each piece, in its variable."""
    dtype = curve.ends.dtype
    equal = jnp.arange(1, rows + 1, dtype=dtype) / rows
    # In the first one the load is a power of the share: four times as many, in equal ratios. The
    # row from 0 on has a share of 1e-4, where the load is so small that its error is.
    finer = jnp.geomspace(1e-4, 1, 4 * rows, dtype=dtype)
    starts = jnp.concatenate([-curve.opening[None], curve.ends[:-1]])

    def approach_at(start, approach, shares):
        return start + _polynomials(2 * shares - 1, len(approach)) @ approach

    first = approach_at(starts[0], curve.approach[0], finer)
    others = jax.vmap(approach_at, (0, 0, None))(starts[1:], curve.approach[1:], equal)
    others = others.at[:, -1].set(curve.ends[1:])
    return jnp.concatenate([-curve.opening[None], first[:-1], curve.ends[:1], others.ravel()])


def load_curve(
    stiffness: Callable[[Numbers], Numbers],
    P: Numbers,
    opening_exponent: ArrayLike,
    borders: Sequence[float] | None = None,
    grid: LoadCurveGrid = LoadCurveGrid(),
) -> LoadCurve:
    """The load curve of a law whose K_n(N) [N/m] is `stiffness`, under the load P [N], a scalar.

    `opening_exponent` is alpha in K_n ~ N^alpha as N vanishes, from 0 to below 1: otherwise the
    approach at which the joint opens would be infinite. `borders` are loads [N] between which K_n
    is smooth; by default it is everywhere. `grid` divides the curve into pieces; above the last of
    them it continues as a straight line.
    """
    stiffness_at_P, dtype = stiffness(P), P.dtype

    def log_stiffness_ratio(log_n):
        """ln of K_n(n P)/K_n(P) for any shape."""
        at = jax.vmap(stiffness)(jnp.exp(log_n.ravel()) * P)
        return jnp.log(at / stiffness_at_P).reshape(log_n.shape)

    if borders is None:
        exponent = jnp.asarray(opening_exponent, dtype)
        logs = jax.lax.stop_gradient(_piece_borders(log_stiffness_ratio, exponent, grid))
    else:
        log_borders = jnp.log(jnp.asarray(borders, dtype) / P)
        logs = jnp.sort(jnp.append(log_borders, 0))
        logs = jnp.append(logs, logs[-1] + math.log(grid.most))
    power = 1 / (1 - jnp.asarray(opening_exponent, dtype))
    nodes = _chebyshev_nodes(grid.degree)
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, grid.degree))
    integral = chebyshev.chebint(np.eye(grid.degree + 1), axis=0, lbnd=-1) / 2  # half of (-1, 1)
    share = jnp.asarray((nodes + 1) / 2, dtype)
    # The variable is ln n, but in the first piece n^(1/power): there e(n) is smooth from n = 0.
    spans = jnp.diff(logs)[:, None]
    first, others = logs[0] + power * jnp.log(share), logs[:-1, None] + spans * share[None]
    least = math.log(jnp.finfo(dtype).tiny) / 4
    log_n = jnp.maximum(jnp.concatenate([first[None], others]), least)
    by_share = jnp.concatenate([(power / share)[None], jnp.broadcast_to(spans, others.shape)])
    slopes = by_share * jnp.exp(log_n - log_stiffness_ratio(log_n))
    slopes = slopes @ jnp.asarray(to_series.T, dtype)
    approach = slopes @ jnp.asarray(integral.T, dtype)
    widths, below = jnp.sum(approach, axis=1), logs <= 0
    # Sums from P both ways: e is large far from P if K_n(P) is far above that of small loads.
    down = jnp.cumsum(jnp.where(below, widths, 0)[::-1])[::-1]
    up = jnp.cumsum(jnp.where(below, 0, widths))
    ends, opening = up - jnp.append(down[1:], 0), down[0]
    top = jnp.exp(log_stiffness_ratio(logs[-1]))
    return LoadCurve(power, logs, slopes, approach, ends, opening, top)


def _chebyshev_nodes(degree: int) -> np.ndarray:
    """Nodes on (-1, 1), which determine a polynomial of that degree."""
    return -np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))


def _polynomials(x, count: int) -> Array:
    """The first Chebyshev polynomials (j, count) at x (j,)."""

    def recur(carry, _):
        one, two = carry
        return (two, 2 * x * two - one), one

    _, rows = jax.lax.scan(recur, (jnp.ones_like(x), x), length=count)
    return rows.T


def _piece_borders(log_stiffness_ratio, exponent, grid: LoadCurveGrid) -> Array:
    """ln n at the borders of the pieces, in each of which load and stiffness grow equally.

    Below the first border K_n is a power of the load, with its exponent at vanishing load.
    """
    dtype = exponent.dtype
    samples = 128  # of the stiffness on either side: several in each piece
    # Down to the load that rounds off beside P; four times as many samples, since it is far.
    x = jnp.linspace(0, math.log(1e-16), 4 * samples, dtype=dtype)
    slope = jnp.diff(log_stiffness_ratio(x)) / jnp.diff(x)
    # The first piece bears a small change of the exponent, which its series resolves.
    other = jnp.abs(slope - exponent) > 0.005
    last = jnp.min(jnp.where(other, x[1:], 0))

    def divide(end, count, limit=None):
        """ln n where each of `count` pieces between P and `end` ends."""
        x = jnp.linspace(0, end, samples, dtype=dtype)
        grown = jnp.abs(jnp.diff(x)) + jnp.abs(jnp.diff(log_stiffness_ratio(x)))
        grown = jnp.append(jnp.zeros(1, dtype), jnp.cumsum(grown))
        most = grown[-1] if limit is None else jnp.minimum(grown[-1], limit)
        return jnp.interp(most * jnp.arange(1, count + 1) / count, grown, x)

    below = divide(jnp.minimum(last, math.log(grid.least)), grid.below)
    above = divide(math.log(grid.most), grid.above, grid.steepest)
    return jnp.concatenate([below[::-1], jnp.zeros(1, dtype), above])


def loaded_equilibrium(curves: Sequence[LoadCurve | LoadTable], e: Array, W: Array) -> Array:
    """e (m,) of joints with load curves at rest: e = `e` + W (1 + e - N/P), W (m, m).

    `e` is the one with linear springs, W the response to a missing load. N/P is convex, so Newton's
    method descends to the root from there.
    """

    def residual(at):
        return jnp.stack([1 + x - curve(x) for curve, x in zip(curves, at, strict=True)])

    def newton_step(at, _):
        value, slope = jax.jvp(residual, (at,), (jnp.ones_like(at),))
        matrix = jnp.eye(len(at), dtype=at.dtype) - W * slope[None]
        return at - jnp.linalg.solve(matrix, at - e - W @ value), None

    # The descent takes a step for each e-fold of a steep law, of which a curve has at most 14.
    return jax.lax.scan(newton_step, e, length=16)[0]
