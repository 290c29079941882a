"""Friction by a table: SciPy's monotone cubic, derivatives by every entry, axes, files."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

import fractaljax as fj
from tools import both_modes, refusals

TABLES = {
    "falling": ([0.0, 0.05, 0.2, 0.5, 1.5], [0.42, 0.33, 0.27, 0.25, 0.24]),
    "rises and falls": ([0.02, 0.05, 0.2, 0.5, 1.5], [0.32, 0.36, 0.27, 0.25, 0.29]),
    "flat, then steep at the end": ([0.0, 0.3, 0.6, 0.7, 0.71], [0.4, 0.4, 0.3, 0.5, 0.2]),
}
SAMPLES = np.array([0.0, 0.013, 0.04, 0.1, 0.33, 0.65, 0.705, 0.9, 1.49, 3.0])
TEXTS = {
    "bare": "0 0.42\n0.5 0.33\n1.5 0.3\n",
    "titles, decimal commas": "speed [mm/s]; mu [-]\n0;0,42\n500;0,33\n1500;0,3\n",
    "units in a line": "# dynamometer 3\nv,mu\nm/s,-\n0,0.42\n0.5,0.33\n\n1.5,0.3\n",
    "per minute": "v in m/min\tmu\n0\t0.42\n30\t0.33\n90\t0.3\n",
}
RNG = np.random.default_rng(3)
CUBE = RNG.uniform(0.2, 0.5, (4, 3, 2))
AXES: dict[str, Any] = {"pressures": [1e5, 5e5, 2e6], "temperatures": [300.0, 600.0]}


def law(x) -> fj.TabulatedFriction:
    return fj.TabulatedFriction(x[:5], x[5:10])


def scipy_mu(speeds, coefficients, at):
    """Constant beyond the ends."""
    return PchipInterpolator(speeds, coefficients)(np.clip(at, speeds[0], speeds[-1]))


@jax.jit
@jax.vmap
def of_tables(x):
    """mu, by both modes, and the slope, at all speeds and of many tables at once."""
    of_all = both_modes(lambda x: law(x).mu(SAMPLES), x)
    return *of_all, law(x).slope(SAMPLES), law(x).mu_m, law(x).in_motion().mu(SAMPLES)


def test_values_and_derivatives():
    """Against SciPy, and its differences by every speed and coefficient."""
    rows = np.array([[*speeds, *coefficients] for speeds, coefficients in TABLES.values()])
    values, forward, reverse, slopes, least, prepared = of_tables(rows)
    np.testing.assert_array_equal(prepared, values)
    for k, x in enumerate(rows):
        np.testing.assert_allclose(values[k], scipy_mu(x[:5], x[5:], SAMPLES), rtol=1e-14)
        h, inside = 1e-6, (x[0] < SAMPLES) & (x[4] > SAMPLES)
        cubic = PchipInterpolator(x[:5], x[5:]).derivative()
        truth = np.where(inside | (x[0] == SAMPLES), cubic(np.clip(SAMPLES, x[0], x[4])), 0)
        np.testing.assert_allclose(slopes[k], truth, rtol=1e-12, atol=1e-13)
        assert float(least[k]) == x[5:].min()
        if k == 2:  # beside a flat piece a derivative has two sides
            continue
        for i in range(10):
            up, down = (x + s * h * (np.arange(10) == i) for s in (1, -1))
            at = [scipy_mu(y[:5], y[5:], SAMPLES) for y in (up, down)]
            if i == 0 and x[0] == 0:  # SciPy has no speed below 0
                continue
            for own in (forward[k], reverse[k]):
                difference = (at[0] - at[1]) / (2 * h)
                np.testing.assert_allclose(own[:, i], difference, rtol=2e-6, atol=1e-8)


def test_pressure_and_temperature():
    """One axis after the other, constant beyond; quantities of the scene; derivatives."""
    speeds, brake = [0.0, 0.1, 0.3, 1.0], fj.brake_scene()

    def of(x):
        return fj.TabulatedFriction(speeds, CUBE, pressure=x[0], temperature=x[1], **AXES)

    def truth(p, T, w):
        p, T = np.clip(p, 1e5, 2e6), np.clip(T, 300, 600)
        by_T = PchipInterpolator(AXES["temperatures"], CUBE, axis=2)(T)
        return scipy_mu(speeds, PchipInterpolator(AXES["pressures"], by_T, axis=1)(p), w)

    x = jnp.array([7e5, 400.0])
    value, *slopes = jax.jit(lambda x: both_modes(lambda x: of(x).mu(SAMPLES), x))(x)
    np.testing.assert_allclose(value, truth(7e5, 400.0, SAMPLES), rtol=1e-13)
    h = np.array([10.0, 0.01])
    for i in range(2):
        steps = [np.array(x) + s * h * (np.arange(2) == i) for s in (1, -1)]
        ends = [truth(p, T, SAMPLES) for p, T in steps]
        for slope in slopes:
            np.testing.assert_allclose(slope[:, i], (ends[0] - ends[1]) / (2 * h[i]), rtol=1e-6)
    np.testing.assert_allclose(of([1e9, 1.0]).mu(SAMPLES), truth(1e9, 1.0, SAMPLES), rtol=1e-13)
    scene = brake.replace(friction=of(x))
    batch = scene.replace(pressure=jnp.array([1e5, 7e5, 2e6])).friction
    np.testing.assert_allclose(batch.mu(0.2), [truth(p, 400.0, 0.2) for p in (1e5, 7e5, 2e6)])
    assert batch.mu_m.shape == (3,)
    again = fj.Scene.from_toml(scene.to_toml())
    assert jax.tree.structure(again) == jax.tree.structure(scene)
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(scene)))
    twice = scene.friction.times(2.0)
    np.testing.assert_allclose(twice.in_motion().mu(SAMPLES), 2 * value, rtol=1e-14)


def test_static_coefficient():
    """mu(0) of the table, or above it."""
    plain, above = (fj.TabulatedFriction([0, 1], [0.4, 0.3], mu_s=mu_s) for mu_s in (None, 0.5))
    assert (float(plain.mu_s), plain.has_jump) == (0.4, False)
    assert (float(above.mu_s), above.has_jump, float(above.kinetic_limit())) == (0.5, True, 0.4)
    assert float(above.times(2.0).mu_s) == 1.0
    assert np.isnan(jax.jit(lambda mu_s: fj.TabulatedFriction([0, 1], [0.4, 0.3], mu_s).mu_s)(0.1))
    traced = jax.jit(lambda last: fj.TabulatedFriction([0.0, 1.0, last], [0.4, 0.3, 0.2]).mu(0.5))
    assert np.isnan(traced(0.5)) and float(traced(2.0)) > 0.3


@pytest.mark.parametrize("name", TEXTS)
def test_files(name, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(TEXTS[name])
    found = fj.TabulatedFriction.from_csv(path, mu_s=0.5)
    np.testing.assert_allclose(found.speeds, [0, 0.5, 1.5], rtol=1e-15)
    np.testing.assert_array_equal(found.coefficients, [0.42, 0.33, 0.3])
    assert float(found.mu_s) == 0.5


def read(text, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(text)
    return fj.TabulatedFriction.from_csv(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v,mu\n0,0.4\n1;0.3\n", r"line 3 must be a speed and a coefficient, got '1;0.3'$"),
        ("v [rpm],mu\n0,0.4\n1,0.3\n", r"the unit of the speeds must be a length per s.*got rpm$"),
        ("v,mu\n", r"it must hold two lines of a speed and a coefficient, got 0$"),
        ("v,mu,T\n0,0.4,20\n1,0.3,20\n", r"it must hold two lines .*'0,0.4,20' has more columns"),
        ("0,0.4\n0,0.3\n", r"speeds must rise, got 0 before 0$"),
        ("0,0.4\n1,-0.3\n", r"coefficients must be above 0, got -0.3$"),
    ],
)
def test_bad_files(text, message, tmp_path):
    with pytest.raises(ValueError, match=r"table\.csv: " + message):
        read(text, tmp_path)


def test_separators_behind_the_numbers(tmp_path):
    found = read("v;mu;\n0;0,4;\n1;0,3;;\n", tmp_path)
    np.testing.assert_array_equal(found.coefficients, [0.4, 0.3])


BAD: Any = [[0.4, 0.3], [0.2]]
test_refusals = refusals(
    [
        (lambda: fj.TabulatedFriction([0.0], [0.4]), "^speeds must be a list of two numbers"),
        (lambda: fj.TabulatedFriction([-1.0, 1.0], [0.4, 0.3]), "^speeds must be at least 0, got"),
        (lambda: fj.TabulatedFriction([0, 1], [0.4, 0.3, 0.2]), r"^coefficients must have shape"),
        (lambda: fj.TabulatedFriction([0, 1], BAD), "^coefficients must be rows of numbers"),
        (lambda: fj.TabulatedFriction([0, 1], ["a", "b"]), "^coefficients must be a real number"),
        (lambda: fj.TabulatedFriction([0, 1], [0.4, 0.3], 0.3), r"^mu_s must be at least mu\(0\)"),
        (
            lambda: fj.TabulatedFriction([0, 1], [0.4, 0.3], pressure=1e5),
            "^pressures must be given with pressure",
        ),
    ],
    kind=(ValueError, TypeError),
)
