"""Which ranges have a logarithmic axis, and the values along them."""

import jax
import numpy as np
import pytest

from fractaljax._base.ranges import is_logarithmic, within


def test_values_along_a_range():
    """Both ends to the last bit; between them the arithmetic or the geometric mean."""
    random = np.random.default_rng(0)
    for low, high in [*np.sort(10 ** random.uniform(-6, 2, (500, 2))), (-3.0, 4.0), (0.0, 1e9)]:
        assert within(low, high, np.array([0.0, 1.0])).tolist() == [low, high]
    assert within(1.0, 3.0, 0.5) == 2
    assert within(1e-4, 1e-2, 0.5) == pytest.approx(1e-3, rel=1e-15)
    at = np.linspace(0, 1, 5)
    traced = jax.jit(lambda at: within(1e-4, 1e-2, at))(at)
    np.testing.assert_allclose(traced, within(1e-4, 1e-2, at), rtol=1e-14)
    assert is_logarithmic(1e-12, 1e-8) and is_logarithmic(1e8, 1e9)
    for low, high in ((1e8, 9e8), (-1.0, 10.0), (0.0, 1.0), (-10.0, -1.0)):
        assert not is_logarithmic(low, high)
