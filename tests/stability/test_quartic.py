"""The closed form of the quartic against 40-digit roots, and its derivatives."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from fractaljax._mechanism.oscillator import Linearised
from fractaljax._stability.quartic import resolutions, rightmost_root, roots
from quartics import (
    EPS,
    FAMILIES,
    condition,
    exact_roots,
    family,
    many_rightmost,
    many_roots,
    stacked,
)
from tools import both_modes

many_resolutions = jax.jit(jax.vmap(resolutions))


def check(columns):
    """Real parts within their resolution but for 2 in 1000, the largest to 1e-12 or its condition.

    1e-12 of the largest root, and of omega but for a few slow roots beside fast ones. Frequencies
    are right to LAPACK's standard but for 1 in 100, beside coalescing roots.
    """
    lin = stacked(columns)
    found = np.asarray(many_roots(lin))
    bounds = np.asarray(many_resolutions(lin, jnp.asarray(found)))
    rightmost, real = np.real(np.asarray(many_rightmost(lin))), np.real(found)
    # Two programs, rounded apart by no more than either may be from the truth.
    assert (np.abs(rightmost - real[:, 0]) <= 40 * bounds[:, 0]).all()
    assert (np.diff(real, axis=1) <= 0).all()
    beside_omega, share, right = [], [], []
    for own, bound, growth, *x in zip(found, bounds, rightmost, *columns, strict=True):
        exact = exact_roots(*x)
        missed, largest = abs(float(growth - exact[0].real)), float(max(map(abs, exact)))
        unavoidable = min(4 * EPS * condition(exact[0], *x), 4 * np.sqrt(EPS) * largest)
        assert missed <= max(1e-12 * largest, unavoidable), x
        beside_omega.append(missed <= max(1e-12 * np.sqrt(x[0] + x[1]), unavoidable))
        for s, room in zip(own.tolist(), bound.tolist(), strict=True):
            nearest = min(exact, key=lambda z: abs(z - s))
            exact.remove(nearest)
            share.append(float(abs(nearest.real - s.real)) / room if room else 0.0)
            assert share[-1] <= 20, x
            # Frequencies by LAPACK's standard, or to half the digits where roots coalesce.
            most = max(1e-12 * largest, 4 * EPS * condition(nearest, *x), room)
            right.append(bool(abs(nearest - s) <= most))
    assert np.mean(beside_omega) > 0.985
    assert np.mean(np.array(share) <= 1) >= 0.998 and np.mean(right) >= 0.99


@pytest.mark.parametrize("name", FAMILIES)
def test_roots_are_exact(name):
    check(family(name, 40))


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_roots_of_many_are_exact(name):
    check(family(name, 500))


OMEGA = 4096.0
MULTIPLE = [
    ((OMEGA**2, OMEGA**2, 2 * OMEGA, 2 * OMEGA, 0.0), -OMEGA),  # one quadruple root
    ((OMEGA**2, OMEGA**2, 2 * OMEGA, 4 * OMEGA, 0.0), -OMEGA * (2 - np.sqrt(3))),
    ((OMEGA**2, 16 * OMEGA**2, 2 * OMEGA, 8 * OMEGA, 0.0), -OMEGA),  # two double roots
    ((OMEGA**2, OMEGA**2, 0.5 * OMEGA, 0.5 * OMEGA, 0.0), -OMEGA / 4),  # one complex pair
    ((OMEGA**2, OMEGA**2, 0.0, 0.0, 0.0), 0.0),
    ((OMEGA**2, 4 * OMEGA**2, 0.5 * OMEGA, 0.5 * OMEGA, 0.0), -OMEGA / 4),
]


def test_multiple_roots_and_opposite_heavy_damping_are_exact():
    """Critical damping, equal modes, and all four roots in one point: not one digit lost."""
    found = many_rightmost(stacked(np.transpose([column for column, _ in MULTIPLE])))
    np.testing.assert_allclose(found.real, [growth for _, growth in MULTIPLE], rtol=4 * EPS)
    # One direction driven, the other damped, both far beyond critical.
    a, b, c_1, c_2, g = family("overdamped", 40)
    columns = a, b, -10 * c_1, 10 * c_2, g
    growth = np.real(many_rightmost(stacked(columns)))
    for own, *x in zip(growth, *columns, strict=True):
        exact = exact_roots(*x)
        assert abs(float(own) - exact[0].real) <= 1e-10 * max(map(abs, exact))


def test_zero_damping_grows_only_by_flutter():
    """Without damping: exactly 0 when stable; else sqrt((sqrt(4(ab+g)) - a - b)/4)."""
    a, b, c_1, c_2, g = family("undamped", 5000)
    ours = np.real(many_rightmost(stacked((a, b, c_1, c_2, g))))
    stable = np.abs(a - b) > 2 * np.sqrt(g) * (1 + 1e-12)
    flutter = np.abs(a - b) < 2 * np.sqrt(g) * (1 - 1e-3)
    assert min(stable.sum(), flutter.sum()) > 500
    assert (ours[stable] == 0).all()
    square = (4 * g - (a - b) ** 2) / (4 * (2 * np.sqrt(a * b + g) + a + b))
    np.testing.assert_allclose(ours[flutter], np.sqrt(square[flutter]), rtol=1e-12)


def test_float32():
    """float32 in, float32 out, and nothing leaves its range."""
    columns = [np.float32(x) for x in family("light", 500)]
    ours, exact = (many_rightmost(stacked(x)) for x in (columns, [np.float64(x) for x in columns]))
    assert ours.dtype == jnp.complex64
    missed = np.abs(np.real(ours - exact)) / np.sqrt(columns[0] + columns[1])
    assert np.quantile(missed, 0.99) < 1e-6
    assert missed.max() < 1e-3


def growth(x):
    return rightmost_root(Linearised(*x)).real


def parts(x):
    s = roots(Linearised(*x))
    return jnp.stack([s.real, s.imag])


growth_slopes = jax.jit(lambda x: both_modes(growth, x)[1:])
parts_slopes = jax.jit(lambda x: both_modes(parts, x)[1:])


def place(s):
    """Of a root among its conjugate and the others."""
    return round(float(s.real), 9), float(s.imag)


def exact_tangents(x):
    """d(root)/dx of every root by differences in 40 digits, (4, 5)."""
    h, columns = mp.mpf(10) ** -15, []
    for i in range(5):
        up, down = ([v + k * h * (i == j) for j, v in enumerate(map(mp.mpf, x))] for k in (1, -1))
        ends = [sorted(exact_roots(*y), key=place) for y in (up, down)]
        columns.append([complex((p - q) / (2 * h)) for p, q in zip(*ends, strict=True)])
    return np.transpose(columns)


@pytest.mark.parametrize(
    "x", [(5.0, 3.0, 0.01, 0.04, 0.5), (5.0, 3.0, 0.1, -0.2, 2.0), (5.0, 3.0, 6.0, 9.0, 0.7)]
)
def test_derivatives_of_every_root(x):
    """By every coefficient, and of the root that `rightmost_root` picks."""
    exact = exact_tangents(x)
    ours = np.asarray(roots(Linearised(*x)))
    order = sorted(range(4), key=lambda i: place(ours[i]))
    for slopes, fastest in zip(
        parts_slopes(jnp.array(x)), growth_slopes(jnp.array(x)), strict=True
    ):
        real, imag = np.asarray(slopes)[:, order]
        np.testing.assert_allclose(real + 1j * imag, exact, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(fastest, slopes[0, 0], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(
    "x",
    [(5.0, 3.0, 0.0, 0.0, 1.0), (3.0, 5.0, 0.0, 0.0, 1.0), (4.0, 4.0, 4.0, 4.0, 0.0)],
    ids=["exceptional", "exceptional, swapped", "quadruple"],
)
def test_gradients_at_exact_coalescence_are_finite(x):
    """a - b = 2 sqrt(g) in representable numbers: the true derivative is infinite."""
    for slopes in (*growth_slopes(jnp.array(x)), *parts_slopes(jnp.array(x))):
        assert jnp.isfinite(slopes).all()


def test_gradients_grow_without_bound_beside_coalescence():
    """Just inside flutter, lambda^2 = (-(a + b) + sqrt((a - b)^2 - 4 g))/2 with a = 5, b = 3."""

    def exact(g):
        return mp.sqrt((-8 + mp.sqrt(4 - 4 * g)) / 2).real

    for off in (1e-4, 1e-8):
        h = mp.mpf(off) / 10**12
        wanted = (exact(1 + mp.mpf(off) + h) - exact(1 + mp.mpf(off) - h)) / (2 * h)
        for slopes in growth_slopes(jnp.array([5.0, 3.0, 0.0, 0.0, 1 + off])):
            found = float(slopes[4])
            assert found == pytest.approx(float(wanted), rel=10 * EPS / off)
            assert found > 0.05 / np.sqrt(off)


@pytest.mark.parametrize(("a", "b"), [(2.0, 3.0), (3.0, 2.0)])
def test_gradients_where_modes_cross(a, b):
    """Uncoupled modes of equal damping decay alike: growth = -c/2, that of either mode."""
    for slopes in growth_slopes(jnp.array([a, b, 0.2, 0.2, 0.0])):
        gradient = slopes.tolist()
        np.testing.assert_allclose(gradient[:2] + gradient[4:], 0, atol=1e-15)
        np.testing.assert_allclose(sorted(gradient[2:4]), [-0.5, 0], atol=1e-15)
