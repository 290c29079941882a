"""A measured contact law: SciPy's monotone cubic of the logarithms, power laws beyond the table."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

import fractaljax as fj
from tools import both_modes, refusals

LOADS, STIFFNESSES = (100.0, 300.0, 700.0, 2000.0), (1e7, 2.5e7, 9e7, 1.5e8)


def K_n(P, loads=LOADS, stiffnesses=STIFFNESSES):
    return fj.MeasuredContact(loads, stiffnesses, P, 0.8).stiffness(0.4, 0.25)[0]


def test_is_scipy_s_monotone_cubic_of_the_logarithms_or_a_power_law():
    """Through its points, and between them."""
    curve = PchipInterpolator(np.log(LOADS), np.log(STIFFNESSES))
    x = np.linspace(math.log(101), math.log(1999), 50)
    x = np.concatenate([np.log(LOADS), x])
    curves = jax.jit(lambda x: both_modes(jax.vmap(lambda x: jnp.log(K_n(jnp.exp(x)))), x))
    value, forward, reverse = curves(x)
    np.testing.assert_allclose(value, curve(x), rtol=1e-14)
    np.testing.assert_allclose(np.exp(value[:4]), STIFFNESSES, rtol=1e-14)
    for jacobian in (forward, reverse):
        slopes = np.diag(jacobian)[4:]
        np.testing.assert_allclose(slopes, curve.derivative()(x[4:]), rtol=1e-10, atol=1e-12)
    assert (np.diff(value[4:]) > 0).all()
    P = np.array([1.0, 50.0, 100.0, 150.0, 400.0, 9e4])
    K_n_at = jax.jit(jax.vmap(lambda P: K_n(P, (100.0, 400.0), (1e7, 2e7))))(P)
    np.testing.assert_allclose(K_n_at, 1e7 * (P / 100) ** 0.5, rtol=1e-13)


@pytest.mark.parametrize("P", [1e-3, 99.0, 2001.0, 1e7])
def test_is_the_power_law_of_its_end_beyond_the_table(P):
    x, y = np.log(LOADS), np.log(STIFFNESSES)
    end = 0 if P < 100 else -1
    slope = PchipInterpolator(x, y).derivative()(x[end])
    assert float(jnp.log(K_n(P))) == pytest.approx(y[end] + slope * (np.log(P) - x[end]), rel=1e-13)


def test_scene_with_a_table_comes_back_from_its_file():
    scene = fj.brake_scene().replace(contact=fj.MeasuredContact(LOADS, STIFFNESSES, 500, 0.8))
    back = fj.Scene.from_toml(scene.to_toml())
    assert back.contact.loads == LOADS and back.contact.stiffnesses == STIFFNESSES
    assert jax.tree.structure(back) == jax.tree.structure(scene)
    assert float(fj.growth_rate(back)) == float(fj.growth_rate(scene))
    # A tuple of the table is not a quantity, the load is.
    assert float(fj.stiffness(scene.replace(P=300.0))[0]) == pytest.approx(2.5e7, rel=1e-14)
    axes: Any = {"K_t/K_n": [0.5]}
    K_n, K_t = fj.sweep(fj.stiffness, scene, progress=False, **axes).values
    assert float(K_t[0] / K_n[0]) == pytest.approx(0.5, rel=1e-14)


test_refuses_what_is_no_measurement = refusals(
    [
        ({"loads": (100.0,), "stiffnesses": (1e7,)}, "two or more and as many, got 1 and 1"),
        ({"stiffnesses": (1e7,)}, "two or more and as many, got 4 and 1"),
        ({"loads": (1.0, 3.0, 2.0, 4.0)}, "loads must rise, got (1.0, 3.0, 2.0, 4.0)"),
        ({"loads": (0.0, 1.0, 2.0, 3.0)}, "loads[0] must be above 0, got 0.0"),
        ({"stiffnesses": (1e7, 2e7, -1.0, 3e7)}, "stiffnesses[2] must be above 0, got -1.0"),
        ({"P": 0.0}, "P must be above 0, got 0.0"),
    ],
    lambda wrong: fj.MeasuredContact(
        **dict(loads=LOADS, stiffnesses=STIFFNESSES, P=1.0, stiffness_ratio=0.8) | wrong
    ),
    plain=True,
)


def test_refuses_a_traced_table():
    with pytest.raises(TypeError, match="loads must be known when a program is traced"):
        jax.jit(lambda x: K_n(500.0, (x, 2 * x)))(1.0)


# --- of a map -------------------------------------------------------------------------------------

MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)


@pytest.fixture(scope="module")
def heights():
    surface = fj.SelfAffine(1e-6, 0.8, 2.5e-4, 5e-5)
    return fj.topography(surface, 1e-3, 64, key=jax.random.key(1), periodic=True)


def test_law_of_a_map_is_that_of_boundary_elements(heights):
    """Also with a plateau; a joint of four times the area is four maps side by side."""
    dx = 1e-3 / 64
    z = np.minimum(np.asarray(heights), 5e-7)
    law = fj.MeasuredContact.from_heights(z, dx, MATERIAL, 2e3, 4e-6)
    for P in (law.loads[0], law.loads[5], 1e3):
        K_n, K_t = law_at(law, P)
        pressed = fj.boundary_element(z, dx, MATERIAL, P / 4)
        rel = 1e-7 if P in law.loads else 0.03  # between two loads of the table
        assert float(K_n) == pytest.approx(4 * float(pressed.K_n), rel=rel)
        assert float(K_t / K_n) == pytest.approx(1.4 / 1.7, rel=1e-12)
    scene = fj.brake_scene().replace(contact=law)
    assert np.isfinite(fj.growth_rate(scene)) and fj.Scene.from_toml(scene.to_toml()) is not None


def law_at(law, P):
    return fj.MeasuredContact(law.loads, law.stiffnesses, P, law.stiffness_ratio).stiffness(
        0.4, 0.2
    )


def test_loads_of_a_map_end_before_it_is_flat(heights):
    pressures = [1e8, 1e9, 1e12, 1e13]
    law = fj.MeasuredContact.from_heights(
        heights, 1e-3 / 64, MATERIAL, 1e3, 1e-6, 0.7, pressures=pressures
    )
    assert law.loads == pytest.approx((1e2, 1e3)) and float(law.stiffness_ratio) == 0.7
    with pytest.raises(ValueError, match="pressures must be two or more that leave gaps"):
        fj.MeasuredContact.from_heights(
            heights, 1e-3 / 64, MATERIAL, 1e3, 1e-6, pressures=pressures[1:]
        )
