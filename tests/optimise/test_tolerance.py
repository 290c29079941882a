"""Quadrature, quantiles and samples of machining scatter against the normal distribution."""

import math
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.optimise.task import DEFAULT_BOUNDS
from fractaljax.optimise.tolerance import check_tolerance, draw, nodes, proportion, quantile

NORMAL = NormalDist()


@pytest.mark.parametrize("dimensions", [1, 2])
def test_nodes_are_standard_normal(dimensions):
    """Weights sum to one; mean, covariance and fourth moment are those of the normal."""
    z, weights = nodes(dimensions)
    assert z.shape == (55, dimensions) and (weights > 0).all()
    assert weights.sum() == pytest.approx(1, rel=1e-14)
    np.testing.assert_allclose(weights @ z, 0, atol=0.02)
    np.testing.assert_allclose((z * weights[:, None]).T @ z, np.eye(dimensions), atol=0.03)
    np.testing.assert_allclose(weights @ z**4, 3, rtol=0.1)


@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_quantile_of_linear_functions(level):
    """In every direction of the plane: the level that is reached is the one asked for."""
    z, weights = nodes(2)
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    values = jnp.asarray(z @ np.stack([np.cos(angles), np.sin(angles)]))
    found = np.asarray(quantile(values, jnp.asarray(weights), level))
    reached = np.array([NORMAL.cdf(x) for x in found])
    assert np.abs(reached - level).max() < (1 - level) / 2


def test_quantile_of_a_radius_and_in_one_dimension():
    """A curved function, and one deviate alone."""
    z, weights = nodes(2)
    squared = quantile(jnp.asarray((z**2).sum(axis=1)), jnp.asarray(weights), 0.95)
    assert 1 - math.exp(-float(squared) / 2) == pytest.approx(0.95, abs=0.012)
    z, weights = nodes(1)
    assert quantile(jnp.asarray(z[:, 0]), jnp.asarray(weights), 0.95) == pytest.approx(
        NORMAL.inv_cdf(0.95), abs=0.03
    )


def test_quantile_of_samples_is_between_its_neighbours():
    """Equal weights: the mean of the order statistics around the level, whatever the order."""
    values = np.random.default_rng(3).permutation(np.arange(100.0))
    found = quantile(jnp.asarray(values), jnp.full(100, 0.01), 0.9)
    assert found == pytest.approx(np.arange(85, 95).mean(), rel=1e-12)


def test_quantile_is_continuous_with_the_derivative_of_its_nodes():
    """Forward and reverse mode against differences, also where two nodes change places."""
    z, weights = (jnp.asarray(x) for x in nodes(2))

    def at(x):
        return quantile(z[:, 0] * x + jnp.sin(3 * z[:, 1]) * (1 - x), weights, 0.95)

    xs = jnp.linspace(0.2, 0.9, 401)
    values, forward = (np.asarray(jax.vmap(f)(xs)) for f in (at, jax.jacfwd(at)))
    reverse = np.asarray(jax.vmap(jax.jacrev(at))(xs))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    assert np.abs(np.diff(values)).max() < 0.01
    difference = np.asarray((jax.vmap(at)(xs + 1e-7) - jax.vmap(at)(xs - 1e-7)) / 2e-7)
    assert (np.abs(difference - forward) < 1e-5).mean() > 0.99


def test_samples_scatter_as_asked_and_repeat():
    """Standard deviations, independence, and the same seed the same samples."""
    drawn = draw({"D": 0.005, "G": 0.05}, 20000, seed=4)
    assert drawn["D"].std() == pytest.approx(0.005, rel=0.02)
    assert drawn["G"].std() == pytest.approx(0.05, rel=0.02)
    assert abs(np.corrcoef(drawn["D"], drawn["G"])[0, 1]) < 0.02
    again, other = (draw({"D": 0.005, "G": 0.05}, 20000, seed=seed) for seed in (4, 5))
    np.testing.assert_array_equal(drawn["D"], again["D"])
    assert (drawn["D"] != other["D"]).all()


def test_proportion_has_a_standard_error_at_its_ends():
    """The usual one in the middle, one over n at nothing and at all."""
    assert proportion(3000, 10000) == (0.3, pytest.approx(math.sqrt(0.21 / 10000), rel=1e-3))
    assert proportion(0, 10000) == (0.0, pytest.approx(1e-4, rel=1e-3))
    assert proportion(10000, 10000) == (1.0, pytest.approx(1e-4, rel=1e-3))


def test_names_and_zeros():
    """`ln G` is kept under G; what does not scatter is left out."""
    scene = fj.brake_scene()
    checked = check_tolerance({"ln G": 0.05, "D": 0.0}, scene, DEFAULT_BOUNDS)
    assert checked == {"G": 0.05}


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [
        ({"D": -0.1}, "tolerance of D must be at least 0, got -0.1"),
        ({"D": math.nan}, "tolerance of D must be at least 0, got nan"),
        ({"G": 0.1}, "tolerance must be of D, ln G or both, got G"),
        ({}, "tolerance must be of D, ln G or both, got none"),
        ({"D": 0.0}, "tolerance must be above 0 for D or ln G, got 0 for all"),
        ({"D": 0.02}, "tolerance of D must be below 0.0166667, so that D stays inside 2 and 3"),
        (0.1, "tolerance must be a mapping, got 0.1"),
        ({"D": "small"}, "tolerance of D must be a number, got 'small'"),
    ],
)
def test_refusals(tolerance, message):
    """One clear line."""
    with pytest.raises((ValueError, TypeError)) as caught:
        check_tolerance(tolerance, fj.brake_scene(), DEFAULT_BOUNDS)
    assert message in str(caught.value) and "\n" not in str(caught.value)
