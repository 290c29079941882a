"""The margin against Hurwitz determinants and roots in 40 digits, its sign, and its smoothness."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.oscillator import Linearised
from fractaljax._stability.margin import least, margin_of
from quartics import (
    EPS,
    exact_least,
    exact_margin,
    log_uniform,
    many_margins,
    many_rightmost,
    stacked,
)
from structures import two_joints
from tools import DOCS, assert_same_picture, both_modes, load_script


def flat(a, b, c_1, c_2, g, shift):
    return margin_of(Linearised(a, b, c_1, c_2, g), shift)


BRAKE = fj.brake_scene()
HESSIAN = jax.jit(jax.hessian(lambda x: flat(*x)))
gradients = jax.jit(lambda x: both_modes(lambda x: flat(*x), x)[1:])


def systems(n, low=-5, high=-1, signs=(1,), coalescing=False, seed=0):
    """Columns a, b, c_1, c_2, g: damping of 10^low..10^high beside a and b of 0.1..10."""
    rng = np.random.default_rng(seed)
    a, b = log_uniform(rng, -1, 1, n), log_uniform(rng, -1, 1, n)
    c_1, c_2 = (log_uniform(rng, low, high, n) * rng.choice(signs, n) for _ in range(2))
    g = log_uniform(rng, -6, 1, n) * a * b
    if coalescing:  # within 1e-8..1e-1 of the exceptional point
        b = a + 2 * np.sqrt(g) * (1 + rng.choice([-1, 1], n) * log_uniform(rng, -8, -1, n))
    return a, b, c_1, c_2, g


FAMILIES = {
    "light": {},
    "driven": {"signs": (-1, 1)},
    "coalescing": {"coalescing": True},
    "driven and coalescing": {"signs": (-1, 1), "coalescing": True},
    "strong": {"low": -1, "high": 1},
    "strong and driven": {"low": -1, "high": 1, "signs": (-1, 1)},
    "anything": {"low": -3, "high": 3, "signs": (-1, 1)},
    "anything, coalescing": {"low": -3, "high": 3, "signs": (-1, 1), "coalescing": True},
}


def growth_rates(columns):
    return np.real(many_rightmost(stacked(columns)))


def margins(columns, shift=None):
    shift = np.zeros_like(columns[0]) if shift is None else shift
    return np.asarray(many_margins(stacked(columns), jnp.asarray(shift)))


def shifts(columns, growth):
    """No shift; up and down by all sizes; and close to the growth rate itself, on both sides."""
    rng, n = np.random.default_rng(1), len(growth)
    omega = np.sqrt(columns[0] + columns[1])
    near = np.abs(growth) * log_uniform(rng, -5, 0, n) * rng.choice([-1, 1], n)
    far = log_uniform(rng, -5, 0, n) * rng.choice([-1, 1], n) * omega
    return {"none": 0 * omega, "any": far, "near": growth + near}


@pytest.mark.parametrize("family", FAMILIES)
def test_positive_exactly_where_stable(family):
    """20,000 systems, each with three shifts: the sign of shift - growth, without exception."""
    columns = systems(20_000, **FAMILIES[family])
    growth = growth_rates(columns)
    size = np.sqrt(columns[0] + columns[1]) + np.abs(columns[2]) + np.abs(columns[3])
    for name, shift in shifts(columns, growth).items():
        found = margins(columns, shift)
        assert np.isfinite(found).all()
        sure = np.abs(growth - shift) > 1e-11 * size
        assert sure.mean() > 0.95
        np.testing.assert_array_equal((found > 0)[sure], (growth < shift)[sure], name)


def exactly_stable(a, b, c_1, c_2, g) -> bool:
    """By Routh and Hurwitz, in rational numbers: without any rounding."""
    a, b, c_1, c_2, g = map(Fraction, (a, b, c_1, c_2, g))
    a_3, a_2, a_1, a_0 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g
    H_3 = a_3 * a_2 * a_1 - a_1**2 - a_3**2 * a_0
    return min(a_3, a_2, a_1, a_0, H_3) > 0


@pytest.mark.parametrize("family", ["light", "coalescing", "strong"])
def test_sign_at_the_boundary(family):
    """Couplings within 1e-14..1e-8 of the boundary, but for a few roundings of coupling and a."""
    n, rng = 400, np.random.default_rng(3)
    a, b, c_1, c_2, _ = systems(n, **FAMILIES[family], seed=2)
    off = log_uniform(rng, -14, -8, n) * rng.choice([-1, 1], n)
    a_3, a_1 = c_1 + c_2, c_1 * b + c_2 * a
    g = c_1 * c_2 / a_3**2 * ((a - b) ** 2 + a_3 * a_1) * (1 + off)
    moves = [(1, 1 - 50 * EPS), (1, 1 + 50 * EPS), (1 - 4 * EPS, 1), (1 + 4 * EPS, 1)]
    stable = [
        [exactly_stable(*x) for x in zip(a * k, b, c_1, c_2, g * j, strict=True)] for k, j in moves
    ]
    sure = np.all(stable, axis=0) == np.any(stable, axis=0)
    assert sure.mean() > 0.7
    found = margins((a, b, c_1, c_2, g)) > 0
    np.testing.assert_array_equal(found[sure], np.array(stable[0])[sure])


def test_without_damping():
    """0 as long as it does not flutter, negative when it does, 0 at the boundary itself."""
    a, b, _, _, g = systems(2000, seed=4)
    zero = 0 * a
    found, flutter = margins((a, b, zero, zero, g)), (a - b) ** 2 < 4 * g
    assert flutter.sum() > 200
    assert (found[flutter] < 0).all()
    assert (found[~flutter] == 0).all()
    assert (margins((a, b, zero, zero, zero), zero + 1) > 0).all()
    assert float(flat(5.0, 3.0, 0.0, 0.0, 1.0, 0.0)) == 0
    # One undamped direction: any coupling at all destabilises.
    assert float(flat(5.0, 3.0, 0.01, 0.0, 1e-12, 0.0)) < 0
    assert float(flat(5.0, 3.0, 0.01, 0.0, 0.0, 0.0)) == 0


@pytest.mark.parametrize("decades", [6, 20, 100])
def test_no_wrong_sign_over_hundreds_of_decades(decades):
    """Right or NaN: of the margin always, of the growth rate beyond rounding of its eigenvalues."""
    r, n = np.random.default_rng(decades), 1000
    a = log_uniform(r, -decades, decades, n)
    b = a * np.where(r.random(n) < 0.3, 1, log_uniform(r, -decades, decades, n))
    omega = np.sqrt(a + b)
    c_1, c_2 = (
        omega * log_uniform(r, -12, min(decades, 9), n) * np.where(r.random(n) < 0.2, -1, 1)
        for _ in range(2)
    )
    g = np.minimum(a * b * log_uniform(r, -decades, 4, n), 1e300)
    columns = a, b, c_1, c_2, g
    growth, margin = growth_rates(columns), margins(columns)
    stable = np.array([exactly_stable(*row) for row in zip(*columns, strict=True)])
    known = np.isfinite(margin)
    assert 0.3 * n < known.sum() and (np.isfinite(growth) == known).all()
    assert ((margin > 0) == stable)[known].all()
    certain = known & (np.abs(growth) > 1e-6 * (omega + np.abs(c_1) + np.abs(c_2)))
    assert ((growth < 0) == stable)[certain].all()
    assert (~known == (np.maximum(abs(c_1), abs(c_2)) / omega > EPS**-0.5))[g < 1e3 * a * b].all()


@pytest.mark.slow
def test_float32():
    """float32 in, float32 out; the sign is right but within the rounding of the coefficients."""
    columns = [np.float32(x) for x in systems(20_000, low=-4, high=-1, seed=7)]
    found, growth = margins(columns), growth_rates([np.asarray(x, float) for x in columns])
    assert found.dtype == jnp.float32
    wrong = (found > 0) != (growth < 0)
    assert wrong.mean() < 2e-3
    assert (np.abs(growth[wrong]) < 1e-4).all()
    small = jax.tree.map(lambda x: x.astype(jnp.float32), BRAKE)
    assert fj.margin(small, -3.0).dtype == jnp.float32
    np.testing.assert_allclose(fj.margin(small), fj.margin(BRAKE), rtol=1e-2)


@pytest.mark.parametrize("family", ["light", "driven", "coalescing", "strong"])
def test_value_is_that_of_the_hurwitz_determinant(family):
    """Every digit but what a rounding of the coefficients takes, shifted and not."""
    columns = systems(60, **FAMILIES[family], seed=5)
    for shift in shifts(columns, growth_rates(columns)).values():
        for value, *x in zip(margins(columns, shift), *columns, shift, strict=True):
            x = [float(number) for number in x]
            wanted = exact_margin(*x)
            if isinstance(wanted, mp.mpc):  # beyond critical damping: see `least`
                continue
            moved = [[*x[:i], x[i] * (1 + 4 * EPS), *x[i + 1 :]] for i in range(6)]
            rounding = sum(abs(mp.re(exact_margin(*y)) - wanted) for y in moved)
            assert abs(value - wanted) <= 4 * rounding + 1e-14 * abs(wanted)


def test_close_to_the_least_damping_ratio_and_that_of_bare_joints():
    """Lightly damped and well apart: 0.5 to 1 times the least decay rate over the rms frequency."""
    a, b, c_1, c_2, g = systems(20_000, low=-5, high=-2, seed=6)
    growth = growth_rates((a, b, c_1, c_2, g))
    apart = (np.abs(a - b) > 0.2 * (a + b)) & (4 * g < 0.5 * (a - b) ** 2) & (growth < 0)
    ratio = (margins((a, b, c_1, c_2, g)) / (-growth / np.sqrt((a + b) / 2)))[apart]
    assert apart.sum() > 1000
    assert ratio.min() > 0.5 and ratio.max() < 1.0 and np.median(ratio) > 0.8
    # Equal uncoupled modes keep a third.
    assert float(flat(0.5, 0.5, 0.02, 0.02, 0.0, 0.0)) / (0.01 * np.sqrt(2)) > 0.3
    bare = fj.margin(BRAKE.replace(contact=fj.FixedContact(0.0, 0.0)))
    # The smaller decay beside the rms frequency is 0.0011.
    assert 0.0009 < float(bare) < 0.0011
    np.testing.assert_allclose(fj.margin(BRAKE.replace(G=1.342e-8)), bare, rtol=1e-14)


def test_least():
    """Fischer and Burmeister's function, to the last digit where it is nearly 0."""
    x, y = np.array([3.0, -3.0, 1e-12, 1.0, 0.0, 0.0]), np.array([4.0, 4.0, 1.0, -1e-12, 0.0, 2.0])
    pairs = [(mp.mpf(p), mp.mpf(q)) for p, q in zip(x, y, strict=True)]
    wanted = [float(exact_least(p + q, p * q)) for p, q in pairs]
    np.testing.assert_allclose(least(jnp.asarray(x + y), jnp.asarray(x * y)), wanted, rtol=2e-12)


POINTS = {
    "exceptional point": (5.0, 3.0, 0.01, 0.01, 1.0, 0.0),
    "exceptional point, shifted": (5.0, 3.0, 0.01, 0.01, 1.0, -0.002),
    "crossing": (4.0, 4.0, 0.01, 0.01, 0.0, 0.0),
    "crossing real parts": (5.0, 3.0, 0.01, 0.01, 1e-4, 0.0),
    "crossing, coupled": (4.0, 4.0, 0.01, 0.03, 1e-5, 0.0),
    "flutter": (5.0, 3.0, 0.01, 0.02, 1.5, 0.1),
    "driven": (5.0, 3.0, -0.01, 0.02, 0.5, 0.0),
    "strong damping": (5.0, 3.0, 2.0, 4.0, 0.5, -0.1),
}
SINGULAR = {
    "undamped exceptional point": (5.0, 3.0, 0.0, 0.0, 1.0, 0.0),
    "undamped, stable": (5.0, 3.0, 0.0, 0.0, 0.5, 0.0),
    "undamped, flutter": (5.0, 3.0, 0.0, 0.0, 2.0, 0.0),
    "undamped, equal": (4.0, 4.0, 0.0, 0.0, 0.0, 0.0),
    "quadruple root at the shift": (4.0, 4.0, 4.0, 4.0, 0.0, -2.0),
    "opposite damping": (0.5, 0.5, 2.0, -2.0, 0.1, 0.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", POINTS)
def test_derivatives(name):
    """Both modes and the second by g against differences in 40 digits, at coalescence too."""
    point = POINTS[name]
    h, wanted = mp.mpf(10) ** -15, []
    for i in range(6):
        up, down = (
            [x + k * h * (j == i) for j, x in enumerate(map(mp.mpf, point))] for k in (1, -1)
        )
        wanted.append(float((exact_margin(*up) - exact_margin(*down)) / (2 * h)))
    for gradient in gradients(jnp.asarray(point)):
        np.testing.assert_allclose(gradient, wanted, rtol=1e-9, atol=1e-13)
    hessian, h = HESSIAN(jnp.asarray(point)), mp.mpf(10) ** -12
    up, at, down = (
        exact_margin(*point[:4], mp.mpf(point[4]) + k * h, point[5]) for k in (1, 0, -1)
    )
    assert jnp.isfinite(hessian).all()
    np.testing.assert_allclose(hessian[4, 4], float((up - 2 * at + down) / h**2), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", SINGULAR)
def test_derivatives_are_finite_where_there_are_none(name):
    point = jnp.asarray(SINGULAR[name])
    for derivative in (*gradients(point), HESSIAN(point)):
        assert jnp.isfinite(derivative).all()


def test_smooth_through_coalescence_where_the_growth_rate_is_not():
    """One Taylor polynomial on both sides of the exceptional point, and none of the growth rate."""
    x = np.linspace(-1, 1, 40)
    g = 1 + 1e-4 * x  # the damping is 0.01: coalescence is resolved on a scale of 1e-4
    columns = [*(np.full(40, value) for value in (5.0, 3.0, 0.01, 0.01)), g]

    def missed(values):
        fit = np.polynomial.Polynomial.fit(x, values, 8)
        return np.abs(fit(x) - values).max() / np.ptp(values)

    assert missed(margins(columns)) < 1e-3
    assert missed(growth_rates(columns)) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("slope", [True, False])
@pytest.mark.parametrize(
    "x",
    [BRAKE, BRAKE.replace(D=2.6), BRAKE.replace(G=1e-8), BRAKE.replace(xi_1=40.0), two_joints(4)],
)
def test_it_is_that_of_stability_and_has_the_sign_of_shift_minus_growth(x, slope):
    found = fj.stability(x, slope)
    np.testing.assert_allclose(fj.margin(x, friction_slope=slope), found.margin, rtol=1e-12)
    growth = float(found.growth_rate)
    for shift in (0.0, growth - 1e-9 * abs(growth), growth + 1e-9 * abs(growth)):
        assert (float(fj.margin(x, shift, slope)) > 0) == (growth < shift)


@pytest.mark.slow
def test_of_a_structure_it_is_the_least_damping_ratio():
    structure = two_joints(4)
    found = fj.stability(structure)
    assert found.margin == pytest.approx(float(found.damping_ratios.min()), rel=1e-12)
    s = np.asarray(found.eigenvalues) - 7.0
    assert fj.margin(structure, 7) == pytest.approx((-s.real / np.abs(s)).min(), rel=1e-12)


@pytest.mark.slow
def test_picture_in_the_docs_is_the_one_drawn_now(tmp_path):
    load_script(DOCS / "make_margin.py").draw(tmp_path / "margin.png")
    assert_same_picture(tmp_path / "margin.png", "margin.png")


def test_smoothed_abscissa_of_the_picture():
    """The sum over the modes of 1/(2 (s - Re lambda)) is 1/eps for a normal matrix."""
    normal = np.array([[-0.1, 1, 0, 0], [-1, -0.1, 0, 0], [0, 0, -0.3, 2], [0, 0, -2, -0.3]])
    s = load_script(DOCS / "make_margin.py").smoothed_abscissa(normal, 0.01)
    assert 1 / (s + 0.1) + 1 / (s + 0.3) == pytest.approx(100, rel=1e-9)
