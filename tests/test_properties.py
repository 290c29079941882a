"""What holds of roughness, damping, files, sweeps and identification, whatever the input."""

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import given, settings

import fractaljax as fj
from benchmarks.extreme import programs
from benchmarks.extreme.points import (
    JOINT_COLUMNS,
    MECHANISM_COLUMNS,
    ROUGHNESS_COLUMNS,
    areas,
    joints,
    mechanisms,
)
from properties import QUICK, places
from tools import reference_scene

ROUGHNESS = jax.jit(jax.vmap(programs.roughness))
FEW = settings(QUICK, max_examples=15)  # calls that are not compiled, or print


@QUICK
@given(u=places(ROUGHNESS_COLUMNS))
def test_roughness_is_positive_and_grows_with_G(u):
    x = areas(u)
    rougher = x.copy()
    rougher[:, 1] *= 16.0
    less, more = ROUGHNESS(x), ROUGHNESS(rougher)
    for name in ("Sq", "Sa", "Sdq"):
        a, b = np.asarray(less[name]), np.asarray(more[name])
        assert (a > 0).all() and np.isfinite(b).all()
        # G stands there as G^(D-2) alone.
        np.testing.assert_allclose(b / a, 16.0 ** (x[:, 0] - 2), rtol=1e-12)


@QUICK
@given(u=places(ROUGHNESS_COLUMNS))
def test_a_larger_copy_of_a_surface_is_as_steep_and_higher(u):
    x = areas(u)
    copy = x.copy()
    copy[:, [1, 3, 4]] *= 8.0
    small, large = ROUGHNESS(x), ROUGHNESS(copy)
    np.testing.assert_allclose(large["Sdq"], small["Sdq"], rtol=1e-12)
    np.testing.assert_allclose(large["Sq"], 8 * np.asarray(small["Sq"]), rtol=1e-12)


DOF = 3


@FEW
@given(
    u=hnp.arrays(np.float64, (2, DOF, DOF), elements=st.floats(-1, 1)),
    ratio=st.floats(1e-6, 1e3),
)
def test_modal_damping_gives_back_its_ratio(u, ratio):
    M, K = (x @ x.T + 0.1 * np.eye(DOF) for x in u)
    C = np.asarray(fj.modal_damping(M, 1e8 * K, ratio))
    # From coordinates in which M is the identity and K diagonal.
    L = np.linalg.cholesky(M)
    inverse = np.linalg.inv(L)
    squares, X = np.linalg.eigh(inverse @ (1e8 * K) @ inverse.T)
    own = X.T @ inverse @ C @ inverse.T @ X
    wanted = np.diag(2 * ratio * np.sqrt(squares))
    np.testing.assert_allclose(own, wanted, atol=1e-10 * wanted.max())
    # The square of it is proportional to K, where damping is the same for all.
    np.testing.assert_allclose(C, C.T, atol=1e-12 * np.abs(C).max())


@FEW
@given(alpha=st.floats(0, 1e6), beta=st.floats(0, 1))
def test_rayleigh_damping_is_that_sum(alpha, beta):
    M, K = np.diag([1.0, 2.0]), np.array([[3e6, -1e6], [-1e6, 1e6]])
    found, wanted = fj.rayleigh_damping(M, K, alpha, beta), alpha * M + beta * K
    # What is smaller than any normal number, compiled programs make 0.
    np.testing.assert_allclose(found, wanted, rtol=1e-15, atol=1e-300)


@FEW
@given(u=places(JOINT_COLUMNS + MECHANISM_COLUMNS))
def test_a_scene_comes_back_from_its_file(u):
    joint, mass = joints(u[:, :JOINT_COLUMNS])[0], mechanisms(u[:, JOINT_COLUMNS:])[0]
    surface, material, P, frictions = programs.joint(joint)
    scene = fj.Scene(
        fj.FractalContact(surface, material, P),
        fj.Stribeck(**frictions, v_m=mass[11]),
        fj.Oscillator(*mass[:7]),
    )
    for given_scene in (scene, programs.scene(mass)):
        back = fj.Scene.from_toml(given_scene.to_toml())
        assert jax.tree.structure(back) == jax.tree.structure(given_scene)
        assert jax.tree.all(jax.tree.map(lambda a, b: a == b, back, given_scene))


@FEW
@given(u=hnp.arrays(np.float64, (4,), elements=st.floats(0, 1)))
def test_a_sweep_gives_what_single_calls_give(u):
    scene, K_n = reference_scene(), 1e3 * 1e12**u
    swept = fj.sweep(fj.growth_rate, scene, progress=False, K_n=K_n)
    alone = [float(fj.growth_rate(scene.replace(K_n=K))) for K in K_n.tolist()]
    omega = np.sqrt(K_n) + 1e4
    assert (np.abs(np.asarray(swept) - alone) <= 1e-15 * omega).all()


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
    same = fj.identify(z * unit, dx * unit)
    assert abs(same.D - base.D) < 1e-8
    assert abs(np.log(same.G / base.G / unit)) < 1e-6
    tall = fj.identify(z * higher, dx)
    assert abs(tall.D - base.D) < 1e-8
    moved = (base.D - 2) * np.log(tall.G / base.G)
    assert abs(moved - np.log(higher)) < 1e-6
