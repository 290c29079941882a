"""Extremes along an orbit, against a motion that is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._dynamics.hybrid import NONE, SECTION
from fractaljax._dynamics.limit_cycle import extreme_values
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.segments import Segments

COUNT = 35


@pytest.mark.slow
def test_the_higher_of_two_nearly_equal_maxima():
    """eps cos t + cos 2t has the maxima 1 + eps and 1 - eps, wherever the segments begin.

    Cubics through the segments' ends are off by more than the two differ.
    """
    joint = fj.Joint(fj.FixedContact(0.0, 0.0, 1.0), fj.Coulomb(0.3), [1.0, 0.0], V=5.0)
    structure = fj.Structure(np.eye(2), np.zeros((2, 2)), np.diag([1.0, 4.0]), [joint])
    system = hybrid_system(structure)
    unit, still = 1 / system.omega, system.equilibrium()
    length = 2 * np.pi / COUNT

    def highest(phase, eps):
        t = length * jnp.arange(COUNT) + phase
        x = jnp.stack([jnp.cos(t), jnp.cos(2 * t)])
        rates = jnp.stack([-jnp.sin(t), -2 * jnp.sin(2 * t)])
        y = jnp.concatenate([x, unit * rates]) + still[:, None]
        duration, guard = jnp.full(COUNT, length / unit), jnp.full(COUNT, NONE).at[-1].set(SECTION)
        orbit = Segments(y, duration, jnp.ones((1, COUNT)), guard)
        row = jnp.zeros((1, 4)).at[0, 0].set(eps).at[0, 1].set(1)
        return extreme_values(system, orbit, row)[1, 0] - row[0] @ still

    phases, eps = length * np.linspace(0, 1, 21), np.array([1e-7, 1e-6, -1e-6, 1e-5])
    phases, eps = np.repeat(phases, 4), np.tile(eps, 21)
    slopes = jax.value_and_grad(highest, argnums=(0, 1))
    value, (by_phase, by_eps) = jax.jit(jax.vmap(slopes))(phases, eps)
    np.testing.assert_allclose(value, 1 + abs(eps), rtol=0, atol=1e-11)
    np.testing.assert_allclose(by_phase, 0, atol=1e-7)
    np.testing.assert_allclose(by_eps, np.sign(eps), rtol=0, atol=1e-7)
