"""The load curve of a joint: its normal force N as a function of the approach u of its bodies.

dN/du = K_n(N) with N = P at u = 0, and N = 0 where the joint is open. In units of the load,
n = N/P and e = K_n(P) u/P, the approach is an integral, e(n) = integral of K_n(P)/K_n(n P) dn from
1 to n, and the curve its inverse.
"""

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from numpy.polynomial import chebyshev

from .._base.parts import Numbers

_LEAST, _MOST = 1 / 256, 1024.0  # loads over P between which pieces lie; one more begins at 0
_FAINTEST = 1e-16  # least load over P at which K_n is compared with its power law
_POWER = 0.005  # tolerance of its exponent, against that at vanishing load
_BELOW, _ABOVE = 16, 8  # pieces on either side of P
_STEEPEST = 14.0  # e-folds of load and stiffness above P, beyond which the curve is straight
_SAMPLES = 128  # of the stiffness, on either side, for the borders of the pieces
_DEGREE = 16  # of the series of e in each piece
_NEWTON = 10  # Newton steps to its inverse
_POWERS = 7  # degree of the polynomials of the table
_ROWS, _FIRST = 32, 128  # rows of the table in each piece, and in the first one
_FINEST = 1e-4  # share of the first piece: its rows are no finer
_SETTLING = 16  # Newton steps to an equilibrium


def _nodes(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes on (-1, 1), and the matrix from values there to a Chebyshev series."""
    nodes = -np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return nodes, np.linalg.inv(chebyshev.chebvander(nodes, degree))


_NODES, _TO_SERIES = _nodes(_DEGREE)
_INTEGRAL = chebyshev.chebint(np.eye(_DEGREE + 1), axis=0, lbnd=-1) / 2  # over half of (-1, 1)
_ROW_NODES = _nodes(_POWERS)[0]
_TO_POWERS = np.linalg.inv(np.vander(_ROW_NODES))  # highest first


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
        width = jnp.sum(approach, axis=1)
        least = jnp.where(piece > 0, -0.1, jnp.finfo(e.dtype).eps ** 2)
        share = jnp.maximum((e - start) / width, least)

        def closer(z, _):
            T = _polynomials(2 * z - 1)
            off = jnp.sum(approach * T, axis=1) / width - share
            slope = jnp.sum(slopes * T[:, :-1], axis=1) / width
            # Not at 0 and 1 exactly, where a border of two pieces would lose its derivative.
            return jnp.clip(z - off / slope, least, 1.1), None

        z, _ = jax.lax.scan(closer, share, length=_NEWTON)
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
        starts = jax.lax.stop_gradient(self.table[0])
        groups = starts.reshape(-1, _ROWS, *starts.shape[1:])
        group = jnp.maximum(jnp.sum(groups[:, 0] <= e[None], axis=0) - 1, 0)
        starts_in_group = jnp.take_along_axis(groups, group[None, None], axis=0)[0]
        return group * _ROWS + jnp.maximum(jnp.sum(starts_in_group <= e[None], axis=0) - 1, 0)


@jax.jit
def tabulated(curve: LoadCurve) -> LoadTable:
    """The table of a load curve.

    It deviates by less than 1e-11 of P or N, or by 1e-9 of P at loads below P where K_n(P) is a
    million times that of small loads, in full contact.
    """
    at = jax.lax.stop_gradient(_borders_of_rows(curve))
    middle, half = (at[1:] + at[:-1]) / 2, (at[1:] - at[:-1]) / 2
    e = middle[:, None] + half[:, None] * jnp.asarray(_ROW_NODES, at.dtype)[None]
    load = curve(jnp.append(e.ravel(), at[-1]))
    powers = jnp.asarray(_TO_POWERS, at.dtype) @ load[:-1].reshape(e.shape).T
    table = jnp.concatenate([at[None, :-1], middle[None], 1 / half[None], powers])
    return LoadTable(curve.opening, table, jnp.stack([at[-1], load[-1], curve.top]))


def _borders_of_rows(curve: LoadCurve) -> Array:
    """e where the rows of the table meet (r + 1,): equal shares of each piece, in its variable."""
    dtype = curve.ends.dtype
    equal = jnp.arange(1, _ROWS + 1, dtype=dtype) / _ROWS
    # In the first one the load is a power of the share.
    finer = jnp.geomspace(_FINEST, 1, _FIRST, dtype=dtype)
    starts = jnp.concatenate([-curve.opening[None], curve.ends[:-1]])

    def inside(start, approach, shares):
        return start + _polynomials(2 * shares - 1) @ approach

    first = inside(starts[0], curve.approach[0], finer)
    others = jax.vmap(inside, (0, 0, None))(starts[1:], curve.approach[1:], equal)
    others = others.at[:, -1].set(curve.ends[1:])
    return jnp.concatenate([-curve.opening[None], first[:-1], curve.ends[:1], others.ravel()])


def load_curve(
    stiffness: Callable[[Numbers], Numbers],
    P: Numbers,
    opening_exponent: ArrayLike,
    borders: Sequence[float] | None = None,
) -> LoadCurve:
    """The load curve of a law whose K_n(N) [N/m] is `stiffness`, under the load P [N], a scalar.

    `opening_exponent` is alpha in K_n ~ N^alpha as N vanishes, from 0 to below 1: otherwise the
    approach at which the joint opens would be infinite. `borders` are loads [N] between which K_n
    is smooth; by default it is everywhere. Above 1024 P, or where load and stiffness have grown by
    e^14, the curve continues as a straight line.
    """
    stiffness_at_P, dtype = stiffness(P), P.dtype

    def relative(log_n):
        """ln of K_n(n P)/K_n(P) for any shape."""
        at = jax.vmap(stiffness)(jnp.exp(log_n.ravel()) * P)
        return jnp.log(at / stiffness_at_P).reshape(log_n.shape)

    if borders is None:
        logs = jax.lax.stop_gradient(_borders(relative, jnp.asarray(opening_exponent, dtype)))
    else:
        log_borders = jnp.log(jnp.asarray(borders, dtype) / P)
        logs = jnp.sort(jnp.append(log_borders, 0))
        logs = jnp.append(logs, logs[-1] + math.log(_MOST))
    power = 1 / (1 - jnp.asarray(opening_exponent, dtype))
    share = jnp.asarray((_NODES + 1) / 2, dtype)
    # The variable is ln n, but in the first piece n^(1/power): there e(n) is smooth from n = 0.
    spans = jnp.diff(logs)[:, None]
    first, others = logs[0] + power * jnp.log(share), logs[:-1, None] + spans * share[None]
    least = math.log(jnp.finfo(dtype).tiny) / 4
    log_n = jnp.maximum(jnp.concatenate([first[None], others]), least)
    by_share = jnp.concatenate([(power / share)[None], jnp.broadcast_to(spans, others.shape)])
    slopes = by_share * jnp.exp(log_n - relative(log_n))
    slopes = slopes @ jnp.asarray(_TO_SERIES.T, dtype)
    approach = slopes @ jnp.asarray(_INTEGRAL.T, dtype)
    widths, below = jnp.sum(approach, axis=1), logs <= 0
    # Sums from P both ways: e is large far from P if K_n(P) is far above that of small loads.
    down = jnp.cumsum(jnp.where(below, widths, 0)[::-1])[::-1]
    up = jnp.cumsum(jnp.where(below, 0, widths))
    ends, opening = up - jnp.append(down[1:], 0), down[0]
    return LoadCurve(power, logs, slopes, approach, ends, opening, jnp.exp(relative(logs[-1])))


def _polynomials(x) -> Array:
    """Chebyshev polynomials (j, 18) at x (j,)."""

    def following(carry, _):
        one, two = carry
        return (two, 2 * x * two - one), one

    _, rows = jax.lax.scan(following, (jnp.ones_like(x), x), length=_DEGREE + 2)
    return rows.T


def _borders(relative, exponent) -> Array:
    """ln n at the borders of the pieces, in each of which load and stiffness grow equally.

    Below the first border K_n is a power of the load, with its exponent at vanishing load.
    """
    dtype = exponent.dtype
    x = jnp.linspace(0, math.log(_FAINTEST), 4 * _SAMPLES, dtype=dtype)
    other = jnp.abs(jnp.diff(relative(x)) / jnp.diff(x) - exponent) > _POWER
    last = jnp.min(jnp.where(other, x[1:], 0))
    sides = []
    for end, count in ((jnp.minimum(last, math.log(_LEAST)), _BELOW), (math.log(_MOST), _ABOVE)):
        x = jnp.linspace(0, end, _SAMPLES, dtype=dtype)
        grown = jnp.abs(jnp.diff(x)) + jnp.abs(jnp.diff(relative(x)))
        grown = jnp.append(jnp.zeros(1, dtype), jnp.cumsum(grown))
        most = grown[-1] if count == _BELOW else jnp.minimum(grown[-1], _STEEPEST)
        sides.append(jnp.interp(most * jnp.arange(1, count + 1) / count, grown, x))
    below, above = sides
    return jnp.concatenate([below[::-1], jnp.zeros(1, dtype), above])


def loaded_equilibrium(curves: Sequence[LoadCurve | LoadTable], e: Array, W: Array) -> Array:
    """e (m,) of joints with load curves at rest: e = `e` + W (1 + e - N/P), W (m, m).

    `e` is the one with linear springs, W the response to a missing load. N/P is convex, so Newton's
    method descends to the root from there.
    """

    def residual(at):
        return jnp.stack([1 + x - curve(x) for curve, x in zip(curves, at, strict=True)])

    def closer(at, _):
        value, slope = jax.jvp(residual, (at,), (jnp.ones_like(at),))
        matrix = jnp.eye(len(at), dtype=at.dtype) - W * slope[None]
        return at - jnp.linalg.solve(matrix, at - e - W @ value), None

    return jax.lax.scan(closer, e, length=_SETTLING)[0]
