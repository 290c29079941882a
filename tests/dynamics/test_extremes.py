"""Extremes along an orbit, against a motion that is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._dynamics.extremes import extreme_values
from fractaljax._dynamics.guard import NONE, SECTION, UNUSED
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.segments import Segments

COUNT = 35


LENGTH = 2 * np.pi / COUNT


def oscillators():
    """Of frequencies 1 and 2, with a constant friction."""
    joint = fj.Joint(fj.FixedContact(0.0, 0.0, 1.0), fj.Coulomb(0.3), [1.0, 0.0], V=5.0)
    structure = fj.Structure(np.eye(2), np.zeros((2, 2)), np.diag([1.0, 4.0]), [joint])
    return hybrid_system(structure)


@pytest.mark.slow
def test_the_higher_of_two_nearly_equal_maxima():
    """eps cos t + cos 2t has the maxima 1 + eps and 1 - eps, wherever the segments begin.

    Cubics through the segments' ends are off by more than the two differ.
    """
    system, length = oscillators(), LENGTH
    unit, still = 1 / system.omega, system.equilibrium()

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


def test_a_maximum_that_is_nearly_an_inflection():
    """cos t + a cos(2t + b), of which the motion passes the maximum before a switch ends it.

    The third derivative there is large beside the second: cubics find the place roughly.
    """
    system = oscillators()
    unit, still = 1 / system.omega, system.equilibrium()
    row = jnp.zeros((1, 4)).at[0, 0].set(1)

    @jax.jit
    def found(a, b, end):
        def highest(a, b):
            t = end + LENGTH * jnp.arange(-4, 1)
            x = jnp.stack([jnp.cos(t), jnp.cos(2 * t + b)])
            rates = jnp.stack([-jnp.sin(t), -2 * jnp.sin(2 * t + b)])
            y = jnp.concatenate([x, unit * rates]) + still[:, None]
            duration, guard = jnp.full(5, LENGTH / unit), jnp.full(5, NONE)
            # The last leads from the end back to the beginning in no time.
            duration, guard = duration.at[-1].set(0), guard.at[-1].set(UNUSED)
            orbit = Segments(y, duration, jnp.ones((1, 5)), guard)
            return extreme_values(system, orbit, row.at[0, 1].set(a))[1, 0] - still[0]

        return jax.value_and_grad(highest, (0, 1))(a, b)

    u = 1.0
    for bend, left in ((0.05, 0.05), (0.05, 0.01), (0.01, 0.008)):
        # The sines and cosines of t and u = 2t + b give slope 0 and second derivative -bend.
        square = [4 * np.sin(u) ** 2 + 16 * np.cos(u) ** 2, -8 * bend * np.cos(u), bend**2 - 1]
        a = np.roots(square).max()
        top = np.arctan2(-2 * a * np.sin(u), bend - 4 * a * np.cos(u))
        value, slopes = found(a, u - 2 * top, top + left)
        assert float(value) == pytest.approx(np.cos(top) + a * np.cos(u), rel=0, abs=1e-11)
        assert slopes == pytest.approx((np.cos(u), -a * np.sin(u)), rel=0, abs=1e-6)
