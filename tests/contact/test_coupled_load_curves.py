"""Joints whose load curves respond to one another: the equilibrium of both at once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._contact.load_curve import loaded_equilibrium

W = jnp.array([[0.6, 0.3], [0.2, 0.7]])  # each responds to the other


# Hertz's law, and nearly exponential ones: a Newton step for each of eleven e-folds of N.
@pytest.mark.parametrize("powers", [(1.5, 1.5), (4.0, 1.5), (60.0, 40.0)])
@pytest.mark.parametrize("linear", [(-0.3, 0.8), (8.0, 10.0)])
def test_both_are_in_equilibrium_to_rounding(powers, linear):
    """e = linear + W (1 + e - N/P) of both, with its derivatives."""
    curves: list[Any] = [lambda e, p=p: jnp.maximum(1 + e / p, 0) ** p for p in powers]
    linear = jnp.array(linear)

    @jax.jit
    def solution(linear, W):
        def solve(linear, W):
            return loaded_equilibrium(curves, linear, W)

        return solve(linear, W), *jax.jacfwd(solve, (0, 1))(linear, W)

    e, by_linear, by_W = solution(linear, W)
    deficit = np.array([1 + x - curve(x) for curve, x in zip(curves, e, strict=True)])
    np.testing.assert_allclose(e, linear + W @ deficit, rtol=0, atol=1e-13)
    # (1 - W diag(slope)) de = dlinear + dW deficit
    slope = np.array([1 - jax.grad(curve)(x) for curve, x in zip(curves, e, strict=True)])
    inverse = np.linalg.inv(np.eye(2) - W * slope[None])
    np.testing.assert_allclose(by_linear, inverse, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(by_W, np.einsum("ij,k->ijk", inverse, deficit), atol=1e-11)
