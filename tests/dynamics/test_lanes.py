"""Small systems of equations of many lanes, beside LAPACK's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._dynamics.lanes import solve, solve_positive


def lanes_last(x):
    return jnp.moveaxis(x, 0, -1)


# Written out up to six unknowns and by an inverse beyond, or by elimination up to sixteen.
@pytest.mark.parametrize("n", [1, 2, 3, 6, 7, 18])
@pytest.mark.parametrize("method", [solve, solve_positive])
def test_solution_and_its_derivatives(method, n):
    rng = np.random.default_rng(n)
    W, b = rng.standard_normal((4, n, n)), rng.standard_normal((4, n))
    W = W @ W.transpose(0, 2, 1) + n * np.eye(n)

    def ours(W, b):
        return method(lanes_last(W), lanes_last(b)).T

    def theirs(W, b):
        return jnp.linalg.solve(W, b[..., None])[..., 0]

    change = rng.standard_normal((4, n, n)), rng.standard_normal((4, n))
    weights = rng.standard_normal((4, n))

    def everything(f):
        value, slope = jax.jvp(f, (W, b), change)
        second = jax.jvp(lambda W, b: jax.jvp(f, (W, b), change)[1], (W, b), change)[1]
        pulled = jax.grad(lambda W, b: jnp.sum(weights * f(W, b)), (0, 1))(W, b)
        return value, slope, second, *pulled

    found, wanted = (jax.jit(lambda f=f: everything(f))() for f in (ours, theirs))
    for x, y in zip(found, wanted, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-13 * max(1, abs(y).max()))


@pytest.mark.parametrize("n", [3, 4, 16])
def test_pivots(n):
    """Of matrices whose diagonal vanishes, and whose largest entries are in another row each."""
    rng = np.random.default_rng(n)
    W, b = np.eye(n) + rng.uniform(-0.3, 0.3, (4, n, n)) / n, rng.standard_normal((4, n))
    W = np.stack([w[rng.permutation(n)] for w in W]) * (1 - np.eye(n))
    found = jax.jit(solve)(lanes_last(W), lanes_last(b)).T
    wanted = np.linalg.solve(W, b[..., None])[..., 0]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * abs(wanted).max())


@pytest.mark.parametrize("n", [1, 2, 3, 6, 7])
def test_lanes_of_one_matrix(n):
    """As of a matrix for each of them."""
    rng = np.random.default_rng(n)
    W, b = rng.standard_normal((n, n, 1)), rng.standard_normal((n, 4))
    W = np.einsum("ikl,jkl->ijl", W, W) + n * np.eye(n)[:, :, None]
    found = jax.jit(solve_positive)(W, b)
    np.testing.assert_allclose(found, np.linalg.solve(W[:, :, 0], b), rtol=0, atol=1e-13)
