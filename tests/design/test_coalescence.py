"""Designs at walls of growth: two modes that coalesce, flat before it and steep beyond."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import fractaljax as fj
from fractaljax._design.coalescence import neighbour_residuals, scene_residuals
from fractaljax._stability.quadratic import leading

W = 100.0  # square of the mean frequency


def flutter(c=0.02, p=0.1, m=1.0):
    """kappa = W +- sqrt(p^2 - m^2), and c the damping of both modes."""
    turned = np.array([[0.0, -1.0], [1.0, 0.0]])
    K = [(1.0, W * np.eye(2)), ("p", np.diag([1.0, -1.0])), ("m", turned)]
    return fj.ParametricStructure(np.eye(2), c * np.eye(2), K, parameters={"p": p, "m": m})


def signs(residuals, slack=1e-9):
    return residuals.max(axis=1) > slack


def test_residuals_have_the_signs_of_growth_rates():
    """Of all damping: light, equal, heavy, negative; with real eigenvalues too."""
    rng = np.random.default_rng(0)
    n, count = 3, 400
    A = rng.standard_normal((count, n, n))
    K = A @ A.transpose(0, 2, 1) + 1.5 * rng.standard_normal((count, n, n))
    C = rng.standard_normal((count, n, n)) * rng.choice([0, 0.1, 3], (count, 1, 1))
    C += np.eye(n) * rng.choice([0.01, 1.0, 6.0], (count, 1, 1))
    target = rng.uniform(-0.3, 0.1, count)

    @jax.jit
    @jax.vmap
    def both(C, K, target):
        found = leading(jnp.eye(n), C, K, n)
        return found.s.real.max() - target, neighbour_residuals(found, target, jnp.array(0.1))

    above, residuals = map(np.asarray, both(C, K, target))
    clear = np.abs(above) > 1e-9
    assert clear.mean() > 0.99 and 0.2 < (above > 0).mean() < 0.9
    np.testing.assert_array_equal(signs(residuals)[clear], (above > 0)[clear])
    scene = fj.brake_scene()
    rng = np.random.default_rng(1)
    count = 2000
    moved = {
        "xi_1": 10 ** rng.uniform(-4, 0.5, count),
        "xi_2": 10 ** rng.uniform(-4, 0.5, count),
        "omega_1": rng.uniform(4e3, 8e3, count),
        "D": rng.uniform(2.3, 2.6, count),
        "mu": rng.uniform(0.2, 0.9, count),
    }
    targets = rng.choice([-1.0, 1.0], count) * 10 ** rng.uniform(0, 4, count)

    @jax.jit
    @jax.vmap
    def of_scenes(values, target):
        x = scene.replace(friction=fj.Coulomb(0.3)).replace(**values)
        growth = fj.growth_rate(x)
        found = scene_residuals(x, True, growth, target, jnp.array(10.0))
        return growth - target, jnp.stack(found)

    above, residuals = map(np.asarray, of_scenes(moved, targets))
    clear = np.abs(above) > 1e-6 * np.abs(targets)
    assert clear.mean() > 0.99 and 0.2 < (above > 0).mean() < 0.8
    np.testing.assert_array_equal(signs(residuals)[clear], (above > 0)[clear])


@pytest.mark.slow
def test_residuals_are_smooth_through_coalescence():
    """T = r^2 + (W' - sqrt(W'^2 - p^2 + m^2))/2, W' = W - c^2/4, r = target + c/2, at p = 0.1."""
    c, target, p = 0.02, -0.005, 0.1
    m = p + np.array([-1e-6, -1e-9, 1e-9, 1e-6])

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def residual(m):
        found = leading(jnp.eye(2), c * jnp.eye(2), flutter(c, p, m).K, 2)
        return neighbour_residuals(found, jnp.array(target), jnp.array(0.01)).max()

    r, mean = target + c / 2, W - c**2 / 4
    root = np.sqrt(mean**2 - p**2 + m**2)
    unit = 0.01 * W  # of |s|^2, to sqrt(|p^2 - m^2|)/W
    T, slope = r**2 + (mean - root) / 2, -m / (2 * root)
    found, by_m = residual(m)
    np.testing.assert_allclose(found, np.arcsinh(-T / unit), rtol=2e-3)
    np.testing.assert_allclose(by_m, -slope / unit, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("c", [2e-2, 2e-4])
def test_nearest_design_on_the_wall(c):
    """m^2 - p^2 <= 4 r^2 (W - c^2/4 + r^2), r = target + c/2, a hyperbola: the nearest of it."""
    target = -c / 4
    R = 4 * (target + c / 2) ** 2 * (W - c**2 / 4 + (target + c / 2) ** 2)
    bounds = {"p": (0.0, 2.0), "m": (0.5, 1.5)}

    def distance(m):
        return ((np.sqrt(max(m * m - R, 0)) - 0.1) / 2) ** 2 + (m - 1) ** 2

    least: Any = minimize_scalar(distance, bounds=(0.5, 1.5), options={"xatol": 1e-12})
    best = fj.design(flutter(c), bounds, target=target, starts=2, lattice=8, progress=False)
    assert best.violated == ()
    assert best.value == pytest.approx(least.fun, rel=1e-5)
    assert len(best.history["objective"]) < 40


@pytest.mark.slow
def test_nearest_scene_on_the_wall():
    """Equal decay rates of both modes: the growth rate is flat up to the wall."""
    scene, rate = fj.brake_scene(), 1.0
    o = scene.oscillator
    x = scene.replace(
        friction=fj.Coulomb(scene.friction.mu_s), xi_1=rate / o.omega_1, xi_2=rate / o.omega_2
    )
    wall = brentq(lambda D: float(fj.growth_rate(x.replace(D=D))) + rate / 2, 2.4, 2.45, xtol=1e-12)
    best = fj.design(x, {"D": (2.1, 2.9)}, target=-rate / 2, progress=False)
    assert float(best.scene.contact.surface.D) == pytest.approx(wall, rel=1e-8)
    assert best.active == ("growth_rate <= target",)
