"""The stick-slip limit cycle: amplitude, frequency and share of sticking, with gradients."""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import concrete, raise_unless, require_kind, whole
from .._base.programs import exported_jit
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import has_memory
from .._stability.stability import growth_rate
from .cycle import CycleResult, LimitCycle, Orbit
from .cycle_search import CycleSearch
from .excitation import Excitation, excited_system
from .hybrid import HybridSystem
from .orbit import orbit
from .scaled import (
    check_rtol,
    degrees_of_freedom,
    require_drive,
    scaled_start,
    smoothing,
    start_state,
    steps_follow_motion,
)
from .search import find_attractor
from .segments import Segments
from .status import Status

if TYPE_CHECKING:
    from diffrax import AbstractSolver


# Kept out of the cycle's program, which another contact law then does not compile again.
@exported_jit
def scale_problem(mechanism: Mechanism, excitation) -> tuple[HybridSystem, Float[Array, ""]]:
    """The scaled system, and its growth rate at the equilibrium."""
    system = excited_system(mechanism, excitation)
    # An excited motion does not end in equilibrium.
    growth = jnp.ones_like(system.omega) if system.excited else growth_rate(mechanism)
    return system, growth / system.omega


@functools.partial(exported_jit, static_argnames=("of_scene", "segments", "rtol", "search"))
def find_cycle(
    system: HybridSystem,
    growth,
    start,
    max_returns,
    *,
    of_scene: bool,
    segments: int,
    rtol: float,
    search: CycleSearch,
) -> LimitCycle:
    """The limit cycle that the motion of a scaled system from a start ends in.

    Its period is cut into at most `segments`.
    """
    frozen, growth = jax.lax.stop_gradient((system, growth))
    equilibrium, y = frozen.equilibrium(), scaled_start(frozen, start)
    h = 0.25 if system.fastest is None else 0.2  # a finer mesh saves a second solution
    h = jnp.asarray(h * (rtol / 1e-9) ** 0.125, y.dtype)
    max_returns = max_returns.astype(y.dtype)
    limits = max_returns, h, jnp.asarray(rtol, y.dtype)
    attractor = find_attractor(frozen, y, equilibrium, growth, *limits, segments, search)
    attractor = jax.lax.stop_gradient(attractor)

    y, duration = orbit(system, attractor.segments)
    closed = Segments(y, duration, attractor.segments.s, attractor.segments.guard)
    period = jnp.sum(duration)
    error = attractor.error
    status = CycleResult.exhausted
    for outcome in Status:
        status = CycleResult.where(attractor.status == outcome, outcome.result, status)
    exists = attractor.status == Status.CONVERGED
    rounding_of_growth = 1e3 * jnp.finfo(y.dtype).eps
    unstable = exists & (attractor.growth > 100 * error + rounding_of_growth)
    status = CycleResult.where(unstable, CycleResult.unstable, status)
    status = CycleResult.where(exists & ~(error <= rtol), CycleResult.inaccurate, status)

    def only(value):
        return jnp.where(exists, value, jnp.nan)

    return LimitCycle(
        period=only(period) / system.omega,
        state=only(system.mechanism_state(y[:, 0]) * system.units),
        error=only(error),
        returns=attractor.period_returns,
        regularisation_error=only(jnp.zeros_like(error)),
        result=status,
        of_scene=of_scene,
        _system=system,
        _orbit=Orbit(closed),
    )


def refine_cycle(cycle: LimitCycle, arguments: tuple, count: int, static: dict) -> LimitCycle:
    """A cycle solved with `count` segments, solved again with as many as a long period needs.

    Only for one cycle, outside of a compiled program.
    """
    if concrete(cycle.period) is None or cycle.period.ndim:
        return cycle
    while count < static["search"].most_segments:
        # 512 segments keep 16,384 steps: a motion without a period shall not take longer.
        too_long = bool(cycle.result == CycleResult.too_long) and count < 512
        if not too_long and not bool(cycle.result == CycleResult.inaccurate):
            break
        count *= 8
        cycle = find_cycle(*arguments, segments=count, **static)
    return cycle


def check_arguments(mechanism, start, excitation, rtol, max_returns, search, segments=None):
    """Options of a search: `max_returns` as a number, segment count, and what is static."""
    n, joints = degrees_of_freedom(mechanism), mechanism.joints_by_name()
    require_drive(mechanism, excitation)
    if excitation is not None:
        require_kind("excitation", excitation, Excitation)
    require_kind("search", search, CycleSearch)
    rtol = check_rtol(rtol, jnp.result_type(*jax.tree.leaves((mechanism, start, excitation))))
    returns = jnp.asarray(whole("max_returns", max_returns, 1), float)
    # One return takes some 35 segments at rtol 1e-9.
    count = 64 if segments is None else whole("segments", segments, 16)
    if segments is None and any(x.follows_load_curve for x in joints.values()):
        count *= 8  # towards an opening segments are short: less than a second compilation
    elif segments is None and (steps_follow_motion(n) or len(joints) > 1):
        count *= 4  # a period may be long beside that of the highest frequency, or of many phases
    of_scene = mechanism.sole_joint is not None
    return returns, count, {"of_scene": of_scene, "rtol": rtol, "search": search}


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
    search: CycleSearch = CycleSearch(),
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle that the motion from `start` ends in, by the exact law of dry friction.

    With an excitation: the periodic motion under it.

    A coarse run from `start` is compared at its returns to a section: the maxima of t.x, the
    tangential displacement of the first joint (of x1 in a scene). Where they repeat, Newton's
    method solves for the periodic orbit, and every derivative is the implicit one of its
    equations. A period has at most 16 returns, unless `search` says otherwise. Derivatives with
    respect to `start` are zero. An orbit that repels so weakly that the motion does not leave it is
    returned as `unstable`.

    Friction with memory has no switches: the motion is diffrax's, the orbit y(T) = y, with the
    states of the laws in y and, as `internal`, beside `state`.

    **Arguments:**

    - `mechanism`: a scene, or a structure of n degrees of freedom whose joints all have a V;
      `jax.vmap` takes many, and a member that fails marks only itself. All wait for the slowest:
      on a CPU `jax.lax.map` is quicker, with `batch_size=32` where all searches are as long.
    - `start`: (2n,), [x, v] in m and m/s; by default the sliding equilibrium, displaced by V/omega
      along t, where omega^2 is the sum of the squared eigenfrequencies for a scene, and the root
      of the sum of their fourth powers for a structure. If mu_s of the first joint lies above
      mu(0), it is not displaced but has the velocity V along t, with which the joint sticks. With
      V = 0 it is the equilibrium without friction.
    - `excitation`: a harmonic force. The returns are then its periods, at each of which its time is
      0 again: the section is stroboscopic, `state` is that at the time 0, `period` is `returns`
      periods of the excitation (above 1 the motion is subharmonic), and none of the 2n
      `multipliers` is 1 by itself. `start` is the state at the time 0. Joints may then have V = 0,
      as friction dampers do. One that sticks for a whole period, with a `stick_fraction` of 1, may
      rest at any place within its limits: at that where the motion from `start` leaves it, with a
      multiplier of 1 and one of 0.
    - `regularisation`: eps [m/s], to replace sgn v by tanh(v/eps), of laws without a jump. The
      cycle is then compared with the exact law's from the same start: `regularisation_error` is the
      largest relative difference of period and amplitudes, and the result `depends_on_eps` where it
      is above 1e-3. Derivatives differ by far more than values do.
    - `solver`: a diffrax solver for the regularised law, Tsit5 by default; an implicit one, such
      as Kvaerno5, for a small eps. Friction with memory takes Kvaerno5 by default; with soft
      bristles Tsit5 is quicker.
    - `max_steps`: most steps of that solver in one period, 4096 by default; four times as many
      with memory, whose orbit is integrated a hundred times as accurately as `rtol`.
    - `rtol`: relative tolerance of period and states, 1e-9 by default and at least 9.1e-13; in
      float32 both are 4.9e-4. It sets the number of segments.
    - `max_returns`: returns of the coarse run after which the search gives up.
    - `segments`: most segments that the orbit is cut into, 64 by default, 256 for more than 8
      degrees of freedom or more than one joint, and 512 where a joint follows its load curve; one
      return takes some 35, more where the highest frequency is far above that of the motion.
      Outside of compiled programs a longer period gets more; inside, the result says that it
      needs them.
    - `search`: options of the coarse run, of what counts as near to an orbit or an equilibrium, and
      of when to give up.
    - `throw`: raise unless the result is `converged`. Otherwise `result` says what was found, and
      everything is NaN where there is no cycle.

    **Raises:** `ValueError` for a start of another shape, an rtol above 0.1 or below what the
    precision can hold, less than 16 segments, max_returns below 1, or the regularised law of
    friction with a jump; `RuntimeError` if `throw`.
    Under a trace (`jit`, `vmap`) everything is NaN instead.
    """
    memory = has_memory(mechanism)
    start = None if start is None else start_state(start, degrees_of_freedom(mechanism), memory)
    inputs = mechanism, start, excitation
    returns, count, static = check_arguments(*inputs, rtol, max_returns, search, segments)
    eps, steps = smoothing(regularisation, memory), whole("max_steps", max_steps, 1)
    options: Any = solver, static["rtol"], steps, int(max_returns), static["of_scene"]
    if memory:
        from .smooth import smooth_cycle

        cycle = smooth_cycle(*inputs, None, None, *options)
        return raise_unless(CycleResult.converged, cycle) if throw else cycle
    arguments = *scale_problem(mechanism, excitation), start, returns
    cycle = find_cycle(*arguments, segments=count, **static)
    if segments is None:
        cycle = refine_cycle(cycle, arguments, count, static)
    if eps is not None:
        from .smooth import smooth_cycle
        from .smooth_system import without_jump

        cycle = smooth_cycle(without_jump(mechanism), start, excitation, eps, cycle, *options)
    return raise_unless(CycleResult.converged, cycle) if throw else cycle
