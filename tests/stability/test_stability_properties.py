"""What holds for every mechanism of two directions, stiff, soft, undamped or overdamped."""

from collections.abc import Callable

import jax
import numpy as np
import pytest

from benchmarks.extreme import programs
from benchmarks.extreme.points import MECHANISM_COLUMNS, mechanisms, places
from fractaljax._mechanism.oscillator import linearise
from quartics import coefficients

NAMES = ["m", "omega_1", "omega_2", "xi_1", "xi_2", "F", "V", "K_n", "K_t", "mu_s", "mu_m", "v_m"]
SQUEAL, _, _ = programs.of_rows(programs.squeal)
GROWTH, _, _ = programs.of_rows(programs.growth_and_margin)
REST, _, _ = programs.of_rows(programs.rest)
MU_C, _, _ = programs.of_rows(programs.critical_friction)


def _linearised(x):
    scene = programs.scene(x)
    return linearise(scene.oscillator, scene.friction, scene.contact.K_n, scene.contact.K_t)


LINEARISED = jax.jit(jax.vmap(_linearised))


def matrices(x):
    """State matrices (n, 4, 4) by NumPy from the row itself, Eq. 43 with the slope of the law."""
    m, w_1, w_2, xi_1, xi_2, F, V, K_n, K_t, mu_s, mu_m, v_m = x.T
    drop, u = mu_s - mu_m, V / v_m
    mu, slope = mu_s - drop * u * (3 - u**2) / 2, 1.5 * drop / v_m * (u**2 - 1)
    K_1, K_2 = m * w_1**2 + K_t, m * w_2**2 + K_n
    f = F / np.sqrt(2) / (K_1 * K_2 + mu**2 * K_n * K_t)
    x_1, x_2 = f * (K_2 - mu * K_n), -f * (K_1 + mu * K_t)
    A = np.zeros((len(x), 4, 4))
    A[:, 0, 2] = A[:, 1, 3] = 1
    A[:, 2, 0], A[:, 2, 1], A[:, 3, 0], A[:, 3, 1] = -K_1 / m, mu * K_n / m, -mu * K_t / m, -K_2 / m
    A[:, 2, 2] = -(2 * xi_1 * w_1 + slope * K_n * x_2 / m)
    A[:, 3, 3] = -(2 * xi_2 * w_2 - slope * K_t * x_1 / m)
    return A, np.sqrt((K_1 + K_2) / m), np.stack([x_1, x_2], axis=1)


def check_finite(u):
    x = mechanisms(u)
    for program in (SQUEAL, REST):
        for name, values in program(x).items():
            assert np.isfinite(values).all(), name
    # Without tangential coupling nothing squeals, whatever the friction.
    assert np.array_equal(np.isinf(MU_C(x)["mu_c"]), x[:, NAMES.index("K_t")] == 0)


def compare_gradients(x, value, forward, reverse):
    """Finite, and the same in both modes, by logarithms and beside the largest."""
    for name in value:
        a, b = np.asarray(forward[name]), np.asarray(reverse[name])
        assert np.isfinite(a).all() and np.isfinite(b).all(), name
        if name in ("growth_rate", "margin", "x_0", "mu_c"):
            columns = x.reshape((len(x),) + (1,) * (a.ndim - 2) + (-1,))
            value_size = np.abs(np.asarray(value[name]))
            value_size = np.where(np.isinf(value_size), 0, value_size)
            size = np.abs(a * columns).max(axis=-1) + value_size
            size = size + (matrices(x)[1] if name == "growth_rate" else 0)
            room = 1e-9 * size + 1e-300
            if name == "margin":
                # Of the order of the damping, and with a kink where there is none: beside it the
                # second derivative is the inverse of the damping.
                damping = (x[:, 1] * x[:, 3] + x[:, 2] * x[:, 4]) / matrices(x)[1]
                bend = np.divide(1, damping, out=np.zeros_like(damping), where=damping > 0)
                room = room + 1e-9 * damping + 10 * np.finfo(float).eps * size * bend
            assert (np.abs((a - b) * columns) <= room[..., None]).all(), name


def check_eigenvalues_rebuild_the_polynomial(u):
    """Backward stable: the four of them are exact for coefficients that are off by rounding."""
    x = mechanisms(u)
    found = SQUEAL(x)
    s = np.asarray(found["real"]) + 1j * np.asarray(found["imaginary"])
    lin = {name: np.asarray(value) for name, value in vars(LINEARISED(x)).items()}
    c_1, c_2, a, b = lin["c_1"], lin["c_2"], lin["a"], lin["b"]
    exact = coefficients(a, b, c_1, c_2, lin["g"])[1:]
    # What the coefficients are made of, which may cancel in them.
    parts = [
        np.abs(c_1) + np.abs(c_2),
        a + b + np.abs(c_1 * c_2),
        np.abs(c_1) * b + np.abs(c_2) * a,
        a * b + lin["g"],
    ]
    size = np.abs(s).max(axis=1) + np.sqrt(a + b)
    for row, roots in enumerate(s):
        rebuilt = np.poly(roots)
        for k in range(4):
            allowed = 1e-13 * (parts[k][row] + size[row] ** (k + 1))
            assert abs(rebuilt[k + 1] - exact[k][row]) <= allowed, (k, x[row].tolist())


def growth_by_lapack(x):
    """Growth rates, and the size of what they are rounded beside."""
    A, omega, rest = matrices(x)
    # In units of omega, where the matrix is balanced.
    A[:, 2:, :2] /= omega[:, None, None] ** 2
    A[:, 2:, 2:] /= omega[:, None, None]
    return np.linalg.eigvals(A).real.max(axis=1) * omega, omega * np.abs(A).max(axis=(1, 2)), rest


def check_growth_rate_is_that_of_the_state_matrix(u):
    x = mechanisms(u)
    exact, size, rest = growth_by_lapack(x)
    found = {name: np.asarray(value) for name, value in SQUEAL(x).items()}
    # Eigenvalues that coalesce, two of them, have half the digits; LAPACK has no more.
    assert (np.abs(found["growth_rate"] - exact) <= 1e-7 * size).all()
    # Beside damping of 1e5 times the root itself, rounding leaves one in 100,000 a digit less.
    apart = np.abs(found["growth_rate"] - found["real"][:, 0]) / size
    assert np.quantile(apart, 0.9999) <= 1e-12 and apart.max() <= 1e-11
    np.testing.assert_allclose(REST(x)["x_0"], rest, rtol=1e-9, atol=1e-9 * np.abs(rest).max())


def check_unit_of_time(u):
    """Everything faster by a power of two, which rounds nothing."""
    x = mechanisms(u)
    faster = x.copy()
    for name, factor in {"omega_1": 4, "omega_2": 4, "K_n": 16, "K_t": 16, "F": 16}.items():
        faster[:, NAMES.index(name)] *= factor
    for name in ("V", "v_m"):
        faster[:, NAMES.index(name)] *= 4
    before, after = SQUEAL(x), SQUEAL(faster)
    size = np.abs(np.asarray(before["real"]) + 1j * np.asarray(before["imaginary"])).max(axis=1)
    off = np.asarray(after["growth_rate"]) - 4 * np.asarray(before["growth_rate"])
    assert (np.abs(off) <= 1e-12 * size).all()
    np.testing.assert_allclose(after["margin"], before["margin"], rtol=1e-11, atol=1e-300)


def test_growth_rates_of_thousands_are_lapacks():
    """To 1e-12 of the frequency, but for a few that coalesce: to half the digits."""
    u = places(np.random.default_rng(11), 3000, MECHANISM_COLUMNS)
    x = mechanisms(u)
    x[:, 3:5] = 0.1 * u[:, 3:5]  # damping ratios
    exact, size, _ = growth_by_lapack(x)
    off = np.abs(np.asarray(GROWTH(x)["growth_rate"]) - exact)
    assert (off <= 1e-12 * size).mean() > 0.99
    assert (off <= 1e-7 * size).all()


@pytest.mark.slow
@pytest.mark.parametrize("program", [programs.squeal, programs.rest, programs.critical_friction])
@pytest.mark.optimised
def test_gradients_of_a_hundred_thousand_mechanisms(program):
    x = mechanisms(places(np.random.default_rng(9), 100_000, MECHANISM_COLUMNS))
    compare_gradients(x, *(of(x) for of in programs.of_rows(program)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "check",
    [
        check_finite,
        check_eigenvalues_rebuild_the_polynomial,
        check_growth_rate_is_that_of_the_state_matrix,
        check_unit_of_time,
    ],
)
@pytest.mark.optimised
def test_a_hundred_thousand_mechanisms(check: Callable):
    slow = check is check_eigenvalues_rebuild_the_polynomial
    check(places(np.random.default_rng(7), 10_000 if slow else 100_000, MECHANISM_COLUMNS))


def row(**changes):
    base = dict(
        zip(NAMES, [1.0, 6e3, 5e3, 1e-3, 7e-3, 5.0, 0.15, 4e8, 2e8, 0.4, 0.25, 0.5], strict=True)
    )
    return np.array([[(base | changes)[name] for name in NAMES]])


@pytest.mark.slow
def test_an_eigenvalue_that_rounding_makes_zero_has_a_damping_ratio():
    """Found by the search: NaN, and with it every derivative of the scene in reverse mode."""
    x = row(m=0.0267, omega_1=1.0, omega_2=1.0, xi_1=1e4, xi_2=1e4, F=0.0, K_n=1e15, K_t=0.0)
    found = programs.of_rows(programs.squeal)[0](x)
    assert np.isfinite(found["damping_ratio"]).all()
    gradient = jax.jit(jax.vmap(jax.grad(lambda x: programs.squeal(x)["damping_ratio"])))(x)
    assert np.isfinite(gradient).all()


@pytest.mark.slow  # compiles four programs
def test_derivatives_in_single_precision_do_not_leave_its_range():
    """Found by the search: omega^8 overflowed in the margin's, a square of damping in mu_c's."""
    stiff = row(K_n=1e13, K_t=5e12).astype(np.float32)
    light = row(K_n=2e14, K_t=6e11, xi_1=4e-7, xi_2=5e-7, omega_2=10.0).astype(np.float32)
    for program, name, x in (
        (programs.growth_and_margin, "margin", stiff),
        (programs.critical_friction, "mu_c", light),
    ):
        one = jax.jit(jax.vmap(jax.grad(lambda x: program(x)[name])))  # noqa: B023
        exact = np.asarray(one(x.astype(float)))
        np.testing.assert_allclose(one(x), exact, rtol=1e-3, atol=1e-4 * np.abs(exact).max())
