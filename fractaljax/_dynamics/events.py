"""A coarse Runge-Kutta step that stops where the first guard reaches zero."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .guard import NONE, SECTION
from .hybrid import HybridSystem
from .lanes import first_least, row_numbers
from .step_length import step_length
from .transition import switch

# Longest steps in units of h over the highest rate: of a stable step, where h is 0.3, and of a step
# that can be cut into stable segments of the eighth order.
STABLE, MOST = 8.0, 14.0


class Cubic(eqx.Module):
    """k_0 + k_1 x + k_2 x^2 + k_3 x^3 on 0 <= x <= 1, elementwise."""

    k_0: Array
    k_1: Array
    k_2: Array
    k_3: Array

    @classmethod
    def through(cls, g_0, g_1, d_0, d_1) -> "Cubic":
        """The cubic with values g and slopes d at 0 and at 1."""
        return cls(g_0, d_0, 3 * (g_1 - g_0) - 2 * d_0 - d_1, d_0 + d_1 - 2 * (g_1 - g_0))

    @classmethod
    def at_thirds(cls, g) -> "Cubic":
        """The cubic with values g (4, ...) at 0, 1/3, 2/3 and 1."""
        g_0, a, b, g_1 = g
        return cls(
            g_0,
            (18 * a - 11 * g_0 - 9 * b + 2 * g_1) / 2,
            (18 * g_0 - 45 * a + 36 * b - 9 * g_1) / 2,
            (27 * a - 9 * g_0 - 27 * b + 9 * g_1) / 2,
        )

    def __neg__(self) -> "Cubic":
        return Cubic(-self.k_0, -self.k_1, -self.k_2, -self.k_3)

    def __call__(self, x):
        return self.k_0 + x * (self.k_1 + x * (self.k_2 + x * self.k_3))

    def slope(self, x):
        """Derivative at x."""
        return self.k_1 + x * (2 * self.k_2 + 3 * x * self.k_3)

    def minimum(self) -> tuple[Array, Array]:
        """Place of the minimum strictly inside 0 < x < 1, else 0, and whether there is one."""
        square = self.k_2**2 - 3 * self.k_1 * self.k_3
        root = jnp.sqrt(jnp.maximum(square, 0))
        # The form of this root without cancellation.
        over = jnp.where(self.k_2 > 0, -self.k_1, root - self.k_2)
        below = jnp.where(self.k_2 > 0, self.k_2 + root, 3 * self.k_3)
        x = jnp.where(below == 0, 0, over / jnp.where(below == 0, 1, below))
        inside = (square >= 0) & (x > 0) & (x < 1)
        return jnp.where(inside, x, 0), inside

    def root_before(self, end) -> Array:
        """Root at which it falls through zero in (0, end], if there is one and no minimum inside.

        Newton's method, kept in a bracket by bisection. Beyond a maximum the cubic only falls:
        there the first guess is the root of the parabola from the maximum to `end`, elsewhere the
        root of the secant.
        """
        at_end, (peak, inside) = self(end), (-self).minimum()
        inside = inside & (peak < end)
        low = jnp.where(inside, peak, 0)
        value, high = self(low), end
        share = value / jnp.where(value == at_end, 1, value - at_end)
        share = jnp.where(inside, jnp.sqrt(jnp.maximum(share, 0)), share)
        x = low + (end - low) * share
        for _ in range(3):
            value, slope = self(x), self.slope(x)
            low, high = jnp.where(value < 0, low, x), jnp.where(value < 0, x, high)
            newton = x - value / jnp.where(slope == 0, 1, slope)
            good = (slope < 0) & (newton >= low) & (newton <= high)
            x = jnp.where(good, newton, (low + high) / 2)
        return x


def quintic(y, d, x):
    """Quintic interpolant at x, of values y (3, ...) and slopes d (3, ...) at 0, 1/2 and 1."""
    u, v, w = x, x - 0.5, x - 1
    # Lagrange weights squared, each with the correction of its own slope.
    at_0, at_m, at_1 = 4 * (v * w) ** 2, 16 * (u * w) ** 2, 4 * (u * v) ** 2
    first, last = y[0] + u * (d[0] + 6 * y[0]), y[2] + w * (d[2] - 6 * y[2])
    return at_0 * first + at_m * (y[1] + v * d[1]) + at_1 * last


def without_start(cubic: Cubic, rising) -> Cubic:
    """The cubic less its value at 0, divided by x, where `rising`; elsewhere the cubic itself.

    The root of the quotient is where the cubic returns to its first value, however soon.
    """
    k_0, k_1, k_2, k_3 = cubic.k_0, cubic.k_1, cubic.k_2, cubic.k_3
    return Cubic(
        jnp.where(rising, jnp.maximum(k_1, 0), k_0),
        jnp.where(rising, k_2, k_1),
        jnp.where(rising, k_3, k_2),
        jnp.where(rising, 0, k_3),
    )


def first_root(whole: Cubic) -> Array:
    """First root in (0, 1] at which cubics fall through zero, or 2 without one; any shape.

    A root at 0 does not count: the motion has just left it. A cubic below zero at 0 has its root
    there.
    """
    entered = whole.k_0 == 0
    cubic = without_start(whole, entered)
    # A minimum below zero has a root before it, even if the cubic ends above zero.
    lowest, dips = cubic.minimum()
    dips &= cubic(lowest) < 0
    end = jnp.where(dips, lowest, 1)
    x = cubic.root_before(end)
    # A step of zero length would be repeated forever.
    x = jnp.where(entered, jnp.maximum(x, 1e-6), x)
    return jnp.where(whole.k_0 < 0, 0, jnp.where(cubic(end) < 0, x, 2))


def rounding(y) -> Array:
    """Rounding error of a guard at y (2n, ...), within which it counts as zero."""
    return 64 * jnp.finfo(y.dtype).eps * (1 + jnp.max(jnp.abs(y), axis=0))


def step(system: HybridSystem, y, s, last, h, reach=None):
    """A step of length h or less in contact state s, by the classical fourth-order method.

    `last` is the guard that ended the previous step: a section just crossed is not crossed again.
    Returns the state and contact state after the step, its length, the number of the guard that
    ended it or `NONE`, the factor by which friction shortened it or 0, and the reach of the next
    step. States inside the step lie on the cubic through its ends.

    For a system whose steps follow the motion, `reach` (...) is the length that has the error of a
    step h of a harmonic motion with frequency 1.
    """
    unit, allowed = h if reach is None else h / system.fastest, (0.9 * h) ** 4 / 72
    f_0 = system.field(y, s)
    usual = jnp.broadcast_to(h, y.shape[1:])
    longest = usual if reach is None else jnp.minimum(reach, STABLE * unit)
    h = step_length(system, y, s, f_0, longest, usual)
    shorter, step = jnp.where(h < longest, usual / h, 0), h[None]
    f_b = system.field(y + step / 2 * f_0, s)
    f_c = system.field(y + step / 2 * f_b, s)
    f_d = system.field(y + step * f_c, s)
    y_1 = y + step / 6 * (f_0 + 2 * f_b + 2 * f_c + f_d)
    f_1 = system.field(y_1, s)

    def between(theta):
        left, right = 1 - theta, theta
        return (
            left**2 * (1 + 2 * right) * y
            + right**2 * (3 - 2 * right) * y_1
            + step * left * right * (left * f_0 - right * f_1)
        )

    nodes = jnp.stack([y, between(1 / 3), between(2 / 3), y_1])
    guards = jax.vmap(lambda y: system.guards(y, s))(nodes)
    # A guard within rounding of zero at the start has just been entered.
    start = jnp.where(jnp.abs(guards[0]) <= rounding(y)[None], 0, guards[0])
    roots = first_root(Cubic.at_thirds((start, *guards[1:])))
    # Only a fall through the section counts. (XLA does not vectorise updates of rows.)
    falls = (start > 0) & (last != SECTION)[None]
    first, theta = first_least(jnp.where((row_numbers(roots) != SECTION) | falls, roots, 2))
    hit = theta <= 1
    guard = jnp.where(hit, first, NONE)
    end = jnp.where(hit[None], between(jnp.where(hit, theta, 1)[None]), y_1)
    y_end, s_end = switch(system, end, s, guard)
    if reach is not None:
        rates = slice(system.n, None)
        error = h / 6 * jnp.max(jnp.abs(f_d - f_1)[rates], axis=0)
        size = allowed * (1 + jnp.max(jnp.abs(y)[rates], axis=0))
        reach = h * jnp.clip((size / jnp.maximum(error, 1e-300)) ** 0.25, 0.2, 2.2)
        reach = jnp.minimum(reach, MOST * unit)
    y_end = system.with_unit_excitation(y_end)
    return y_end, s_end, jnp.where(hit, theta, 1) * h, guard, shorter, reach


def guards_and_rates(system: HybridSystem, y, s, h, f) -> tuple[Array, Array]:
    """The guards at y (k, ...) and their changes over a step h (...), where dy/dt = f."""
    guards, rates = jax.jvp(lambda y: system.guards(y, s), (y,), (f,))
    return guards, jnp.asarray(h)[None] * rates
