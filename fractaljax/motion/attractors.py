"""Every motion that a mechanism may end in, found from many starts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import number, require_scalar
from ..mechanism.scene import Scene
from .cycle import CycleResult, LimitCycle
from .limit_cycle import limit_cycle
from .stick_slip import rest, stick_slip, units


def attractors(
    scene: Scene, starts: Any = None, *, rtol: float | None = None, max_turns: int = 5000
) -> list[LimitCycle]:
    """Every distinct motion that the starts end in, those without a cycle among them.

    Two cycles are one if their periods and amplitudes agree to 1e-6. `starts` is (k, 4), [x1, x2,
    v1, v2] in m and m/s; by default 32 spread evenly in both directions about the equilibrium, up
    to velocities of 2 V. The first start that led to each motion decides the order; `rtol` and
    `max_turns` are those of `limit_cycle`.

    **Raises:** `ValueError` for starts of another shape, and what `limit_cycle` raises.
    """
    require_scalar(scene)
    if starts is None:
        starts = _spread(scene)
    starts = number("starts", jnp.asarray(starts, dtype=float))
    if starts.ndim != 2 or starts.shape[1] != 4:
        raise ValueError(f"starts must have shape (k, 4), got {starts.shape}")
    cycles = jax.vmap(
        lambda start: limit_cycle(scene, start, rtol=rtol, max_turns=max_turns, throw=False)
    )(starts)
    distinct: list[LimitCycle] = []
    for i in range(len(starts)):
        cycle = jax.tree.map(lambda x, i=i: x[i], cycles)
        if not any(_same(cycle, other) for other in distinct):
            if bool(cycle.result == CycleResult.inaccurate):
                # On its own it gets the segments it needs, and may turn out to be known.
                cycle = limit_cycle(scene, cycle.state, rtol=rtol, throw=False)
            if not any(_same(cycle, other) for other in distinct):
                distinct.append(cycle)
    return distinct


@jax.jit
def _spread(scene: Scene) -> jax.Array:
    system = stick_slip(scene)
    still = rest(scene, system)
    # Phases of the two directions at unrelated steps, three sizes in turn.
    k = jnp.arange(32)
    first, second = 2 * jnp.pi * k / 32, 2 * jnp.pi * ((k * 0.618034) % 1)
    size = jnp.array([0.5, 1.0, 2.0])[k % 3]
    away = jnp.stack([jnp.cos(first), jnp.cos(second), jnp.sin(first), jnp.sin(second)], axis=1)
    return (still[None] + size[:, None] * away) * units(system)[None]


def _same(one: LimitCycle, other: LimitCycle) -> bool:
    numbers = [np.array([c.period, *c.amplitude]) for c in (one, other)]
    if np.isnan(numbers[0]).any() or np.isnan(numbers[1]).any():
        return bool(np.isnan(numbers).all()) and bool(one.result == other.result)
    return bool(np.allclose(*numbers, rtol=1e-6, atol=0))
