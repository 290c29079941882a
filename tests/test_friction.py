"""Friction laws: Eq. 38, its slope, both sliding directions, refusals."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import fractaljax as fj

STRIBECK, COULOMB = fj.Stribeck(0.4, 0.25, 0.5), fj.Coulomb(0.4)
SPEEDS = np.array([1e-300, 1e-9, 0.01, 0.15, 0.3, 0.4999, 0.5, 0.75, 1.0, 3.0])
BOTH_WAYS = np.concatenate([-SPEEDS[::-1], [0.0], SPEEDS])
MODES = pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])


class Exponential(fj.Friction):
    """A law as a user writes one: mu(v) = mu_m + (mu_s - mu_m) exp(-v/v_0)."""

    mu_s: jax.Array
    mu_m: jax.Array
    v_0: jax.Array

    def coefficient(self, speed):
        return self.mu_m + (self.mu_s - self.mu_m) * jnp.exp(-jnp.asarray(speed) / self.v_0)


WRONG: Any = None
ABSTRACT: Any = fj.Friction
EXPONENTIAL = Exponential(*map(jnp.array, (0.4, 0.25, 0.5)))


def equation_38(v):
    """As printed, for v > 0, in working precision."""
    mu_s, mu_m, v_m = mpf(0.4), mpf(0.25), mpf(0.5)
    return mu_s - 3 * (mu_s - mu_m) / (2 * v_m) * v + (mu_s - mu_m) / (2 * v_m**3) * v**3


def test_values():
    """Eq. 38 in 40 digits; its minimum; a constant."""
    with mp.workdps(40):
        truth = [float(equation_38(mpf(v))) for v in SPEEDS]
    np.testing.assert_allclose(STRIBECK.coefficient(SPEEDS), truth, rtol=1e-15)
    assert STRIBECK.coefficient(0.0) == 0.4 and STRIBECK.slope(0.5) == 0.0
    np.testing.assert_array_equal(COULOMB.coefficient(SPEEDS), 0.4)
    assert COULOMB.mu_s == COULOMB.mu_m == 0.4 and not COULOMB.velocity_dependent


@MODES
def test_slope(mode):
    """`slope` and both modes against differences in 60 digits; even in the velocity."""
    with mp.workdps(60):
        h = mpf("1e-20")  # truncation h^2, rounding 1e-60/h
        pairs = [(equation_38(mpf(v) + h), equation_38(mpf(v) - h)) for v in SPEEDS]
        truth = np.array([float((up - down) / (2 * h)) for up, down in pairs])
    by_mode = jax.vmap(mode(STRIBECK.coefficient))(SPEEDS)
    for found in (by_mode, STRIBECK.slope(SPEEDS), STRIBECK.slope(-SPEEDS)):
        # Near the minimum two terms of the size of the slope at 0 cancel.
        np.testing.assert_allclose(found, truth, rtol=1e-15, atol=5e-16)
    np.testing.assert_array_equal(COULOMB.slope(SPEEDS), 0)


@MODES
def test_derivatives_by_parameter(mode):
    """dmu/dmu_s = 1 - c, dmu/dmu_m = c and dmu/dv_m, with c = u (3 - u^2)/2, u = v/v_m."""
    u = 0.15 / 0.5
    c, by_v_m = u * (3 - u**2) / 2, 0.15 * 1.5 * (1 - u**2) * u / 0.5
    found = mode(lambda *x: fj.Stribeck(*x).coefficient(0.15), argnums=(0, 1, 2))(0.4, 0.25, 0.5)
    np.testing.assert_allclose(found, [1 - c, c, by_v_m], rtol=2e-15)


@pytest.mark.parametrize("law", [STRIBECK, COULOMB, EXPONENTIAL])
def test_branches(law):
    """One direction's law and slope, smooth through v = 0; a sign between smooths the jump."""
    for sign in (1.0, -1.0):
        assert law.branch(0.0, sign) == sign * 0.4
        own = sign * law.coefficient(sign * BOTH_WAYS)
        np.testing.assert_allclose(law.branch(BOTH_WAYS, sign), own, rtol=1e-15, atol=1e-16)
        near = jax.vmap(jax.grad(lambda v, sign=sign: law.branch(v, sign)))(BOTH_WAYS[9:12])
        np.testing.assert_allclose(near, law.slope(0.0), rtol=1e-14, atol=1e-15)
    smoothed = law.branch(SPEEDS, 0.25) - law.branch(SPEEDS, 1.0)
    np.testing.assert_allclose(smoothed, -0.75 * 0.4, rtol=1e-14)


def test_stribeck_branch_is_one_cubic():
    truth = np.polynomial.Polynomial([0.4, -1.5 * 0.15 / 0.5, 0, 0.5 * 0.15 / 0.5**3])
    np.testing.assert_allclose(
        STRIBECK.branch(BOTH_WAYS, 1.0), truth(BOTH_WAYS), rtol=1e-15, atol=5e-16
    )


def test_float32():
    single = jax.tree.map(lambda x: x.astype(jnp.float32), STRIBECK)
    v = SPEEDS[1:].astype(np.float32)
    assert single.coefficient(v).dtype == single.slope(v).dtype == np.float32
    np.testing.assert_allclose(single.coefficient(v), STRIBECK.coefficient(SPEEDS[1:]), rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fj.Stribeck(0.0, 0.0, 0.5), r"^mu_s must be above 0, got 0\.0$"),
        (lambda: fj.Stribeck(0.4, -0.1, 0.5), r"^mu_m must be at least 0, got -0\.1$"),
        (lambda: fj.Stribeck(0.4, 0.5, 0.5), r"^mu_s must be at least mu_m = 0\.5, got 0\.4$"),
        (lambda: fj.Stribeck(0.4, 0.25, 0.0), r"^v_m must be above 0"),
        (lambda: fj.Stribeck(0.4, 0.25, np.nan), r"^v_m must be above 0, got nan"),
        (lambda: fj.Coulomb(0), "^mu must be above 0, got 0"),
        (lambda: fj.Coulomb(WRONG), "^mu must be a number, got None"),
        (lambda: jax.jit(fj.Stribeck)(0.4, 0.5, 0.5), "mu_s must be at least mu_m"),
        (lambda: ABSTRACT(), "abstract"),
    ],
)
def test_refusals(call, message):
    with pytest.raises((ValueError, TypeError, RuntimeError), match=message):
        jax.block_until_ready(call())
