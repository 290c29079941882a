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
from fractaljax.surface.roughness import root_mean_square_height, roughness

L, N, KEYS = 1e-3, 48, 150


def exact(x, count):
    """(Sq, Sdq) of Eq. 13, wave by wave."""
    D, G, gamma, L = x
    square = slope = mpmath.mpf(0)
    for n in range(count):
        height = L**2 * (G / L) ** (2 * D - 4) * mpmath.log(gamma) * gamma ** (2 * (D - 3) * n) / 2
        square += height
        slope += height * (2 * mpmath.pi * gamma**n / L) ** 2
    return mpmath.sqrt(square), mpmath.sqrt(slope)


CASES = [
    (2.4, 1.342e-10, 1.5, 1e-3, 1e-6),
    (2.001, 1e-12, 1.3, 1e-2, 1e-7),
    (2.999, 1e-8, 2, 1, 1e-3),
]


@jax.jit
def everything(x, L_s):
    """Sq and Sdq, and their derivatives by D, G, gamma and L in both modes."""

    def both(x):
        found = roughness(fj.Surface(*x[:3]), x[3], L_s)
        return jnp.stack([found.Sq, found.Sdq])

    return both(x), jax.jacfwd(both)(x), jax.jacrev(both)(x)


@pytest.mark.parametrize("case", CASES)
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


def test_batches():
    """Of surfaces, and under vmap."""
    surfaces = fj.Surface(jnp.array([2.3, 2.7]), 1e-10)
    found = roughness(surfaces, L, 1e-6)
    mapped = jax.vmap(lambda D: roughness(fj.Surface(D, 1e-10), L, 1e-6))(surfaces.D)
    for i, D in enumerate((2.3, 2.7)):
        alone = roughness(fj.Surface(D, 1e-10), L, 1e-6)
        for name in ("Sq", "Sa", "Sdq"):
            assert getattr(alone, name) == pytest.approx(float(getattr(found, name)[i]), rel=1e-13)
            assert getattr(alone, name) == pytest.approx(float(getattr(mapped, name)[i]), rel=1e-13)


def test_it_counts_its_waves():
    """The sum over n term by term, where L/L_s is a power of gamma and just beside."""
    surface = fj.Surface(2.5, 1e-10, 1.5)
    for ratio, count in [(1.5**7, 8), (1.5**7 * 0.999, 7), (1.5**7 * 1.001, 8), (1.01, 1)]:
        waves = sum(1.5 ** (2 * (2.5 - 3) * n) for n in range(count))
        expected = 1e-3 * (1e-10 / 1e-3) ** 0.5 * math.sqrt(math.log(1.5) / 2 * waves)
        found = root_mean_square_height(surface, 1e-3, 1e-3 / ratio)
        assert found == pytest.approx(expected, rel=1e-13)


def test_single_precision_counts_the_same_waves():
    """A power of a gamma that single precision rounds, either way."""
    for gamma in (1.3, 1.7):
        surface = fj.Surface(2.5, 1e-10, gamma)
        single = jax.tree.map(lambda x: x.astype(jnp.float32), surface)
        for n in range(1, 20):
            L_s = L / gamma**n
            double = float(root_mean_square_height(surface, L, L_s))
            assert float(root_mean_square_height(single, L, L_s)) == pytest.approx(double, rel=1e-5)


# ---------------------------------------------------------------------------------------------
# Against surfaces
# ---------------------------------------------------------------------------------------------


def height(surface, L, L_s, M, x, y, phases):
    """Eq. 13 summed term by term, without its constant part."""
    D, G, gamma = (float(part) for part in (surface.D, surface.G, surface.gamma))
    n_max = int(math.log(L / L_s) / math.log(gamma))
    z = np.zeros_like(x)
    for m in range(1, M + 1):
        along = np.hypot(x, y) * np.cos(np.arctan2(y, x) - math.pi * m / M)
        for n in range(n_max + 1):
            wave = 2 * math.pi * gamma**n * along / L
            z -= gamma ** ((D - 3) * n) * np.cos(wave + phases[m - 1, n])
    return L * (G / L) ** (D - 2) * math.sqrt(math.log(gamma) / M) * z


@pytest.mark.parametrize(("D", "G", "gamma"), [(2.4, 1.342e-10, 1.5), (2.85, 1e-9, 1.3)])
def test_areas_much_larger_than_L(D, G, gamma):
    """Mean square and mean absolute height of surfaces, over points spread far beyond L."""
    surface, L_s, M = fj.Surface(D, G, gamma), 1e-4, 8
    random = np.random.default_rng(1)
    x, y = random.uniform(-50 * L, 50 * L, size=(2, 4000))
    z = np.stack(
        [height(surface, L, L_s, M, x, y, random.uniform(0, 2 * np.pi, (M, 40))) for _ in range(12)]
    )
    expected = roughness(surface, L, L_s)
    assert math.sqrt(np.mean(z**2)) == pytest.approx(float(expected.Sq), rel=0.01)
    assert abs(z).mean() == pytest.approx(float(expected.Sa), rel=0.01)


@jax.jit
def draw(D, keys):
    surface = fj.Surface(D, 1e-10)
    return jax.vmap(lambda key: fj.topography(surface, L, N, key=key, L_s=L / 8))(keys)


@functools.cache
def ensemble(D) -> np.ndarray:
    """Surfaces (keys, n, n) on areas L x L, down to L/8: slopes need a fine grid."""
    return np.asarray(draw(D, jax.random.split(jax.random.key(5), KEYS)))


def assert_mean(samples, expected):
    """The mean over keys is as expected within four standard errors, and those are small."""
    error = samples.std(ddof=1) / math.sqrt(len(samples))
    assert abs(samples.mean() - expected) < 4 * error and error < 0.05 * expected


def without(z, *removed):
    """Surfaces less their least-squares fit by some functions on the grid."""
    basis, _ = np.linalg.qr(np.stack([f.ravel() for f in removed], axis=1))
    flat = z.reshape(len(z), -1)
    return flat - flat @ basis @ basis.T


def removed_square(D, *removed):
    """The mean square that goes with the fit: of every wave the part that lies in its span."""
    basis, _ = np.linalg.qr(np.stack([f.ravel() for f in removed], axis=1))
    x, y = np.meshgrid(np.arange(N) / N, np.arange(N) / N, indexing="ij")
    total = 0.0
    for n in range(1 + int(math.log(8) / math.log(1.5))):
        square = L**2 * (1e-10 / L) ** (2 * D - 4) * math.log(1.5) / 2 * 1.5 ** (2 * (D - 3) * n)
        for m in range(1, 11):
            a = math.pi * m / 10
            wave = np.exp(2j * np.pi * 1.5**n * (x * math.cos(a) + y * math.sin(a))).ravel()
            total += square / 10 * np.sum(abs(basis.T @ wave) ** 2) / N**2
    return total


PLANE = (np.ones((N, N)), *np.meshgrid(np.arange(N) - N / 2, np.arange(N) - N / 2, indexing="ij"))


@pytest.mark.parametrize(("D", "by_mean", "by_plane"), [(2.05, 0.0043, 0.08), (2.4, 0.0043, 0.065)])
def test_areas_of_the_size_of_L(D, by_mean, by_plane):
    """Sq less what mean or plane take with them: little, and more, as the docstring says."""
    z, expected = ensemble(D), float(roughness(fj.Surface(D, 1e-10), L, L / 8).Sq)
    for removed, least in [(PLANE[:1], by_mean), (PLANE, by_plane)]:
        square = expected**2 - removed_square(D, *removed)
        assert_mean((without(z, *removed) ** 2).mean(axis=1), square)
        assert 0.5 * least < 1 - math.sqrt(square) / expected < least


@pytest.mark.parametrize("D", [2.05, 2.4])
def test_gradient_of_sampled_surfaces(D):
    """Sdq from differences over the grid, which see sin(k dx)/dx of every wavenumber k."""
    z, dx = ensemble(D), L / N
    slopes = [(np.diff(z, axis=axis) / dx) ** 2 for axis in (1, 2)]
    squares = sum(slope.mean(axis=(1, 2)) for slope in slopes)
    seen = 0.0
    for n in range(1 + int(math.log(8) / math.log(1.5))):
        square = L**2 * (1e-10 / L) ** (2 * D - 4) * math.log(1.5) / 2 * 1.5 ** (2 * (D - 3) * n)
        for m in range(1, 11):
            a = math.pi * m / 10
            for k in 2 * np.pi * 1.5**n / L * np.array([math.cos(a), math.sin(a)]):
                seen += square / 10 * (2 * math.sin(k * dx / 2) / dx) ** 2
    assert_mean(squares, seen)
    expected = float(roughness(fj.Surface(D, 1e-10), L, L / 8).Sdq)
    assert 0.98 < math.sqrt(seen) / expected < 1


@pytest.mark.parametrize("D", [2.01, 2.4, 2.9])
def test_mean_absolute_height_is_nearly_gaussian(D):
    """E|X| = (2/pi) int (1 - prod J0(a t))/t^2 dt of ten waves each: 0.64 percent more at most."""

    def integrand(t, a):
        return (1 - np.prod(j0(a * t) ** 10)) / t**2

    worst = 0.0
    for count in (1, 2, 18):
        a = 1.5 ** ((D - 3) * np.arange(count))
        a *= math.sqrt(2 / (10 * np.sum(a**2)))  # of unit mean square
        end = 60.0
        integral, _ = quad(integrand, 1e-9, end, (a,), limit=500)
        ratio = 2 / math.pi * (integral + 1 / end) / math.sqrt(2 / math.pi)
        assert 0 < ratio - 1 < 0.0064
        worst = max(worst, ratio - 1)
    assert worst > 0.0063
    found = roughness(fj.Surface(D, 1e-10), L, 1e-6)
    assert found.Sa == pytest.approx(math.sqrt(2 / math.pi) * float(found.Sq), rel=1e-14)


@pytest.mark.parametrize(
    ("L", "L_s", "message"),
    [
        (0.0, 1e-6, "L must be above 0, got 0.0"),
        (1e-3, -1.0, "L_s must be above 0, got -1.0"),
        (1e-6, 1e-3, "L must be at least L_s = 0.001, got 1e-06"),
        (math.nan, 1e-6, "L must be above 0, got nan"),
    ],
)
def test_refusals(L, L_s, message):
    """One clear line."""
    with pytest.raises(ValueError) as caught:
        roughness(fj.Surface(2.5, 1e-10), L, L_s)
    assert message in str(caught.value) and "\n" not in str(caught.value)
