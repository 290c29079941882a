"""Derivatives of the implicit solutions of contact laws by each argument."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from derivatives import check_slopes
from fractaljax._contact.asperity import _root
from fractaljax._contact.load_balance import log_area_ratio, log_load
from synthetic import rough
from tools import both_modes

# An elastic-plastic joint. Then D = 5/2 and beyond, a small plastic share, mu_m behind the step of
# Eq. 19.
JOINT = {
    **{"D": 2.4, "G": 1.342e-10, "gamma": 1.5, "P": 1907.3},
    **{"E": 1.154e11, "nu": 0.3, "sigma_y": 3.55e8, "H": 9.94e8, "mu_s": 2.0, "mu_m": 0.25},
}
OTHERS = [{"D": 2.5}, {"D": 2.7, "G": 1e-9}, {"D": 2.3, "G": 1e-12}, {"mu_m": 0.5, "P": 5e3}]


def test_a_joint_by_every_quantity():
    def logs(row):
        D, G, gamma, P, E, nu, sigma_y, H, mu_s, mu_m = row
        material = fj.Material(E, nu, sigma_y, H)
        state: Any = fj.contact_state(fj.Surface(D, G, gamma), material, P, mu_s=mu_s, mu_m=mu_m)
        values = state.K_n, state.K_t, state.A_r, state.a_e, state.Q_e, state.plastic_share
        return jnp.log(jnp.stack(values))

    rows = [list((JOINT | change).values()) for change in ({}, *OTHERS)]
    check_slopes(logs, rows, JOINT)


def test_the_root_of_the_load_balance_undoes_it():
    """By s, D and beta: of s(t(s, D, beta), D, beta) = s, to second order."""

    def identity(x):
        s, D, beta = x
        return log_load(log_area_ratio(s, D, beta), D, beta)

    @jax.jit
    @jax.vmap
    def slopes_and_bends(x):
        _, *first = both_modes(identity, x)
        return *first, jax.jacfwd(jax.grad(identity))(x)

    rows = jnp.array([[0.7, 2.4, 0.38], [5.0, 2.5, 0.2], [3.0, 2.9, 0.01], [20.0, 2.1, 0.9]])
    forward, reverse, bends = slopes_and_bends(rows)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, np.tile([1.0, 0.0, 0.0], (4, 1)), atol=1e-13)
    np.testing.assert_allclose(bends, 0, atol=1e-10)


def test_a_root_by_what_its_function_holds():
    """x^3 + p x = q: dx/dq = 1/(3 x^2 + p), dx/dp = -x dx/dq, d2x/dq2 = -6 x (dx/dq)^3."""

    def root(x):
        return _root(lambda t: t**3 + x[0] * t - x[1], jnp.ones_like(x[0]))

    value, *slopes, bend = jax.jit(lambda x: (*both_modes(root, x), jax.jacfwd(jax.grad(root))(x)))(
        jnp.array([2.0, 12.0])
    )
    assert float(value) == pytest.approx(2, rel=1e-15)
    for slope in slopes:
        np.testing.assert_allclose(slope, [-2 / 14, 1 / 14], rtol=1e-14)
    assert float(bend[1, 1]) == pytest.approx(-12 / 14**3, rel=1e-13)


# --- boundary elements ------------------------------------------------------------------------

HEIGHTS, DX, E = rough((8, 9)), 1e-5, 1.154e11
CHANGES = np.random.default_rng(3).standard_normal((3, *HEIGHTS.shape)) * HEIGHTS.std()
LOAD = 0.547 * 9.94e8 * HEIGHTS.size * DX**2


def pressed(u):
    """Of a height, dx, E and P: all by logarithms, heights along a direction."""
    material = fj.Material(E * u[2], 0.3, 3.55e8, 9.94e8)
    heights = HEIGHTS + jnp.log(u[0]) * CHANGES[0]
    return fj.boundary_element(heights, DX * u[1], material, LOAD * u[3], rtol=1e-13)


def test_a_pressed_surface_by_every_quantity():
    """Linear in heights and load while no point joins or leaves the contact."""

    def numbers(u):
        s = pressed(u)
        sums = [
            jnp.sum(weights * x)
            for weights, x in zip(CHANGES[1:], (s.pressure, s.gap), strict=True)
        ]
        return jnp.stack([sums[0] / LOAD, sums[1] / 1e-12, s.mean_gap / 1e-6])

    check_slopes(numbers, np.ones((1, 4)), ("heights", "dx", "E", "P"), 1e-6, 1e-6, 1e-5)


def test_the_compliance_of_a_pressed_surface_by_every_quantity():
    """d(1/K_n) is -d(d mean gap)/dP, between 0.95 P and 1.05 P, where points join the contact."""
    shares = np.array([0.95, 1.05])

    def scaled(u, share):
        return pressed(u.at[3].multiply(share)).mean_gap

    @jax.jit
    def slopes(u):
        _, forward, reverse = both_modes(lambda u: 1 / pressed(u).K_n, u)
        return forward, reverse, jax.vmap(jax.jacfwd(scaled), (None, 0))(u, shares)

    forward, reverse, gaps = map(np.asarray, slopes(jnp.ones(4)))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    gaps = gaps / np.stack([np.ones(2)] * 3 + [shares], axis=1)  # not by the logarithm of P
    by_load = (gaps[0] - gaps[1]) / (0.1 * LOAD)
    assert (abs(by_load[[0, 3]]) > 1e-9).all()
    np.testing.assert_allclose(forward[[0, 3]], by_load[[0, 3]], rtol=1e-8)
