"""Blocks cover a grid once, in its order, with as many points as asked for or a few less."""

import numpy as np
import pytest

from fractaljax._sweep.blocks import Blocks, blocks

SHAPES = [(1,), (7,), (5, 3), (3, 5), (2, 1, 4), (3, 4, 5), (1, 1), (2, 3, 1, 5)]


@pytest.mark.parametrize("shape", SHAPES)
def test_blocks_cover_a_grid_once(shape):
    points = np.arange(np.prod(shape)).reshape(shape)
    for most in range(1, points.size + 3):
        found, seen = blocks(shape, most), []
        for k in range(found.number):
            own = points[found.index(k)]
            assert own.shape == found.block_shape(k) and own.size == found.size(k) <= found.most
            repeated = np.append(own, [own.flat[-1]] * (found.most + 2 - own.size))
            np.testing.assert_array_equal(points[*found.points(k, found.most + 2)], repeated)
            seen.append(own.ravel())
        np.testing.assert_array_equal(np.sort(np.concatenate(seen)), points.ravel())
        assert found.most <= most
        assert list(map(found.place, range(found.number))) == list(np.ndindex(found.counts))
        # Never more than twice those that points need if they lie in a row.
        assert found.number < 2 * -(-points.size // most) or found.most * 2 > most


def test_few_blocks():
    """About as many as there must be, and all alike."""
    assert blocks((100, 100, 100, 100), 8192) == Blocks((100,) * 4, (1, 4, 20, 100))
    assert blocks((100, 100, 10, 10), 8192).number == 125
    assert blocks((100, 9), 100).block == (10, 9)
    assert blocks((8193,), 8192).block == (4097,)
    assert blocks((3, 4), 10**15).block == (3, 4)
