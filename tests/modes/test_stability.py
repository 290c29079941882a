"""Eigenvalues in closed form against 40-digit roots, LAPACK and the exact facts of the model."""

import dataclasses
import functools
import subprocess
import sys
from collections import Counter

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.mechanism.oscillator import Linearised
from fractaljax.modes.stability import _critical_eigenvalue, _eigenvalues
from tools import primitives

EPS = np.finfo(float).eps
OSCILLATOR = fj.brake_scene().oscillator

_many_critical = jax.jit(jax.vmap(_critical_eigenvalue))
_many_eigenvalues = jax.jit(jax.vmap(_eigenvalues))


# --- independent truths -------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _forty_digits():
    with mp.workdps(40):
        yield


def quartic_roots(coefficients):
    """Roots of a quartic by the Durand-Kerner method in 100 digits, from NumPy's as a start."""
    with mp.workdps(100):
        coefficients = [mp.mpf(x) for x in coefficients]
        start = np.roots([float(x) for x in coefficients])
        roots = [mp.mpmathify(complex(s)) + mp.mpc(k, 1) * 1e-12 for k, s in enumerate(start)]
        for _ in range(400):
            largest = 0
            for i, s in enumerate(roots):
                others = mp.fprod(s - other for other in roots[:i] + roots[i + 1 :])
                step = functools.reduce(lambda total, x: total * s + x, coefficients) / others
                roots[i] -= step
                largest = max(largest, abs(step))
            if largest < mp.mpf(10) ** -60:
                return roots
    raise AssertionError("no convergence")


def exact_eigenvalues(a, b, c_1, c_2, g):
    """Roots of the characteristic polynomial in 40 digits, the largest real part first."""
    a, b, c_1, c_2, g = (mp.mpf(float(x)) for x in (a, b, c_1, c_2, g))
    omega = mp.sqrt(a + b)
    a, b, c_1, c_2, g = a / omega**2, b / omega**2, c_1 / omega, c_2 / omega, g / omega**4
    coefficients = [1, c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g]
    return sorted((omega * root for root in quartic_roots(coefficients)), key=lambda s: -s.real)


def condition(s, a, b, c_1, c_2, g):
    """Sum over the coefficients x of |x ds/dx|: what one rounding of each can do to s."""
    s = mp.mpc(s)
    a, b, c_1, c_2, g = (mp.mpf(float(x)) for x in (a, b, c_1, c_2, g))
    first, second = s**2 + c_1 * s + a, s**2 + c_2 * s + b
    slope = abs((2 * s + c_1) * second + (2 * s + c_2) * first)
    size = (a + abs(c_1 * s)) * abs(second) + (b + abs(c_2 * s)) * abs(first) + g
    return float(size / slope) if slope else np.inf


def lapack_eigenvalues(a, b, c_1, c_2, g):
    """Eigenvalues of the state matrices by LAPACK, in units of omega and scaled back."""
    a, b, c_1, c_2, g = map(np.asarray, (a, b, c_1, c_2, g))
    omega = np.sqrt(a + b)
    matrix = np.zeros((len(a), 4, 4))
    matrix[:, 0, 2] = matrix[:, 1, 3] = 1
    matrix[:, 2, 0], matrix[:, 3, 1] = -a / omega**2, -b / omega**2
    matrix[:, 2, 1], matrix[:, 3, 0] = np.sqrt(g) / omega**2, -np.sqrt(g) / omega**2
    matrix[:, 2, 2], matrix[:, 3, 3] = -c_1 / omega, -c_2 / omega
    return np.linalg.eigvals(matrix) * omega[:, None]


def stacked(columns):
    return Linearised(*(jnp.asarray(column) for column in columns))


@dataclasses.dataclass
class Errors:
    """What ours and LAPACK miss the exact growth rate by, one entry a system."""

    ours: np.ndarray
    lapack: np.ndarray
    omega: np.ndarray
    largest: np.ndarray  # largest |lambda|
    condition: np.ndarray


def errors(columns) -> Errors:
    ours = np.real(_many_critical(stacked(columns)))
    lapack = lapack_eigenvalues(*columns).real.max(axis=1)
    rows = []
    for own, other, *x in zip(ours, lapack, *columns, strict=True):
        exact = exact_eigenvalues(*x)
        missed = [float(abs(mp.mpf(float(value)) - exact[0].real)) for value in (own, other)]
        rows.append([*missed, float(max(map(abs, exact))), condition(exact[0], *x)])
    missed, lapack_missed, largest, conditions = np.array(rows).T
    omega = np.sqrt(np.asarray(columns[0]) + np.asarray(columns[1]))
    return Errors(missed, lapack_missed, omega, largest, conditions)


# --- random systems -----------------------------------------------------------------------


def logarithmic(rng, low, high, n):
    return 10 ** rng.uniform(low, high, n)


def contacts(rng, n, xi_1, xi_2):
    """(a, b, c_1, c_2, g) of fixed contacts, K_n 1e3..1e13, kappa 0..1, mu 0.01..0.9."""
    K_n, kappa, mu = logarithmic(rng, 3, 13, n), rng.uniform(0, 1, n), rng.uniform(0.01, 0.9, n)
    omega_1, omega_2, m = (logarithmic(rng, *x, n) for x in ((2, 5), (2, 5), (-2, 2)))
    a, b = omega_1**2 + kappa * K_n / m, omega_2**2 + K_n / m
    return a, b, 2 * xi_1 * omega_1, 2 * xi_2 * omega_2, mu**2 * kappa * (K_n / m) ** 2


def polynomials(rng, n, low, high, signs=(1,)):
    """(a, b, c_1, c_2, g) with damping of 10^low..10^high beside a, b of 0.01..100."""
    c_1, c_2 = (logarithmic(rng, low, high, n) * rng.choice(signs, n) for _ in range(2))
    return (
        logarithmic(rng, -2, 2, n),
        logarithmic(rng, -2, 2, n),
        c_1,
        c_2,
        logarithmic(rng, -6, 3, n),
    )


def near_coalescence(rng, n, xi_1, xi_2):
    """|a - b| = 2 sqrt(g) (1 +- 1e-14..1e-1): both sides of the undamped exceptional point."""
    a, _, c_1, c_2, g = contacts(rng, n, xi_1, xi_2)
    off = rng.choice([-1, 1], n) * logarithmic(rng, -14, -1, n)
    return a, a + 2 * np.sqrt(g) * (1 + off), c_1, c_2, g


# --- accuracy -----------------------------------------------------------------------------


def light(n):
    rng = np.random.default_rng(1)
    return contacts(rng, n, rng.uniform(0, 0.1, n), rng.uniform(0, 0.1, n))


def equally_damped(n):
    rng = np.random.default_rng(2)
    a, b, c, _, g = contacts(rng, n, rng.uniform(0, 0.1, n), np.zeros(n))
    return a, b, c, c, g


def undamped(n):
    return contacts(np.random.default_rng(3), n, np.zeros(n), np.zeros(n))


def heavy(n):
    rng = np.random.default_rng(4)
    return contacts(rng, n, logarithmic(rng, 0, 4, n), logarithmic(rng, 0, 4, n))


def heavy_and_equal(n):
    rng = np.random.default_rng(5)
    a, b, c, _, g = contacts(rng, n, logarithmic(rng, 0, 4, n), np.zeros(n))
    return a, b, c, c, g


def heavy_beside_light(n):
    rng = np.random.default_rng(6)
    return contacts(rng, n, logarithmic(rng, 0, 4, n), rng.uniform(0, 0.1, n))


def equal_and_near_critical(n):
    """One direction overdamped and one not, by the same damping: p < 0 and alpha = 0."""
    rng = np.random.default_rng(16)
    share, c = rng.uniform(0.02, 0.3, n), rng.uniform(1.42, 1.8, n)
    return share, 1 - share, c, c, logarithmic(rng, -4, -1.3, n)


def unstable_slope(n):
    rng = np.random.default_rng(7)
    return polynomials(rng, n, -4, -0.5, signs=(-1, 1))


def uncoupled(n):
    a, b, c_1, c_2, g = polynomials(np.random.default_rng(8), n, -4, 0)
    return a, b, c_1, c_2, 0 * g


def equal_stiffness(n):
    a, _, c_1, c_2, g = polynomials(np.random.default_rng(9), n, -4, 0)
    return a, a, c_1, c_2, g


def weakly_coupled_twins(n):
    """a = b and a coupling below the rounding of a b, which must not be lost in it."""
    a, _, _, _, g = polynomials(np.random.default_rng(10), n, -4, 0)
    return a, a, 0 * a, 0 * a, 1e-20 * a**2 * g


FAMILIES = [
    light,
    equally_damped,
    undamped,
    heavy,
    heavy_and_equal,
    heavy_beside_light,
    equal_and_near_critical,
    unstable_slope,
    uncoupled,
    equal_stiffness,
    weakly_coupled_twins,
]


def check_accuracy(found: Errors):
    """1e-12 of the largest eigenvalue, and of omega but for a few slow roots beside fast ones.

    Where eigenvalues coalesce, what one rounding of the coefficients must do is allowed.
    """
    unavoidable = np.minimum(4 * EPS * found.condition, 4 * np.sqrt(EPS) * found.largest)
    assert (found.ours <= np.maximum(1e-12 * found.largest, unavoidable)).all()
    assert (found.ours <= np.maximum(1e-12 * found.omega, unavoidable)).mean() > 0.985


@pytest.mark.parametrize("family", FAMILIES)
def test_growth_rate_is_exact_to_1e_12_of_omega(family):
    check_accuracy(errors(family(40)))


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_growth_rate_of_many_is_exact_to_1e_12_of_omega(family):
    check_accuracy(errors(family(1500)))


@pytest.mark.parametrize("family", [light, equally_damped, undamped, unstable_slope])
def test_growth_rate_agrees_with_lapack(family):
    """Thousands of systems; LAPACK itself is good to 1e-12 of omega, or to its conditioning."""
    columns = family(5000)
    ours = np.real(_many_critical(stacked(columns)))
    other = lapack_eigenvalues(*columns).real.max(axis=1)
    omega = np.sqrt(columns[0] + columns[1])
    far = np.abs(ours - other) > 1e-12 * omega
    for i in np.flatnonzero(far):  # coalescing eigenvalues, by chance
        column = [x[i] for x in columns]
        exact = exact_eigenvalues(*column)[0]
        assert abs(ours[i] - exact.real) <= 4 * EPS * condition(exact, *column)
    assert far.sum() < 50


@pytest.mark.parametrize("slope", [True, False])
def test_growth_rate_of_scenes_agrees_with_lapack(slope):
    """The whole chain from random scenes with Stribeck friction, against its own state matrix."""
    rng, n = np.random.default_rng(11), 3000
    K_n, kappa = logarithmic(rng, 3, 13, n), rng.uniform(0, 1, n)
    mu_s, xi = rng.uniform(0.01, 0.9, n), rng.uniform(0, 0.1, (2, n))
    mu_m, V = mu_s * rng.uniform(0, 1, n), rng.uniform(0.01, 1, n)

    def rate(K_n, K_t, mu_s, mu_m, xi_1, xi_2, V):
        scene = fj.Scene(fj.FixedContact(K_n, K_t), fj.Stribeck(mu_s, mu_m, 0.5), OSCILLATOR)
        return fj.growth_rate(scene.replace(xi_1=xi_1, xi_2=xi_2, V=V), slope)

    ours = np.asarray(jax.jit(jax.vmap(rate))(K_n, kappa * K_n, mu_s, mu_m, *xi, V))
    w_1, w_2, m, F = (float(getattr(OSCILLATOR, x)) for x in ("omega_1", "omega_2", "m", "F"))
    u = V / 0.5
    mu = mu_s + (mu_s - mu_m) * (u**3 - 3 * u) / 2
    falling = (3 * (mu_s - mu_m) * (u**2 - 1) / 2 / 0.5) if slope else np.zeros(n)
    static = np.zeros((n, 2, 2))
    static[:, 0, 0], static[:, 1, 1] = m * w_1**2 + kappa * K_n, m * w_2**2 + K_n
    static[:, 0, 1], static[:, 1, 0] = -mu * K_n, mu * kappa * K_n
    load = np.tile(np.array([[F], [-F]]) / np.sqrt(2), (n, 1, 1))
    x_01, x_02 = np.linalg.solve(static, load)[..., 0].T
    matrix = np.zeros((n, 4, 4))
    omega = np.sqrt(static[:, 0, 0] / m + static[:, 1, 1] / m)
    matrix[:, 0, 2] = matrix[:, 1, 3] = 1
    matrix[:, 2:, :2] = -static / m / omega[:, None, None] ** 2
    matrix[:, 2, 2] = -(2 * xi[0] * w_1 + falling * K_n * x_02 / m) / omega
    matrix[:, 3, 3] = -(2 * xi[1] * w_2 - falling * kappa * K_n * x_01 / m) / omega
    other = np.linalg.eigvals(matrix).real.max(axis=1) * omega
    assert (np.abs(ours - other) <= 1e-12 * omega).mean() > 0.99  # the rest coalesce
    assert (np.abs(ours - other) <= 1e-8 * omega).all()


@pytest.mark.parametrize("damping", ["none", "equal", "unequal"])
def test_near_coalescence_is_as_exact_as_the_problem_allows_and_as_lapack(damping):
    """There a rounding of the coefficients moves the growth rate by up to its square root."""
    rng, n = np.random.default_rng(12), 60
    xi = 0 * rng.uniform(size=n) if damping == "none" else logarithmic(rng, -6, -1, n)
    other = xi if damping != "unequal" else logarithmic(rng, -6, -1, n)
    a, b, c_1, c_2, g = near_coalescence(rng, n, xi, other)
    found = errors((a, b, c_1, c_1 if damping == "equal" else c_2, g))
    check_accuracy(found)
    assert (found.ours / found.omega).max() <= (found.lapack / found.omega).max()


@pytest.mark.parametrize(("low", "high"), [(0, 1), (1, 2), (2, 4)])
def test_overdamped_roots_are_exact_beside_omega(low, high):
    """Damping of up to 1e5 omega, both signs apart: the slow root is not lost in the fast one."""
    found = errors(polynomials(np.random.default_rng(13), 40, low, high))
    check_accuracy(found)
    assert (found.ours <= 1e-13 * found.largest).all()


def test_opposite_heavy_damping_is_exact_beside_the_largest_eigenvalue():
    """One direction driven, the other damped, both far beyond critical."""
    found = errors(polynomials(np.random.default_rng(14), 60, 1, 4, signs=(-1, 1)))
    assert (found.ours <= 1e-10 * found.largest).all()


def test_all_four_eigenvalues_are_exact():
    """Every eigenvalue with both its parts, sorted by growth, in light and heavy damping."""
    for family in (light, undamped, heavy, unstable_slope):
        columns = family(12)
        ours = np.asarray(_many_eigenvalues(stacked(columns)))
        assert (np.diff(np.real(ours), axis=1) <= 0).all()
        for own, *x in zip(ours, *columns, strict=True):
            left = list(own)
            for s in exact_eigenvalues(*x):
                nearest = min(left, key=lambda z: abs(mp.mpmathify(complex(z)) - s))
                left.remove(nearest)
                bound = max(
                    1e-12 * max(float(abs(s)), np.sqrt(x[0] + x[1])), 4 * EPS * condition(s, *x)
                )
                assert abs(mp.mpmathify(complex(nearest)) - s) <= bound


def test_multiple_roots_are_exact():
    """Critical damping, uncoupled twins, and all four roots in one point: not one digit lost."""
    omega = 4096.0
    cases = [
        ((omega**2, omega**2, 2 * omega, 2 * omega, 0.0), -omega),  # one quadruple root
        ((omega**2, omega**2, 2 * omega, 4 * omega, 0.0), -omega * (2 - np.sqrt(3))),
        ((omega**2, 16 * omega**2, 2 * omega, 8 * omega, 0.0), -omega),  # two double roots
        ((omega**2, omega**2, 0.5 * omega, 0.5 * omega, 0.0), -omega / 4),  # one complex pair
        ((omega**2, omega**2, 0.0, 0.0, 0.0), 0.0),
        ((omega**2, 4 * omega**2, 0.5 * omega, 0.5 * omega, 0.0), -omega / 4),
    ]
    for column, growth in cases:
        assert float(_critical_eigenvalue(stacked(column)).real) == pytest.approx(
            growth, rel=4 * EPS, abs=0
        )


def test_start_with_negative_leading_coefficient():
    """More mean damping than stiffness: p <= 0 in Ferrari's resolvent."""
    rng, n = np.random.default_rng(15), 40
    a, b = rng.uniform(0.1, 1, (2, n))
    c_1, c_2 = rng.uniform(2.2, 6, (2, n))
    sigma, d = (c_1 + c_2) / 4, (c_1 - c_2) / 2
    assert (a + b - 2 * sigma**2 - d**2 <= 0).all()
    check_accuracy(errors((a, b, c_1, c_2, rng.uniform(0, 4, n))))


def test_zero_damping_grows_only_by_flutter():
    """Without damping: exactly 0 when stable; else sqrt((sqrt(4(ab+g)) - a - b)/4)."""
    a, b, c_1, c_2, g = undamped(5000)
    ours = np.real(_many_critical(stacked((a, b, c_1, c_2, g))))
    stable = np.abs(a - b) > 2 * np.sqrt(g) * (1 + 1e-12)
    flutter = np.abs(a - b) < 2 * np.sqrt(g) * (1 - 1e-3)
    assert stable.sum() > 500
    assert flutter.sum() > 500
    assert (ours[stable] == 0).all()
    excess = (4 * g - (a - b) ** 2) / (4 * (2 * np.sqrt(a * b + g) + a + b))
    np.testing.assert_allclose(ours[flutter], np.sqrt(excess[flutter]), rtol=1e-12)


def test_single_precision_follows_its_own_rounding():
    """float32 in, float32 out, and nothing leaves its range."""
    columns = [np.float32(x) for x in light(500)]
    ours = _many_critical(stacked(columns))
    assert ours.dtype == jnp.complex64
    other = lapack_eigenvalues(*(np.asarray(x, float) for x in columns)).real.max(axis=1)
    omega = np.sqrt(columns[0] + columns[1])
    missed = np.abs(np.real(ours) - other) / omega
    assert np.quantile(missed, 0.99) < 1e-6
    assert missed.max() < 1e-3


# --- exact facts --------------------------------------------------------------------------


def fixed_scene(K_n=4e8, kappa=0.5, mu=0.4):
    return fj.Scene(fj.FixedContact(K_n, kappa * K_n), fj.Coulomb(mu), OSCILLATOR)


def test_eigenvalues_rebuild_the_characteristic_polynomial():
    """s^4 + (c1+c2) s^3 + (a+b+c1 c2) s^2 + (c1 b+c2 a) s + (ab + mu^2 K_n K_t/m^2)."""
    scene = fixed_scene().replace(m=2.5, xi_1=0.03, xi_2=0.08)
    o = scene.oscillator
    a, b = float(o.omega_1) ** 2 + 2e8 / 2.5, float(o.omega_2) ** 2 + 4e8 / 2.5
    c_1, c_2 = 0.06 * float(o.omega_1), 0.16 * float(o.omega_2)
    wanted = [1, c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + 0.16 * 8e16 / 6.25]
    built = np.poly(np.asarray(fj.stability(scene).eigenvalues))
    scale = np.sqrt(a + b) ** np.arange(5)
    np.testing.assert_allclose(built.real / scale, np.array(wanted) / scale, rtol=0, atol=1e-14)
    np.testing.assert_allclose(built.imag / scale, 0, atol=1e-14)


@pytest.mark.parametrize("kappa", [0.3, 0.8])
@pytest.mark.parametrize("side", [-1, 1])
def test_undamped_flutter_boundary(kappa, side):
    """Undamped flutter iff |a - b| < 2 mu sqrt(K_n K_t)/m, told apart at 1e-9 of mu."""
    scene = fixed_scene(kappa=kappa).replace(xi_1=0.0, xi_2=0.0)
    o = scene.oscillator
    apart = float(o.omega_1) ** 2 + kappa * 4e8 - float(o.omega_2) ** 2 - 4e8
    mu_c = abs(apart) / (2 * 4e8 * np.sqrt(kappa))
    growth = float(fj.growth_rate(scene.replace(mu=mu_c * (1 + side * 1e-9))))
    assert growth > 0 if side > 0 else growth == 0


def closed_form_mu_c(scene):
    """Damped boundary: mu_c^2 K_n K_t/m^2 = (a3 a2 a1 - a1^2)/a3^2 - ab, in 40 digits."""
    o, contact = scene.oscillator, scene.contact
    m, w_1, w_2, xi_1, xi_2, K_n, K_t = (
        mp.mpf(float(x))
        for x in (o.m, o.omega_1, o.omega_2, o.xi_1, o.xi_2, contact.K_n, contact.K_t)
    )
    a, b, c_1, c_2 = w_1**2 + K_t / m, w_2**2 + K_n / m, 2 * xi_1 * w_1, 2 * xi_2 * w_2
    a_3, a_2, a_1 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a
    coupling = (a_3 * a_2 * a_1 - a_1**2) / a_3**2 - a * b
    return float(m * mp.sqrt(coupling / (K_n * K_t)))


def bisected_mu_c(scene, slope=True):
    rate = jax.jit(lambda mu: fj.growth_rate(scene.replace(mu=mu), slope))
    low, high = 0.01, 2.0
    while high - low > 2e-13:
        middle = (low + high) / 2
        low, high = (middle, high) if rate(middle) < 0 else (low, middle)
    return (low + high) / 2


@pytest.mark.parametrize(
    ("K_n", "kappa", "tabled"),
    [(4e8, 0.15, 0.7540173), (3.2e9, 0.15, 0.7827956), (4e8, 0.5, 0.2355233)],
)
def test_critical_friction_is_the_tabled_one(K_n, kappa, tabled):
    scene = fixed_scene(K_n, kappa)
    found = bisected_mu_c(scene)
    assert found == pytest.approx(tabled, abs=5.1e-8)
    assert found == pytest.approx(closed_form_mu_c(scene), rel=1e-10)


def test_unequal_damping_destabilises():
    """In the limit of light damping mu_c falls to 2 sqrt(c1 c2)/(c1+c2) = 0.7171 of its value."""
    scene = fixed_scene().replace(xi_1=1e-7, xi_2=7e-7)
    o = scene.oscillator
    undamped_mu_c = abs(float(o.omega_1) ** 2 + 2e8 - float(o.omega_2) ** 2 - 4e8) / (
        2 * np.sqrt(8e16)
    )
    c_1, c_2 = float(o.omega_1), 7 * float(o.omega_2)
    ratio = bisected_mu_c(scene) / undamped_mu_c
    assert ratio == pytest.approx(2 * np.sqrt(c_1 * c_2) / (c_1 + c_2), rel=1e-6)
    assert ratio == pytest.approx(0.7171, abs=5e-5)


@pytest.mark.parametrize(("K_n", "growth"), [(3e8, 624), (4e8, 477), (5e8, 257)])
def test_growth_of_the_limit_cycle_cases(K_n, growth):
    """Section 3.3 of the source: mu_s 0.4, mu_m 0.25, v_m 0.5, V 0.15, F 5, kappa 0.5."""
    scene = fixed_scene(K_n).replace(friction=fj.Stribeck(0.4, 0.25, 0.5))
    assert float(fj.growth_rate(scene)) == pytest.approx(growth, abs=0.5)


def stribeck_chain(x, slope=True):
    """Critical eigenvalue of a fixed contact with Stribeck friction; all numbers mpmath."""
    u, drop = x["V"] / x["v_m"], x["mu_s"] - x["mu_m"]
    mu = x["mu_s"] - 3 * drop / 2 * u + drop / 2 * u**3
    falling = (-3 * drop / 2 + 3 * drop / 2 * u**2) / x["v_m"]
    m, K_n, K_t = x["m"], x["K_n"], x["K_t"]
    k_1, k_2 = m * x["omega_1"] ** 2 + K_t, m * x["omega_2"] ** 2 + K_n
    f = x["F"] / mp.sqrt(2)
    static = mp.lu_solve(mp.matrix([[k_1, -mu * K_n], [mu * K_t, k_2]]), mp.matrix([f, -f]))
    c_1, c_2 = 2 * x["xi_1"] * x["omega_1"], 2 * x["xi_2"] * x["omega_2"]
    if slope:
        c_1, c_2 = c_1 + falling * K_n * static[1] / m, c_2 - falling * K_t * static[0] / m
    a, b, g = k_1 / m, k_2 / m, mu**2 * K_n * K_t / m**2
    unit = mp.sqrt(a + b)
    coefficients = [
        1,
        (c_1 + c_2) / unit,
        (a + b + c_1 * c_2) / unit**2,
        (c_1 * b + c_2 * a) / unit**3,
        (a * b + g) / unit**4,
    ]
    upper = (s for s in quartic_roots(coefficients) if s.imag > -(mp.mpf(10) ** -30))
    return unit * max(upper, key=lambda s: s.real)


NAMES = ("K_n", "K_t", "mu_s", "mu_m", "v_m", "m", "omega_1", "omega_2", "xi_1", "xi_2", "V", "F")


def numbers_of(scene):
    """The quantities `stribeck_chain` needs; K_n and K_t of whatever contact the scene has."""
    K_n, K_t = fj.stiffness(scene)
    parts = {"K_n": K_n, "K_t": K_t}
    for part in (scene.friction, scene.oscillator):
        parts |= {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    return {name: mp.mpf(float(parts[name])) for name in NAMES}


@pytest.mark.parametrize(("slope", "tabled"), [(True, 22.080110302126), (False, 23.3109730404)])
def test_reference_brake(slope, tabled):
    """The reference scene: growth and frequency of an independent 40-digit chain."""
    scene = fj.brake_scene()
    exact = stribeck_chain(numbers_of(scene), slope)
    found = fj.stability(scene, friction_slope=slope)
    assert float(fj.growth_rate(scene, slope)) == pytest.approx(tabled, rel=1e-11)
    assert float(found.growth_rate) == pytest.approx(float(exact.real), rel=1e-12)
    assert float(found.frequency) == pytest.approx(float(exact.imag / (2 * mp.pi)), rel=1e-14)
    assert float(found.damping_ratio) == pytest.approx(float(-exact.real / abs(exact)), rel=1e-12)


def test_bare_oscillator():
    """Without contact the two directions decay by themselves: -xi_i omega_i, at omega_i."""
    scene = fj.Scene(fj.FixedContact(0.0, 0.0), fj.Coulomb(0.4), OSCILLATOR)
    found = fj.stability(scene)
    decay = [float(OSCILLATOR.xi_1 * OSCILLATOR.omega_1)]
    decay += [float(OSCILLATOR.xi_2 * OSCILLATOR.omega_2)]
    slow = float(OSCILLATOR.omega_1)
    np.testing.assert_allclose(found.growth_rate, -min(decay), rtol=1e-14)
    np.testing.assert_allclose(sorted(found.eigenvalues.real), -np.repeat(decay[::-1], 2), 1e-14)
    np.testing.assert_allclose(found.frequency, slow * np.sqrt(1 - 1e-6) / (2 * np.pi), 1e-14)
    np.testing.assert_allclose(found.damping_ratio, 0.001, rtol=1e-13)
    # The smaller decay beside the rms frequency is 0.0011; see test_margin.py for the rest.
    assert 0.0009 < float(found.margin) < 0.0011


def test_growth_rate_is_that_of_stability():
    """The cheap route and the full one give the same number."""
    scene = fj.brake_scene()
    for changed in (scene, scene.replace(D=2.6), scene.replace(G=1e-8), scene.replace(xi_1=40.0)):
        for slope in (True, False):
            cheap = fj.growth_rate(changed, slope)
            np.testing.assert_allclose(cheap, fj.stability(changed, slope).growth_rate, 1e-15)


# --- derivatives --------------------------------------------------------------------------


@functools.cache
def _exact_slopes(items):
    x, h = dict(items), mp.mpf(10) ** -12

    def moved(name, factor):
        return stribeck_chain(x | {name: x[name] * factor})

    return {name: (moved(name, 1 + h) - moved(name, 1 - h)) / (2 * h * x[name]) for name in NAMES}


def exact_slopes(x):
    """d lambda/d(name) of `stribeck_chain` by central differences, complex, to 20 digits."""
    return _exact_slopes(tuple(x.items()))


def fixed_like(scene):
    K_n, K_t = fj.stiffness(scene)
    return scene.replace(contact=fj.FixedContact(K_n, K_t))


def of_numbers(scene):
    """The critical growth rate as a function of a dict of quantities of the scene."""
    return lambda changes: fj.growth_rate(scene.replace(**changes))


SCENES = {
    "reference": {},
    "stable": {"mu_s": 0.26},
    "overdamped": {"xi_1": 30.0, "xi_2": 50.0},
    "driven by the slope": {"F": 5e3, "V": 0.02, "v_m": 0.1},
}


@pytest.mark.parametrize("changes", SCENES.values(), ids=SCENES.keys())
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradients_of_growth_rate(changes, mode):
    """Every quantity of the oscillator and the friction law, in both modes.

    The scale of an error is |d lambda/dx|: the growth rate is the real part of an eigenvalue that
    is known to so many digits as a complex number, and its own derivative may be far smaller.
    """
    scene = fixed_like(fj.brake_scene().replace(**changes))
    x = numbers_of(scene)
    found = mode(of_numbers(scene))({name: float(value) for name, value in x.items()})
    for name, slope in exact_slopes(x).items():
        assert abs(float(found[name]) - slope.real) <= 1e-9 * abs(slope), name


def richardson(f, x, h):
    """Sixth-order central difference of a vector function."""
    differences = [(f(x + k * h) - f(x - k * h)) / (2 * k * h) for k in (1, 2, 3)]
    return 1.5 * differences[0] - 0.6 * differences[1] + 0.1 * differences[2]


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("name", ["D", "log_G", "P", "E", "mu_s", "mu_m"])
def test_gradients_through_the_contact_law(name, mode):
    """d lambda = lambda_K dK + lambda_x dx, with lambda_K exact and dK by differences."""
    scene = fj.brake_scene()

    def changed(value):
        return scene.replace(**({"G": jnp.exp(value)} if name == "log_G" else {name: value}))

    known = {"log_G": jnp.log(1.342e-10), "D": 2.4, "P": 1907.3, "E": 1.154e11}
    start = float(known.get(name, getattr(scene.friction, name, 0.0)))
    stiffness = jax.jit(lambda value: jnp.stack(fj.stiffness(changed(value))))
    dK_n, dK_t = richardson(stiffness, start, 1e-3 if name == "D" else 3e-3 * abs(start) / 5)
    slopes = exact_slopes(numbers_of(scene))
    wanted = slopes["K_n"] * float(dK_n) + slopes["K_t"] * float(dK_t) + slopes.get(name, 0)
    found = mode(lambda value: fj.growth_rate(changed(value)))(start)
    assert abs(float(found) - wanted.real) <= 1e-9 * abs(wanted)


def test_gradients_of_every_eigenvalue():
    """Real and imaginary parts of all four, against the implicit formula by differences."""
    scene = fixed_like(fj.brake_scene())
    x = numbers_of(scene)
    low, high = (
        fj.stability(scene.replace(K_n=float(x["K_n"]) * (1 + h))).eigenvalues
        for h in (-1e-5, 1e-5)
    )
    by_difference = np.asarray(high - low) / (2e-5 * float(x["K_n"]))

    def parts(K_n):
        s = fj.stability(scene.replace(K_n=K_n)).eigenvalues
        return s.real, s.imag

    for mode in (jax.jacfwd, jax.jacrev):
        real, imag = mode(parts)(float(x["K_n"]))
        found = np.asarray(real) + 1j * np.asarray(imag)
        np.testing.assert_allclose(found, by_difference, rtol=1e-6)
        exact = complex(exact_slopes(x)["K_n"])
        assert abs(found[0] - exact) <= 1e-10 * abs(exact)


def test_second_derivatives():
    """The Hessian against differences of the exact gradient, on the scale of |d2 lambda|."""
    scene = fixed_like(fj.brake_scene())
    x = numbers_of(scene)
    names = ["K_n", "K_t", "mu_s", "V", "xi_2"]
    hessian = jax.hessian(lambda values: of_numbers(scene)(dict(zip(names, values, strict=True))))(
        jnp.array([float(x[name]) for name in names])
    )
    h = mp.mpf(10) ** -8
    for i, name in enumerate(names):
        up, down = (exact_slopes(x | {name: x[name] * (1 + k * h)}) for k in (1, -1))
        for j, other in enumerate(names):
            wanted = (up[other] - down[other]) / (2 * h * x[name])
            assert abs(float(hessian[i, j]) - wanted.real) <= 1e-8 * abs(wanted), (name, other)


def flat(a, b, c_1, c_2, g):
    return _critical_eigenvalue(Linearised(a, b, c_1, c_2, g)).real


@pytest.mark.parametrize(
    "point",
    [(5.0, 3.0, 0.0, 0.0, 1.0), (3.0, 5.0, 0.0, 0.0, 1.0), (4.0, 4.0, 4.0, 4.0, 0.0)],
    ids=["exceptional", "exceptional, swapped", "quadruple"],
)
def test_gradients_at_exact_coalescence_are_finite(point):
    """a - b = 2 sqrt(g) in representable numbers: the true derivative is infinite."""
    for mode in (jax.jacfwd, jax.jacrev):
        gradient = jnp.stack(mode(flat, argnums=range(5))(*point))
        assert jnp.isfinite(gradient).all()
    assert jnp.isfinite(jnp.stack(jax.jacfwd(_real_parts, argnums=range(5))(*point))).all()


def _real_parts(*coefficients):
    return _eigenvalues(Linearised(*coefficients)).real


def test_gradients_grow_without_bound_beside_coalescence():
    """Just inside flutter d(growth)/dg = 1/(8 growth s^2)...: large, and right."""
    for off in (1e-4, 1e-8):
        h = mp.mpf(off) / 10**12

        def growth(g):
            # lambda^2 = (-(a + b) + sqrt((a - b)^2 - 4 g))/2 with a = 5, b = 3.
            return mp.sqrt((-8 + mp.sqrt(4 - 4 * g)) / 2).real

        wanted = (growth(1 + mp.mpf(off) + h) - growth(1 + mp.mpf(off) - h)) / (2 * h)
        found = float(jax.grad(flat, argnums=4)(5.0, 3.0, 0.0, 0.0, 1 + off))
        assert found == pytest.approx(float(wanted), rel=10 * EPS / off)
        assert found > 0.05 / np.sqrt(off)


def test_gradients_where_modes_cross():
    """Uncoupled modes of equal damping decay alike: growth = -c/2, whichever is taken.

    With c_1 = c_2 it is one of the two, so its derivative is -1/2 by one damping and 0 by the
    other; it depends on neither stiffness.
    """
    for a, b in ((2.0, 3.0), (3.0, 2.0)):
        for mode in (jax.jacfwd, jax.jacrev):
            gradient = [float(x) for x in mode(flat, argnums=range(5))(a, b, 0.2, 0.2, 0.0)]
            np.testing.assert_allclose(gradient[:2], 0, atol=1e-15)
            np.testing.assert_allclose(sorted(gradient[2:4]), [-0.5, 0], atol=1e-15)
            assert abs(gradient[4]) <= 1e-15


def test_fully_plastic_joint_has_no_gradient():
    """No elastic contact, no stiffness: D and G change nothing, exactly."""
    scene = fj.brake_scene().replace(G=1.342e-8)
    for mode in (jax.jacfwd, jax.jacrev):
        gradient = mode(of_numbers(scene))({"D": 2.4, "G": 1.342e-8})
        assert float(gradient["D"]) == 0
        assert float(gradient["G"]) == 0


# --- structure ----------------------------------------------------------------------------


def test_vmapped_is_looped():
    """One program over D and G, against one scene at a time."""
    scene = fj.brake_scene()
    D, G = np.meshgrid(np.linspace(2.2, 2.8, 5), np.geomspace(1e-11, 1e-9, 4))

    def rate(D, G):
        return fj.growth_rate(scene.replace(D=D, G=G))

    many = jax.jit(jax.vmap(rate))(D.ravel(), G.ravel())
    looped = [float(rate(D, G)) for D, G in zip(D.ravel(), G.ravel(), strict=True)]
    omega = 2 * np.pi * 1000
    np.testing.assert_allclose(many, looped, rtol=0, atol=1e-14 * omega)
    nested = jax.vmap(jax.vmap(rate, (0, None)), (None, 0))(D[0], G[:, 0])
    np.testing.assert_allclose(np.ravel(nested), looped, rtol=0, atol=1e-14 * omega)
    full = jax.vmap(lambda D, G: fj.stability(scene.replace(D=D, G=G)))(D.ravel(), G.ravel())
    assert full.eigenvalues.shape == (20, 4)
    np.testing.assert_allclose(full.growth_rate, looped, rtol=0, atol=1e-14 * omega)


@pytest.mark.parametrize("function", [fj.growth_rate, fj.stability])
def test_a_scene_of_arrays_is_refused_with_a_hint(function):
    scene = fj.brake_scene().replace(D=np.array([2.4, 2.5]))
    with pytest.raises(ValueError, match=r"D must be a scalar, got shape \(2,\); use jax.vmap"):
        function(scene)


def traced(scene, slope=True, function=fj.growth_rate) -> Counter:
    return primitives(jax.make_jaxpr(lambda s: function(s, slope))(scene).jaxpr)


RATIO = fj.FractalContact(
    fj.Surface(2.4, 1.342e-10), fj.Material(1.154e11, 0.3, 3.55e8, 9.94e8), 1e3, 0.5
)


def test_a_scene_traces_what_it_needs_and_nothing_else():
    """Strictly less work the less a scene holds."""
    brake = fj.brake_scene()
    sizes = [
        traced(scene, slope).total()
        for scene, slope in [
            (fixed_scene(), True),
            (fixed_like(brake), True),
            (brake.replace(contact=RATIO), True),
            (brake, True),
        ]
    ]
    assert sizes == sorted(set(sizes)), sizes
    assert traced(fixed_like(brake), False).total() < traced(fixed_like(brake)).total()
    assert traced(fixed_scene(), False) == traced(fixed_scene())


def test_a_fixed_contact_traces_no_contact_law():
    """The one exp and log are those of the closed form, in single precision; no cbrt, no pow."""
    fixed, fractal = traced(fixed_scene()), traced(fj.brake_scene())
    assert not {"log1p", "expm1", "cbrt", "pow", "cos", "acos"} & set(fixed)
    assert (fixed["exp"], fixed["log"]) == (1, 1)
    assert fractal["exp"] > 1 and fractal["log"] > 1
    assert fractal["cbrt"] == 1  # Eq. 36
    assert traced(fj.brake_scene().replace(contact=RATIO))["cbrt"] == 0


@pytest.mark.parametrize("function", [fj.growth_rate, fj.stability])
def test_no_loop_no_lapack_no_callback(function):
    """Concrete numbers trace plain arithmetic only, and no check that calls back."""
    for scene in (fj.brake_scene(), fixed_scene(), fj.brake_scene().replace(contact=RATIO)):
        names = set(traced(scene, function=function))
        assert not {name for name in names if "while" in name or "scan" in name or "eig" in name}
        assert not {name for name in names if "callback" in name or "custom_call" in name}
        text = function.lower(scene).as_text()
        assert "custom_call" not in text


def test_import_loads_no_heavy_library():
    """Integrators, optimisers and plotting come with the call that needs them."""
    heavy = ("diffrax", "optax", "matplotlib", "scipy", "tqdm", "SurfaceTopography")
    code = f"import sys, fractaljax; print([x for x in {heavy!r} if x in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "question",
    [
        fj.growth_rate,
        fj.stability,
        fj.critical_friction,
        fj.margin,
        functools.partial(fj.hopf_boundary, x=("kappa", 0, 1), y=("mu", 0.1, 0.2)),
        functools.partial(fj.design, progress=False),
        lambda scene, friction_slope: fj.constraints.DampingRatio(
            0.01, friction_slope=friction_slope
        ),
        lambda scene, friction_slope: fj.constraints.Frequency(1.0, friction_slope=friction_slope),
    ],
)
def test_friction_slope_is_true_or_false(question):
    brake = fj.brake_scene()
    for scene in (brake, brake.replace(friction=fj.Coulomb(0.4))):
        with pytest.raises(TypeError, match="friction_slope must be True or False, got 'no'"):
            question(scene, friction_slope="no")
