"""Wear of a map beside closed forms, its conditions and another program; derivatives, limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from synthetic import rough
from tools import both_modes, refusals

MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
E = float(MATERIAL.E)
DX, PRESSURE = 1e-5, 1e8
ROUGH = rough((12, 10))
SQ = ROUGH.std()


def wavenumbers(shape):
    return 2 * np.pi / DX * np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))


# --- closed forms --------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 5])
def test_full_contact_wears_each_wave_by_itself(steps):
    """A step divides a wave by 1 + c E q/2, with c the wear per pressure."""
    n, depth, pressure = 16, 2e-6, 2e9
    i = np.arange(n)
    waves = [
        2e-8 * np.cos(2 * np.pi * (m * i[:, None] + k * i) / n + 1) for m, k in ((1, 0), (3, -5))
    ]
    worn = fj.run_in(sum(waves) + 4e-6, DX, MATERIAL, pressure, depth, steps=steps, rtol=1e-11)
    c, expected = depth / steps / pressure, 4e-6 - depth
    for wave, size in zip(waves, (1, np.hypot(3, 5)), strict=True):
        q = 2 * np.pi * size / (n * DX)
        expected = expected + wave / (1 + c * E * q / 2) ** steps
    np.testing.assert_allclose(worn.heights, expected, rtol=0, atol=1e-18)
    assert (worn.pressure > 0).all() and float(worn.K_n) == np.inf


def test_small_steps_decay_exponentially_and_the_error_falls_as_their_length():
    n, depth, pressure = 8, 2e-7, 1e9
    wave = 1e-8 * np.sin(2 * np.pi * np.arange(n) / n)[:, None] * np.ones(n)
    expected = np.exp(-depth / pressure * E * np.pi / (n * DX))
    ratio = [
        float(fj.run_in(wave, DX, MATERIAL, pressure, depth, steps=steps).Sq) / wave.std()
        for steps in (32, 64)
    ]
    assert 0.05 < expected < 0.95
    coarse, fine = (abs(x - expected) / expected for x in ratio)
    assert fine < 0.02 and coarse / fine == pytest.approx(2, rel=0.03)


# --- conditions ----------------------------------------------------------------------------


def test_one_step_is_archard_s_law_and_its_pressure_that_of_the_worn_surface():
    depth = 0.1 * SQ
    worn = fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, depth, steps=1, rtol=1e-12)
    p, h = np.asarray(worn.pressure), np.asarray(worn.heights)
    np.testing.assert_allclose(ROUGH - h, depth * p / PRESSURE, rtol=0, atol=1e-15 * SQ)
    q = wavenumbers(p.shape)
    S = np.divide(2 / E, q, out=np.zeros_like(q), where=q > 0)
    gap = np.real(np.fft.ifft2(S * np.fft.fft2(p))) - h
    gap -= gap[p > 0].mean()
    assert 0.05 < (p > 0).mean() < 0.95
    assert np.abs(gap[p > 0]).max() < 2e-12 * SQ and gap[p == 0].min() > -2e-12 * SQ


@pytest.mark.parametrize("pressure", [1e6, 1e8, 3e9])
def test_wear_is_the_depth_and_only_in_contact(pressure):
    Sq, area = SQ, 0
    for depth in (1e-3 * SQ, 0.03 * SQ, 0.3 * SQ, 2 * SQ):
        worn = fj.run_in(ROUGH, DX, MATERIAL, pressure, depth, steps=4)
        wear = ROUGH - np.asarray(worn.heights)
        assert wear.mean() == pytest.approx(depth, rel=1e-12)
        touches = np.asarray(worn.pressure) > 0
        assert not wear[~touches].any() and (wear >= 0).all()
        assert float(worn.Sq) < Sq and touches.mean() >= area
        Sq, area = float(worn.Sq), touches.mean()
        h = np.asarray(worn.heights)
        h = h - h.mean()
        assert float(worn.Sq) == pytest.approx(h.std(), rel=1e-12)
        assert float(worn.Ssk) == pytest.approx((h**3).mean() / h.std() ** 3, rel=1e-12)
        assert float(worn.Sku) == pytest.approx((h**4).mean() / h.std() ** 4, rel=1e-12)
        pressed = fj.boundary_element(worn.heights, DX, MATERIAL, pressure * h.size * DX**2)
        np.testing.assert_allclose(worn.pressure, pressed.pressure, rtol=1e-5, atol=1e-5 * pressure)
        assert float(worn.K_n) == pytest.approx(float(pressed.K_n), rel=1e-9)


def test_no_depth_leaves_the_surface():
    worn = fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, 0.0, steps=2)
    pressed = fj.boundary_element(ROUGH, DX, MATERIAL, PRESSURE * ROUGH.size * DX**2)
    assert (worn.heights == ROUGH).all()
    np.testing.assert_allclose(worn.pressure, pressed.pressure, atol=1e-6 * PRESSURE)


# --- another program -----------------------------------------------------------------------

# p/(E Sdq), S: Sq and Sdq over those before, Ssk, Sku and K_n/(nominal area) [N/m^3] after a depth
# of S Sq, on a map of 256 x 256 points, as the surface below, whose Ssk was -0.105.
WORN = {
    (0.01, 0.01): (0.97900, 0.97959, -0.2223, 2.758, 3.4201e14),
    (0.01, 0.1): (0.85369, 0.89108, -0.7101, 2.925, 1.32161e15),
    (0.01, 0.3): (0.66822, 0.75669, -1.3692, 4.432, 3.64596e15),
    (0.001, 0.03): (0.94441, 0.96023, -0.3813, 2.676, 4.0936e14),
    (0.001, 0.1): (0.85308, 0.89871, -0.7165, 2.922, 1.10755e15),
}


@pytest.mark.slow
@pytest.mark.parametrize("row", WORN)
def test_values_of_another_program(row):
    """From map to map Sq varies by .0025 and Ssk by .05, hence one that begins with the same Ssk.

    K_n/(nominal area) then differs by 5 percent, as it does before the wear.
    """
    L, n = 1e-3, 256
    surface = fj.SelfAffine(Sq=1e-6, H=0.8, rolloff=L / 8, shortest=L / 32)
    z = np.asarray(fj.topography(surface, L, n, key=jax.random.key(71), periodic=True))
    assert (z**3).mean() / z.std() ** 3 == pytest.approx(-0.105, abs=0.02)

    def slope(z):
        waves = np.fft.fft2(z) * wavenumbers(z.shape) * DX * n / L
        return np.sqrt((np.abs(waves) ** 2).sum()) / z.size

    (share, S), (Sq, Sdq, Ssk, Sku, K_n) = row, WORN[row]
    worn = fj.run_in(z, L / n, MATERIAL, share * E * slope(z), S * z.std())
    assert float(worn.Sq) / z.std() == pytest.approx(Sq, abs=0.003)
    assert slope(worn.heights) / slope(z) == pytest.approx(Sdq, abs=0.008)
    assert float(worn.Ssk) == pytest.approx(Ssk, abs=0.03)
    assert float(worn.Sku) == pytest.approx(Sku, abs=0.1)
    assert float(worn.K_n) / L**2 == pytest.approx(K_n, rel=0.08)


# --- derivatives ---------------------------------------------------------------------------


def test_derivatives_in_both_modes():
    """To each height, E, dx, pressure and depth, of heights, pressure and statistics."""
    unit = 1e-6

    def solve(x):
        log_E, log_dx, log_pressure, log_depth = x[-4:]
        worn = fj.run_in(
            x[:-4].reshape(8, 9) * unit,
            DX * jnp.exp(log_dx),
            fj.Material(E * jnp.exp(log_E), 0.3, 3.55e8, 9.94e8),
            PRESSURE * jnp.exp(log_pressure),
            3e-8 * jnp.exp(log_depth),
            steps=4,
            rtol=1e-12,
        )
        shape = jnp.stack([worn.Sq / unit, worn.Ssk, worn.Sku])
        return jnp.concatenate([worn.heights.ravel() / unit, worn.pressure.ravel() / 1e8, shape])

    x = jnp.asarray(np.append(rough((8, 9)).ravel() / unit, np.zeros(4)))
    worn, forward, reverse = jax.jit(lambda x: both_modes(solve, x))(x)
    assert 0.05 < (worn[72:144] > 0).mean() < 0.95
    np.testing.assert_allclose(forward, reverse, atol=1e-9)
    value = jax.jit(solve)
    for i in [*range(0, 72, 7), 72, 73, 74, 75]:
        step = jnp.zeros_like(x).at[i].set(1e-5)
        slope = (value(x + step) - value(x - step)) / 2e-5
        np.testing.assert_allclose(forward[:, i], slope, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("argument", [0, 1, 2])
def test_derivative_by_one_argument_alone(argument):
    def corner(z, pressure, depth):
        worn = fj.run_in(z, DX, MATERIAL, pressure, depth, steps=2)
        return worn.heights[0, 0] / 1e-6 + worn.pressure.max() / 1e8

    x = jnp.asarray(ROUGH), jnp.asarray(PRESSURE), jnp.asarray(0.1 * SQ)
    reverse, forward = (mode(corner, argument)(*x) for mode in (jax.grad, jax.jacfwd))
    assert reverse.any()
    np.testing.assert_allclose(reverse, forward, rtol=1e-6, atol=1e-6 * abs(forward).max())


def test_derivative_of_the_stiffness_by_the_depth():
    """Wear makes contact stiffer; a map of few points moves in jumps, so over a wide step."""
    surface = fj.SelfAffine(1e-6, 0.8, rolloff=1e-3 / 4, shortest=1e-3 / 8)
    z = fj.topography(surface, 1e-3, 64, key=jax.random.key(1), periodic=True)

    def log_K_n(log_depth):
        return jnp.log(fj.run_in(z, 1e-3 / 64, MATERIAL, 1e7, jnp.exp(log_depth), steps=2).K_n)

    at, step = jnp.log(1e-7), 0.3
    value, slope = jax.jit(jax.value_and_grad(log_K_n))(at)
    wide = (log_K_n(at + step) - log_K_n(at - step)) / (2 * step)
    assert np.isfinite(value) and float(slope) == pytest.approx(float(wide), rel=0.2)


def test_no_second_derivatives():
    def Sq(depth):
        return fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, depth, steps=1).Sq

    with pytest.raises(TypeError, match="first derivatives only"):
        jax.jacfwd(jax.jacfwd(Sq))(0.1 * SQ)


# --- extremes ------------------------------------------------------------------------------


@pytest.mark.parametrize("pressure", [1e2, 1e5, 1e11])
@pytest.mark.parametrize("share", [1e-6, 10, 1e6])
def test_any_depth_and_pressure(pressure, share):
    worn = fj.run_in(ROUGH, DX, MATERIAL, pressure, share * SQ)
    assert worn.result == fj.BoundaryElementResult.converged
    assert (ROUGH - worn.heights).mean() == pytest.approx(share * SQ, rel=1e-9)
    all_hills_go = share > 1 and pressure < 1e6
    assert float(worn.Sq) < (1e-6 if all_hills_go else 1) * SQ


def test_a_flat_surface_stays_flat():
    worn = fj.run_in(np.full((8, 9), 0.1), DX, MATERIAL, PRESSURE, 1e-6)
    np.testing.assert_allclose(worn.heights, 0.1 - 1e-6, rtol=1e-15)
    np.testing.assert_allclose(worn.pressure, PRESSURE, rtol=1e-14)
    assert float(worn.K_n) == np.inf


def test_float32():
    material = fj.Material(*(jnp.float32(x) for x in (E, 0.3, 3.55e8, 9.94e8)))
    half = [jnp.float32(x) for x in (ROUGH, DX, PRESSURE, 0.1 * SQ)]
    worn = fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, 0.1 * SQ)
    single = fj.run_in(half[0], half[1], material, half[2], half[3])
    assert single.heights.dtype == single.pressure.dtype == single.K_n.dtype == jnp.float32
    np.testing.assert_allclose(single.heights, worn.heights, rtol=0, atol=1e-4 * SQ)
    assert float(single.K_n) == pytest.approx(float(worn.K_n), rel=1e-3)


def test_many_depths_at_once():
    depths = SQ * jnp.array([0.01, 0.1, 1.0])
    many = jax.vmap(lambda depth: fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, depth))(depths)
    for heights, depth in zip(many.heights, depths, strict=True):
        one = fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, depth)
        np.testing.assert_allclose(heights, one.heights, rtol=0, atol=1e-8 * SQ)


def test_what_does_not_converge_says_so():
    def wear(**options):
        return fj.run_in(ROUGH, DX, MATERIAL, PRESSURE, 0.1 * SQ, **options)

    assert wear(max_steps=1, throw=False).result == fj.BoundaryElementResult.not_converged
    with pytest.raises(RuntimeError, match=r"^boundary elements did not converge"):
        wear(max_steps=1)
    assert np.isnan(jax.jit(lambda: wear(max_steps=1).heights)()).all()


test_refusals = refusals(
    [
        ({"z": np.zeros(8)}, r"^z must have shape \(nx, ny\), got \(8,\)$"),
        ({"z": np.full((8, 8), np.nan)}, r"^z must be finite, got nan$"),
        ({"dx": 0}, r"^dx must be above 0, got 0\.0$"),
        ({"material": 1.0}, r"^material must be a Material, got 1\.0"),
        ({"pressure": 0}, r"^pressure must be above 0, got 0\.0$"),
        ({"pressure": np.ones(2)}, r"^pressure must be a single number, got shape \(2,\)$"),
        ({"depth": -1.0}, r"^depth must be at least 0, got -1\.0$"),
        ({"steps": 0}, r"^steps must be a whole number of at least 1, got 0$"),
        ({"rtol": 1}, r"^rtol must be above 0 and below 1, got 1\.0$"),
        ({"max_steps": 0}, r"^max_steps must be a whole number of at least 1, got 0$"),
        ({"throw": 1}, "^throw must be True or False, got 1$"),
    ],
    lambda change: fj.run_in(
        **(dict(z=ROUGH, dx=DX, material=MATERIAL, pressure=1e8, depth=1e-7) | change)
    ),
    kind=(ValueError, TypeError),
)


def test_lists_are_heights():
    listed, array = (
        fj.run_in(z, DX, MATERIAL, PRESSURE, 0.1 * SQ, steps=2) for z in (ROUGH.tolist(), ROUGH)
    )
    np.testing.assert_array_equal(listed.heights, array.heights)
