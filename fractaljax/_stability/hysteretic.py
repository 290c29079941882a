"""Which solutions of a problem with structural damping are modes of the structure.

Structural (hysteretic) damping K_loss is a force in phase with the velocity of an oscillation and
independent of its frequency: s^2 M + s C + K + i K_loss, for Im s > 0. The solutions of that
problem are not conjugate to each other, those with Im s < 0 describe no motion, and the force of an
oscillation that turns the other way is the conjugate one. Hence, by sgn(Im s) i K_loss,

- the modes are the solutions with Im s > 0, and their conjugates;
- a real s stays where K_loss x = 0, as for a rigid body, and where K_loss does act, it counts only
  as the static divergence s > 0 of s^2 M + s C + K: what grows without oscillation does no work
  against K_loss. A motion that decays without oscillation has no hysteresis, and is left out.

These are n pairs, as a rule. Where fewer solutions have Im s > 0, places are left over: they hold
a negative number below every real part, with an infinite error.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

if TYPE_CHECKING:
    from .quadratic import Modes


def physical_modes(solutions: "Modes", static: "Modes") -> "Modes":
    """The modes (2n,) among the `solutions` (2n,) with K + i K_loss; `static` are those with K.

    The n of positive frequency come first, and their conjugates last, in the opposite order.
    """
    real = jnp.abs(solutions.s.imag) <= solutions.error
    frequency = jnp.where(real, 0, solutions.s.imag)
    order = jnp.argsort(-jax.lax.stop_gradient(frequency))
    s, x, error, y = (each[order] for each in solutions)
    real, upper = real[order], frequency[order] > 0
    s, kept = jnp.where(real, s.real, s), real | upper
    mirror = ~kept & upper[::-1]
    none = -jnp.abs(jax.lax.stop_gradient(s)).max()
    s = jnp.where(kept, s, jnp.where(mirror, s[::-1].conj(), none))
    x, y = (jnp.where(mirror[:, None], each[::-1].conj(), each) for each in (x, y))
    error = jnp.where(kept, error, jnp.where(mirror, error[::-1], jnp.inf))
    # Divergence takes the places of conjugates whose frequency is least: without damping, of those
    # of its own counterpart, which decays.
    beside = jnp.abs(static.s[:, None] - s[None]) <= static.error[:, None] + error[None]
    same = (beside & real[None]).any(axis=1)
    diverges = (static.s.imag == 0) & (static.s.real > static.error) & ~same
    rank = jnp.cumsum(~kept) - 1
    taken = ~kept & (rank < diverges.sum())
    source = jnp.argsort(~diverges)[jnp.maximum(rank, 0)]
    return type(solutions)(
        jnp.where(taken, static.s[source].real, s),
        jnp.where(taken[:, None], static.x[source], x),
        jnp.where(taken, static.error[source], error),
        jnp.where(taken[:, None], static.y[source], y),
    )
