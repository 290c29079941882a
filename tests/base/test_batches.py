"""Batches of one shape: the same rows for any number of points, and one program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._base.batches import in_batches

SHAPES = []


@jax.jit
def program(x, y):
    SHAPES.append((x.shape, y.shape))
    return {"sum": jnp.sum(x, axis=1) + y, "above": x > y[:, None]}


@pytest.mark.parametrize("n", [0, 1, 3, 4, 5, 8, 11])
def test_any_number_of_rows(n):
    """Nothing of what fills up the last batch is left, and types are the program's."""
    random = np.random.default_rng(n)
    x, y = random.uniform(size=(n, 2)), random.uniform(size=n)
    found = in_batches(program, 4, x, y)
    np.testing.assert_allclose(found["sum"], x.sum(axis=1) + y, rtol=1e-15)
    np.testing.assert_array_equal(found["above"], x > y[:, None])
    assert found["above"].dtype == bool and isinstance(found["sum"], np.ndarray)
    assert set(SHAPES) == {((4, 2), (4,))}


def test_the_last_row_fills_up_a_batch():
    """Not zeros, for which a law may have no answer."""
    shown = []
    in_batches(lambda x: shown.append(x) or x, 4, np.arange(1.0, 6.0))
    np.testing.assert_array_equal(shown, [[1, 2, 3, 4], [5, 5, 5, 5]])
