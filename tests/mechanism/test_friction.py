"""Friction laws: Eq. 38, its branches and slope, symmetry, refusals."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import fractaljax as fj
from fractaljax.mechanism.friction import Friction

GOOD = {"mu_s": 0.4, "mu_m": 0.25, "v_m": 0.5}
VELOCITIES = np.array([1e-300, 1e-9, 0.01, 0.15, 0.3, 0.4999, 0.5, 0.75, 1.0, 3.0])
MODES = pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])


def law(v):
    """Eq. 38 as printed, in working precision, for v > 0."""
    mu_s, mu_m, v_m = (mpf(GOOD[name]) for name in ("mu_s", "mu_m", "v_m"))
    return mu_s - 3 * (mu_s - mu_m) / (2 * v_m) * v + (mu_s - mu_m) / (2 * v_m**3) * v**3


def test_values():
    """Eq. 38 on both sides of rest, against 40 digits."""
    friction = fj.Stribeck(**GOOD)
    with mp.workdps(40):
        truth = np.array([float(law(mpf(v))) for v in VELOCITIES])
    np.testing.assert_allclose(friction.coefficient(VELOCITIES), truth, rtol=1e-15)


def test_odd():
    """mu(-v) = -mu(v), mu(0) = 0, to the last bit."""
    for friction in (fj.Stribeck(**GOOD), fj.Coulomb(0.4)):
        np.testing.assert_array_equal(
            friction.coefficient(-VELOCITIES), -friction.coefficient(VELOCITIES)
        )
        assert friction.coefficient(0.0) == 0.0


def test_minimum():
    """At v_m the friction is mu_m with slope 0, and higher on both sides; at rest it is mu_s."""
    friction = fj.Stribeck(**GOOD)
    np.testing.assert_allclose(friction.coefficient(0.5), 0.25, rtol=1e-15)
    assert friction.slope(0.5) == 0.0
    assert (friction.coefficient(np.array([0.499, 0.501])) > 0.25).all()
    assert friction.coefficient(1e-300) == 0.4


@MODES
def test_slope(mode):
    """dmu/dv on both sides of rest: `slope` and both modes against differences in 60 digits."""
    friction = fj.Stribeck(**GOOD)
    with mp.workdps(60):
        h = mpf("1e-20")  # truncation h^2, rounding 1e-60/h
        slopes = [(law(mpf(v) + h) - law(mpf(v) - h)) / (2 * h) for v in VELOCITIES]
    truth = np.array([float(slope) for slope in slopes])
    for sign in (1, -1):
        found = jax.vmap(mode(friction.coefficient))(sign * VELOCITIES)
        # Near the minimum two terms of the size of the slope at rest cancel.
        np.testing.assert_allclose(found, truth, rtol=1e-15, atol=5e-16)
        np.testing.assert_allclose(friction.slope(sign * VELOCITIES), truth, rtol=1e-15, atol=5e-16)


@MODES
def test_derivatives_by_parameter(mode):
    """dmu/dmu_s = 1 - c, dmu/dmu_m = c and dmu/dv_m, with c = u (3 - u^2)/2, u = v/v_m."""

    def at(mu_s, mu_m, v_m):
        return fj.Stribeck(mu_s, mu_m, v_m).coefficient(0.15)

    found = mode(at, argnums=(0, 1, 2))(*GOOD.values())
    u = 0.15 / 0.5
    c = u * (3 - u**2) / 2
    by_v_m = (0.4 - 0.25) * 1.5 * (1 - u**2) * u / 0.5
    np.testing.assert_allclose(found, [1 - c, c, by_v_m], rtol=2e-15)


@MODES
def test_coulomb(mode):
    """Constant friction: mu on one side, -mu on the other, no slope, static and smallest alike."""
    friction = fj.Coulomb(0.4)
    np.testing.assert_array_equal(friction.coefficient(VELOCITIES), 0.4)
    np.testing.assert_array_equal(jax.vmap(mode(friction.coefficient))(VELOCITIES), 0)
    assert friction.mu_s == friction.mu_m == 0.4
    assert not friction.velocity_dependent


def test_stribeck_without_drop_is_coulomb():
    """mu_m = mu_s: the two laws agree, to the last bit."""
    flat = fj.Stribeck(0.4, 0.4, 0.5)
    np.testing.assert_array_equal(
        flat.coefficient(VELOCITIES), fj.Coulomb(0.4).coefficient(VELOCITIES)
    )
    np.testing.assert_array_equal(flat.slope(VELOCITIES), 0)


@pytest.mark.parametrize("friction", [fj.Stribeck(**GOOD), fj.Coulomb(0.4)])
def test_branch(friction):
    """coefficient(v) = branch(v, sgn v) to the last bit, and branch(0, +-1) = +-mu_s."""
    v = np.concatenate([-VELOCITIES, [0.0], VELOCITIES])
    np.testing.assert_array_equal(friction.coefficient(v), friction.branch(v, np.sign(v)))
    np.testing.assert_array_equal(friction.branch(0.0, np.array([1.0, -1.0])), [0.4, -0.4])
    # Linear in the sign, as a regularised one between -1 and 1 needs it.
    middle, ends = friction.branch(v, 0.25), (friction.branch(v, 1.0), friction.branch(v, -1.0))
    np.testing.assert_allclose(middle, 0.625 * ends[0] + 0.375 * ends[1], rtol=0, atol=2e-15)


@MODES
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_branch_goes_on_through_rest(mode, sign):
    """One side's law is one cubic on both sides of v = 0: values and slope are the law's own."""
    friction = fj.Stribeck(**GOOD)
    v = np.concatenate([-VELOCITIES[::-1], [0.0], VELOCITIES])
    truth = np.polynomial.Polynomial([sign * 0.4, -1.5 * 0.15 / 0.5, 0, 0.5 * 0.15 / 0.5**3])
    one_side = functools.partial(friction.branch, sign=sign)
    np.testing.assert_allclose(one_side(v), truth(v), rtol=1e-15, atol=3e-16)
    slope = jax.vmap(mode(one_side))(v)
    np.testing.assert_allclose(slope, truth.deriv()(v), rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(slope, friction.slope(v), rtol=1e-15, atol=1e-15)
    assert mode(functools.partial(fj.Coulomb(0.4).branch, sign=sign))(0.0) == 0


def test_a_law_without_branch_is_none():
    """`branch` is what a friction law must bring: without it there is nothing to build."""

    class Lawless(Friction):
        mu_s: jax.Array
        mu_m: jax.Array
        velocity_dependent = False
        lowest = "mu_m"

        def slope(self, v):
            return v

    with pytest.raises(TypeError, match=r"abstract method '?branch"):
        Lawless(jnp.array(0.4), jnp.array(0.3))  # pyright: ignore[reportAbstractUsage]


def test_float32():
    """float32 parameters and velocity give a float32 coefficient and slope."""
    friction = fj.Stribeck(*(jnp.float32(x) for x in GOOD.values()))
    v = VELOCITIES[1:].astype(np.float32)
    assert friction.coefficient(v).dtype == friction.slope(v).dtype == np.float32
    exact = fj.Stribeck(**GOOD)
    np.testing.assert_allclose(
        friction.coefficient(v), exact.coefficient(VELOCITIES[1:]), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "bad", "bound"),
    [
        *(("mu_s", x, "above 0") for x in (0, -0.1, np.nan, np.inf)),
        *(("mu_m", x, "at least 0") for x in (-0.1, np.nan, np.inf)),
        *(("mu_s", x, "at least mu_m = 0.25") for x in (0.2, np.nextafter(0.25, 0))),
        *(("v_m", x, "above 0") for x in (0, -0.5, np.nan, np.inf)),
    ],
)
def test_stribeck_refusals(name, bad, bound):
    """The message holds the argument, the bound and the value; mu_m may not exceed mu_s."""
    with pytest.raises(ValueError, match=f"^{name} must be {bound}, got {float(bad)!r}$"):
        fj.Stribeck(**GOOD | {name: bad})


def test_smallest_above_static_is_refused():
    """mu_m > mu_s is told with both values."""
    with pytest.raises(ValueError, match=r"^mu_s must be at least mu_m = 0\.5, got 0\.4$"):
        fj.Stribeck(0.4, 0.5, 0.5)


@pytest.mark.parametrize("bad", [0, -0.4, np.nan, np.inf])
def test_coulomb_refusals(bad):
    """The message holds the argument, the bound and the value."""
    with pytest.raises(ValueError, match=f"^mu must be above 0, got {float(bad)!r}$"):
        fj.Coulomb(bad)


@pytest.mark.parametrize("bad", ["0.4", None, False, 0.4j])
def test_not_a_number(bad):
    """Anything but a real number is a TypeError that names the argument."""
    with pytest.raises(TypeError, match=r"^mu must be a"):
        fj.Coulomb(bad)
    for name in GOOD:
        with pytest.raises(TypeError, match=f"^{name} must be a"):
            fj.Stribeck(**GOOD | {name: bad})


def test_traced_refusal():
    """Under jit the compiled program raises, with the argument and the bound."""
    stribeck, coulomb = eqx.filter_jit(fj.Stribeck), eqx.filter_jit(fj.Coulomb)
    arguments = [jnp.array(x) for x in GOOD.values()]
    assert stribeck(*arguments).mu_m == 0.25
    with pytest.raises((RuntimeError, ValueError), match="mu_s must be at least mu_m"):
        jax.block_until_ready(stribeck(arguments[0], jnp.array(0.5), arguments[2]))
    with pytest.raises((RuntimeError, ValueError), match="mu must be above 0"):
        jax.block_until_ready(coulomb(jnp.array(-1.0)))


def test_eager_gradient_refuses_with_the_value():
    """Inside an eager jax.grad the value is known, and is shown."""
    with pytest.raises(ValueError, match=r"^mu_s must be at least mu_m = 0\.25, got 0\.125"):
        jax.grad(lambda mu_s: fj.Stribeck(mu_s, 0.25, 0.5).coefficient(0.1))(0.125)
