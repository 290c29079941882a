"""The Weierstrass-Mandelbrot sum against Eq. 13 term by term, and against what it is on average."""

import functools
import itertools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.surface.topography import random_turns, topography

D, G, L = 2.4, 1.342e-10, 1e-3
SURFACE = fj.Surface(D, G)
KEY = jax.random.key(7)


def frequencies(n, gamma=1.5):
    """How many there are down to 2 L/n."""
    return 1 + int(math.log(n / 2) / math.log(gamma))


def phases(key, count, M=10):
    return 2 * math.pi * np.asarray(random_turns(key, count, M))


def double_sum(points, D, G, L, M, phi, gamma=1.5):
    """Eq. 13 as it is printed."""
    x, y = points
    z = np.zeros(x.shape)
    r, theta = np.hypot(x, y), np.arctan2(y, x)
    for m in range(1, M + 1):
        for n, row in enumerate(phi):
            wave = 2 * math.pi * gamma**n * r / L * np.cos(theta - math.pi * m / M)
            wave += row[m - 1]
            z += gamma ** ((D - 3) * n) * (math.cos(row[m - 1]) - np.cos(wave))
    return L * (G / L) ** (D - 2) * math.sqrt(math.log(gamma) / M) * z


def grid(n, L=L):
    return np.meshgrid(np.arange(n) * L / n, np.arange(n) * L / n, indexing="ij")


@pytest.mark.parametrize(
    ("n", "M", "gamma", "L_s"),
    [(48, 10, 1.5, None), (33, 3, 1.2, 1e-4), (17, 1, 1.5, 1e-6), (2, 10, 1.5, None)],
)
def test_equals_the_double_sum(n, M, gamma, L_s):
    """Even and odd grids, one direction, wavelengths that the grid does not resolve."""
    count = 1 + int(math.log(n / 2 if L_s is None else L / L_s) / math.log(gamma))
    z = topography(fj.Surface(2.6, 1e-9, gamma), L, n, key=KEY, L_s=L_s, M=M)
    expected = double_sum(grid(n), 2.6, 1e-9, L, M, phases(KEY, count, M), gamma)
    assert z.shape == (n, n) and z.dtype == jnp.float64
    np.testing.assert_allclose(z, expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_many_waves_are_taken_in_blocks():
    """More of them than one product of matrices takes, not a multiple of it."""
    n, gamma = 40, 1.08
    count = frequencies(n, gamma)
    assert count * 10 > 256 and count * 10 % 256
    z = topography(fj.Surface(D, G, gamma), L, n, key=KEY)
    expected = double_sum(grid(n), D, G, L, 10, phases(KEY, count), gamma)
    np.testing.assert_allclose(z, expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_equals_mpmath_at_a_few_points():
    """Eq. 13 in 40 digits, the grid's own corner and its far one among the points."""
    n = 512
    count = frequencies(n)
    turns = np.asarray(random_turns(KEY, count, 10))
    z = topography(SURFACE, L, n, key=KEY)
    scale = float(fj.roughness(SURFACE, L, 2 * L / n).Sq)
    with mpmath.workdps(40):
        mp = mpmath.mpf
        front = mp(L) * (mp(G) / mp(L)) ** (mp(D) - 2) * mpmath.sqrt(mpmath.log(mp(1.5)) / 10)
        for i, j in [(0, 0), (1, 2), (511, 511), (511, 0), (123, 321)]:
            total = mp(0)
            for k in range(count):
                for m in range(1, 11):
                    phi = 2 * mpmath.pi * mp(turns[k, m - 1])
                    a = mpmath.pi * m / 10
                    along = (i * mpmath.cos(a) + j * mpmath.sin(a)) / n
                    wave = 2 * mpmath.pi * mp(1.5) ** k * along + phi
                    height = mp(1.5) ** ((mp(D) - 3) * k)
                    total += height * (mpmath.cos(phi) - mpmath.cos(wave))
            assert abs(float(front * total) - float(z[i, j])) < 1e-12 * scale


def test_origin_is_at_height_zero():
    """The bracket of Eq. 13 is 0 where x = y = 0, whatever the phases."""
    z = topography(SURFACE, L, 64, key=KEY)
    assert abs(float(z[0, 0])) < 1e-13 * float(jnp.ptp(z))


def test_a_finer_grid_is_the_same_surface():
    """The same waves at other points; and with finer ones added, only those are new."""
    coarse = topography(SURFACE, L, 32, key=KEY, L_s=1e-4)
    fine = topography(SURFACE, L, 64, key=KEY, L_s=1e-4)
    np.testing.assert_allclose(fine[::2, ::2], coarse, rtol=0, atol=1e-18)
    added = topography(SURFACE, L, 64, key=KEY, L_s=1e-5) - fine
    whole = phases(KEY, 12)
    rest = double_sum(grid(64), D, G, L, 10, whole) - double_sum(grid(64), D, G, L, 10, whole[:6])
    np.testing.assert_allclose(added, rest, rtol=0, atol=1e-18)


def test_powers_of_gamma_belong_to_the_sum():
    """n_max counts a ratio that is a power of gamma, whatever its rounding, in every precision."""
    for ratio, count in [(1.7**7, 8), (1.7**7 * 0.999, 7), (1.7**7 * 1.001, 8), (1.0, 1)]:
        for dtype in (jnp.float32, jnp.float64):
            surface = jax.tree.map(lambda x: x.astype(dtype), fj.Surface(2.5, 1e-10, 1.7))  # noqa: B023
            z = topography(surface, 1e-3, 8, key=KEY, L_s=1e-3 / ratio)
            expected = double_sum(grid(8), 2.5, 1e-10, 1e-3, 10, phases(KEY, count), 1.7)
            assert z.dtype == dtype
            np.testing.assert_allclose(z, expected, rtol=0, atol=1e-5 * abs(expected).max())


def test_single_precision_keeps_its_digits():
    """Phases of thousands of radians are reduced before they are rounded."""
    n = 1024
    single = jax.tree.map(lambda x: x.astype(jnp.float32), fj.Surface(2.9, 1e-10))
    z = topography(single, 1e-3, n, key=KEY)
    double = topography(jax.tree.map(lambda x: x.astype(float), single), 1e-3, n, key=KEY)
    assert z.dtype == jnp.float32
    error = np.asarray(z, float) - np.asarray(double)
    assert abs(error).max() < 2e-5 * float(jnp.std(double))


# ---------------------------------------------------------------------------------------------
# Derivatives and batches
# ---------------------------------------------------------------------------------------------

AT = (2.45, 2e-10, 1.4, 1.3e-3)
SIDE = 5


@jax.jit
def weigh(z):
    return jnp.vdot(jnp.cos(jnp.arange(SIDE**2.0)).reshape(SIDE, SIDE), z) * 1e6


def measure(x):
    """A smooth number of a surface: at L_s = L/5, away from a power of gamma."""
    D, G, gamma, L = x
    return weigh(topography(fj.Surface(D, G, gamma), L, SIDE, key=KEY, L_s=1.3e-3 / 5, M=3))


def test_derivatives_in_both_modes():
    """By D, G, gamma and L against central differences in 30 digits."""
    phi = phases(KEY, 1 + int(math.log(5) / math.log(AT[2])), 3)

    def exact(D, G, gamma, L):
        total = mpmath.mpf(0)
        for k, row in enumerate(phi):
            for m in range(1, 4):
                a, phase = mpmath.pi * m / 3, mpmath.mpf(row[m - 1])
                for i, j in np.ndindex(SIDE, SIDE):
                    along = (i * mpmath.cos(a) + j * mpmath.sin(a)) / SIDE
                    wave = 2 * mpmath.pi * gamma**k * along + phase
                    height = mpmath.cos(phase) - mpmath.cos(wave)
                    total += weights[SIDE * i + j] * gamma ** ((D - 3) * k) * height
        return total * L * (G / L) ** (D - 2) * mpmath.sqrt(mpmath.log(gamma) / 3) * 10**6

    found = jax.jacrev(measure)(AT)
    forward = jax.jacfwd(measure)(AT)
    np.testing.assert_allclose(forward, found, rtol=1e-10)
    with mpmath.workdps(30):
        weights = [mpmath.mpf(float(w)) for w in jnp.cos(jnp.arange(SIDE**2.0))]
        step = mpmath.mpf(10) ** -9
        for i, slope in enumerate(found):
            ends = []
            for sign in (1, -1):
                at = [mpmath.mpf(value) for value in AT]
                at[i] *= 1 + sign * step
                ends.append(exact(*at))
            expected = (ends[0] - ends[1]) / (2 * mpmath.mpf(AT[i]) * step)
            assert float(slope) == pytest.approx(float(expected), rel=1e-9)


def test_second_derivatives():
    """By gamma, whose waves carry every order of it, against differences of the first."""

    def slope(gamma):
        return jax.grad(lambda gamma: measure((AT[0], AT[1], gamma, AT[3])))(gamma)

    expected = (slope(AT[2] + 1e-5) - slope(AT[2] - 1e-5)) / 2e-5
    second = jax.jvp(slope, (AT[2],), (1.0,))[1]
    assert float(second) == pytest.approx(float(expected), rel=1e-6)


def test_jit_and_vmap():
    """Over D, G and key; L may be traced where L_s is not given."""

    @jax.jit
    def batch(Ds, Gs, keys, L):
        def one(D, G, key):
            return topography(fj.Surface(D, G), L, 16, key=key)

        return jax.vmap(one)(Ds, Gs, keys)

    Ds, Gs = jnp.array([2.3, 2.7]), jnp.array([1e-10, 1e-9])
    keys = jax.random.split(KEY, 2)
    found = batch(Ds, Gs, keys, L)
    for i in range(2):
        alone = topography(fj.Surface(Ds[i], Gs[i]), L, 16, key=keys[i])
        np.testing.assert_allclose(found[i], alone, rtol=0, atol=1e-13 * float(jnp.ptp(alone)))
    moved = fj.brake_scene()
    z = jax.jit(lambda D: topography(moved.replace(D=D).contact.surface, L, 16, key=KEY))(2.3)
    np.testing.assert_allclose(z, topography(fj.Surface(2.3, G), L, 16, key=KEY), rtol=1e-9)


def test_old_keys_are_keys():
    """`jax.random.PRNGKey` gives the surface of `jax.random.key`."""
    old = topography(SURFACE, L, 8, key=jax.random.PRNGKey(7))
    np.testing.assert_array_equal(old, topography(SURFACE, L, 8, key=KEY))


# ---------------------------------------------------------------------------------------------
# On average over phases
# ---------------------------------------------------------------------------------------------

N, KEYS = 64, 150
LAGS = [(1, 0), (0, 3), (2, 5), (16, 0), (20, -20), (32, 7)]


@jax.jit
def draw(D, keys):
    return jax.vmap(lambda key: topography(fj.Surface(D, G), L, N, key=key))(keys)


@functools.cache
def ensemble(D=D) -> np.ndarray:
    """Surfaces (keys, n, n) of one D and G."""
    return np.asarray(draw(D, jax.random.split(jax.random.key(1), KEYS)))


def waves(D=D, n=N, M=10):
    """(k_x, k_y, mean square) of every wave of Eq. 13."""
    k, a = np.meshgrid(np.arange(frequencies(n)), np.pi * np.arange(1, M + 1) / M, indexing="ij")
    wavenumber = 2 * np.pi * 1.5**k / L
    square = L**2 * (G / L) ** (2 * D - 4) * math.log(1.5) / (2 * M) * 1.5 ** (2 * (D - 3) * k)
    return tuple(x.ravel() for x in (wavenumber * np.cos(a), wavenumber * np.sin(a), square))


def assert_means(samples, expected):
    """The mean over keys is as expected within four standard errors, and those are small."""
    error = samples.std(axis=0, ddof=1) / math.sqrt(len(samples))
    assert (abs(samples.mean(axis=0) - expected) < 4 * error).all()
    assert (error < 0.15 * expected).all()


def test_structure_function():
    """E[(z(x + r) - z(x))^2] = 2 sum of mean squares times 1 - cos(k.r), in every direction."""
    z, (kx, ky, square) = ensemble(), waves()
    samples, expected = [], []
    for i, j in LAGS:
        left, right = (slice(max(0, -j), N - max(0, j)), slice(max(0, j), N + min(0, j)))
        step = z[:, i:, right] - z[:, : N - i, left]
        samples.append((step**2).mean(axis=(1, 2)))
        expected.append(np.sum(2 * square * (1 - np.cos((kx * i + ky * j) * L / N))))
    assert_means(np.stack(samples, axis=1), np.array(expected))


WINDOW = np.hanning(N + 1)[:-1]  # its transform of a constant ends at the second point


def test_power_spectrum():
    """The windowed periodogram of profiles along x is every wave's line, as wide as the window."""
    z, (kx, _, square) = ensemble(), waves()
    found = abs(np.fft.rfft(z[:, :, ::8] * WINDOW[None, :, None], axis=1)) ** 2
    i, q = np.arange(N), 2 * np.pi * np.arange(2, N // 2 + 1) / L
    lines = sum(
        abs(np.exp(1j * np.subtract.outer(sign * kx, q)[..., None] * i * L / N) @ WINDOW) ** 2
        for sign in (1, -1)
    )
    assert_means(found.mean(axis=2)[:, 2:], (square[:, None] / 2 * lines).sum(axis=0))


@pytest.mark.parametrize("D", [2.4, 2.8])
def test_spectrum_is_the_continuous_power_law(D):
    """C(f) = G^(2D-4)/2 f^(2D-7) [m^3] for areas, integrated over bands of two frequencies."""
    window = np.multiply.outer(WINDOW, WINDOW)
    found = abs(np.fft.fft2(ensemble(D) * window)) ** 2 / (N**2 * np.sum(window**2))
    f = np.hypot(*np.meshgrid(*[np.fft.fftfreq(N, L / N)] * 2))
    edges = 1.5 ** np.array([4.5, 6.5, 8.5]) / L
    for low, high in itertools.pairwise(edges):
        power = found[:, (f >= low) & (f < high)].sum(axis=1).mean()
        law = G ** (2 * D - 4) / 2 * (low ** (2 * D - 6) - high ** (2 * D - 6)) / (6 - 2 * D)
        assert power == pytest.approx(law, rel=0.03)


def test_refusals_name_the_argument():
    """One clear line, and no surface."""
    good: dict[str, Any] = {"surface": SURFACE, "L": L, "n": 8, "key": KEY}
    many = jax.tree.map(lambda x: jnp.stack([x, x]), SURFACE)
    for change, kind, message in [
        ({"n": 1}, ValueError, "n must be a whole number of at least 2, got 1"),
        ({"n": 8.0}, ValueError, "n must be a whole number of at least 2, got 8.0"),
        ({"n": None}, ValueError, "n must be a whole number of at least 2, got None"),
        ({"M": 0}, ValueError, "M must be a whole number of at least 1, got 0"),
        ({"M": True}, ValueError, "M must be a whole number of at least 1, got True"),
        ({"L": 0.0}, ValueError, "L must be above 0, got 0.0"),
        ({"L": math.inf}, ValueError, "L must be above 0, got inf"),
        ({"L": "1 mm"}, TypeError, "L must be a number, got '1 mm'"),
        ({"L": jnp.array([1.0, 2.0])}, ValueError, "L must be a scalar, got shape (2,)"),
        ({"L_s": -1e-6}, ValueError, "L_s must be above 0, got -1e-06"),
        ({"L_s": 2e-3}, ValueError, "L must be at least L_s = 0.002, got 0.001"),
        ({"key": 3}, TypeError, "key must be one key of jax.random, got 3"),
        ({"key": None}, TypeError, "key must be one key of jax.random, got None"),
        ({"key": jnp.array(1.5)}, TypeError, "key must be one key of jax.random"),
        (
            {"key": jax.random.split(KEY)},
            ValueError,
            "key of jax.random, got an array of shape (2,)",
        ),
        (
            {"n": 2**40},
            ValueError,
            "1099511627776 x 1099511627776 points would take 2.90e+25 bytes",
        ),
        (
            {"n": 10**400},
            ValueError,
            "points would take 2.40e+801 bytes of memory; this machine has",
        ),
        ({"M": 2**50}, ValueError, "4 x 1125899906842624 waves would take"),
        ({"surface": fj.Surface(D, G, 1 + 3e-16)}, ValueError, " x 10 waves would take"),
        ({"L": 1e300, "L_s": 1e-300}, ValueError, "L/L_s must be finite, got inf"),
        ({"surface": many}, ValueError, "D must be a scalar, got shape (2,)"),
        ({"surface": "rough"}, TypeError, "surface must be a Surface, got 'rough'"),
    ]:
        with pytest.raises(kind) as caught:
            topography(**good | change)
        assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("gamma", lambda x: topography(fj.Surface(D, G, 1 + x), L, 8, key=KEY)),
        ("L", lambda x: topography(SURFACE, x, 8, key=KEY, L_s=1e-6)),
        ("L_s", lambda x: topography(SURFACE, 2.0, 8, key=KEY, L_s=x)),
    ],
)
def test_traced_structure_is_refused(name, make):
    """The number of waves cannot depend on what is traced; it says what cannot be."""
    for transform in (jax.jit, lambda f: lambda x: jax.vmap(f)(jnp.array([x, x]))):
        with pytest.raises(TypeError, match=f"^{name} must be known while a program is traced"):
            transform(make)(0.5)


@pytest.mark.slow
def test_many_times_faster_than_the_double_loop():
    """Side by side, both in this process."""
    n = 512
    topography(SURFACE, L, n, key=KEY).block_until_ready()
    times = []
    phi = phases(KEY, frequencies(n))
    for run in (
        lambda: topography(SURFACE, L, n, key=KEY).block_until_ready(),
        lambda: double_sum(grid(n), D, G, L, 10, phi),
    ):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    assert times[1] > 10 * times[0], times
