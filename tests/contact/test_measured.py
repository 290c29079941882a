"""A measured contact law: SciPy's monotone cubic of the logarithms, power laws beyond the table."""

import importlib
import itertools
import math
import warnings
from types import SimpleNamespace
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


DX, P, AREA = 1e-3 / 64, 2e3, 4e-6


def of_map(z, dx: Any = DX, P: Any = P, area=AREA, **options):
    """The law of a map, of which nothing is to be said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return fj.MeasuredContact.from_heights(z, dx, MATERIAL, P, area, **options)


def same(law, other, rtol=1e-6):
    np.testing.assert_allclose(law.loads, other.loads, rtol=rtol)
    np.testing.assert_allclose(law.stiffnesses, other.stiffnesses, rtol=rtol)


def test_a_tilted_map_is_that_without_tilt(heights):
    z = np.asarray(heights)
    i, j = np.indices(z.shape)
    tilted = z + 1e-7 * i - 3e-7 * j + 1e-5
    same(of_map(tilted, prepare=True), of_map(z, prepare=True))
    with pytest.warns(
        UserWarning, match=r"a plane is 9\d% of the mean square of z, and makes it so"
    ):
        askew = fj.MeasuredContact.from_heights(tilted, DX, MATERIAL, P, AREA)
    assert askew.stiffnesses[3] < 0.8 * of_map(z).stiffnesses[3]


def test_gaps_are_filled_and_spikes_told(heights):
    z = np.array(heights)
    expected = of_map(z, prepare=True)
    z[np.random.default_rng(0).uniform(size=z.shape) < 0.01] = np.nan
    same(of_map(z), expected, rtol=0.02)
    same(of_map(np.ma.masked_invalid(z)), of_map(z))
    z[30, 31] = 1e-4
    with pytest.warns(UserWarning, match="1 of 4096 heights were taken for spikes and filled"):
        spiked = fj.MeasuredContact.from_heights(z, DX, MATERIAL, P, AREA)
    same(spiked, expected, rtol=0.02)


def test_takes_lists_measurements_files_and_topographies(heights, tmp_path):
    z = np.asarray(heights)
    same(of_map(z.tolist()), of_map(z))
    expected = of_map(z, prepare=True)
    same(of_map(fj.Measurement(z, DX, DX, "mine"), None), expected)
    np.savez(tmp_path / "map.npz", z=z, dx=DX)
    same(of_map(tmp_path / "map.npz", None), expected)
    same(of_map(str(tmp_path / "map.npz"), DX), expected)
    topography = SimpleNamespace(heights=lambda: z * 1e6, unit="um", pixel_size=(DX * 1e6,) * 2)
    same(of_map(topography, None), expected)


def test_steps_that_differ(heights):
    """Every other line along y, of heights that it resolves: the contact is nearly the same."""
    surface = fj.SelfAffine(1e-6, 0.8, 2.5e-4, 1.2e-4)
    z = np.asarray(fj.topography(surface, 1e-3, 64, key=jax.random.key(1), periodic=True))
    options: Any = {"prepare": False, "pressures": [1e8, 5e8, 1e9, 2e9]}
    whole, half = of_map(z, **options), of_map(z[:, ::2], dy=2 * DX, **options)
    np.testing.assert_allclose(half.stiffnesses, whole.stiffnesses, rtol=0.03)
    squared = of_map(z[:, ::2], **options)  # as if dy were dx
    assert squared.stiffnesses[-1] < 0.7 * whole.stiffnesses[-1]
    turned = of_map(z[:, ::2].T, 2 * DX, dy=DX, **options)
    same(turned, half)
    read = fj.Measurement(z[:, ::2], DX, 2 * DX, "mine")
    same(of_map(read, None), of_map(z[:, ::2], dy=2 * DX, prepare=True))


def test_a_yielding_table_ends_at_the_hardness(heights):
    law = of_map(heights, plastic=True)
    elastic = of_map(heights)
    H = float(MATERIAL.H)
    assert len(law.loads) < len(elastic.loads) and law.loads[-1] < H * AREA < elastic.loads[-1]
    assert law.loads == elastic.loads[: len(law.loads)]
    with pytest.raises(ValueError, match="leave gaps between the surfaces and are below the hard"):
        of_map(heights, plastic=True, pressures=[1.1 * H, 1.2 * H])


def test_the_table_reaches_down_to_the_load_of_the_joint(heights):
    """As far as two points touch: below, and above the table, there is a warning."""
    usual = of_map(heights)
    low = of_map(heights, P=usual.loads[0] / 20)
    assert low.loads[0] == pytest.approx(usual.loads[0] / 20, rel=1e-12)
    assert low.loads[-12:] == usual.loads and 1 < usual.loads[0] / low.loads[-13] < 4.001
    own = DX**2 * heights.size
    pressed = fj.boundary_element(heights, DX, MATERIAL, low.loads[0] * own / AREA)
    assert float(law_at(low, low.P)[0]) == pytest.approx(float(pressed.K_n) * AREA / own, rel=1e-6)
    both = of_map(heights, P=np.array([usual.loads[0] / 20, P]))
    same(both, low)
    for load, words in ((1e-6, "is below the table, from"), (1e6, "is above the table, up to")):
        with pytest.warns(UserWarning, match=words):
            fj.MeasuredContact.from_heights(heights, DX, MATERIAL, load, AREA)


def test_loads_without_a_solution_are_left_out(heights, monkeypatch):
    module = importlib.import_module("fractaljax._contact.measured")
    press, usual = module.boundary_element, of_map(heights)

    def fails_at(*numbers):
        calls = itertools.count()

        def pressed(*arguments, **options):
            options |= {"max_steps": 1} if next(calls) in numbers else {}
            return press(*arguments, **options)

        monkeypatch.setattr(module, "boundary_element", pressed)

    fails_at(3, 5)
    with pytest.warns(UserWarning, match="did not converge at .*, .* Pa: the table leaves out"):
        law = fj.MeasuredContact.from_heights(heights, DX, MATERIAL, P, AREA)
    assert law.loads == tuple(x for i, x in enumerate(usual.loads) if i not in (3, 5))
    fails_at(*range(11))
    with pytest.raises(RuntimeError, match=r"converged at 1 of 12 pressures and two are needed"):
        of_map(heights)


def test_derivative_in_the_load_of_the_joint(heights):
    """The table is structure, P is a quantity: also where it decides how far the table reaches."""
    K_n = jax.grad(lambda P: jnp.log(of_map(heights, P=P).stiffness(0.4, 0.25)[0]))(1e3)
    law = of_map(heights)
    both = [math.log(float(law_at(law, x)[0])) for x in (1e3 * (1 - 1e-5), 1e3 * (1 + 1e-5))]
    assert float(K_n) * 1e3 == pytest.approx((both[1] - both[0]) / 2e-5, rel=1e-4)


MAP = np.random.default_rng(0).normal(size=(20, 20)) * 1e-7

test_refuses_what_is_no_map = refusals(
    [
        ({"z": MAP[0]}, "z is too short: a profile needs 32 points, got shape (20,)"),
        ({"z": MAP.ravel()}, "z must be a map (n, m), got a profile of shape (400,), which cannot"),
        ({"z": MAP * 0}, "z has no roughness: it is constant"),
        ({"z": MAP * 0, "prepare": False}, "z has no roughness: it is constant"),
        ({"z": [[1.0, 2.0], [3.0]]}, "z must be rows of as many numbers, got [[1.0, 2.0], [3.0]]"),
        ({"z": [["a"]]}, "z must be real numbers, got [['a']]"),
        ({"z": MAP[:9]}, "z is too short: each side of a map needs 16 points, got shape (9, 20)"),
        ({"z": np.where(MAP > 2e-7, np.nan, MAP), "prepare": False}, "z must be finite with prepa"),
        ({"dx": None}, "dx is needed beside heights: the step between them in m, such as dx=1e-6"),
        ({"dy": -1.0}, "dy must be above 0 and finite, in m, got -1.0"),
        ({"P": 0.0}, "P must be above 0, got 0.0"),
        ({"area": 0.0}, "area must be above 0, got 0.0"),
        ({"material": 1.0}, "material must be a Material, got 1.0"),
        ({"prepare": 1}, "prepare must be True or False, got 1"),
        ({"plastic": 1}, "plastic must be True or False, got 1"),
        ({"pressures": [1.0, -1.0]}, "pressures[1] must be above 0, got -1.0"),
        ({"pressures": [2.0, 1.0]}, "pressures must rise, got (2.0, 1.0)"),
        ({"stiffness_ratio": -1.0}, "stiffness_ratio must be at least 0, got -1.0"),
    ],
    lambda wrong: fj.MeasuredContact.from_heights(
        **dict(z=MAP, dx=1e-6, material=MATERIAL, P=1.0, area=1e-6) | wrong
    ),
    kind=(ValueError, TypeError),
    plain=True,
)


def test_refuses_a_traced_map():
    with pytest.raises(TypeError, match="z, steps, material and area must be known when a prog"):
        jax.jit(lambda z: fj.MeasuredContact.from_heights(z, DX, MATERIAL, P, AREA).P)(MAP)
