"""Where a range is gone along in logarithms, and its values between the ends."""

import jax
import numpy as np
import pytest

from fractaljax.base.ranges import is_logarithmic, within


def test_logarithms_only_where_a_range_asks_for_them():
    """From a decade on."""
    assert is_logarithmic(1e-12, 1e-8)
    assert is_logarithmic(1e8, 1e9)
    assert not is_logarithmic(1e8, 9e8)
    assert not is_logarithmic(-1.0, 10.0)
    assert not is_logarithmic(0.0, 1.0)
    assert not is_logarithmic(-10.0, -1.0)


@pytest.mark.parametrize("ends", [(1e-12, 1e-8), (2.1, 2.9), (-3.0, 4.0), (0.0, 1e9)])
def test_both_ends_are_met(ends):
    low, high = ends
    found = within(low, high, np.array([0.0, 1.0]))
    np.testing.assert_allclose(found, ends, rtol=1e-15)


def test_ends_are_met_to_the_last_bit():
    """Beyond one by a rounding error, an envelope up to the end of a domain would be refused."""
    random = np.random.default_rng(0)
    for low, high in np.sort(10 ** random.uniform(-6, 2, (500, 2))):
        assert within(low, high, np.array([0.0, 1.0])).tolist() == [low, high]


def test_the_middle_is_the_arithmetic_or_the_geometric_mean():
    assert within(1.0, 3.0, 0.5) == 2
    assert within(1e-4, 1e-2, 0.5) == pytest.approx(1e-3, rel=1e-15)
    assert within(1.0, 10.0, 0.5) == pytest.approx(10**0.5, rel=1e-15)


def test_places_can_be_traced():
    at = np.linspace(0, 1, 5)
    np.testing.assert_allclose(
        jax.jit(lambda at: within(1e-4, 1e-2, at))(at), within(1e-4, 1e-2, at), rtol=1e-14
    )
