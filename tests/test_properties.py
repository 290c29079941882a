"""What holds for any input: roughness, files, sweeps and identification."""

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import given, settings

import fractaljax as fj
from properties import QUICK
from tools import reference_scene

FEW = settings(QUICK, max_examples=10)  # calls that are not compiled, or print
UNIT = st.floats(0, 1)


@jax.jit
def roughness(D, G, gamma, L, L_s):
    return fj.roughness(fj.Surface(D, G, gamma), L, L_s)


def test_roughness_scales():
    """With G as G^(D-2) alone; a larger copy of a surface is as steep and higher."""
    u = np.random.default_rng(3).uniform(size=(5, 500))
    D, G, gamma = 2 + 1e-6 + (1 - 2e-6) * u[0], 10 ** (-18 + 14 * u[1]), 1 + 10 ** (4 * u[2] - 3)
    L = 10 ** (9 * u[3] - 8)
    L_s = L / 10 ** (8 * u[4])
    base = roughness(D, G, gamma, L, L_s)
    rougher = roughness(D, 16.0 * G, gamma, L, L_s)
    larger = roughness(D, 8.0 * G, gamma, 8.0 * L, 8.0 * L_s)
    for name, length in (("Sq", 8.0), ("Sa", 8.0), ("Sdq", 1.0)):
        value = np.asarray(getattr(base, name))
        assert (value > 0).all() and np.isfinite(value).all()
        np.testing.assert_allclose(getattr(rougher, name) / value, 16.0 ** (D - 2), rtol=1e-12)
        np.testing.assert_allclose(getattr(larger, name), length * value, rtol=1e-12)


@FEW
@given(u=hnp.arrays(np.float64, 14, elements=UNIT))
def test_a_scene_comes_back_from_its_file(u):
    surface = fj.Surface(2.1 + 0.8 * u[0], 10 ** (-14 + 8 * u[1]), 1.001 + u[2])
    material = fj.Material(1e9 + 1e12 * u[3], u[4] / 2, 1e6 + 1e8 * u[5], 2e8 + 1e9 * u[6])
    for contact in (fj.FractalContact(surface, material, 1 + u[7]), fj.FixedContact(*1e9 * u[:2])):
        scene = fj.Scene(
            contact,
            fj.Stribeck(0.3 + u[8], 0.3 * u[9], 1e-3 + u[10]),
            fj.Oscillator(1 + u[11], 1e3 + u[12], 1e4, u[13], u[0], -u[1], 1 + u[2]),
        )
        back = fj.Scene.from_toml(scene.to_toml())
        assert jax.tree.structure(back) == jax.tree.structure(scene)
        assert jax.tree.all(jax.tree.map(lambda a, b: a == b, back, scene))


@FEW
@given(u=hnp.arrays(np.float64, 4, elements=UNIT))
def test_a_sweep_gives_what_single_calls_give(u):
    scene, K_n = reference_scene(), 1e3 * 1e12**u
    swept = fj.sweep(fj.growth_rate, scene, progress=False, K_n=K_n)
    alone = [float(fj.growth_rate(scene.replace(K_n=K))) for K in K_n.tolist()]
    assert (np.abs(np.asarray(swept) - alone) <= 1e-15 * (np.sqrt(K_n) + 1e4)).all()


@pytest.fixture(scope="module")
def measured():
    surface, n, L = fj.Surface(2.4, 1e-10), 256, 1e-3
    z = np.asarray(fj.topography(surface, L, n, key=jax.random.key(4))[:, 0])
    return z, L / n, fj.identify(z, L / n)


@FEW
@given(power=st.integers(-30, 20), height=st.integers(-10, 10))
def test_identification_in_other_units(measured, power, height):
    """Lengths times 2^power move G alone; heights times 2^height move it as G^(D-2) says."""
    z, dx, base = measured
    unit, higher = 2.0**power, 2.0**height
    same, tall = fj.identify(z * unit, dx * unit), fj.identify(z * higher, dx)
    assert abs(same.D - base.D) < 1e-8 and abs(tall.D - base.D) < 1e-8
    assert abs(np.log(same.G / base.G / unit)) < 1e-6
    assert abs((base.D - 2) * np.log(tall.G / base.G) - np.log(higher)) < 1e-6
