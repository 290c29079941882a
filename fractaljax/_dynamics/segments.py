"""Short segments of an orbit, each in one contact state, and the flow along them."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .guard import UNUSED
from .hybrid import HybridSystem
from .lanes import row_numbers
from .runge_kutta import runge_kutta


class Segments(eqx.Module):
    """A closed chain of N segments, of one orbit or of several lanes.

    The end of the last one is the start of the first.
    """

    y: Float[Array, "2n N ..."]  # state at the start of each
    duration: Float[Array, "N ..."]
    s: Float[Array, "f N ..."]  # contact state
    guard: Int[Array, "N ..."]  # which guard ends it: a number, NONE within a phase, or UNUSED

    @property
    def used(self) -> Bool[Array, "N ..."]:
        """True for segments that are not padding of zero duration."""
        return self.guard != UNUSED


def tableau():
    """The coefficients of the segments' steps."""
    # Imported late, so that a stability analysis does not wait for diffrax.
    import diffrax

    return diffrax.Dopri8.tableau


def flow(system: HybridSystem, y, duration, s, error=False) -> Any:
    """The state (2n, ...) after `duration` (...) in contact state s (f, ...), by one step.

    With `error`, also an estimate (2n, ...) of its error.
    """
    field = functools.partial(_field, system, s)
    duration = jnp.asarray(duration)[None]
    return runge_kutta(tableau(), field, y, duration, error=error)


def _field(system: HybridSystem, s, y) -> Array:
    return system.field(y, s)


def next_start(y) -> Array:
    """The states at which segments must end: the starts of the next ones."""
    return jnp.roll(y, -1, axis=1)


def chosen_guard(system: HybridSystem, y, s, guard) -> Array:
    """The guard that ends each segment, at y; 0 where none does."""
    guards = system.guards(y, s)
    return jnp.sum(jnp.where(row_numbers(guards) == guard[None], guards, 0), axis=0)


def cumulative(x, block: int = 8) -> Array:
    """The cumulative sums of x (..., k), which compile faster than jnp.cumsum.

    They are sums over each `block`, as XLA leaves longer sums to a library, and over the blocks.
    """
    k = x.shape[-1]
    if k <= block or k % block:
        at = jnp.arange(k)
        return jnp.sum(jnp.where(at[None] <= at[:, None], x[..., None, :], 0), axis=-1)
    inside = cumulative(x.reshape(*x.shape[:-1], k // block, block), block)
    before = cumulative(inside[..., -1], block) - inside[..., -1]
    return (inside + before[..., None]).reshape(x.shape)


def mean_square(system: HybridSystem, segments: Segments) -> Float[Array, " 2n"]:
    """The mean of each component squared over a period, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    share = jnp.asarray((nodes + 1) / 2, segments.y.dtype)
    y, h, s = segments.y, segments.duration, segments.s
    inside = jax.vmap(lambda share: flow(system, y, share * h, s))(share)
    weights = jnp.asarray(weights / 2, y.dtype)
    return jnp.einsum("g,gin,n->i", weights, inside**2, h) / jnp.sum(h)
