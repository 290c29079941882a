"""The batches of a sweep, one after another, on the devices of this process by one program."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._base.programs import exported_jit
from .blocks import Blocks
from .program import Program

_POINTS = "points"  # the axis that devices share


class Batches:
    """`program` at the points of each block of a grid, over the devices of a mesh."""

    def __init__(
        self, program: Program, scene: Any, grid: Sequence[np.ndarray], blocks: Blocks, mesh: Mesh
    ):
        self._program, self._blocks, self._mesh = program, blocks, mesh
        everywhere = NamedSharding(mesh, PartitionSpec())
        self._fixed = jax.device_put((scene, [jnp.asarray(v) for v in grid]), everywhere)

    def begin(self, k: int) -> list[jax.Array]:
        """Start block k: its leaves (points or more, ...), which JAX may still be computing."""
        # Every block has the points of the longest, for one compiled shape.
        points = -(-self._blocks.most // self._mesh.size) * self._mesh.size
        places = [axis.astype(np.int32) for axis in self._blocks.points(k, points)]
        places = jax.device_put(places, NamedSharding(self._mesh, PartitionSpec(_POINTS)))
        return _batch(self._program, self._mesh, *self._fixed, places)

    def end(self, k: int, begun: Sequence[jax.Array]) -> list[np.ndarray]:
        """The leaves (*shape of block k, ...) once they are computed."""
        shape, size = self._blocks.block_shape(k), self._blocks.size(k)
        return [np.asarray(leaf)[:size].reshape(*shape, *leaf.shape[1:]) for leaf in begun]


def mesh_of(devices: Sequence[Any] | None) -> Mesh:
    """The mesh of devices, by default all of this process, that share the points of a batch."""
    chosen = jax.local_devices() if devices is None else list(devices)
    if not chosen:
        raise ValueError("devices must name at least one device, got none")
    return Mesh(np.array(chosen), (_POINTS,))


@functools.partial(exported_jit, static_argnames=("point", "mesh"))
def _batch(point: Program, mesh: Mesh, scene, axes, places) -> list[jax.Array]:
    """The program `point` at the points that lie at `places` (batch,) on each of the axes."""

    def one(scene, axes, places):
        return point(scene, [axis[i] for axis, i in zip(axes, places, strict=True)])

    def in_turn(scene, axes, places):
        return jax.lax.map(functools.partial(one, scene, axes), places)

    # Side by side every point would take both branches, and as many steps as the slowest one. A
    # CPU gains little by that, an accelerator much.
    cpu = mesh.devices.flat[0].platform == "cpu"
    program = in_turn if cpu and point.branches else jax.vmap(one, (None, None, 0))
    if mesh.size > 1:
        whole, split = PartitionSpec(), PartitionSpec(_POINTS)
        # One program per device: if XLA split a single one, every loop would wait for the slowest.
        program = jax.shard_map(
            program, mesh=mesh, in_specs=(whole, whole, split), out_specs=split, check_vma=False
        )
    return program(scene, axes, places)
