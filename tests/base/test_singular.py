"""Functions with a singular point: value, first and second derivative there and beside it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

from fractaljax._base.singular import (
    boxcox,
    exp_or_inf,
    exprel,
    polynomial,
    positive_cbrt,
    positive_sqrt,
    safe_divide,
)

BESIDE = [1e-300, 1e-14, 1e-10, 1e-7, 1e-5, 1e-3, 1e-2]
EDGE = [0.24, 0.25 - 1e-16, 0.25, 0.25 + 1e-15, 0.26]  # where the series ends
FAR = [0.5, 1.0, 3.0, 10.0, 50.0]
POINTS = np.array([0.0, *(sign * x for x in BESIDE + EDGE + FAR for sign in (1, -1))])
FIRST = pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
ORDERS = pytest.mark.parametrize(
    ("first", "second"),
    [
        (jax.jacfwd, lambda f: jax.jacfwd(jax.jacfwd(f))),
        (jax.jacrev, lambda f: jax.jacrev(jax.jacrev(f))),
        (jax.grad, lambda f: jax.jacfwd(jax.jacrev(f))),
    ],
    ids=["forward", "reverse", "mixed"],
)


def exprel_truth(x):
    """exprel and its first two derivatives, to 40 digits however small x is."""
    if x == 0:
        return mpf(1), mpf(1) / 2, mpf(1) / 3
    with mp.workdps(1000):  # 1e-300 cubed cancels 900 digits
        x = mpf(x)
        exp = mp.exp(x)
        return (exp - 1) / x, (exp * (x - 1) + 1) / x**2, (exp * (x**2 - 2 * x + 2) - 2) / x**3


def relative(found, truth):
    return float(abs(mpf(float(found)) / truth - 1))


@ORDERS
def test_exprel(first, second):
    """(e^x - 1)/x, slope and curvature at x = 0, beside it and across the series radius."""
    found = jax.jit(jax.vmap(lambda x: (exprel(x), first(exprel)(x), second(exprel)(x))))(POINTS)
    # Beyond the series, each order subtracts numbers up to 1/x times its own size.
    for order, bound in enumerate([1e-15, 1e-14, 1e-13]):
        for x, value in zip(POINTS, found[order], strict=True):
            assert relative(value, exprel_truth(x)[order]) < bound, (order, x)


def test_exprel_limit_float32_and_polynomials():
    assert exprel(0.0) == 1.0 and jax.grad(exprel)(0.0) == 0.5
    points = POINTS.astype(np.float32)
    found, slope = exprel(points), jax.vmap(jax.grad(exprel))(points)
    assert found.dtype == slope.dtype == np.float32
    for x, value, derivative in zip(points, found, slope, strict=True):
        truth = exprel_truth(float(x))
        assert relative(value, truth[0]) < 1e-6 and relative(derivative, truth[1]) < 1e-5, x
    x = np.linspace(-2, 2, 6).reshape(2, 3)
    found = polynomial([3.0, -1.0, 0.0, 0.5], jnp.asarray(x))
    np.testing.assert_allclose(found, 3 * x**3 - x**2 + 0.5, rtol=1e-14)
    assert polynomial([1.0, 2.0], jnp.float32(3)).dtype == jnp.float32


def boxcox_truth(t, r):
    """(e^(rt) - 1)/r, its gradient and its Hessian in (t, r); and the terms they are sums of."""
    with mp.workdps(60):
        t, r = mpf(t), mpf(r)
        value, slope, curvature = exprel_truth(r * t)
        exp = mp.exp(r * t)
        truth = t * value, [exp, t**2 * slope], [[r * exp, t * exp], [t * exp, t**3 * curvature]]
        # Of t exprel(rt): where e^(rt) is small, it is the difference of terms that are not.
        mixed = 2 * t * slope
        terms = t * value, [value, t**2 * slope], [[2 * r * slope, mixed], [mixed, truth[2][1][1]]]
    return truth, terms


@ORDERS
def test_boxcox(first, second):
    """(x^r - 1)/r from ln x: value, gradient and Hessian for small and large r ln x, r = 0 too."""
    t, r = np.meshgrid([0.0, 1e-300, 1e-8, 0.1, 3.0, 40.0], [0.0, 1e-14, -1e-9, 1e-3, -0.3, 0.5])
    points = np.stack([t.ravel(), r.ravel()], axis=1)

    def vector(tr):
        return boxcox(tr[0], tr[1])

    found = jax.jit(jax.vmap(lambda x: (vector(x), first(vector)(x), second(vector)(x))))(points)
    for i, point in enumerate(points):
        truth, terms = boxcox_truth(*point)
        for order, bound in enumerate([1e-15, 3e-15, 3e-14]):
            cells = [np.ravel(x) for x in (found[order][i], truth[order], terms[order])]
            for value, true, term in zip(*cells, strict=True):
                # Absolute below 1e-290, where the range of a double ends.
                size = max(abs(true), abs(term)) + mpf("1e-290")
                assert abs(mpf(float(value)) - true) < bound * size, (order, point)


ROOTS = pytest.mark.parametrize(("root", "n"), [(positive_cbrt, 3), (positive_sqrt, 2)])


@ROOTS
@FIRST
def test_roots(root, n, mode):
    """Exactly 0 for x <= 0 in value, slope and curvature; above, huge slopes but finite ones."""
    both = jax.jit(jax.vmap(lambda x: (root(x), mode(root)(x), mode(mode(root))(x))))
    for order in both(np.array([0.0, -0.0, -1e-300, -1e-14, -1.0, -1e300, -np.inf])):
        np.testing.assert_array_equal(order, 0)
    points = np.array([3e-308, 1e-300, 1e-100, 1e-16, 1e-3, 1.0, 7.5, 1e300])
    for x, value, slope in zip(points, *both(points)[:2], strict=True):
        with mp.workdps(40):
            power = mpf(1) / n
            assert relative(value, mpf(x) ** power) < 1e-15, x
            assert relative(slope, power * mpf(x) ** (power - 1)) < 2e-15, x


@FIRST
def test_safe_divide(mode):
    """The quotient and its derivatives, and `otherwise` with its own where the divisor is 0."""

    def at(*x):
        return [float(safe_divide(*x)), *map(float, mode(safe_divide, argnums=(0, 1, 2))(*x))]

    assert at(3.0, 2.0, 7.0) == [1.5, 0.5, -0.75, 0.0]
    for zero in (0.0, -0.0):
        assert at(3.0, zero, 7.0) == [7.0, 0.0, 0.0, 1.0]
    assert safe_divide(3.0, 1e-300, 7.0) == 3.0 / 1e-300


@FIRST
@pytest.mark.parametrize(("dtype", "last"), [(np.float64, 709.7), (np.float32, 88.7)])
def test_exp_or_inf(mode, dtype, last):
    """exp as far as the dtype reaches; beyond, infinity whose derivative is 0."""
    x = np.array([-1e4, -1.0, 0.0, last, last + 0.1, 1e4], dtype)
    values, slopes = jax.jit(jax.vmap(lambda x: (exp_or_inf(x), mode(exp_or_inf)(x))))(x)
    assert values.dtype == slopes.dtype == dtype
    np.testing.assert_array_equal(values[4:], np.inf)
    np.testing.assert_array_equal(slopes[4:], 0)
    np.testing.assert_allclose(values[:4], np.exp(x[:4]), rtol=4 * np.finfo(dtype).eps)
    np.testing.assert_array_equal(slopes[:4], values[:4])
