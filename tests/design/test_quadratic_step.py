"""Quadratic programs against their conditions of optimality, and known minima by their sequence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._design.quadratic_step import quadratic_step
from fractaljax._design.sequential import Row, sequential
from minima import MINIMA

RHO = 10.0


def programs(count, v, k, seed):
    """Random programs of every scale: steep and flat residuals, tiny and wide bounds."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, v, v))
    g = rng.normal(size=(count, v)) * 10 ** rng.uniform(-3, 1, (count, 1))
    B = q @ np.swapaxes(q, 1, 2) + 0.1 * np.eye(v)
    c = 2 * rng.normal(size=(count, k))
    A = rng.normal(size=(count, k, v)) * 10 ** rng.uniform(-1, 2, (count, k, 1))
    radius = 10 ** rng.uniform(-6, -0.3, (count, 1))
    low = np.where(rng.random((count, v)) < 0.2, 0.0, -radius)
    return g, B, c, A, low, np.broadcast_to(radius, (count, v))


@pytest.mark.parametrize(("v", "k"), [(1, 2), (2, 5), (5, 12), (8, 4)])
def test_steps_meet_the_conditions_of_optimality(v, k):
    """No feasible direction lowers the merit: the slope is that of multipliers of the right sign.

    A residual below 0 has none, one above 0 has rho, one at 0 what is left.
    """
    numbers = programs(200, v, k, seed=v)
    step = jax.jit(jax.vmap(lambda g, B, c, A, lo, hi: quadratic_step(g, B, c, A, RHO, lo, hi)))
    d, multipliers = map(np.asarray, step(*map(jnp.asarray, numbers)))
    g, B, c, A, low, high = numbers
    assert np.isfinite(d).all() and (d >= low).all() and (d <= high).all()
    size = 1 + np.abs(g).max(axis=1) + RHO * np.abs(A).sum(axis=(1, 2))
    slope = np.einsum("nij,nj->ni", B, d) + g + np.einsum("nkv,nk->nv", A, multipliers)
    # Inside the bounds the slope is none, at one it points outwards.
    at_low = d - low <= 1e-7 * (high - low)
    at_high = high - d <= 1e-7 * (high - low)
    off = np.where(at_low, np.minimum(slope, 0), np.where(at_high, np.maximum(slope, 0), slope))
    assert (np.abs(off) <= 1e-8 * size[:, None]).all()
    r, scale = c + np.einsum("nkv,nv->nk", A, d), 1 + np.abs(A).sum(axis=2)
    assert (np.abs(multipliers[r < -1e-6 * scale]) < 1e-6 * RHO).all()
    assert (np.abs(multipliers[r > 1e-6 * scale] - RHO) < 1e-6 * RHO).all()
    assert (multipliers >= 0).all() and (multipliers <= RHO).all()
    assert (r > 1e-3).any() and (r < -1e-3).any()


def problem(f, c):
    """The row of functions of one design."""

    def row(u):
        def values(u):
            return f(u), jnp.stack(c(u))

        (f_u, c_u), (g, A) = values(u), jax.jacfwd(values)(u)
        return Row(f_u, c_u, g, A, c_u)

    return row


# With a multiplier of 50, above the penalty that a search begins with.
DEAR = (lambda u: 50 * (u[0] - 0.2) ** 2 / 0.8, lambda u: (0.6 - u[0],), (0.6, None))


@pytest.mark.parametrize(("f", "c", "solution"), [*MINIMA, DEAR])
def test_known_solutions(f, c, solution):
    """Curved, cornered, bounded and free minima, and one that is dear, from random starts."""
    starts = jnp.asarray(np.random.default_rng(0).uniform(size=(6, 2)))
    land = jax.jit(jax.vmap(lambda u: sequential(problem(f, c), u, 1.0, 60)[0]))
    ends = np.asarray(land(starts))
    met = [u for u in ends if (np.asarray(c(u)) <= 1e-9).all()]
    assert len(met) >= 5
    best = min(met, key=f)
    for found, known in zip(best, solution, strict=True):
        assert known is None or found == pytest.approx(known, abs=1e-7)
