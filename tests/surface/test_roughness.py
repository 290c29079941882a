"""Roughness parameters against sums in 40 digits, and against surfaces summed directly."""

import functools
import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

import fractaljax as fj
from fractaljax._surface.roughness import root_mean_square, roughness
from tools import both_modes, refusals

L, N, KEYS, GAMMA, G = 1e-3, 48, 150, 1.5, 1e-10


def exact(x, count):
    """(Sq, Sdq) of Eq. 13, wave by wave."""
    D, G, gamma, L = x
    square = slope = mpmath.mpf(0)
    for n in range(count):
        height = L**2 * (G / L) ** (2 * D - 4) * mpmath.log(gamma) * gamma ** (2 * (D - 3) * n) / 2
        square += height
        slope += height * (2 * mpmath.pi * gamma**n / L) ** 2
    return mpmath.sqrt(square), mpmath.sqrt(slope)


@jax.jit
def everything(x, L_s):
    """Sq and Sdq, and their derivatives by D, G, gamma and L in both modes."""

    def both(x):
        found = roughness(fj.Surface(*x[:3]), x[3], L_s)
        return jnp.stack([found.Sq, found.Sdq])

    return both_modes(both, x)


@pytest.mark.parametrize(
    "case",
    [(2.4, 1.342e-10, 1.5, 1e-3, 1e-6), (2.001, 1e-12, 1.3, 1e-2, 1e-7), (2.999, 1e-8, 2, 1, 1e-3)],
)
def test_values_and_derivatives(case):
    """Against sums, and differences of sums, in 40 digits."""
    *x, L_s = case
    count = 1 + int(math.log(x[3] / L_s) / math.log(x[2]))
    values, *slopes = everything(jnp.array(x, float), L_s)
    with mpmath.workdps(40):
        at = [mpmath.mpf(value) for value in x]
        np.testing.assert_allclose(values, np.array(exact(at, count), float), rtol=1e-11)
        for i in range(4):
            step = at[i] * mpmath.mpf(10) ** -15
            ends = [exact([*at[:i], at[i] + s, *at[i + 1 :]], count) for s in (step, -step)]
            expected = [float((up - down) / (2 * step)) for up, down in zip(*ends, strict=True)]
            for slope in slopes:
                np.testing.assert_allclose(slope[:, i], expected, rtol=1e-9)


@jax.jit
def of_numbers(D, G, gamma, L, L_s):
    return roughness(fj.Surface(D, G, gamma), L, L_s)


def test_roughness_scales():
    """With G as G^(D-2) alone; a larger copy of a surface is as steep and higher."""
    u = np.random.default_rng(3).uniform(size=(5, 500))
    D, G, gamma = 2 + 1e-6 + (1 - 2e-6) * u[0], 10 ** (-18 + 14 * u[1]), 1 + 10 ** (4 * u[2] - 3)
    L = 10 ** (9 * u[3] - 8)
    L_s = L / 10 ** (8 * u[4])
    base = of_numbers(D, G, gamma, L, L_s)
    rougher = of_numbers(D, 16.0 * G, gamma, L, L_s)
    larger = of_numbers(D, 8.0 * G, gamma, 8.0 * L, 8.0 * L_s)
    for name, length in (("Sq", 8.0), ("Sa", 8.0), ("Sdq", 1.0)):
        value = np.asarray(getattr(base, name))
        assert (value > 0).all() and np.isfinite(value).all()
        np.testing.assert_allclose(getattr(rougher, name) / value, 16.0 ** (D - 2), rtol=1e-12)
        np.testing.assert_allclose(getattr(larger, name), length * value, rtol=1e-12)


def test_batches_and_powers_of_gamma():
    """Of surfaces, and under vmap."""
    D = jnp.array([2.3, 2.7])
    found = roughness(fj.Surface(D, G), L, 1e-6)
    mapped = jax.vmap(lambda D: roughness(fj.Surface(D, G), L, 1e-6))(D)
    alone = roughness(fj.Surface(2.7, G), L, 1e-6)
    for name, value in vars(alone).items():
        np.testing.assert_allclose(getattr(found, name), getattr(mapped, name), rtol=1e-13)
        assert value == pytest.approx(float(getattr(found, name)[1]), rel=1e-13)
    # L/L_s a power of gamma or just beside it, in double and in single precision.
    for ratio, count in [(1.5**7, 8), (1.5**7 * 0.999, 7), (1.5**7 * 1.001, 8), (1.01, 1)]:
        waves = sum(1.5 ** (2 * (2.5 - 3) * n) for n in range(count))
        expected = 1e-3 * (1e-10 / 1e-3) ** 0.5 * math.sqrt(math.log(1.5) / 2 * waves)
        found = root_mean_square(fj.Surface(2.5, G), 1e-3, 1e-3 / ratio)
        assert found == pytest.approx(expected, rel=1e-13)
    for gamma in (1.3, 1.7):  # rounded either way
        surface = fj.Surface(2.5, G, gamma)
        single = jax.tree.map(lambda x: x.astype(jnp.float32), surface)
        L_s = L / gamma ** np.arange(1.0, 20.0)
        double = root_mean_square(surface, L, L_s)
        np.testing.assert_allclose(root_mean_square(single, L, L_s), double, rtol=1e-5)


def waves(D, L_s=L / 8):
    """Cycles per L along x and y, and mean square, of every wave of a surface."""
    count = 1 + int(math.log(L / L_s) / math.log(GAMMA))
    n, a = np.meshgrid(np.arange(count), np.pi * np.arange(1, 11) / 10, indexing="ij")
    square = L**2 * (G / L) ** (2 * D - 4) * math.log(GAMMA) / 20 * GAMMA ** (2 * (D - 3) * n)
    return (GAMMA**n * np.cos(a)).ravel(), (GAMMA**n * np.sin(a)).ravel(), square.ravel()


@pytest.mark.parametrize("D", [2.4, 2.85])
def test_areas_much_larger_than_L(D):
    """Mean square and mean absolute height of Eq. 13 over points spread far beyond L."""
    random = np.random.default_rng(1)
    x, y = random.uniform(-50, 50, size=(2, 4000))
    kx, ky, square = waves(D, 1e-4)
    z = np.stack(
        [
            np.cos(2 * np.pi * (np.outer(x, kx) + np.outer(y, ky) + random.uniform(size=kx.shape)))
            @ np.sqrt(2 * square)
            for _ in range(12)
        ]
    )
    expected = roughness(fj.Surface(D, G), L, 1e-4)
    assert math.sqrt(np.mean(z**2)) == pytest.approx(float(expected.Sq), rel=0.01)
    assert abs(z).mean() == pytest.approx(float(expected.Sa), rel=0.01)


@jax.jit
def draw(D, keys):
    surface = fj.Surface(D, G)
    # Not vmapped, which takes longer to compile.
    return jax.lax.map(lambda key: fj.topography(surface, L, N, key=key, L_s=L / 8), keys)


@functools.cache
def ensemble(D) -> np.ndarray:
    """Surfaces (keys, n, n) on areas L x L, down to L/8: slopes need a fine grid."""
    return np.asarray(draw(D, jax.random.split(jax.random.key(5), KEYS)))


def assert_mean(samples, expected):
    """The mean over keys is as expected within four standard errors, and those are small."""
    error = samples.std(ddof=1) / math.sqrt(len(samples))
    assert abs(samples.mean() - expected) < 4 * error and error < 0.05 * expected


X, Y = np.meshgrid(np.arange(N) / N, np.arange(N) / N, indexing="ij")
PLANE = (np.ones((N, N)), X, Y)


@pytest.mark.parametrize(("D", "by_mean", "by_plane"), [(2.05, 0.0043, 0.08), (2.4, 0.0043, 0.065)])
def test_areas_of_the_size_of_L(D, by_mean, by_plane):
    """Sq less what mean or plane take with them: little, and more, as the docstring says."""
    z, expected = ensemble(D), float(roughness(fj.Surface(D, G), L, L / 8).Sq)
    for removed, least in [(PLANE[:1], by_mean), (PLANE, by_plane)]:
        basis, _ = np.linalg.qr(np.stack([f.ravel() for f in removed], axis=1))
        taken = sum(  # of every wave the part in the span
            square * np.sum(abs(basis.T @ np.exp(2j * np.pi * (kx * X + ky * Y)).ravel()) ** 2)
            for kx, ky, square in zip(*waves(D), strict=True)
        )
        left = expected**2 - taken / N**2
        flat = z.reshape(len(z), -1)
        assert_mean(((flat - flat @ basis @ basis.T) ** 2).mean(axis=1), left)
        assert 0.5 * least < 1 - math.sqrt(left) / expected < least


@pytest.mark.parametrize("D", [2.05, 2.4])
def test_gradient_of_sampled_surfaces(D):
    """Sdq from differences over the grid, which see sin(k dx)/dx of every wavenumber k."""
    z, dx = ensemble(D), L / N
    slopes = [(np.diff(z, axis=axis) / dx) ** 2 for axis in (1, 2)]
    kx, ky, square = waves(D)
    seen = sum(np.sum(square * (2 * np.sin(np.pi * k / N) / dx) ** 2) for k in (kx, ky))
    assert_mean(sum(slope.mean(axis=(1, 2)) for slope in slopes), seen)
    expected = float(roughness(fj.Surface(D, G), L, L / 8).Sdq)
    assert 0.98 < math.sqrt(seen) / expected < 1


@pytest.mark.parametrize("D", [2.01, 2.4, 2.9])
def test_mean_absolute_height_is_nearly_gaussian(D):
    """E|X| = (2/pi) int (1 - prod J0(a t))/t^2 dt of ten waves each: 0.64 percent more at most."""
    excess = []
    for count in (1, 2, 18):
        a = 1.5 ** ((D - 3) * np.arange(count))
        a *= math.sqrt(2 / (10 * np.sum(a**2)))  # of unit mean square
        end = 60.0
        integral, _ = quad(
            lambda t, a: (1 - np.prod(j0(a * t) ** 10)) / t**2, 1e-9, end, (a,), limit=500
        )
        excess.append(2 / math.pi * (integral + 1 / end) / math.sqrt(2 / math.pi) - 1)
    assert min(excess) > 0 and 0.0063 < max(excess) < 0.0064
    found = roughness(fj.Surface(D, G), L, 1e-6)
    assert found.Sa == pytest.approx(math.sqrt(2 / math.pi) * float(found.Sq), rel=1e-14)


test_refusals = refusals(
    [
        (0.0, 1e-6, r"^L must be above 0, got 0\.0$"),
        (1e-3, -1.0, r"^L_s must be above 0, got -1\.0$"),
        (1e-6, 1e-3, r"^L must be at least L_s = 0\.001, got 1e-06$"),
    ],
    lambda L, L_s: roughness(fj.Surface(2.5, G), L, L_s),
)
