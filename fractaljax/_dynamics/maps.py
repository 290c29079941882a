"""Derivatives of the ends of segments by the states at their starts and by durations."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .guard import UNUSED
from .hybrid import HybridSystem
from .knots import between_knots
from .lanes import product
from .runge_kutta import runge_kutta, stability_polynomial
from .segments import Segments, chosen_guard, next_start, tableau


class Maps(eqx.Module):
    """Derivatives of each segment's end, and of the guard that ends it."""

    A: Float[Array, "N 2n 2n ..."]  # of the end by the state at its start
    b: Float[Array, "2n N ..."]  # of the end by its duration
    c: Float[Array, "2n N ..."]  # of the guard by the state it ends in; 0 where none ends it


def exact_maps(system: HybridSystem, segments: Segments) -> Maps:
    """Derivatives of the segments, as exact as their steps are."""
    # The stages of many degrees of freedom fill the cache: one segment at a time.
    size = len(segments.duration) if system.fastest is None else 1
    # With knots, the end of a segment tells between which it lies.
    more = () if system.knots is None else (next_start(segments.y),)
    _, A, b = in_blocks(functools.partial(_maps, system), identity_maps, size, segments, *more)
    return Maps(A, b, _guard_slopes(system, segments))


def coarse_maps(system: HybridSystem, segments: Segments) -> Maps:
    """Approximate derivatives, with which Newton's method converges as well.

    They take a tenth of the time.
    """
    polynomial_maps = functools.partial(_polynomial_maps, system)
    size = segments_together(segments) if system.fastest is None else 1
    _, A, b = in_blocks(polynomial_maps, identity_maps, size, segments, next_start(segments.y))
    return Maps(A, b, _guard_slopes(system, segments))


def segments_together(segments: Segments) -> int:
    """How many segments of each lane Newton's method takes at a time.

    They are all of at most 512 over all lanes; of more, 128 over all lanes, but at least 8 of each.
    """
    length, lanes = len(segments.duration), segments.duration[0].size
    return length if length * lanes <= 512 else max(128 // lanes, 8)


def identity_maps(segments: Segments, *_) -> tuple[Array, Array, Array]:
    """Ends, A and b of segments that are not used."""
    y = segments.y
    return y, jnp.moveaxis(_identity(y), 2, 0), jnp.zeros_like(y)


def in_blocks(function: Callable, unused: Callable, size: int, segments: Segments, *more) -> Any:
    """function(segments, ...) in blocks of `size`; `unused` for blocks without a used segment."""
    length, lanes = len(segments.duration), segments.duration.ndim - 1
    if size >= length:
        return function(segments, *more)

    def split(x):
        x = jnp.moveaxis(x, axis_of(x, lanes), 0)
        x = jnp.pad(x, [(0, -length % size), *[(0, 0)] * (x.ndim - 1)], constant_values=UNUSED)
        return x.reshape(-1, size, *x.shape[1:])

    def block(arguments):
        arguments = jax.tree.map(lambda x: jnp.moveaxis(x, 0, axis_of(x, lanes)), arguments)
        return jax.lax.cond(
            jnp.any(arguments[0].used), lambda: function(*arguments), lambda: unused(*arguments)
        )

    def joined(x):
        axis = axis_of(x[0], lanes)
        x = jnp.moveaxis(x, axis + 1, 1)
        return jnp.moveaxis(x.reshape(-1, *x.shape[2:])[:length], 0, axis)

    return jax.tree.map(joined, jax.lax.map(block, jax.tree.map(split, (segments, *more))))


def _maps(system: HybridSystem, segments: Segments, target=None) -> tuple[Array, Array, Array]:
    """The ends of segments that need not be neighbours, and their derivatives A and b.

    `target` is about where they end, for a system with knots.
    """
    y, s = segments.y, segments.s
    if target is not None:
        system = between_knots(system, y, segments.duration, target, s)

    def field(columns):
        # The state and its tangents side by side: one array, one compiled loop per stage.
        along, slope = jax.linearize(lambda y: system.field(y, s), columns[:, 0])
        tangents = _apply_slope(slope, columns[:, 1:])
        return jnp.concatenate([along[:, None], tangents], axis=1)

    columns = jnp.concatenate([y[:, None], _identity(y)], axis=1)
    columns = runge_kutta(tableau(), field, columns, segments.duration[None, None])
    ends, A = columns[:, 0], columns[:, 1:]
    return ends, jnp.moveaxis(A, 2, 0), system.field(ends, s)


def _polynomial_maps(system: HybridSystem, segments: Segments, ends):
    """As `_maps`, for known ends: A is the stability polynomial of the mean Jacobian.

    Exact if the field is affine. (In powers of its fourth power, by Paterson and Stockmeyer.)
    """
    y, h, s = segments.y, segments.duration, segments.s
    system = between_knots(system, y, h, ends, s)
    b = system.field(ends, s)
    state = (y + ends) / 2 + h[None] / 12 * (system.field(y, s) - b)  # its mean in time
    _, slope = jax.linearize(lambda y: system.field(y, s), state)
    mean = _apply_slope(slope, _identity(y)) * h[None, None]
    eye, mean = (jnp.moveaxis(x, 2, 0) for x in (_identity(y), mean))
    powers, times = [eye, mean], jax.vmap(functools.partial(product, written_out=True))
    count = 4  # powers that are evaluated, of the last of which the rest is a polynomial
    for _ in range(count - 1):
        powers.append(times(powers[-1], mean))
    coefficients = stability_polynomial(tableau()).tolist()
    A = None
    for first in reversed(range(0, len(coefficients), count)):
        block = coefficients[first : first + count]
        terms = sum(c * power for c, power in zip(block, powers, strict=False))
        A = terms if A is None else times(A, powers[-1]) + terms
    return ends, A, b


def _apply_slope(slope: Callable, tangents) -> Array:
    """The slope along each of the tangents (2n, k, ...)."""
    return jax.vmap(slope, in_axes=1, out_axes=1)(tangents)


def _identity(y) -> Array:
    """The tangents (2n, 2n, ...) at states y (2n, ...)."""
    eye = jnp.eye(len(y), dtype=y.dtype).reshape(len(y), len(y), *(1,) * (y.ndim - 1))
    return jnp.broadcast_to(eye, (len(y), *y.shape))


def _guard_slopes(system: HybridSystem, segments: Segments) -> Array:
    """Derivatives (2n, N, ...) of the guards that end segments by the states they end in."""
    _, pull = jax.vjp(
        lambda end: chosen_guard(system, end, segments.s, segments.guard), next_start(segments.y)
    )
    return pull(jnp.ones_like(segments.duration))[0]


def axis_of(x, lanes: int) -> int:
    """The axis of segments in x (..., N, ...) with `lanes` axes of lanes; the first of matrices."""
    before = x.ndim - 1 - lanes
    return before if before < 2 else 0
