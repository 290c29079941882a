"""The batches of a sweep: blocks of its grid, numbered in the order of their first points."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np


@dataclasses.dataclass(frozen=True)
class Blocks:
    """A grid of `shape` in blocks of the shape `block`; the last one on an axis may be shorter."""

    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def most(self) -> int:
        """The number of points of a full block."""
        return math.prod(self.block)

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of blocks along each axis."""
        return tuple(-(-n // size) for n, size in zip(self.shape, self.block, strict=True))

    @property
    def number(self) -> int:
        return math.prod(self.counts)

    def place(self, k: int) -> tuple[int, ...]:
        """The index of block k among the blocks, on each axis."""
        return tuple(map(int, np.unravel_index(k, self.counts)))

    def index(self, k: int) -> tuple[slice, ...]:
        """Where block k lies on each axis of the grid."""
        ends = zip(self.place(k), self.block, self.shape, strict=True)
        return tuple(slice(i * size, min((i + 1) * size, n)) for i, size, n in ends)

    def block_shape(self, k: int) -> tuple[int, ...]:
        """The shape of block k."""
        return tuple(axis.stop - axis.start for axis in self.index(k))

    def size(self, k: int) -> int:
        """The number of points of block k."""
        return math.prod(self.block_shape(k))

    def points(self, k: int, number: int) -> list[np.ndarray]:
        """Where the points of block k lie on each axis (number,); the last one repeats."""
        within = np.minimum(np.arange(number), self.size(k) - 1)
        places = np.unravel_index(within, self.block_shape(k))
        return [place + axis.start for place, axis in zip(places, self.index(k), strict=True)]


def blocks(shape: Sequence[int], most: int) -> Blocks:
    """Few blocks of at most `most` points: whole last axes, parts of two, single first points."""
    split, row = len(shape) - 1, 1
    while split and row * shape[split] <= most:
        row *= shape[split]
        split -= 1
    n, before = shape[split], shape[split - 1] if split else 1
    # Equal pieces of the axis that does not fit as a whole, and what then fits of the axis before.
    pieces = np.arange(-(-n // min(most // row, n)), n + 1)
    lengths = -(-n // pieces)
    others = np.clip(most // (row * lengths), 1, before)
    best = np.argmin(-(-n // lengths) * -(-before // others))
    length, other = int(lengths[best]), int(others[best])
    other = -(-before // -(-before // other))
    two = (other, length) if split else (length,)
    return Blocks(tuple(shape), (1,) * (split + 1 - len(two)) + two + tuple(shape[split + 1 :]))
