"""The Weierstrass-Mandelbrot sum against Eq. 13 term by term, and against its expectations."""

import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._surface.topography import random_phases, topography
from tools import refusals

D, G, L, GAMMA = 2.4, 1.342e-10, 1e-3, 1.5
SURFACE = fj.Surface(D, G)
KEY = jax.random.key(7)


def phases(count, M=10):
    return 2 * math.pi * np.asarray(random_phases(KEY, count, M))


def double_sum(n, D, G, phi, gamma=GAMMA):
    """Eq. 13 as it is printed."""
    x, y = np.meshgrid(np.arange(n) * L / n, np.arange(n) * L / n, indexing="ij")
    r, theta, z, M = np.hypot(x, y), np.arctan2(y, x), 0, phi.shape[1]
    for m in range(1, M + 1):
        for k, row in enumerate(phi):
            wave = 2 * math.pi * gamma**k * r / L * np.cos(theta - math.pi * m / M) + row[m - 1]
            z = z + gamma ** ((D - 3) * k) * (math.cos(row[m - 1]) - np.cos(wave))
    return L * (G / L) ** (D - 2) * math.sqrt(math.log(gamma) / M) * z


@pytest.mark.parametrize(
    ("n", "M", "gamma", "L_s"),
    [
        (48, 10, 1.5, None),
        (33, 3, 1.2, 1e-4),
        (17, 1, 1.5, 1e-6),  # wavelengths that the grid does not resolve
        (2, 10, 1.5, None),
        (40, 10, 1.08, None),  # several blocks of waves, the last one not full
        (8, 10, 1.7, L / 1.7**7),  # exactly a power of gamma
    ],
)
def test_equals_the_double_sum(n, M, gamma, L_s):
    count = 1 + int(math.log(n / 2 if L_s is None else L / L_s) / math.log(gamma) + 1e-9)
    z = topography(fj.Surface(2.6, 1e-9, gamma), L, n, key=KEY, L_s=L_s, M=M)
    expected = double_sum(n, 2.6, 1e-9, phases(count, M), gamma)
    assert z.shape == (n, n) and z.dtype == jnp.float64
    np.testing.assert_allclose(z, expected, rtol=0, atol=1e-12 * abs(expected).max())


def eq_13(at, i, j, n, cycles):
    """The height at a grid point in working precision."""
    D, G, gamma, L = at
    total, M = mpmath.mpf(0), cycles.shape[1]
    for k, row in enumerate(cycles):
        for m in range(1, M + 1):
            phi, a = 2 * mpmath.pi * mpmath.mpf(row[m - 1]), mpmath.pi * m / M
            along = (i * mpmath.cos(a) + j * mpmath.sin(a)) / n
            wave = mpmath.cos(phi) - mpmath.cos(2 * mpmath.pi * gamma**k * along + phi)
            total += gamma ** ((D - 3) * k) * wave
    return total * L * (G / L) ** (D - 2) * mpmath.sqrt(mpmath.log(gamma) / M)


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-12), (jnp.float32, 2e-5)])
def test_phases_of_many_cycles_keep_their_digits(dtype, tolerance):
    """Eq. 13 in 40 digits at a few points, among them the corners of the grid."""
    n, surface = 512, jax.tree.map(lambda x: x.astype(dtype), fj.Surface(2.9, G))
    cycles = np.asarray(random_phases(KEY, 1 + int(math.log(n / 2) / math.log(1.5)), 10))
    z = topography(surface, L, n, key=KEY)
    assert z.dtype == dtype and abs(float(z[0, 0])) < tolerance * float(jnp.std(z))
    with mpmath.workdps(40):
        at = [mpmath.mpf(float(x)) for x in (surface.D, surface.G, GAMMA, dtype(L))]
        for i, j in [(1, 2), (511, 511), (511, 0), (123, 321)]:
            error = abs(float(eq_13(at, i, j, n, cycles)) - float(z[i, j]))
            assert error < tolerance * float(jnp.std(z))


def test_a_finer_grid_is_the_same_surface():
    """The same waves at other points; shorter ones are added to them."""
    coarse = topography(SURFACE, L, 32, key=KEY, L_s=1e-4)
    fine = topography(SURFACE, L, 64, key=KEY, L_s=1e-4)
    np.testing.assert_allclose(fine[::2, ::2], coarse, rtol=0, atol=1e-18)
    added = topography(SURFACE, L, 64, key=KEY, L_s=1e-5) - fine
    phi = phases(12)
    rest = double_sum(64, D, G, phi) - double_sum(64, D, G, phi[:6])
    np.testing.assert_allclose(added, rest, rtol=0, atol=1e-18)


# --- periodic ---------------------------------------------------------------------------------


def whole_waves(count, M, gamma, ratio):
    """Waves per L along x and y (2, count, M), rounded by hand."""
    k = np.zeros((2, count, M))
    for i, m in np.ndindex(count, M):
        for axis, part in enumerate((math.cos, math.sin)):
            exact = gamma**i * part(math.pi * (m + 1) / M)
            k[axis, i, m] = math.copysign(min(round(abs(exact)), math.floor(ratio)), exact)
    return k


def periodic_sum(x, y, D, G, phi, k, gamma=GAMMA):
    """Eq. 13 with waves k at points x, y [m]."""
    x, y, z = np.asarray(x), np.asarray(y), 0
    for i, m in np.ndindex(*phi.shape):
        a, b = k[:, i, m]
        wave = 2 * math.pi * (a * x + b * y) / L + phi[i, m]
        z = z + math.hypot(a, b) ** (D - 3) * (math.cos(phi[i, m]) - np.cos(wave))
    return L * (G / L) ** (D - 2) * math.sqrt(math.log(gamma) / phi.shape[1]) * z


@pytest.mark.parametrize(
    ("n", "M", "gamma", "L_s"),
    [
        (48, 10, 1.5, None),
        (33, 3, 1.2, 1e-4),
        (3, 10, 1.5, None),  # 1.5 waves would round to 2, finer than the grid
        (40, 10, 1.08, None),
        (16, 4, 2.0, L / 64),  # finer than the grid because L_s says so
    ],
)
def test_periodic_equals_the_double_sum_of_whole_waves(n, M, gamma, L_s):
    ratio = n / 2 if L_s is None else round(L / L_s)
    count = 1 + int(math.log(ratio) / math.log(gamma) + 1e-9)
    k = whole_waves(count, M, gamma, ratio)
    assert np.hypot(*k).min() >= 1 and (L_s is not None or abs(k).max() <= n / 2)
    x, y = np.meshgrid(np.arange(n) * L / n, np.arange(n) * L / n, indexing="ij")
    expected = periodic_sum(x, y, 2.6, 1e-9, phases(count, M), k, gamma)
    surface = fj.Surface(2.6, 1e-9, gamma)
    z = topography(surface, L, n, key=KEY, L_s=L_s, M=M, periodic=True)
    np.testing.assert_allclose(z, expected, rtol=0, atol=1e-12 * abs(expected).max())
    single = jax.tree.map(lambda x: x.astype(jnp.float32), surface)
    z = topography(single, L, n, key=KEY, L_s=L_s, M=M, periodic=True)
    assert z.dtype == jnp.float32
    np.testing.assert_allclose(z, expected, rtol=0, atol=2e-5 * expected.std())


def test_periodic_edges_meet():
    """The grid goes on as itself at x = L, and no step at an edge is beyond those inside."""
    n, ratio = 96, 48
    count = 1 + int(math.log(ratio) / math.log(GAMMA))
    z = np.asarray(topography(SURFACE, L, n, key=KEY, periodic=True))
    k, x = whole_waves(count, 10, GAMMA, ratio), np.arange(n) * L / n
    for at in ((x + L, 0 * x), (x, 0 * x + L), (x - L, 0 * x + 3 * L)):
        beyond = periodic_sum(*at, D, G, phases(count), k)
        np.testing.assert_allclose(beyond, z[:, 0], rtol=0, atol=1e-11 * z.std())

    def steps(z):  # rms over the edge, and inside
        change = np.diff(z, axis=0, append=z[:1])
        return np.sqrt((change[-1] ** 2).mean()), np.sqrt((change[:-1] ** 2).mean())

    for each in (z, z.T):
        edge, inside = steps(each)
        assert edge < 1.3 * inside
    edge, inside = steps(np.asarray(topography(SURFACE, L, n, key=KEY)))
    assert edge > 3 * inside


@pytest.mark.slow
def test_periodic_roughness():
    """Sq and Sdq over seeds: half the squares of all amplitudes, near the closed form."""
    n, count = 64, 1 + int(math.log(32) / math.log(GAMMA))
    keys = jax.random.split(jax.random.key(3), 200)
    z = jax.vmap(lambda key: topography(SURFACE, L, n, key=key, periodic=True))(keys)
    alone = topography(SURFACE, L, n, key=keys[5], periodic=True)
    np.testing.assert_allclose(z[5], alone, rtol=0, atol=1e-13 * float(jnp.ptp(alone)))
    f = 2 * np.pi * np.fft.fftfreq(n, 1 / n) / L
    power = abs(np.fft.fft2(z)) ** 2 / n**4  # the grid holds whole waves: no leak, no alias
    power[:, 0, 0] = 0  # the mean
    k = whole_waves(count, 10, GAMMA, 32)
    square = L**2 * (G / L) ** (2 * D - 4) * math.log(1.5) / 20 * np.hypot(*k) ** (2 * D - 6)
    closed = fj.roughness(SURFACE, L, 2 * L / n)
    for weight, of_wave, stated in (
        (1.0, 1.0, closed.Sq),
        (f[:, None] ** 2 + f**2, (2 * math.pi / L) ** 2 * (k**2).sum(axis=0), closed.Sdq),
    ):
        samples = (power * weight).sum(axis=(1, 2))
        error, expected = samples.std(ddof=1) / math.sqrt(keys.size), np.sum(square * of_wave)
        assert abs(samples.mean() - expected) < 3 * error < 0.1 * expected
        assert math.sqrt(expected) == pytest.approx(float(stated), rel=0.01)


def assert_slopes(exact, at, slopes, curvatures):
    """Against differences in 30 digits: by each number, and some second derivatives."""
    with mpmath.workdps(30):
        at = [mpmath.mpf(value) for value in at]
        for i, slope in enumerate(slopes):
            step = at[i] * mpmath.mpf("1e-9")
            up, down = (exact([*at[:i], at[i] + s, *at[i + 1 :]]) for s in (step, -step))
            assert float(slope) == pytest.approx(float((up - down) / (2 * step)), rel=1e-9)
            if i in curvatures:
                curvature = (up + down - 2 * exact(at)) / step**2
                assert float(curvatures[i]) == pytest.approx(float(curvature), rel=1e-6)


@pytest.mark.slow
def test_periodic_derivatives():
    """By D, ln G and L in both modes, the second by D, against differences in long digits."""
    cycles = np.asarray(random_phases(KEY, 5, 3))
    k = whole_waves(5, 3, AT[2], 5)

    def measured(x):
        surface = fj.Surface(x[0], jnp.exp(x[1]), AT[2])
        z = topography(surface, x[2], SIDE, key=KEY, L_s=1.3e-3 / 5, M=3, periodic=True)
        return jnp.vdot(WEIGHTS, z)

    def exact(at):
        D, log_G, L = at
        total = mpmath.mpf(0)
        for i, m in np.ndindex(5, 3):
            phi = 2 * mpmath.pi * mpmath.mpf(cycles[i, m])
            a, b = (int(each) for each in k[:, i, m])
            for (p, q), weight in np.ndenumerate(WEIGHTS):
                wave = 2 * mpmath.pi * mpmath.mpf(a * p + b * q) / SIDE + phi
                height = mpmath.cos(phi) - mpmath.cos(wave)
                total += mpmath.mpf(weight) * mpmath.sqrt(a * a + b * b) ** (D - 3) * height
        return total * L * (mpmath.exp(log_G) / L) ** (D - 2) * mpmath.sqrt(mpmath.log(AT[2]) / 3)

    at = (AT[0], math.log(AT[1]), AT[3])
    found, forward = jax.grad(measured)(at), jax.jacfwd(measured)(at)
    np.testing.assert_allclose(forward, found, rtol=1e-10)
    second = jax.grad(lambda D: jax.grad(measured)((D, *at[1:]))[0])(at[0])
    assert_slopes(exact, at, found, {0: second})


# --- derivatives and batches ------------------------------------------------------------------

AT = (2.45, 2e-10, 1.4, 1.3e-3)
SIDE = 4
WEIGHTS = np.cos(np.arange(SIDE**2.0)).reshape(SIDE, SIDE) * 1e6


def measure(x):
    """A smooth number of a surface: at L_s = L/5, away from a power of gamma."""
    surface = fj.Surface(*x[:3])
    return jnp.vdot(WEIGHTS, topography(surface, x[3], SIDE, key=KEY, L_s=1.3e-3 / 5, M=3))


@pytest.mark.slow
def test_derivatives():
    """By D, G, gamma and L in both modes against differences in 30 digits; the second by gamma."""
    cycles = np.asarray(random_phases(KEY, 1 + int(math.log(5) / math.log(AT[2])), 3))

    def exact(at):
        heights = [eq_13(at, i, j, SIDE, cycles) for i, j in np.ndindex(SIDE, SIDE)]
        return sum(mpmath.mpf(w) * z for w, z in zip(WEIGHTS.flat, heights, strict=True))

    found, forward = jax.jacrev(measure)(AT), jax.jacfwd(measure)(AT)
    np.testing.assert_allclose(forward, found, rtol=1e-10)
    by_gamma = lambda gamma: jax.grad(measure)((*AT[:2], gamma, AT[3]))[2]  # noqa: E731
    _, second = jax.jvp(by_gamma, AT[2:3], (1.0,))
    assert_slopes(exact, AT, found, {2: second})


@pytest.mark.slow
def test_jit_and_vmap():
    """Over D, G and key, old kinds of keys too; L may be traced where L_s is not given."""

    @jax.jit
    def batch(Ds, Gs, keys, L):
        return jax.vmap(lambda D, G, key: topography(fj.Surface(D, G), L, 16, key=key))(
            Ds, Gs, keys
        )

    Ds, Gs, keys = jnp.array([2.3, 2.7]), jnp.array([1e-10, 1e-9]), jax.random.split(KEY, 2)
    for i, z in enumerate(batch(Ds, Gs, keys, L)):
        alone = topography(fj.Surface(Ds[i], Gs[i]), L, 16, key=keys[i])
        np.testing.assert_allclose(z, alone, rtol=0, atol=1e-13 * float(jnp.ptp(alone)))
    old = topography(SURFACE, L, 16, key=jax.random.PRNGKey(7))
    np.testing.assert_array_equal(old, topography(SURFACE, L, 16, key=KEY))


# --- on average over phases -------------------------------------------------------------------

N, KEYS = 64, 150


@jax.jit
def draw(D, keys):
    # Not vmapped, which takes longer to compile.
    return jax.lax.map(lambda key: topography(fj.Surface(D, G), L, N, key=key), keys)


def ensemble(D) -> np.ndarray:
    """Surfaces (keys, n, n) of one D and G."""
    return np.asarray(draw(D, jax.random.split(jax.random.key(1), KEYS)))


@pytest.mark.slow
def test_structure_function():
    """E[(z(x + r) - z(x))^2] = 2 sum of mean squares times 1 - cos(k.r), in every direction."""
    k, a = np.meshgrid(np.arange(9), np.pi * np.arange(1, 11) / 10, indexing="ij")
    square = L**2 * (G / L) ** (2 * D - 4) * math.log(1.5) / 20 * 1.5 ** (2 * (D - 3) * k)
    z = ensemble(D)
    for i, j in [(1, 0), (0, 3), (2, 5), (16, 0), (20, -20), (32, 7)]:
        left, right = (slice(max(0, -j), N - max(0, j)), slice(max(0, j), N + min(0, j)))
        step = z[:, i:, right] - z[:, : N - i, left]
        samples = (step**2).mean(axis=(1, 2))
        angle = 2 * np.pi * 1.5**k * (np.cos(a) * i + np.sin(a) * j) / N
        expected, error = np.sum(2 * square * (1 - np.cos(angle))), samples.std(ddof=1)
        assert abs(samples.mean() - expected) < 4 * error / math.sqrt(KEYS)
        assert error / math.sqrt(KEYS) < 0.15 * expected


@pytest.mark.parametrize("D", [2.4, 2.8])
def test_spectrum_is_the_continuous_power_law(D):
    """C(f) = G^(2D-4)/2 f^(2D-7) [m^3] for areas, integrated over bands of two frequencies."""
    window = np.hanning(N + 1)[:-1]
    window = np.multiply.outer(window, window)
    found = abs(np.fft.fft2(ensemble(D) * window)) ** 2 / (N**2 * np.sum(window**2))
    f = np.hypot(*np.meshgrid(*[np.fft.fftfreq(N, L / N)] * 2))
    for low, high in [(4.5, 6.5), (6.5, 8.5)]:
        low, high = 1.5**low / L, 1.5**high / L
        power = found[:, (f >= low) & (f < high)].sum(axis=1).mean()
        law = G ** (2 * D - 4) / 2 * (low ** (2 * D - 6) - high ** (2 * D - 6)) / (6 - 2 * D)
        assert power == pytest.approx(law, rel=0.03)


# --- refusals ---------------------------------------------------------------------------------


test_refusals = refusals(
    [
        ({"n": 1}, "n must be a whole number of at least 2, got 1"),
        ({"n": None}, "n must be a whole number of at least 2, got None"),
        ({"periodic": 1}, "periodic must be True or False, got 1"),
        ({"M": True}, "M must be a whole number of at least 1, got True"),
        ({"L": math.inf}, "L must be above 0, got inf"),
        ({"L": jnp.array([1.0, 2.0])}, "L must be a single number, got shape (2,)"),
        ({"L_s": -1e-6}, "L_s must be above 0, got -1e-06"),
        ({"L_s": 2e-3}, "L must be at least L_s = 0.002, got 0.001"),
        ({"L": 1e300, "L_s": 1e-300}, "L/L_s must be finite, got inf"),
        ({"key": 3}, "key must be one key of jax.random, got 3"),
        ({"key": jax.random.split(KEY)}, "key of jax.random, got an array of shape (2,)"),
        ({"n": 10**400}, "points would take 2.40e+801 bytes of memory; this machine has"),
        ({"M": 2**50}, "4 x 1125899906842624 waves would take"),
        ({"surface": fj.Surface(D, G, 1 + 3e-16)}, " x 10 waves would take"),
        ({"surface": jax.tree.map(lambda x: jnp.stack([x, x]), SURFACE)}, "D must be a scalar"),
        ({"surface": "rough"}, "surface must be a Spectrum, got 'rough'"),
    ],
    lambda change: topography(**({"surface": SURFACE, "L": L, "n": 8, "key": KEY}) | change),
    kind=(ValueError, TypeError),
    plain=True,
)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("gamma", lambda x: topography(fj.Surface(D, G, 1 + x), L, 8, key=KEY)),
        ("L", lambda x: topography(SURFACE, x, 8, key=KEY, L_s=1e-6)),
        ("L_s", lambda x: topography(SURFACE, 2.0, 8, key=KEY, L_s=x)),
    ],
)
def test_the_number_of_waves_cannot_be_traced(name, make):
    for transform in (jax.jit, lambda f: lambda x: jax.vmap(f)(jnp.array([x, x]))):
        with pytest.raises(TypeError, match=f"^{name} must be known while a program is traced"):
            transform(make)(0.5)
