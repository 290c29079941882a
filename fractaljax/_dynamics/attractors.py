"""The distinct attractors of a mechanism, found from many starts."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import number
from .._mechanism.mechanism import Mechanism
from .cycle import CycleResult, LimitCycle
from .cycle_search import CycleSearch
from .excitation import Excitation
from .limit_cycle import check_arguments, find_cycle, refine_cycle, scale_problem
from .scaled import degrees_of_freedom, hybrid_system


def attractors(
    mechanism: Mechanism,
    starts: ArrayLike | Sequence[Sequence[float]] | None = None,
    *,
    excitation: Excitation | None = None,
    rtol: float | None = None,
    max_returns: int = 5000,
    search: CycleSearch = CycleSearch(),
) -> list[LimitCycle]:
    """Every distinct motion that the starts end in, including those without a cycle.

    Two cycles are the same if their periods and amplitudes agree to 1e-6. The list is in the order
    of the starts.

    **Arguments:**

    - `mechanism`: as in `limit_cycle`.
    - `starts`: (k, 2n), [x, v] in m and m/s; by default 32 spread about the equilibrium, up to
      velocities of 2 V.
    - `excitation`, `rtol`, `max_returns`, `search`: as in `limit_cycle`.

    **Raises:** `ValueError` for starts of another shape, and what `limit_cycle` raises.
    """
    n = degrees_of_freedom(mechanism)
    if starts is None:
        starts = _spread(mechanism)
    starts = number("starts", jnp.asarray(starts, dtype=float))
    if starts.ndim != 2 or starts.shape[1] != 2 * n:
        raise ValueError(f"starts must have shape (k, {2 * n}), got {starts.shape}")
    inputs = mechanism, starts, excitation
    returns, segments, static = check_arguments(*inputs, rtol, max_returns, search)
    system, growth = scale_problem(mechanism, excitation)
    cycles = jax.vmap(
        lambda start: find_cycle(system, growth, start, returns, segments=segments, **static)
    )(starts)
    distinct: list[LimitCycle] = []
    for i in range(len(starts)):
        cycle = jax.tree.map(lambda x, i=i: x[i], cycles)
        if any(_same(cycle, other) for other in distinct):
            continue
        if bool(cycle.result == CycleResult.inaccurate):
            # Refined alone it gets the segments it needs. It may then equal a listed one.
            cycle = refine_cycle(cycle, (system, growth, cycle.state, returns), segments, static)
            if any(_same(cycle, other) for other in distinct):
                continue
        distinct.append(cycle)
    return distinct


@jax.jit
def _spread(mechanism: Mechanism) -> Float[Array, "32 2n"]:
    system = hybrid_system(mechanism)
    # Incommensurate phase steps of the degrees of freedom, at three sizes.
    k = jnp.arange(32)
    steps = np.append(1 / 32, (np.arange(1, system.n) * 0.618034) % 1)
    phase = 2 * jnp.pi * ((k[:, None] * steps[None]) % 1)
    size = jnp.array([0.5, 1.0, 2.0])[k % 3]
    direction = jnp.concatenate([jnp.cos(phase), jnp.sin(phase)], axis=1)
    return (system.equilibrium()[None] + size[:, None] * direction) * system.units[None]


def _same(one: LimitCycle, other: LimitCycle) -> bool:
    numbers = [np.array([c.period, *c.amplitude]) for c in (one, other)]
    if np.isnan(numbers[0]).any() or np.isnan(numbers[1]).any():
        return bool(np.isnan(numbers).all()) and bool(one.result == other.result)
    return bool(np.allclose(*numbers, rtol=1e-6, atol=0))
