"""Stiffness over two quantities: point by point, its slopes, a given area, what is refused."""

import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.base.parts import substitute

D, G = np.array([2.33, 2.4, 2.5, 2.61]), np.array([1.342e-10, 3e-9])
STEP = 1e-6


@pytest.fixture(scope="module")
def scene():
    return fj.brake_scene()


@pytest.fixture(scope="module")
def curves(scene):
    return fj.stiffness_over(scene, ("D", D), ("G", G))


@jax.jit
def _state(scene):
    return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)


def states(scene):
    """Indices and the state of the joint of every point."""
    for i, j in np.ndindex(G.size, D.size):
        yield (i, j), _state(substitute(scene, {"D": D[j], "G": G[i]}))


def test_points_are_those_of_the_joint(scene, curves):
    """Stiffness, area, load and regime; all three regimes are among them."""
    assert (curves.names, curves.units) == (("D", "G"), ("-", "m"))
    assert curves.K_n.shape == curves.K_t_slope.shape == (2, 4)
    for at, state in states(scene):
        for name in ("K_n", "K_t", "A_r"):
            np.testing.assert_allclose(getattr(curves, name)[at], getattr(state, name), rtol=1e-12)
        assert (curves.regime == state.regime)[at]
        assert curves.P[at] == 1907.3 and curves.E[at] == 1.154e11
    for regime in (fj.Regime.fully_plastic, fj.Regime.elastic_plastic, fj.Regime.gross_slip):
        assert (curves.regime == regime).any()


@pytest.mark.parametrize("A_r", [None, 2.745e-6])
def test_slopes_are_those_of_differences(scene, curves, A_r):
    """d ln K/dD, under a load and at an area; NaN exactly where a stiffness is 0."""
    if A_r is not None:
        curves = fj.stiffness_over(scene, ("D", D), ("G", G), A_r=A_r)
    sides = [fj.stiffness_over(scene, ("D", D + s), ("G", G), A_r=A_r) for s in (-STEP, STEP)]
    for name in ("K_n", "K_t"):
        slope = np.asarray(getattr(curves, f"{name}_slope"))
        low, high = (np.asarray(getattr(side, name)) for side in sides)
        stiff = np.asarray(getattr(curves, name)) > 0
        np.testing.assert_array_equal(np.isfinite(slope), stiff)
        wanted = np.log(high[stiff] / low[stiff]) / (2 * STEP)
        np.testing.assert_allclose(slope[stiff], wanted, rtol=1e-5)


def test_given_area(scene):
    """The area is the one given, the load the one that makes it, and the stiffness Eq. 31's."""
    A_r, A_a = 2.745e-6, 1e-4
    curves = fj.stiffness_over(scene, ("D", D), ("G", G), A_r=A_r)
    np.testing.assert_allclose(curves.A_r, A_r, rtol=1e-13)
    wanted = [fj.contact_load(fj.Surface(D, g), scene.contact.material, A_r, mu_m=0.25) for g in G]
    np.testing.assert_allclose(curves.P, np.stack(wanted), rtol=1e-13)
    star = curves.dimensionless(A_a)
    for (i, j), state in states(scene):  # a_e does not depend on the load
        K_n = fj.dimensionless_normal_stiffness(D[j], A_r / A_a, state.a_e / A_a)
        np.testing.assert_allclose(star.K_n[i, j], K_n, rtol=1e-12)


def test_dimensionless(scene, curves):
    """Eqs. 31 and 37; slopes by ln G are the same as before."""
    star = curves.dimensionless(1e-4)
    assert (star.names, star.units) == (("D", "G*"), ("-", "-"))
    np.testing.assert_allclose(star.y, G / 1e-2)
    np.testing.assert_allclose(star.K_t, curves.K_t / 1.154e9)
    np.testing.assert_allclose(star.A_r, curves.A_r / 1e-4)
    np.testing.assert_array_equal(star.K_n_slope, curves.K_n_slope)
    loads = fj.stiffness_over(scene, ("P", [1e3, 2e3, 4e3, 8e3]), ("D", [2.4, 2.5]))
    star = loads.dimensionless(1e-4)
    assert star.names == ("P*", "D")
    np.testing.assert_allclose(star.x, np.array([1e3, 2e3, 4e3, 8e3]) / 1.154e7)
    np.testing.assert_allclose(star.P[0], star.x)
    for name in ("K_n_slope", "K_t_slope"):
        exponents = [getattr(c, name) * c.x[None] for c in (star, loads)]
        np.testing.assert_allclose(*exponents, rtol=1e-14)


def test_given_ratio_on_an_axis(scene):
    """K_t is the ratio times K_n, and nothing slips."""
    curves = fj.stiffness_over(scene, ("K_t/K_n", [0.1, 0.2, 0.3, 0.4]), ("D", [2.4, 2.61]))
    np.testing.assert_allclose(curves.K_t, curves.x[None] * curves.K_n, rtol=1e-14)
    assert (curves.regime == fj.Regime.elastic_plastic).all()


def test_refusals(scene, curves):
    fixed = scene.replace(contact=fj.FixedContact(1e8, 1e8))
    with pytest.raises(ValueError, match="needs a FractalContact: a FixedContact has none"):
        fj.stiffness_over(fixed, ("mu_s", [0.3]), ("m", [1.0]))
    with pytest.raises(ValueError, match="scene has no quantity 'Q'"):
        fj.stiffness_over(scene, ("Q", [1.0]), ("D", [2.4]))
    with pytest.raises(ValueError, match=r"D must be above 2 and below 3, got 3\.0"):
        fj.stiffness_over(scene, ("D", [2.4, 3.0]), ("G", G))
    with pytest.raises(ValueError, match=r"values of D must be a list, got shape \(1, 2\)"):
        fj.stiffness_over(scene, ("D", [[2.4, 2.5]]), ("G", G))
    with pytest.raises(ValueError, match="quantities must be independent, got D and D"):
        fj.stiffness_over(scene, ("D", D), ("D", D))
    with pytest.raises(ValueError, match=r"A_r must be above 0, got -1\.0"):
        fj.stiffness_over(scene, ("D", D), ("G", G), A_r=-1.0)
    with pytest.raises(ValueError, match="P cannot be an axis beside it"):
        fj.stiffness_over(scene, ("D", D), ("P", [1e3]), A_r=1e-6)
    with pytest.raises(ValueError, match=r"mu_s must be at least mu_m = 0\.4, got 0\.3"):
        fj.stiffness_over(scene, ("mu_s", [0.3, 0.5]), ("mu_m", [0.2, 0.4]))
    with pytest.raises(ValueError, match="D must be a scalar"):
        fj.stiffness_over(scene.replace(D=D), ("G", G), ("P", [1e3]))
    with pytest.raises(ValueError, match=r"A_a must be above 0, got 0\.0"):
        curves.dimensionless(0.0)
    with pytest.raises(ValueError, match="dimensionless already"):
        curves.dimensionless(1e-4).dimensionless(1e-4)
    moduli = fj.stiffness_over(scene, ("P", [1e3, 2e3]), ("E", [1e11, 2e11]))
    with pytest.raises(ValueError, match="no axis where E changes"):
        moduli.dimensionless(1e-4)
