"""LAPACK under `vmap`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._base.lapack import one_by_one, solve


@functools.partial(jax.jit, static_argnums=2)
def solved(A, b, transposed):
    return solve(A.T if transposed else A, b)


@pytest.mark.parametrize("shape", [(3,), (3, 2)])
def test_solutions_and_their_derivatives(shape):
    rng = np.random.default_rng(0)
    A, dA = rng.standard_normal((2, 3, 3))
    b, db = rng.standard_normal((2, *shape))
    x, dx = jax.jvp(lambda A, b: solved(A, b, False), (A, b), (dA, db))
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-12)
    np.testing.assert_allclose(dx, np.linalg.solve(A, db - dA @ x), rtol=1e-11)
    forward, reverse = (d(lambda A: solved(A, b, True))(A) for d in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-12)


def test_a_batch_of_eigenvalue_problems_and_solutions_ends():
    """In one program, as XLA orders it, two batches at once never do on two cores."""
    n = 130
    A = jax.random.normal(jax.random.key(0), (32, n, n))
    eigenvalues = one_by_one(lambda A: jax.lax.linalg.eig(A)[0])

    @jax.jit
    @jax.vmap
    def all_of_it(A):
        return solve(A, A[:, 0]), solve(A.T, A[0]), eigenvalues(A)

    for _ in range(3):
        x, y, s = all_of_it(A)
    trace = jnp.trace(A, axis1=1, axis2=2)
    assert abs(s.sum(axis=1) - trace).max() < 1e-9
    np.testing.assert_allclose(x[:, 0], 1.0, rtol=1e-6)
    np.testing.assert_allclose(y[:, 0], 1.0, rtol=1e-6)
