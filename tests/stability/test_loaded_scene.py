"""A scene on its load curve: the equilibrium beside SciPy's root of the forces, and a structure."""

from typing import Any

import jax
import numpy as np
import pytest
import scipy.optimize

import fractaljax as fj
from fractaljax._stability.two_directions import two_directions

P, K_N = 500.0, 4e8
LOADS = np.array([P / 10, 10 * P])
# Hertz's law: N = P (1 + 2 u/(3 u_P))^(3/2), u_P = P/K_n.
LAW = fj.MeasuredContact(LOADS, K_N * (LOADS / P) ** (1 / 3), P, 0.8)


def load(u):
    return P * max(1 + 2 * u * K_N / (3 * P), 0) ** 1.5


@pytest.mark.parametrize(("mu", "F"), [(0.4, 200.0), (1.3, -300.0)])
def test_static_forces_balance(mu, F):
    """K_t x_1 and the load N push and rub: mu N along x_1, and mu K_t x_1 along -x_2."""
    scene = fj.Scene(LAW, fj.Coulomb(mu), fj.brake_scene().oscillator, preload=True).replace(F=F)
    o, K_t = scene.oscillator, 0.8 * K_N
    k_1, k_2 = (float(o.m * w**2) for w in (o.omega_1, o.omega_2))

    def forces(x):
        x_1, x_2 = x
        N = load(x_2)
        push = F / np.sqrt(2)
        return [
            (push + mu * N - K_t * x_1) / k_1 - x_1,
            (-push - (N - P) - mu * K_t * x_1) / k_2 - x_2,
        ]

    root: Any = scipy.optimize.root(forces, [0.0, 0.0], tol=1e-15)
    x_1, x_2 = root.x
    assert abs(load(x_2) / P - 1) > 0.05  # or a straight line would do
    at = jax.jit(two_directions, static_argnums=1)(scene, True)
    assert at.static is not None
    np.testing.assert_allclose(at.static, [x_1, load(x_2)], rtol=1e-8)
    slope = K_N * (load(x_2) / P) ** (1 / 3)
    np.testing.assert_allclose([at.K_n, at.K_t], [slope, K_t], rtol=1e-7)
    _, _, K = fj.assemble(fj.Structure.from_scene(scene))
    np.testing.assert_allclose(K, [[k_1 + K_t, -mu * slope], [mu * K_t, k_2 + slope]], rtol=1e-7)
