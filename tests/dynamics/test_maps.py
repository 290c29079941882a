"""Maps of an orbit's segments: coarse beside exact ones, in blocks beside all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._dynamics.guard import NONE, UNUSED
from fractaljax._dynamics.lanes import together
from fractaljax._dynamics.maps import _maps, coarse_maps, exact_maps, identity_maps, in_blocks
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.segments import Segments

LENGTH, USED, LANES = 11, 7, 3


def problem(n: int):
    """A system whose field is affine, and segments of three lanes anywhere."""
    rng = np.random.default_rng(n)
    random = rng.standard_normal((n, n))
    joint = fj.Joint(fj.FixedContact(0.4, 0.3, 2.0), fj.Coulomb(0.3), 0, n - 1, V=1.0, preload=True)
    structure = fj.Structure(np.eye(n), 0.1 * np.eye(n), random @ random.T + np.eye(n), [joint])
    y = rng.standard_normal((2 * n, LENGTH, LANES))
    used = np.arange(LENGTH)[:, None] < USED
    duration = np.where(used, rng.uniform(0.1, 0.4, (LENGTH, LANES)), 0)
    guard = np.broadcast_to(np.where(used, NONE, UNUSED), (LENGTH, LANES))
    system = hybrid_system(structure)
    s = np.ones((len(system.P), LENGTH, LANES))
    return system, Segments(*map(jnp.asarray, (y, duration, s, guard)))


# Products are written out up to eight rows.
@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 4, 6])
def test_coarse_maps_of_an_affine_field_are_exact(n):
    system, segments = problem(n)
    exact = jax.jit(exact_maps)(system, segments)
    coarse = jax.jit(coarse_maps)(system, segments)
    np.testing.assert_allclose(coarse.A[:USED], exact.A[:USED], rtol=0, atol=1e-14)
    np.testing.assert_allclose(coarse.c, exact.c, rtol=0, atol=0)


@pytest.mark.parametrize("size", [1, 4, 7])
def test_segments_in_blocks(size):
    system, segments = problem(2)

    def solved(size):
        return in_blocks(lambda some: _maps(system, some), identity_maps, size, segments)

    found, wanted = jax.jit(lambda: (solved(size), solved(LENGTH)))()
    ends, A, b = found
    np.testing.assert_allclose(ends[:, :USED], wanted[0][:, :USED], rtol=0, atol=1e-15)
    np.testing.assert_allclose(A[:USED], wanted[1][:USED], rtol=0, atol=1e-15)
    np.testing.assert_allclose(b[:, :USED], wanted[2][:, :USED], rtol=0, atol=1e-15)
    # A block without a used segment is not evaluated.
    idle = -(-USED // size) * size
    assert not np.any(b[:, idle:])
    np.testing.assert_array_equal(
        ends, np.where(np.arange(LENGTH)[:, None] < idle, ends, segments.y)
    )


@pytest.mark.parametrize(
    ("size", "count", "found"),
    [(88, 128, 4), (64, 128, 8), (512, 128, 1), (9999, 128, 1), (8, 96, 32)],
)
def test_items_in_an_inner_loop(size, count, found):
    assert together(size, count) == found
