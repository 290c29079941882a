"""The equations of a periodic orbit of known itinerary, with one quantity of the mechanism free.

The unknowns u are the first state (2n,), the duration of every phase (M,), and the quantity on its
window, 0 to 1. The equations say that the chain closes and that each phase ends where its guard is
zero. Their derivatives by the states between are eliminated by the affine maps of the segments.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._base.programs import exported_jit
from .._base.ranges import is_logarithmic
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import substituted
from .events import Cubic
from .extremes import extreme_values
from .guard import NONE, UNUSED
from .hybrid import HybridSystem
from .runge_kutta import runge_kutta
from .scaled import hybrid_system
from .segments import Segments, chosen_guard, flow, next_start, tableau
from .step_length import density
from .transition import switch


class Window(eqx.Module):
    """The range of a quantity, mapped to 0 to 1 on a linear or logarithmic scale."""

    low: Float[Array, ""]  # of the quantity or its logarithm
    high: Float[Array, ""]
    name: str = eqx.field(static=True)
    logarithmic: bool = eqx.field(static=True)

    @classmethod
    def over(cls, name: str, low: float, high: float) -> "Window":
        """The window of a quantity from low to high; logarithmic over a decade or more."""
        scale, ends = is_logarithmic(low, high), jnp.array([low, high])
        ends = jnp.log(ends) if scale else ends
        return cls(ends[0], ends[1], name, scale)

    def value(self, q) -> Any:
        """The quantity at q."""
        coordinate = self.low + q * (self.high - self.low)
        return jnp.exp(coordinate) if self.logarithmic else coordinate

    def place(self, value) -> Any:
        """The q of a value."""
        coordinate = jnp.log(value) if self.logarithmic else value
        return (coordinate - self.low) / (self.high - self.low)

    def system(self, x: Mechanism, q) -> HybridSystem:
        """The hybrid system of x with the quantity at q."""
        return hybrid_system(substituted(x, {self.name: self.value(q)}))


class Chain(eqx.Module):
    """The itinerary: N segments in M phases, each of one contact state, padded."""

    s: Float[Array, "f N"]  # contact state
    guard: Int[Array, " N"]  # that ends the segment: a number, NONE within a phase, or UNUSED
    phase: Int[Array, " N"]  # which phase it belongs to
    begin: Float[Array, " N"]  # its start, as a share of the phase
    share: Float[Array, " N"]  # its duration, as a share of the phase; 0 for padding
    used: Float[Array, " M"]  # 1 for a phase, 0 for padding

    @property
    def ends(self) -> Array:
        """True for segments that end a phase."""
        return (self.guard != NONE) & (self.guard != UNUSED)


class Lifted(NamedTuple):
    """States at the starts of the segments near a solution, as an affine function of u."""

    u: Float[Array, " k"]
    y: Float[Array, "2n N"]  # at u
    D: Float[Array, "2n k N"]  # derivative by u

    def at(self, u) -> Float[Array, "2n N"]:
        """The states at another u."""
        return self.y + jnp.einsum("ikn,k->in", self.D, u - self.u)


def durations(chain: Chain, u, n: int) -> Float[Array, " N"]:
    """The durations of the segments; n is the number of degrees of freedom."""
    return u[2 * n : -1][chain.phase] * chain.share


def _mix(system, rate, e):
    return jax.tree.map(lambda a, d: a + e * d, system, rate)


def equations(x: Mechanism, window: Window, chain: Chain, lifted: Lifted, u):
    """Residual (2n + M,) and Jacobian (2n + M, 2n + M + 1) at u, and the next `Lifted`.

    Also the largest gap between segments. For a padding phase the equation is h = 0.
    """
    system, rate = jax.jvp(lambda q: window.system(x, q), (u[-1],), (jnp.ones_like(u[-1]),))
    y, s, n = lifted.at(u), chain.s, system.n
    h = durations(chain, u, n)

    def field(columns):
        def both(y, e):
            return _mix(system, rate, e).field(y, s)

        along, slope = jax.linearize(both, columns[:, 0], jnp.zeros_like(u[-1]))
        by = jnp.zeros(2 * n + 1, y.dtype).at[-1].set(1)
        tangents = jax.vmap(slope, in_axes=(1, 0), out_axes=1)(columns[:, 1:], by)
        return jnp.concatenate([along[:, None], tangents], axis=1)

    units = jnp.eye(2 * n, 2 * n + 1, dtype=y.dtype)[:, :, None]
    columns = jnp.concatenate([y[:, None], jnp.broadcast_to(units, (2 * n, 2 * n + 1, len(h)))], 1)
    ends = runge_kutta(tableau(), field, columns, h[None, None])
    ends, A, Q = ends[:, 0], ends[:, 1:-1], ends[:, -1]
    b = system.field(ends, s) * chain.share[None]
    target = next_start(y)
    g, pull = jax.vjp(lambda y: chosen_guard(system, y, s, chain.guard), target)
    (c,) = pull(jnp.ones_like(h))
    _, c_q = jax.jvp(
        lambda e: chosen_guard(_mix(system, rate, e), target, s, chain.guard),
        (jnp.zeros_like(u[-1]),),
        (jnp.ones_like(u[-1]),),
    )
    D, d, D_end, d_end = _chained(chain, A, b, Q, ends - target, len(u))
    row = jnp.einsum("in,ikn->nk", c, D_end).at[:, -1].add(c_q)
    first = jnp.eye(2 * n, len(u), dtype=y.dtype)
    padding = jnp.diag(1 - chain.used)
    residual = jnp.concatenate(
        [d_end[:, -1], _of_phases(chain, g + jnp.sum(c * d_end, 0)) + padding @ u[2 * n : -1]]
    )
    guards = _of_phases(chain, row.T).T.at[:, 2 * n : -1].add(padding)
    jacobian = jnp.concatenate([D_end[..., -1] - first, guards])
    return residual, jacobian, Lifted(u, y + d, D), jnp.max(jnp.abs(d))


condensed = exported_jit(equations)


def return_jacobian(jacobian, k: int, xp: Any = jnp) -> Any:
    """The Jacobian (k, k) of the return map from that of the equations, by JAX or NumPy (`xp`)."""
    changes = xp.linalg.solve(jacobian[k:, k:-1], jacobian[k:, :k])
    return jacobian[:k, :k] + xp.eye(k, dtype=jacobian.dtype) - jacobian[:k, k:-1] @ changes


def _chained(chain: Chain, A, b, Q, gap, k: int):
    """Derivatives by u (2n, k, N) and shifts (2n, N) of the starts of segments and of their ends.

    A, b and Q are the derivatives of the ends by their starts, durations and the quantity.
    """
    phases = len(chain.used)
    of_phase = jax.nn.one_hot(len(A) + chain.phase, k, dtype=A.dtype)
    of_quantity = jnp.zeros(k, A.dtype).at[len(A) + phases].set(1)

    def step(carry, segment):
        D, d = carry
        A, b, Q, gap, column = segment
        end = A @ D + b[:, None] * column[None] + Q[:, None] * of_quantity[None]
        return (end, A @ d + gap), (D, d, end, A @ d + gap)

    start = jnp.eye(len(A), k, dtype=A.dtype), jnp.zeros(len(A), A.dtype)
    lanes = tuple(jnp.moveaxis(x, -1, 0) for x in (A, b, Q, gap))
    _, stacked = jax.lax.scan(step, start, (*lanes, of_phase))
    return tuple(jnp.moveaxis(x, 0, -1) for x in stacked)


def _of_phases(chain: Chain, values) -> Array:
    """The values (..., N) at the ends of the phases (..., M); 0 for padding."""
    place = jax.nn.one_hot(chain.phase, len(chain.used), dtype=values.dtype)
    return jnp.where(chain.ends, values, 0) @ place


class Place(NamedTuple):
    """A place on an orbit at which a guard is evaluated."""

    guard: Int[Array, ""]
    segment: Int[Array, ""]
    theta: Float[Array, ""]  # share of the segment
    before: Int[Array, ""]  # order of the guard's zero at the start of the phase
    after: Int[Array, ""]  # and at its end


def _at_switch(time) -> Array:
    """True for scaled times from a switch that are zero to rounding."""
    return time <= 1e-12


def reduced_guard(system: HybridSystem, chain: Chain, y, h, at: Place, theta) -> Array:
    """The guard over (time since the start of its phase)^before (time to its end)^after.

    This removes the zeros that a guard has where a phase begins and ends.
    """
    k = at.segment
    state, s = y[:, k], chain.s[:, k]
    phase = h[k] / chain.share[k]
    since, left = chain.begin[k] * phase, (1 - chain.begin[k] - chain.share[k]) * phase

    y = flow(system, state, theta * h[k], s)
    values, rates = jax.jvp(lambda y: system.guards(y, s), (y,), (system.field(y, s),))
    value, rate = values[at.guard], rates[at.guard]
    time, rest = since + theta * h[k], left + (1 - theta) * h[k]
    # At its own zero the guard's rate takes the place of the quotient.
    at_start, at_end = (at.before > 0) & _at_switch(time), (at.after > 0) & _at_switch(rest)
    plain = value / jnp.where(at_start | (at.before == 0), 1, time**at.before)
    plain = plain / jnp.where(at_end | (at.after == 0), 1, rest)
    at_start_value = rate / jnp.where(at.after > 0, rest, 1)
    at_end_value = -rate / jnp.where(at.before > 0, jnp.where(at_end, time, 1) ** at.before, 1)
    return jnp.where(at_start, at_start_value, jnp.where(at_end, at_end_value, plain))


@jax.jit
def lowest(x: Mechanism, window: Window, chain: Chain, lifted: Lifted, u, before, after):
    """The least reduced guard anywhere on the orbit, and where it is.

    `before` and `after` (k, M) are the orders of the zeros of the guards where phases begin and
    end; `before` = -1 leaves a guard out. Below zero the orbit does not keep to its itinerary.
    """
    system = window.system(x, u[-1])
    y, n = lifted.at(u), system.n
    h = durations(chain, u, n)
    theta = jnp.arange(5, dtype=y.dtype) / 4  # the ends of a segment, and three places inside

    def samples(share):
        states = flow(system, y, share * h, chain.s)
        rate = system.field(states, chain.s)
        return jax.jvp(lambda y: system.guards(y, chain.s), (states,), (rate,))

    value, rate = jax.vmap(samples, out_axes=1)(theta)
    phase = u[2 * n : -1][chain.phase]
    time = ((chain.begin[None] + theta[:, None] * chain.share[None]) * phase[None])[None]
    rest = phase[None, None] - time
    p, q = before[:, chain.phase][:, None], after[:, chain.phase][:, None]
    at_start, at_end = (p > 0) & _at_switch(time), (q > 0) & _at_switch(rest)
    time, rest = jnp.where(_at_switch(time), 1, time), jnp.where(_at_switch(rest), 1, rest)
    over = jnp.where(at_start, 1, time**p) * jnp.where(at_end, 1, rest**q)
    reduced = jnp.where(at_start, rate, jnp.where(at_end, -rate, value)) / over
    # After a stick ends, a slip begins with a zero of second order, whose sign the stick's decides.
    counted = (chain.share[None, None] > 0) & ~(at_start & (p > 1))
    counted = counted & (jnp.arange(len(value))[:, None, None] > 0) & (p >= 0)
    reduced = jnp.where(counted, reduced, jnp.inf)
    guard, node, segment = jnp.unravel_index(jnp.argmin(reduced), reduced.shape)
    orders = before[guard, chain.phase[segment]], after[guard, chain.phase[segment]]
    place = Place(guard, segment, theta[node], *orders)
    fixed = (at_start | at_end)[guard, node, segment]

    # Not beyond the phase.
    first = jnp.maximum(-chain.begin[segment] / chain.share[segment], -0.3)
    last = jnp.minimum((1 - chain.begin[segment]) / chain.share[segment], 1.3)

    def guard_at(theta):
        return reduced_guard(system, chain, y, h, place, theta)

    refined = descended(guard_at, place.theta, (1 / 4, 1 / 32, 1 / 256, 1 / 2048), first, last)
    refined = jnp.where(fixed, place.theta, refined)
    value = reduced[guard, node, segment]
    least = jnp.where(
        fixed, value, jnp.minimum(value, reduced_guard(system, chain, y, h, place, refined))
    )
    theta = jnp.where(least < value, refined, place.theta)
    return least, Place(guard, segment, theta, *orders)


def descended(
    function: Callable, theta, spacings, first: Any = -jnp.inf, last: Any = jnp.inf
) -> Array:
    """The minimum of a function of one variable near theta, between two ends.

    Each step goes to the vertex of the parabola through three points around the last one.
    """

    def vertex(theta, spacing):
        theta = jnp.clip(theta, first + spacing, last - spacing)
        low, here, high = jax.vmap(function)(theta + spacing * jnp.arange(-1, 2))
        bend = low + high - 2 * here
        offset = (low - high) / (2 * jnp.where(bend > 0, bend, 1))
        offset = jnp.where(bend > 0, jnp.clip(offset, -1, 1), jnp.sign(low - high))
        return theta + spacing * offset, None

    return jax.lax.scan(vertex, theta, jnp.array(spacings, theta.dtype))[0]


@functools.partial(exported_jit, static_argnames="places")
def resampled(x, window: Window, chain: Chain, lifted: Lifted, u, times, longest, *, places: int):
    """States (2n, places) at times since the start of the orbit.

    Also by what factor segments should be shorter than `longest` there.
    """
    system = window.system(x, u[-1])
    h = durations(chain, u, system.n)
    ends = jnp.cumsum(h)
    last = jnp.max(jnp.where(chain.share > 0, jnp.arange(len(h)), 0))
    k = jnp.minimum(jnp.searchsorted(ends, times, side="right"), last)
    s = chain.s[:, k]
    y = flow(system, lifted.at(u)[:, k], times - (ends - h)[k], s)
    return y, density(system, y, s, jnp.broadcast_to(longest, k.shape))


@exported_jit
def measured(x, window: Window, chain: Chain, lifted: Lifted, u):
    """Least, largest and section states (3, 2n) in SI units, 1/omega, and the error."""
    system = window.system(x, u[-1])
    y, h = lifted.at(u), durations(chain, u, system.n)
    segments = Segments(y, h, chain.s, chain.guard)
    extremes = extreme_values(system, segments, jnp.eye(len(y), dtype=y.dtype))
    half = flow(system, flow(system, y, h / 2, chain.s), h / 2, chain.s)
    error = jnp.sum(jnp.max(jnp.abs(half - flow(system, y, h, chain.s)), axis=0))
    states = jnp.concatenate([extremes, at_section(system, segments)[None]])
    return states * system.units[None], 1 / system.omega, error / jnp.max(jnp.abs(y))


def at_section(system: HybridSystem, segments: Segments) -> Float[Array, " 2n"]:
    """The state where t.x of the first face is largest."""
    y, h, s = segments.y, segments.duration, segments.s
    first, last = (system.along(x[: system.n])[0] for x in (y, next_start(y)))
    rate, end_rate = h * system.section(y), h * system.section(next_start(y))
    cubic = Cubic.through(-first, -last, -rate, -end_rate)
    theta, _ = cubic.minimum()
    k = jnp.argmin(cubic(theta))
    y, s = y[:, k], s[:, k]

    def newton(_, t):
        at = flow(system, y, t, s)
        return t - system.section(at) / system.section(system.field(at, s))

    return flow(system, y, jax.lax.fori_loop(0, 4, newton, theta[k] * h[k]), s)


@jax.jit
def linearised(x, window: Window, q):
    """The sliding equilibrium (2n,) in scaled units, and the Jacobian (2n, 2n) of the field."""
    system = window.system(x, q)
    y = system.equilibrium()
    slips = jnp.ones(len(system.P), y.dtype)
    return y, jax.jacfwd(lambda y: system.field(y, slips))(y)


@jax.jit
def largest_friction(x, window: Window, q, y):
    """The largest coefficient of friction at states y (2n, k), over the static one."""
    system = window.system(x, q)
    speeds = system.speed * jnp.abs(system.sliding(y[system.n :]))
    return jnp.max(system.over_static(speeds))


@jax.jit
def after_switch(x, window: Window, q, y, s, guard):
    """The contact state after a guard of contact state s has reached zero at y."""
    return switch(window.system(x, q), y, s, guard)[1]


@jax.jit
def guards_at(x, window: Window, q, y, s):
    """The guards (k,) at one state."""
    return window.system(x, q).guards(y, s)


@jax.jit
def rate_at(x, window: Window, q, y, s):
    """The rate of the section's guard at one state: below 0 at a maximum of t.x."""
    system = window.system(x, q)
    return system.section(system.field(y, s))
