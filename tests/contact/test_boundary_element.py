"""Boundary elements beside closed forms and dense matrices; derivatives, limits, refusals."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import fractaljax as fj
from synthetic import rough
from tools import both_modes, refusals

MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
E, H = float(MATERIAL.E), float(MATERIAL.H)
DX = 1e-5
KINDS = fj.BoundaryElementResult
tight = partial(fj.boundary_element, rtol=1e-12)


def load(heights, fraction):
    """P [N] of a mean pressure that is a fraction of H."""
    return fraction * H * heights.size * DX**2


# --- closed forms --------------------------------------------------------------------------


def hertz_errors(n):
    """Relative errors of area, peak pressure, K_n and mean gap of a ball in a cell of side 1 mm.

    Its images and the mean pressure lower the ball by M P/(pi E L), and flatten it by
    P S/(2 pi E L^3). M = 3.900265 is the energy of a square lattice of charges in a uniform
    background (Bonsall and Maradudin, 1977), S its sum of 1/r^3, 4 zeta(3/2) beta(3/2).
    """
    L, R, a = 1e-3, 0.1, 1.2e-4  # R of the ball as its images leave it
    x = (np.arange(n) + 0.5) / n * L - L / 2
    P, images = 4 * E * a**3 / (3 * R), 3.900264920 / np.pi / (E * L)
    h = -np.add.outer(x**2, x**2) / 2 * (1 / R - P * 9.0336217 / (2 * np.pi * E * L**3))
    expected = {
        "area": np.pi * a**2,
        "peak": 3 * P / (2 * np.pi * a**2),
        "K_n": 1 / (1 / (2 * E * a) - images),
        "mean_gap": -h.mean() - a**2 / R + images * P,
    }
    s = fj.boundary_element(h, L / n, MATERIAL, P)
    computed = {"area": s.area, "peak": s.pressure.max(), "K_n": s.K_n, "mean_gap": s.mean_gap}
    return {name: abs(float(computed[name]) / expected[name] - 1) for name in expected}


def test_hertz():
    coarse, fine = hertz_errors(32), hertz_errors(128)
    assert fine["area"] < 0.02 and fine["K_n"] < 0.02
    assert fine["peak"] < 2e-3 and fine["mean_gap"] < 2e-4
    assert all(fine[name] < coarse[name] / 3 for name in ("area", "K_n", "peak"))


def wave(n, share):
    """Heights of one wave along x, and the load at a share of what closes all gaps."""
    L, height = n * DX, 1e-3 * n * DX
    closes = np.pi * E * height / L  # Pa
    h = height * np.cos(2 * np.pi * (np.arange(n) + 0.5) / n)[:, None] * np.ones(2)
    return h, share * closes * h.size * DX**2, closes, height


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_westergaard(share):
    """p_max = 2 p/sin(psi), sin^2(psi) = p/p*; K_n = pi E A/(lambda ln(p*/p)); the mean gap."""
    n = 512
    h, P, closes, height = wave(n, share)
    s = fj.boundary_element(h, DX, MATERIAL, P)
    touching = 2 / np.pi * np.arcsin(np.sqrt(share))
    assert float(s.area) / (h.size * DX**2) == pytest.approx(touching, abs=2 / n)
    assert float(s.pressure.max()) == pytest.approx(2 * closes * np.sqrt(share), rel=3e-3)
    K_n = np.pi * E * h.size * DX**2 / (n * DX * np.log(1 / share))
    assert float(s.K_n) == pytest.approx(K_n, rel=0.02)
    mean_gap = height * (1 - share + share * np.log(share))
    assert float(s.mean_gap) == pytest.approx(mean_gap, rel=2e-3, abs=1e-4 * height)


@pytest.mark.parametrize("shape", [(16, 16), (9, 14)])
def test_full_contact_is_linear(shape):
    """p = mean + E |q| h/2; the gap is closed and K_n infinite, and neither is NaN."""
    x, y = (2 * np.pi * np.arange(n) / n for n in shape)
    h = 1e-8 * np.cos(2 * x[:, None] + 3 * y) + 4e-6
    q = np.hypot(2 * 2 * np.pi / shape[0], 3 * 2 * np.pi / shape[1]) / DX
    P = load(h, 0.9)
    s = tight(h, DX, MATERIAL, P)
    np.testing.assert_allclose(s.pressure, 0.9 * H + E * q / 2 * (h - 4e-6), rtol=1e-12)
    assert (s.K_n, s.mean_gap) == (np.inf, pytest.approx(0, abs=1e-20))
    assert float(s.area) == pytest.approx(h.size * DX**2, rel=1e-14) and not s.gap.any()


# --- dense matrices ------------------------------------------------------------------------


def dense(shape, aspect=1.0):
    """S [m/Pa], wave by wave, of the displacement at a point under the pressure at another."""
    x, y = (part.ravel() for part in np.indices(shape))
    S = np.zeros((x.size, x.size))
    for k in range(shape[0]):
        for m in range(shape[1]):
            qx, qy = (
                2 * np.pi * (i if 2 * i <= n else i - n) / n
                for i, n in zip((k, m), shape, strict=True)
            )
            if k or m:
                phase = qx * np.subtract.outer(x, x) + qy * np.subtract.outer(y, y)
                S += 2 / np.hypot(qx, qy / aspect) * np.cos(phase) / x.size
    return S * DX / E


def bordered(S, inside, right, total):
    """(p, g) of S p + g = right inside, of the sum `total` inside."""
    k = inside.sum()
    A = np.block([[S[np.ix_(inside, inside)] * E / DX, np.ones((k, 1))], [np.ones(k), 0]])
    solution = np.linalg.solve(A, np.append(right[inside], total * DX / E))
    return solution[:-1] * E / DX, solution[-1]


def by_active_set(S, h, total):
    """(p, g): points that pull leave the contact, points that overlap join it."""
    inside = np.ones(h.size, bool)
    for _ in range(100):
        p = np.zeros(h.size)
        # In units in which displacement and pressure are alike.
        p[inside], g = bordered(S, inside, h * 1.0, total * 1.0)
        gap = S @ p + g - h
        following = np.where(inside, p > 0, gap < 0)
        if (following == inside).all():
            return p, g
        inside = following
    raise AssertionError("the active set does not settle")


@pytest.mark.parametrize("shape, aspect", [((12, 12), 1.0), ((7, 16), 1.0), ((7, 16), 0.3)])
@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.8])
def test_dense_active_set(shape, aspect, fraction):
    h, cell = rough(shape), aspect * DX**2
    S, P = dense(shape, aspect), load(h, fraction) * aspect
    s = tight(h, DX, MATERIAL, P, aspect=aspect)
    flat = (h - h.mean()).ravel()
    p, g = by_active_set(S, flat, P / cell)
    np.testing.assert_allclose(s.pressure.ravel(), p, rtol=1e-9, atol=1e-9 * p.max())
    assert float(s.mean_gap) == pytest.approx(g, rel=1e-9)
    gap = np.where(p > 0, 0, S @ p + g - flat)
    np.testing.assert_allclose(s.gap.ravel(), gap, atol=1e-9 * h.std())
    assert 0 < (p > 0).mean() < 1
    _, sinks = bordered(S, p > 0, np.zeros(h.size), 1 / cell)
    assert float(s.K_n) == pytest.approx(-1 / sinks, rel=1e-8)
    assert float(s.area) == pytest.approx((p > 0).sum() * cell)
    # The conditions, and the mean gap is the mean of the gap.
    assert (s.pressure >= 0).all() and (s.gap >= 0).all() and not (s.pressure * s.gap).any()
    assert float(s.pressure.sum()) * cell == pytest.approx(P, rel=1e-13)
    assert float(s.gap.mean()) == pytest.approx(float(s.mean_gap), rel=1e-9)


@pytest.mark.parametrize("plastic", [False, True])
def test_rectangular_cells_on_either_side(plastic):
    """x and y change places: the same contact, with its derivatives."""
    aspect, P = 2.5, load(ROUGH, 0.3) * 2.5
    s = tight(ROUGH, DX, MATERIAL, P, plastic=plastic, aspect=aspect)
    other = (ROUGH.T, DX * aspect, MATERIAL)
    turned = tight(*other, P, plastic=plastic, aspect=1 / aspect)
    np.testing.assert_allclose(turned.pressure.T, s.pressure, rtol=1e-8, atol=1e-9 * H)
    for name in ("K_n", "mean_gap", "area"):
        assert float(getattr(turned, name)) == pytest.approx(float(getattr(s, name)), rel=1e-8)
    assert float(s.K_n) != pytest.approx(float(tight(ROUGH, DX, MATERIAL, P).K_n), rel=0.1)
    if plastic:
        return
    slope = jax.grad(lambda P: tight(ROUGH, DX, MATERIAL, P, aspect=aspect).K_n)(P)
    turned_slope = jax.grad(lambda P: tight(*other, P, aspect=1 / aspect).K_n)(P)
    assert float(turned_slope) == pytest.approx(float(slope), rel=1e-6)


# --- yielding ------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.9])
def test_plastic_beside_a_quadratic_program(fraction):
    """SLSQP finds which points yield; dense equations their pressures."""
    shape = (6, 7)
    h = rough(shape)
    S, P = dense(shape) * E / DX, load(h, fraction)
    flat, mean, limit = (h - h.mean()).ravel() / DX, fraction * H / E, H / E
    scale = np.abs(flat).max()
    optimum = minimize(
        lambda p: ((p @ S @ p / 2 - flat @ p) / scale**2, (S @ p - flat) / scale**2),
        np.full(h.size, mean),
        jac=True,
        bounds=[(0, limit)] * h.size,
        constraints={
            "type": "eq",
            "fun": lambda p: np.array([(p.mean() - mean) / mean]),
            "jac": lambda p: np.full((1, p.size), 1 / p.size / mean),
        },
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 1000},
    )
    yields = optimum.x > limit * (1 - 1e-5)
    inside = (optimum.x > limit * 1e-5) & ~yields
    p = np.where(yields, limit, 0.0)
    right, total = (flat - S @ p) * DX, P / DX**2 - H * yields.sum()
    p[inside], g = bordered(S * DX / E, inside, right, total)
    p[inside] *= E**0 / E
    s = tight(h, DX, MATERIAL, P, plastic=True)
    assert yields.any() and inside.any()
    np.testing.assert_allclose(s.pressure.ravel() / E, p, rtol=1e-9, atol=1e-9 * limit)
    gap = S @ p + g / DX - flat
    assert (gap[p == 0] >= 0).all() and (gap[yields] <= 0).all()
    assert float(s.mean_gap) == pytest.approx(np.maximum(gap, 0).mean() * DX, rel=1e-8)
    assert float(s.area) == pytest.approx((p > 0).sum() * DX**2)
    assert float(s.pressure.sum()) * DX**2 == pytest.approx(P, rel=1e-12)
    assert float(s.pressure.max()) <= H * (1 + 1e-15) and (s.gap >= 0).all()


def test_plastic_is_elastic_under_a_small_load_and_ends_at_the_hardness():
    h = rough((12, 12))
    small, full = load(h, 1e-9), load(h, 1.0001)
    elastic, plastic = (
        fj.boundary_element(h, DX, MATERIAL, small, plastic=way) for way in (False, True)
    )
    for a, b in zip(jax.tree.leaves(elastic), jax.tree.leaves(plastic), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-18)
    s = fj.boundary_element(h, DX, MATERIAL, 0.99 * full, plastic=True)
    assert float(s.pressure.mean()) == pytest.approx(0.99 * 1.0001 * H)
    s = fj.boundary_element(h, DX, MATERIAL, full, plastic=True, throw=False)
    assert s.result == KINDS.too_soft
    with pytest.raises(RuntimeError, match=r"^the load exceeds what the surface carries"):
        fj.boundary_element(h, DX, MATERIAL, full, plastic=True)


@pytest.mark.parametrize("seed", range(4))
def test_plastic_surfaces_of_any_roughness_converge(seed):
    """White noise of steep slopes, which yields at nearly every contact."""
    h = rough((16, 16), seed, rms=10.0 ** (-8 + seed), slope=0.0)
    for fraction in (1e-6, 0.1, 0.5, 0.99):
        s = fj.boundary_element(h, DX, MATERIAL, load(h, fraction), plastic=True)
        assert float(s.pressure.mean()) == pytest.approx(fraction * H, rel=1e-12)
        assert float(s.area) >= fraction * h.size * DX**2 * (1 - 1e-12)


# --- derivatives ---------------------------------------------------------------------------

ROUGH = rough((10, 12))
WEIGHTS = np.random.default_rng(5).normal(size=(2, *ROUGH.shape))
UNITS = np.array([ROUGH.std(), DX, E, load(ROUGH, 0.2)])


def mixed(x):
    """Pressure, gap and mean gap of heights, dx, E and P in units of their own: three numbers."""
    heights, dx, modulus, P = x[:-3].reshape(ROUGH.shape) * UNITS[0], *(x[-3:] * UNITS[1:])
    s = tight(heights, dx, fj.Material(modulus, 0.3, 3.55e8, H), P)
    # Weights of zero mean would leave the load out.
    return jnp.stack(
        [
            jnp.sum(jnp.asarray(WEIGHTS[0]) * s.pressure) / H,
            jnp.sum(jnp.asarray(WEIGHTS[1]) * s.gap) / UNITS[0],
            s.mean_gap / UNITS[0],
        ]
    )


@pytest.mark.slow
def test_derivatives_of_pressure_gap_and_stiffness():
    """While no point joins or leaves they are linear in heights and load."""
    x = np.append(ROUGH.ravel() / UNITS[0], np.ones(3))
    _, forward, reverse = jax.jit(lambda x: both_modes(mixed, x))(jnp.asarray(x))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    value = jax.jit(mixed)
    for i in [*range(0, 120, 17), 120, 121, 122]:
        step = np.zeros_like(x)
        step[i] = 1e-5
        slope = (value(x + step) - value(x - step)) / 2e-5
        np.testing.assert_allclose(forward[:, i], slope, rtol=1e-6, atol=1e-6)
    # Westergaard: dln K_n/dln P = 1/ln(p*/p) = -dln K_n/dln(height), to a grid point in 20.
    h, P, *_ = wave(4096, 0.3)

    def log_K_n(x):
        log_height, log_P, log_E = x
        material = fj.Material(E * jnp.exp(log_E), 0.3, 3.55e8, H)
        heights = h * jnp.exp(log_height)
        return jnp.log(fj.boundary_element(heights, DX, material, P * jnp.exp(log_P)).K_n)

    expected = 1 / np.log(1 / 0.3)
    _, *slopes = jax.jit(lambda x: both_modes(log_K_n, x))(jnp.zeros(3))
    for by_height, by_P, by_E in slopes:
        assert float(by_P) == pytest.approx(expected, rel=0.04)
        assert float(by_height) == pytest.approx(-expected, rel=0.04)
        assert float(by_P + by_E) == pytest.approx(1, rel=1e-9)  # K_n/E depends on P/E alone


@pytest.mark.parametrize("argument", [0, 1])
def test_derivative_of_the_pressure_by_one_argument_alone(argument):
    def highest(heights, P):
        return tight(heights, DX, MATERIAL, P).pressure.max() / H

    x = jnp.asarray(ROUGH), jnp.asarray(load(ROUGH, 0.3))
    reverse, forward = (mode(highest, argument)(*x) for mode in (jax.grad, jax.jacfwd))
    assert reverse.any()
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * abs(forward).max())


@pytest.mark.slow
def test_derivatives_of_a_surface_and_many_seeds():
    """d mean gap and d ln K_n to D and ln G; `vmap` over seeds equals one by one."""
    L, n = 1e-3, 16

    def solve(x, key):
        surface = fj.Surface(x[0], jnp.exp(x[1]), 1.5)
        s = tight(fj.topography(surface, L, n, key=key), L / n, MATERIAL, 5.0)
        return jnp.stack([s.mean_gap * 1e6, jnp.log(s.K_n)])

    # Two contacts in the last: by symmetry their first guess leaves nothing but rounding.
    x, keys = jnp.array([2.4, np.log(1e-9)]), jax.random.split(jax.random.key(3), 3)
    value, slope = (jax.jit(jax.vmap(f, (None, 0))) for f in (solve, jax.jacrev(solve)))
    many = slope(x, keys)
    for i, step in enumerate(1e-5 * np.eye(2)):
        up, down = value(x + step, keys), value(x - step, keys)
        np.testing.assert_allclose(many[:, 0, i], (up - down)[:, 0] / 2e-5, rtol=1e-6)
    assert np.isfinite(many).all()
    np.testing.assert_allclose(value(x, keys)[2], jax.jit(solve)(x, keys[2]), rtol=1e-10)
    K_n = np.exp(value(x, keys)[:, 1])
    assert (K_n < 2e7).all() and np.ptp(K_n) > 1e6


def test_what_has_no_derivative_says_so():
    def K_n(P, plastic):
        return fj.boundary_element(ROUGH, DX, MATERIAL, P, plastic=plastic).K_n

    for mode in (jax.grad, jax.jacfwd):
        with pytest.raises(TypeError, match=r"^boundary_element with plastic=True cannot be"):
            mode(K_n)(1.0, True)
        for outer in (jax.grad, jax.jacfwd):
            with pytest.raises(TypeError, match=r"^boundary_element has first derivatives only"):
                outer(mode(K_n))(1.0, False)


# --- extremes ------------------------------------------------------------------------------


def test_one_point_and_the_smallest_load():
    h = np.zeros((9, 6))
    h[4, 2] = 1e-6
    s = fj.boundary_element(h, DX, MATERIAL, 1e-12)
    assert float(s.area) == pytest.approx(DX**2)
    assert float(s.pressure[4, 2]) == pytest.approx(1e-12 / DX**2, rel=1e-15)
    # The point sinks in by S's diagonal, so K_n is its inverse.
    assert float(s.K_n) == pytest.approx(DX**2 / dense((9, 6))[0, 0], rel=1e-9)
    assert float(s.mean_gap) == pytest.approx(1e-6 * (1 - 1 / h.size), rel=1e-9)


@pytest.mark.parametrize("plastic", [False, True])
def test_a_flat_surface(plastic):
    s = fj.boundary_element(np.full((8, 9), 0.1), DX, MATERIAL, 1.0, plastic=plastic)
    assert (s.K_n, s.mean_gap) == (np.inf, 0) and not s.gap.any()
    np.testing.assert_allclose(s.pressure, 1 / (72 * DX**2), rtol=1e-14)


def test_lists_are_heights():
    P = load(ROUGH, 0.2)
    listed, array = (fj.boundary_element(z, DX, MATERIAL, P) for z in (ROUGH.tolist(), ROUGH))
    assert float(listed.K_n) == float(array.K_n)

    # Also of traced numbers.
    def of_one(x):
        rows: Any = [[x, 0.0], [0.0, 0.0]]
        return fj.boundary_element(rows, DX, MATERIAL, 1e-3).mean_gap

    traced = jax.jit(of_one)
    spike = np.array([[1e-6, 0.0], [0.0, 0.0]])
    gap = fj.boundary_element(spike, DX, MATERIAL, 1e-3).mean_gap
    assert float(traced(1e-6)) == pytest.approx(float(gap), rel=1e-9)


@pytest.mark.parametrize("plastic", [False, True])
@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_any_units(unit, plastic):
    """In other units of length the same contact, with a distant mean height."""
    P = load(ROUGH, 0.2)
    s = tight(ROUGH, DX, MATERIAL, P, plastic=plastic)
    other = tight(ROUGH * unit, DX * unit, MATERIAL, P * unit**2, plastic=plastic)
    np.testing.assert_allclose(other.pressure, s.pressure, rtol=1e-8, atol=1e-9 * H)
    assert float(other.K_n / s.K_n) == pytest.approx(unit, rel=1e-9)
    assert float(other.mean_gap / s.mean_gap) == pytest.approx(unit, rel=1e-9)


def test_float32():
    P = load(ROUGH, 0.2)
    material = fj.Material(*(jnp.float32(x) for x in (E, 0.3, 3.55e8, H)))
    for plastic in (False, True):
        s = fj.boundary_element(ROUGH, DX, MATERIAL, P, plastic=plastic)
        half = [jnp.float32(x) for x in (ROUGH, DX, P)]
        single = fj.boundary_element(half[0], half[1], material, half[2], plastic=plastic)
        assert single.K_n.dtype == single.pressure.dtype == jnp.float32
        np.testing.assert_allclose(single.pressure, s.pressure, atol=1e-4 * float(s.pressure.max()))
        assert float(single.K_n) == pytest.approx(float(s.K_n), rel=1e-4)
        assert float(single.mean_gap) == pytest.approx(float(s.mean_gap), rel=1e-4)

    mixed = fj.boundary_element(half[0], DX, MATERIAL, half[2])  # the wider of two precisions
    assert mixed.pressure.dtype == mixed.K_n.dtype == jnp.float64


@pytest.mark.parametrize("plastic", [False, True])
def test_what_does_not_converge_says_so(plastic):
    call = partial(fj.boundary_element, ROUGH, DX, MATERIAL, load(ROUGH, 0.3), plastic=plastic)
    assert call(rtol=1e-30, throw=False).result == KINDS.not_converged
    assert call(max_steps=2, throw=False).result == KINDS.not_converged
    with pytest.raises(RuntimeError, match=r"^boundary elements did not converge: rtol may be too"):
        call(rtol=1e-30)


test_refusals = refusals(
    [
        ({"heights": np.zeros(8)}, r"^heights must have shape \(nx, ny\), got \(8,\)$"),
        ({"heights": np.zeros((1, 8))}, r"^heights must have shape \(nx, ny\).*\(1, 8\)$"),
        (
            {"heights": np.where(ROUGH > 1e-7, np.nan, ROUGH)},
            r"^heights must be finite, got \d+ NaN",
        ),
        (
            {"heights": [[1.0], [1.0, 2.0]]},
            r"^heights must be rows of as many numbers, got \[\[1.0",
        ),
        ({"dx": 0}, r"^dx must be above 0, got 0\.0$"),
        ({"P": -1.0}, r"^P must be above 0, got -1\.0$"),
        ({"P": np.ones(2)}, r"^P must be a single number, got shape \(2,\)$"),
        ({"rtol": 0}, r"^rtol must be above 0 and below 1, got 0\.0$"),
        ({"max_steps": 0}, r"^max_steps must be a whole number of at least 1, got 0$"),
        ({"plastic": 1}, "^plastic must be True or False, got 1$"),
        ({"aspect": 0.0}, r"^aspect must be above 0, got 0\.0$"),
    ],
    lambda change: fj.boundary_element(
        **(dict(heights=ROUGH, dx=DX, material=MATERIAL, P=1.0) | change)
    ),
    kind=(ValueError, TypeError),
)


@pytest.mark.slow
@pytest.mark.parametrize("plastic", [False, True])
def test_many_points(plastic):
    """512 x 512 points of a fractal surface meet the conditions to the default tolerance."""
    L, n = 1e-3, 512
    h = fj.topography(fj.Surface(2.4, 1e-9, 1.5), L, n, key=jax.random.key(0))
    s = fj.boundary_element(h, L / n, MATERIAL, 50.0, plastic=plastic)
    q = 2 * np.pi / L * np.hypot(*np.meshgrid(*[np.fft.fftfreq(n) * n] * 2))
    S = np.divide(2 / E, q, out=np.zeros_like(q), where=q > 0)
    p = np.asarray(s.pressure)
    gap = np.real(np.fft.ifft2(S * np.fft.fft2(p))) - h + h.mean()
    free = (p > 0) & (p < H * (1 - 1e-12) if plastic else True)
    gap -= gap[free].mean()
    rms = float(h.std())
    assert np.abs(gap[free]).max() < 2e-9 * rms and gap[p == 0].min() > -2e-9 * rms
    assert p.mean() * L**2 == pytest.approx(50, rel=1e-12)
    assert not plastic or gap[p >= H * (1 - 1e-12)].max() < 2e-9 * rms
