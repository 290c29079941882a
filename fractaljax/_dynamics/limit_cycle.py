"""The stick-slip limit cycle: amplitude, frequency and share of sticking, with gradients."""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.one_kernel import one_kernel, small_kernel
from .._base.parts import concrete, number, raise_unless, require_kind, whole
from .._base.quick import quick_jit
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import joints_of
from .._mechanism.scene import Scene
from .._stability.stability import growth_rate
from . import search
from .assessment import CONVERGED
from .cycle import CycleResult, LimitCycle, Orbit
from .events import Cubic, first_root, rounding
from .excitation import Excitation, excited_system
from .hybrid import NONE, OPEN, HybridSystem
from .lanes import first_least, product, row_numbers
from .maps import maps
from .orbit import orbit
from .scaled import FEW, check_rtol, degrees_of_freedom, scaled_start, start_state
from .segments import Segments, cumulative, flow, next_start

if TYPE_CHECKING:
    from diffrax import AbstractSolver

_SEGMENTS = 64  # one return takes some 35 at rtol 1e-9
_MOST_SEGMENTS = 4096
_CROSSINGS = 16  # segments in which x2 may change sign
_MINIMA = 4  # nearly equal ones of a displacement or a velocity

# In the order of the numbers in `search`.
_RESULTS = (
    CycleResult.exhausted,
    CycleResult.converged,
    CycleResult.equilibrium,
    CycleResult.diverged,
    CycleResult.not_periodic,
    CycleResult.exhausted,
    CycleResult.too_long,
)


def _along(system: HybridSystem, y, s, t, row):
    """row @ y and its first two derivatives by time, each lane at its own time t."""
    y = flow(system, y, t, s)
    rate = system.field(y, s)
    _, change = jax.jvp(lambda y: system.field(y, s), (y,), (rate,))
    return tuple(jnp.sum(row * x, axis=0) for x in (y, rate, change))


def _lowest(x, count: int) -> tuple[Array, Array]:
    """The lowest values (r, count) in the rows of x (r, k), and where: quicker than sorting."""

    def without(x, _):
        k, least = first_least(x)
        return jnp.where(row_numbers(x) == k[None], jnp.inf, x), (least, k)

    _, (least, k) = jax.lax.scan(without, x.T, length=count)
    return least.T, k.T


def _vertex(given, t):
    """The minimum of row @ y by the parabola at t, of third order, and a step towards it."""
    system, y, s, h, row = given
    value, rate, change = _along(system, y, s, t, row)
    most = h / 8
    near = jnp.abs(rate) < change * most
    newton = jnp.where(near, -rate / jnp.where(near, change, 1), 0)
    return value + rate * newton / 2, jnp.where(near, newton, -jnp.sign(rate) * most)


@jax.custom_jvp
def _minima(given: tuple, t, exists) -> tuple[Array, Array]:
    """The minima near the times t, infinite but where one `exists`, and when they are.

    Derivatives are those of the last parabola: with respect to its time a minimum has none.
    """
    length = given[3]

    def going(carry):
        _, change, _, steps = carry
        return (steps < 6) & jnp.any(exists & (jnp.abs(change) > length / 2**20))

    # The cubic's minimum is near, but where it is nearly an inflection.
    def step(carry):
        t, _, _, steps = carry
        value, change = _vertex(given, t)
        return jnp.clip(t + change, 0, length), change, value, steps + 1

    far = jnp.full_like(t, jnp.inf)
    t, _, value, _ = jax.lax.while_loop(going, step, (t, far, far, 0))
    return jnp.where(exists, value, jnp.inf), t


@_minima.defjvp
def _minima_jvp(primals, tangents):
    given, t, exists = primals
    value, t = _minima(given, t, exists)
    _, change = jax.jvp(lambda given: _vertex(given, t)[0], (given,), (tangents[0],))
    return (value, t), (jnp.where(exists, change, 0), jnp.zeros_like(t))


def extreme_values(system: HybridSystem, segments: Segments, rows) -> Float[Array, "2 r"]:
    """Smallest and largest value along the orbit of linear functions rows @ y, rows (r, 2n)."""
    y, h, s = segments.y, segments.duration, segments.s
    nodes = _at_nodes(system, segments, lambda x: system.times(rows, x))
    g_0, g_1, d_0, d_1 = (jnp.concatenate([x, -x]) for x in nodes)
    rows = jnp.concatenate([rows, -rows])
    # Minima inside of segments, by the cubic through the ends. Of those nearly as low it cannot say
    # which is the lowest, so that a few are refined. A row at rest has none.
    through = jax.lax.stop_gradient((g_0, g_1, d_0, d_1))
    cubic, small = Cubic.through(*through), jnp.max(rounding(y))
    theta, inside = cubic.minimum()
    least = jnp.where(inside & (d_1 - d_0 > small / 64), cubic(theta), jnp.inf)
    least, k = (x.ravel() for x in _lowest(least, _MINIMA))
    of_row, length = jnp.arange(len(k)) // _MINIMA, h[k]
    given = (system, y[:, k], s[:, k], length, rows[of_row].T)
    value, _ = _minima(given, theta[of_row, k] * length, least < jnp.inf)
    value = jnp.min(value.reshape(-1, _MINIMA), axis=1)
    # Where one ends a segment both are equal to rounding, and the parabola alone follows it.
    node = jnp.min(g_0, axis=1)
    value = jnp.where(value <= node + small, value, node)
    low, high = jnp.split(value, 2)
    return jnp.stack([low, -high])


def _at_nodes(system: HybridSystem, segments: Segments, values: Callable) -> list[Array]:
    """Linear `values` of the states at the starts and the ends of segments, and their slopes."""
    y, h, s = segments.y, segments.duration, segments.s
    starts = values(y)
    slopes = [values(h[None] * system.field(end, s)) for end in (y, next_start(y))]
    return [starts, jnp.roll(starts, -1, axis=-1), *slopes]


def _time_below_zero(system: HybridSystem, segments: Segments, row, offset) -> Float[Array, ""]:
    """How long row @ y + offset is negative in one period."""
    y, h, s = segments.y, segments.duration, segments.s
    g_0, g_1, d_0, d_1 = _at_nodes(system, segments, lambda x: system.times(row[None], x)[0])
    g_0, g_1 = g_0 + offset, g_1 + offset
    whole_segments = jnp.sum(jnp.where(g_0 < 0, h, 0))
    # In a segment with crossings: from its start to the first zero, and from the last to its end.
    sign, reversed_sign = jnp.where(g_0 < 0, -1, 1), jnp.where(g_0 * g_1 < 0, -1, 1)
    g_0, g_1, d_0, d_1 = (sign * x for x in (g_0, g_1, d_0, d_1))
    back = [reversed_sign * x for x in (g_1, g_0, -d_1, -d_0)]
    cubics = Cubic.through(*(jnp.stack(x) for x in zip((g_0, g_1, d_0, d_1), back, strict=True)))
    first, last = first_root(cubics)
    until, number = cumulative(first <= 1), jnp.arange(_CROSSINGS)
    crosses, k = number < until[-1], jnp.argmax(until[None] > number[:, None], axis=1)
    t = jax.lax.stop_gradient(jnp.concatenate([first[k], 1 - last[k]]))
    twice = jnp.concatenate([k, k])
    t = t * h[twice]
    lanes = jnp.broadcast_to(row[:, None], (len(row), len(t)))
    value, rate, change = _along(system, y[:, twice], s[:, twice], t, lanes)
    # One step of third order from the cubic's root, which carries the derivative as well.
    rate = jnp.where(rate == 0, 1, rate)
    newton = (value + offset) / rate
    t = t - newton * (1 + newton * change / (2 * rate))
    first, last = jnp.split(t, 2)
    # With one crossing the rest of the segment has the other sign, else the time between two.
    crossed = jnp.where(jax.lax.stop_gradient(g_1[k]) < 0, h[k] - first, last - first)
    return whole_segments + jnp.sum(jnp.where(crosses, sign[k] * crossed, 0))


def _monodromy(system: HybridSystem, segments: Segments) -> Float[Array, "2n 2n"]:
    """The product of all segments' maps, with the jump of the tangent at every switch."""
    _, local = maps(system, segments)
    ends, s = next_start(segments.y), segments.s
    before, after = system.field(ends, s), system.field(ends, jnp.roll(s, -1, axis=-1))
    switches = segments.used & (segments.guard != NONE)
    speed = jnp.where(switches, jnp.sum(local.c * before, axis=0), 1)
    jump = jnp.where(switches[None], (after - before) / speed[None], 0)
    eye = jnp.eye(len(ends), dtype=ends.dtype)

    def chain(so_far, segment):
        A, jump, c = segment
        so_far = product(A, so_far)
        return so_far + jump[:, None] * jnp.sum(c[:, None] * so_far, axis=0)[None], None

    return jax.lax.scan(chain, eye, (local.A, jump.T, local.c.T))[0]


# Apart from the cycle's program, which another contact law then does not compile again.
@functools.partial(quick_jit, once=True)
def posed(mechanism: Mechanism, excitation) -> tuple[HybridSystem, Float[Array, ""]]:
    """The scaled system, and its growth rate at the equilibrium."""
    return small_kernel(_posed, mechanism, excitation)


def _posed(mechanism: Mechanism, excitation) -> tuple[HybridSystem, Float[Array, ""]]:
    system = excited_system(mechanism, excitation)
    # An excited motion does not end in equilibrium.
    growth = jnp.ones_like(system.omega) if system.excited else growth_rate(mechanism)
    return system, growth / system.omega


@functools.partial(quick_jit, static_argnames=("of_scene", "segments", "rtol"))
def solved(
    system: HybridSystem, growth, start, max_returns, *, of_scene: bool, segments: int, rtol: float
) -> LimitCycle:
    frozen, growth = jax.lax.stop_gradient((system, growth))

    def states(system, start):
        return system.equilibrium(), scaled_start(system, start)

    equilibrium, y = one_kernel(states, frozen, start)
    h = 0.25 if system.fastest is None else 0.2  # a finer mesh would take a second solution
    h = jnp.asarray(h * (rtol / 1e-9) ** 0.125, y.dtype)
    max_returns = max_returns.astype(y.dtype)
    found = search.find(
        frozen, y, equilibrium, growth, max_returns, h, jnp.asarray(rtol, y.dtype), segments
    )
    found = jax.lax.stop_gradient(found)

    y, duration = orbit(system, found.segments)
    closed = Segments(y, duration, found.segments.s, found.segments.guard)
    period = jnp.sum(duration)
    error = found.error
    status = CycleResult.exhausted
    for outcome, result in enumerate(_RESULTS):
        status = CycleResult.where(found.status == outcome, result, status)
    exists = found.status == CONVERGED
    monodromy = one_kernel(_monodromy, system, closed)
    rounding_of_growth = 1e3 * jnp.finfo(y.dtype).eps
    unstable = exists & (found.growth > 100 * error + rounding_of_growth)
    status = CycleResult.where(unstable, CycleResult.unstable, status)
    status = CycleResult.where(exists & ~(error <= rtol), CycleResult.inaccurate, status)

    def only(value):
        return jnp.where(exists, value, jnp.nan)

    period = only(period)
    n, scale = system.n - system.excited, system.units
    # The loads of the tangential faces are the normal forces of the joints.
    tangential = np.array([faces[0] for faces in system.faces])
    rows = jnp.concatenate([system.L[tangential], jnp.zeros_like(system.L[tangential])], axis=1)
    own = system.own(jnp.eye(2 * system.n, dtype=rows.dtype))
    everything = jnp.concatenate([own, rows])
    low, high = one_kernel(extreme_values, system, closed, everything)
    offset = system.P[tangential][None]
    linear = jnp.zeros((len(system.P), 2), rows.dtype)
    linear = linear.at[tangential].set((jnp.stack([low, high])[:, 2 * n :] + offset).T)
    # A load curve rises, so that its extremes are where those of the approach are.
    forces = system.normal_forces(linear).T * system.force_unit
    forces = jnp.where(np.array(system.opens)[None], jnp.maximum(forces, 0), forces)
    low, high = low[: 2 * n] * scale, high[: 2 * n] * scale

    def share(of):
        return jnp.sum(jnp.where(of, duration[None], 0), axis=1) / period

    # A scene says it of both directions, a structure of each joint.
    shown = slice(None) if of_scene else tangential
    pulls = [
        jnp.zeros_like(period)
        if opens or not faces[1:]
        else one_kernel(_time_below_zero, system, closed, row, shift) / period
        for row, shift, faces, opens in zip(
            rows, offset[0], system.faces, system.opens, strict=True
        )
    ]
    return LimitCycle(
        period=period / system.omega,
        amplitude=only((high - low)[:n]),
        velocity_min=only(low[n:]),
        velocity_max=only(high[n:]),
        stick_fraction=only(share(closed.s == 0))[shown],
        open_fraction=only(share(closed.s == OPEN))[tangential],
        tension_fraction=only(pulls[0] if of_scene else jnp.stack(pulls)),
        normal_force=only(forces.T),
        state=only(system.own(y[:, 0]) * scale),
        error=only(error),
        returns=found.period_returns,
        regularisation_error=only(jnp.zeros_like(error)),
        result=status,
        _monodromy=only(system.own(system.own(monodromy).T).T),
        _system=system,
        _orbit=Orbit(closed),
    )


def refined(cycle: LimitCycle, arguments: tuple, count: int, static: dict) -> LimitCycle:
    """A cycle found with `count` segments, again with as many as a long period needs.

    Known only of one cycle outside of a compiled program.
    """
    if concrete(cycle.period) is None or cycle.period.ndim:
        return cycle
    while count < _MOST_SEGMENTS:
        # 512 segments keep 16,384 steps: a motion without a period shall not take longer.
        too_long = bool(cycle.result == CycleResult.too_long) and count < 8 * _SEGMENTS
        if not too_long and not bool(cycle.result == CycleResult.inaccurate):
            break
        count *= 8
        cycle = solved(*arguments, segments=count, **static)
    return cycle


def checked(mechanism, start, excitation, rtol, max_returns, segments=None):
    """Options of a search: `max_returns` as a number, how many segments, and what is static."""
    n, joints = degrees_of_freedom(mechanism), joints_of(mechanism)
    if excitation is not None:
        require_kind("excitation", excitation, Excitation)
    rtol = check_rtol(rtol, jnp.result_type(*jax.tree.leaves((mechanism, start, excitation))))
    returns = jnp.asarray(whole("max_returns", max_returns, 1), float)
    count = _SEGMENTS if segments is None else whole("segments", segments, 16)
    if segments is None and any(x.follows_load_curve for x in joints.values()):
        count *= 8  # towards an opening segments are short: less than a second compilation
    elif segments is None and (n > FEW or len(joints) > 1):
        count *= 4  # a period may be long beside that of the highest frequency, or of many phases
    return returns, count, {"of_scene": isinstance(mechanism, Scene), "rtol": rtol}


def limit_cycle(
    mechanism: Mechanism,
    start: ArrayLike | Sequence[float] | None = None,
    *,
    excitation: Excitation | None = None,
    regularisation: ScalarLike | None = None,
    solver: "AbstractSolver | None" = None,
    rtol: float | None = None,
    max_returns: int = 5000,
    max_steps: int = 4096,
    segments: int | None = None,
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle that the motion from `start` ends in, by the exact law of dry friction.

    With an excitation: the periodic motion under it.

    A coarse run from `start` is compared at its returns to a section: the maxima of t.x, the
    tangential displacement of the first joint (of x1 in a scene). Where they repeat, Newton's
    method solves for the periodic orbit, and every derivative is the implicit one of its
    equations. A period has at most 16 returns. Derivatives with respect to `start` are zero. An
    orbit that repels so weakly that the motion does not leave it is returned as `unstable`.

    **Arguments:**

    - `mechanism`: a scene, or a structure of n degrees of freedom whose joints all have a V;
      `jax.vmap` takes many, and a member that fails marks only itself. All wait for the slowest:
      on a CPU `jax.lax.map(..., batch_size=32)` is quicker.
    - `start`: (2n,), [x, v] in m and m/s; by default the sliding equilibrium, displaced by V/omega
      along t, where omega^2 is the sum of the squared eigenfrequencies of a scene, and of a
      structure the root of the sum of their fourth powers.
    - `excitation`: a harmonic force. The returns are then its periods, at each of which its time is
      0 again: the section is stroboscopic, `state` is that at the time 0, `period` is `returns`
      periods of the excitation (above 1 the motion is subharmonic), and none of the 2n
      `multipliers` is 1 by itself. `start` is the state at the time 0.
    - `regularisation`: eps [m/s], to replace sgn v by tanh(v/eps). The cycle is then compared
      with the exact law's from the same start: `regularisation_error` is the largest relative
      difference of period and amplitudes, and the result `depends_on_eps` where it is above
      1e-3. Derivatives differ by far more than values do.
    - `solver`: a diffrax solver for the regularised law, Tsit5 by default; an implicit one, such
      as Kvaerno5, for a small eps. `max_steps` bounds its steps in one period.
    - `rtol`: relative tolerance of period and states, 1e-9 by default and at least 9.1e-13; in
      float32 both are 4.9e-4. It sets the number of segments.
    - `max_returns`: returns of the coarse run after which it gives up.
    - `segments`: most pieces that the orbit is cut into, 64 by default, 256 for more than 8 degrees
      of freedom or more than one joint, and 512 where a joint follows its load curve; one return
      takes some 35, more where the highest frequency is far above that of the motion.
      Outside of compiled programs a longer period gets more; inside, the result says that it
      needs them.
    - `throw`: raise unless the result is `converged`. Otherwise `result` says what was found, and
      everything is NaN where there is no cycle.

    **Raises:** `ValueError` for a start of another shape, an rtol above 0.1 or below what the
    precision can hold, less than 16 segments or max_returns below 1; `RuntimeError` if `throw`.
    Under a trace (`jit`, `vmap`) everything is NaN instead.
    """
    start = None if start is None else start_state(start, degrees_of_freedom(mechanism))
    given = mechanism, start, excitation
    returns, count, static = checked(*given, rtol, max_returns, segments)
    arguments = *posed(mechanism, excitation), start, returns
    cycle = solved(*arguments, segments=count, **static)
    if segments is None:
        cycle = refined(cycle, arguments, count, static)
    if regularisation is not None:
        from .regularised import regularised_cycle

        eps = number("regularisation", regularisation, above=0)
        steps = whole("max_steps", max_steps, 1)
        cycle = regularised_cycle(*given, eps, cycle, solver, static["rtol"], steps)
    return raise_unless(CycleResult.converged, cycle) if throw else cycle
