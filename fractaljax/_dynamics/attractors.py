"""The distinct attractors of a mechanism, found from many starts."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import number, require_scalar
from .._mechanism.scene import Scene
from .cycle import CycleResult, LimitCycle
from .limit_cycle import limit_cycle
from .stick_slip import sliding_equilibrium, stick_slip, units


def attractors(
    scene: Scene,
    starts: ArrayLike | Sequence[Sequence[float]] | None = None,
    *,
    rtol: float | None = None,
    max_returns: int = 5000,
) -> list[LimitCycle]:
    """Every distinct motion that the starts end in, also those without a cycle.

    Two cycles are the same if their periods and amplitudes agree to 1e-6. `starts` is (k, 4), [x1,
    x2, v1, v2] in m and m/s; by default 32 spread evenly in both directions about the equilibrium,
    up to velocities of 2 V. The list is in the order of the starts. `rtol` and `max_returns` are
    those of `limit_cycle`.

    **Raises:** `ValueError` for starts of another shape, and what `limit_cycle` raises.
    """
    require_scalar(scene)
    if starts is None:
        starts = _spread(scene)
    starts = number("starts", jnp.asarray(starts, dtype=float))
    if starts.ndim != 2 or starts.shape[1] != 4:
        raise ValueError(f"starts must have shape (k, 4), got {starts.shape}")
    cycles = jax.vmap(
        lambda start: limit_cycle(scene, start, rtol=rtol, max_returns=max_returns, throw=False)
    )(starts)
    distinct: list[LimitCycle] = []
    for i in range(len(starts)):
        cycle = jax.tree.map(lambda x, i=i: x[i], cycles)
        if any(_same(cycle, other) for other in distinct):
            continue
        if bool(cycle.result == CycleResult.inaccurate):
            # On its own it gets the segments it needs. It may then equal a known one.
            cycle = limit_cycle(scene, cycle.state, rtol=rtol, throw=False)
            if any(_same(cycle, other) for other in distinct):
                continue
        distinct.append(cycle)
    return distinct


@jax.jit
def _spread(scene: Scene) -> Float[Array, "32 4"]:
    system = stick_slip(scene)
    # Unrelated steps in the phases of the two directions, at three sizes.
    k = jnp.arange(32)
    first, second = 2 * jnp.pi * k / 32, 2 * jnp.pi * ((k * 0.618034) % 1)
    size = jnp.array([0.5, 1.0, 2.0])[k % 3]
    away = jnp.stack([jnp.cos(first), jnp.cos(second), jnp.sin(first), jnp.sin(second)], axis=1)
    center = sliding_equilibrium(scene, system)
    return (center[None] + size[:, None] * away) * units(system)[None]


def _same(one: LimitCycle, other: LimitCycle) -> bool:
    numbers = [np.array([c.period, *c.amplitude]) for c in (one, other)]
    if np.isnan(numbers[0]).any() or np.isnan(numbers[1]).any():
        return bool(np.isnan(numbers).all()) and bool(one.result == other.result)
    return bool(np.allclose(*numbers, rtol=1e-6, atol=0))
