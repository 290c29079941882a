"""A coarse Runge-Kutta step that stops where the first guard reaches zero."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .stick_slip import SECTION, StickSlip

NONE = SECTION + 1  # as a guard's number: no guard ended the step


class Cubic(eqx.Module):
    """k_0 + k_1 x + k_2 x^2 + k_3 x^3 on 0 <= x <= 1, elementwise."""

    k_0: Array
    k_1: Array
    k_2: Array
    k_3: Array

    @classmethod
    def through(cls, g_0, g_1, d_0, d_1) -> "Cubic":
        """With values g and slopes d at 0 and at 1."""
        return cls(g_0, d_0, 3 * (g_1 - g_0) - 2 * d_0 - d_1, d_0 + d_1 - 2 * (g_1 - g_0))

    def __call__(self, x):
        return self.k_0 + x * (self.k_1 + x * (self.k_2 + x * self.k_3))

    def slope(self, x):
        """Its derivative at x."""
        return self.k_1 + x * (2 * self.k_2 + 3 * x * self.k_3)

    def minimum(self) -> tuple[Array, Array]:
        """Where its minimum strictly inside is, else 0, and whether there is one."""
        square = self.k_2**2 - 3 * self.k_1 * self.k_3
        root = jnp.sqrt(jnp.maximum(square, 0))
        # Of the two forms of this root, the one without cancellation.
        over = jnp.where(self.k_2 > 0, -self.k_1, root - self.k_2)
        below = jnp.where(self.k_2 > 0, self.k_2 + root, 3 * self.k_3)
        x = jnp.where(below == 0, 0, over / jnp.where(below == 0, 1, below))
        inside = (square >= 0) & (x > 0) & (x < 1)
        return jnp.where(inside, x, 0), inside

    def root_before(self, end, start: ArrayLike = 0) -> Array:
        """Where it falls through zero in (0, end], if it does: Newton steps from the secant's root.

        They begin at `start` if that is later.
        """
        at_end = self(end)
        x = end * self.k_0 / jnp.where(self.k_0 == at_end, 1, self.k_0 - at_end)
        x = jnp.maximum(x, start)
        for _ in range(3):
            slope = self.slope(x)
            x = jnp.clip(x - self(x) / jnp.where(slope == 0, 1, slope), 0, end)
        return x


def without_start(cubic: Cubic, rising) -> Cubic:
    """Where `rising`, the cubic less its value at 0, divided by x; elsewhere the cubic.

    The root of the quotient is where the cubic returns to its first value, however soon.
    """
    k_0, k_1, k_2, k_3 = cubic.k_0, cubic.k_1, cubic.k_2, cubic.k_3
    return Cubic(
        jnp.where(rising, jnp.maximum(k_1, 0), k_0),
        jnp.where(rising, k_2, k_1),
        jnp.where(rising, k_3, k_2),
        jnp.where(rising, 0, k_3),
    )


def first_root(g_0, g_1, d_0, d_1) -> Array:
    """Where in (0, 1] a cubic first falls through zero, or 2 if it does not; any shape.

    Arguments are its values g and slopes d at 0 and 1. A root at 0 does not count: the motion has
    just left it. A cubic below zero at 0 has its root there.
    """
    entered = g_0 == 0
    whole = Cubic.through(g_0, g_1, d_0, d_1)
    cubic = without_start(whole, entered)
    # A minimum below zero has a root before it, even if the cubic ends above zero.
    lowest, dips = cubic.minimum()
    dips &= cubic(lowest) < 0
    end = jnp.where(dips, lowest, 1)
    # A cubic that rises from just above zero has a root just before 0, which does not count.
    rising = ~entered & (d_0 > 0)
    back = without_start(whole, rising).root_before(end)
    x = cubic.root_before(end, jnp.where(rising, back, 0))
    # A step of zero length would be repeated forever.
    x = jnp.where(entered, jnp.maximum(x, 1e-6), x)
    return jnp.where(g_0 < 0, 0, jnp.where(cubic(end) < 0, x, 2))


def guards_and_rates(system: StickSlip, y, s, h, f) -> tuple[Array, Array]:
    """The guards at y (4, ...) and their changes over a step h (...), where dy/dt = f."""
    return system.guards(y, s), jnp.asarray(h)[None] * system.guards(f, s, 0.0)


def _nearest(guards, of) -> Array:
    """Of the two guards of each direction the one that is lower in `of`; and the section."""
    lower = [jnp.where(of[k] <= of[k + 1], guards[k], guards[k + 1]) for k in (0, 2)]
    return jnp.stack([*lower, guards[SECTION]])


def step(system: StickSlip, y, s, h):
    """A step of length h, or less, in contact state s by the classical fourth-order method.

    Returns the state and contact state after it, its length, and the number of the guard that
    ended it or `NONE`. States inside the step are those of the cubic through its ends.
    """
    h = h / jnp.maximum(1, 2 * system.stiffness(y))
    step = h[None]
    f_0 = system.field(y, s)
    f_b = system.field(y + step / 2 * f_0, s)
    f_c = system.field(y + step / 2 * f_b, s)
    f_d = system.field(y + step * f_c, s)
    y_1 = y + step / 6 * (f_0 + 2 * f_b + 2 * f_c + f_d)
    f_1 = system.field(y_1, s)

    at_0, at_1 = guards_and_rates(system, y, s, h, f_0), guards_and_rates(system, y_1, s, h, f_1)
    of = at_1[0]
    values, rates = zip(at_0, at_1, strict=True)
    roots = first_root(*(_nearest(x, of) for x in (*values, *rates)))
    # Only a fall through the section counts.
    roots = jnp.stack([roots[0], roots[1], jnp.where(y[2] > 0, roots[2], 2)])
    theta = jnp.min(roots, axis=0)
    hit = theta <= 1
    first = jnp.argmin(roots, axis=0)
    second = jnp.stack([of[k + 1] < of[k] for k in (0, 2)])
    guard = jnp.where(first == 2, SECTION, 2 * first + jnp.where(first == 1, second[1], second[0]))
    guard = jnp.where(hit, guard, NONE)
    left, right = 1 - theta[None], theta[None]
    between = (
        left**2 * (1 + 2 * right) * y
        + right**2 * (3 - 2 * right) * y_1
        + step * left * right * (left * f_0 - right * f_1)
    )
    y_end, s_end = system.switch(jnp.where(hit[None], between, y_1), s, guard)
    return y_end, s_end, jnp.where(hit, theta, 1) * h, guard
