"""Derivatives of implicit solutions of the stability analysis by each argument."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.quantities import value_of, with_friction_times
from fractaljax._stability import quadratic
from fractaljax._stability.rightmost import rightmost
from tools import both_modes, reference_scene

MATRICES = (
    [[2.0, 0.3, 0.1], [0.3, 1.5, 0.2], [0.1, 0.2, 1.0]],
    [[0.10, 0.05, 0.00], [-0.05, 0.20, 0.02], [0.00, 0.03, 0.15]],
    [[6.0, -2.0, 0.5], [-1.5, 5.0, -1.0], [0.2, -1.2, 4.0]],
)


def moved(t):
    """M, C and K, each along a direction of its own."""
    S, A, B = np.random.default_rng(2).standard_normal((3, 3, 3))
    return [jnp.array(X) + h * d for X, h, d in zip(MATRICES, t, (S + S.T, A, B), strict=True)]


def all_modes(t):
    """Every eigenvalue, its right and left vectors relative to their first entries."""
    modes = quadratic.solve(*moved(t))
    return modes.s, modes.x / modes.x[:, :1], modes.y / modes.y[:, :1]


def rightmost_mode(t):
    M, C, K = moved(t)
    return (rightmost((M, C, K), None, None),)


@pytest.mark.parametrize("function", [all_modes, rightmost_mode], ids=lambda f: f.__name__)
def test_slopes_and_bends_by_each_matrix(function):
    """Of eigenvalues and vectors by M, C and K, and their second derivatives."""

    def parts(t):
        values = jnp.concatenate([jnp.ravel(x) for x in function(t)])
        return jnp.concatenate([values.real, values.imag])

    @jax.jit
    def program(t):
        value, forward, reverse = both_modes(parts, t)
        bend = jax.jvp(jax.jacfwd(parts), (t,), (jnp.ones(3),))[1]
        return value, forward, reverse, bend

    at, h = jnp.zeros(3), 1e-4

    def differences(index, step):
        ends = [np.asarray(program(at + k * h * step)[index]) for k in (-2, -1, 1, 2)]
        return (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)

    _, forward, reverse, bend = program(at)
    slopes = np.stack([differences(0, step) for step in np.eye(3)], axis=-1)
    for ours in (forward, reverse):
        np.testing.assert_allclose(ours, slopes, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(bend, differences(1, np.ones(3)), rtol=1e-7, atol=1e-8)


QUANTITIES = (
    *("K_n", "K_t", "mu_s", "mu_m", "v_m", "V"),
    *("m", "omega_1", "omega_2", "xi_1", "xi_2"),
)


def test_nothing_grows_at_the_critical_friction_whatever_the_quantities():
    """The critical friction follows every quantity so that the growth rate stays 0."""
    scene = reference_scene()
    values = jnp.stack([value_of(scene, name) for name in QUANTITIES])

    def growth(u, factor=None):
        x = scene.replace(**dict(zip(QUANTITIES, values * jnp.exp(u), strict=True)))
        if factor is None:
            factor = fj.critical_friction(x) / x.coefficient()
        return fj.growth_rate(with_friction_times(x, factor)), factor

    @jax.jit
    def slopes(u):
        total, factor = jax.grad(growth, has_aux=True)(u)
        return growth(u, factor)[0], total, jax.grad(lambda u: growth(u, factor)[0])(u)

    value, total, partial = map(np.asarray, slopes(jnp.zeros(len(QUANTITIES))))
    assert abs(value) < 1e-8 and (partial != 0).all()
    np.testing.assert_array_less(abs(total), 1e-9 * abs(partial), err_msg=str(QUANTITIES))
