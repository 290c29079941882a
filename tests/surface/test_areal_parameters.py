"""Areal parameters beside closed forms, and beside ISO's definitions in plain NumPy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe
from scipy.stats import norm

import fractaljax as fj
from fractaljax._surface.autocorrelation import autocorrelation_lengths
from synthetic import rough
from tools import both_modes, refusals

NAMES = [*fj.ArealParameters.__annotations__]
LENGTHS = {"Sa", "Sq", "Sz", "Sp", "Sv", "Sk", "Spk", "Svk"}  # of z
N = 256
K = 2 * np.pi * 4  # four periods along a side of 1
X, Y = np.meshgrid(np.arange(N) / N, np.arange(N) / N, indexing="ij")
MAP = rough((72, 64)) + 2e-8 * np.random.default_rng(1).standard_normal((72, 64)) ** 2
GRID = dict(dx=1e-6, dy=1.5e-6)


# --- closed forms --------------------------------------------------------------------------


def test_egg_crate():
    """The autocorrelation is cos kx cos ky: fastest along the axes, slowest along the diagonals."""
    a = 1e-3
    p = fj.areal_parameters(a * np.sin(K * X) * np.sin(K * Y) + 5, 1 / N)
    expected = dict(Sq=a / 2, Sz=2 * a, Sp=a, Sv=a, Sku=2.25, Sdq=a * K / math.sqrt(2))
    expected |= dict(Sal=math.acos(0.2) / K)
    expected |= dict(Str=math.acos(0.2) / (math.sqrt(2) * math.acos(math.sqrt(0.2))))
    for name, value in expected.items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=3e-5), name
    assert float(p.Sa) == pytest.approx(4 * a / math.pi**2, rel=2e-3)  # 64 points in a period
    assert abs(p.Ssk) < 1e-9


@pytest.mark.parametrize("slope", [0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("turned", [False, True])
def test_sine(slope, turned):
    """Sdr of a sine of amplitude slope/k: 2/pi (1 + slope^2)^(1/2) E(slope^2/(1 + slope^2)) - 1."""
    z = slope / K * np.sin(K * X)
    p = fj.areal_parameters(z.T if turned else z, 1 / N)
    expected = 2 / math.pi * math.sqrt(1 + slope**2) * ellipe(slope**2 / (1 + slope**2)) - 1
    assert float(p.Sdr) == pytest.approx(100 * expected, rel=1e-4)
    assert float(p.Sdq) == pytest.approx(slope / math.sqrt(2), rel=1e-4)
    assert float(p.Sal) == pytest.approx(0.21795289157551256 * 2 * math.pi / K, rel=1e-9)
    # Along the lay it does not decay: the lag ends at half the map.
    assert float(p.Sal / p.Str) == pytest.approx(math.hypot(0.5, float(p.Sal)), rel=2e-3)


@pytest.mark.parametrize("waves", [(3, 2), (7, -5)])
def test_lay_in_any_direction(waves):
    """On pixels that are not square: Sal is across the lay, of wavelength 1/|f|."""
    f = np.array(waves) / [1.0, 2.0]
    z = np.cos(2 * np.pi * (f[0] * X[:, ::2] + f[1] * 2 * Y[:, ::2]))
    p = fj.areal_parameters(z, 1 / N, dy=4 / N)
    assert float(p.Sal) == pytest.approx(math.acos(0.2) / (2 * math.pi * np.hypot(*f)), rel=5e-6)


def test_gaussian_heights():
    z = norm.isf((np.random.default_rng(0).permutation(N * N) + 0.5) / N**2).reshape(N, N)
    p = fj.areal_parameters(z, 1.0)
    part = {"Sk": 2.5739561079542517, "Spk": 0.9450307264217136, "Svk": 0.9450307264217136}
    part |= {"Sa": math.sqrt(2 / math.pi), "Sku": 3.0}
    part |= {"Smr1": 9.90509687581113, "Smr2": 90.09490312418886}
    for name, value in part.items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=4e-4), name


def test_small_slopes_and_float32():
    """Sdr is Sdq^2/2 where slopes are small, in float32 too; the rest is as in float64."""
    p = fj.areal_parameters(MAP, **GRID, cutoff=2e-5, shortest=4e-6)
    single = fj.areal_parameters(
        jnp.float32(MAP),
        jnp.float32(1e-6),
        dy=jnp.float32(1.5e-6),
        cutoff=jnp.float32(2e-5),
        shortest=jnp.float32(4e-6),
    )
    for name in NAMES:
        assert getattr(single, name).dtype == jnp.float32
        np.testing.assert_allclose(getattr(single, name), getattr(p, name), rtol=2e-3)
    small = fj.areal_parameters(jnp.float32(1e-4 * MAP), jnp.float32(1e-6))
    assert float(small.Sdr) == pytest.approx(50 * float(small.Sdq) ** 2, rel=1e-5)


# --- filters, area, definitions ------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_transmission(ratio):
    """Of a wave along x or askew, by its wavelength over the nesting index."""
    cutoff = 0.1
    for waves in ((10, 0), (6, 8)):
        f = np.array(waves) / ratio
        z = np.cos(2 * np.pi * (f[0] * X + f[1] * Y))
        share = 2 ** -(ratio**-2)
        p = fj.areal_parameters(z, 1 / N, cutoff=cutoff)
        plain = fj.areal_parameters(z[13:-13, 13:-13], 1 / N)
        assert float(p.Sq / plain.Sq) == pytest.approx(1 - share, rel=1e-2)
        assert float(p.Sz / plain.Sz) == pytest.approx(1 - share, rel=1e-2)
        smooth = fj.areal_parameters(z, 1 / N, shortest=cutoff)
        assert float(smooth.Sz / plain.Sz) == pytest.approx(share, rel=1e-2)


def test_mean_plane_and_area():
    """A plane is no roughness; the area is that of a warning if it is smaller than the cutoff."""
    i, j = np.meshgrid(np.arange(72), np.arange(64), indexing="ij")
    filters = GRID | dict(cutoff=2e-5)
    plain = fj.areal_parameters(MAP, **filters)
    tilted = fj.areal_parameters(MAP + 1e-8 * i - 2e-8 * j + 1e-6, **filters)
    for name in NAMES:
        np.testing.assert_allclose(getattr(tilted, name), getattr(plain, name), rtol=1e-5)
    match = r"^z holds an area of 2\.8e-05 m x 5\.1e-05 m \(half of cutoff = 4\.4e-05 m is dropped"
    with pytest.warns(UserWarning, match=match):
        fj.areal_parameters(MAP, **GRID | dict(cutoff=4.4e-5))


def test_heights():
    """Statistics of the heights, and maps of another orientation."""
    p = fj.areal_parameters(MAP, **GRID)
    z = MAP - MAP.mean()
    expected = dict(Sp=z.max(), Sv=-z.min(), Sz=np.ptp(z), Sa=abs(z).mean(), Sq=z.std())
    expected |= dict(Ssk=(z**3).mean() / z.std() ** 3, Sku=(z**4).mean() / z.std() ** 4)
    for name, value in expected.items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=1e-12), name
    turned = fj.areal_parameters(MAP.T, 1.5e-6, dy=1e-6)
    mirrored = fj.areal_parameters(MAP[::-1], **GRID)
    for name in NAMES:
        rtol = 1e-5 if name in ("Sal", "Str") else 1e-9  # by one of 720 directions
        np.testing.assert_allclose(getattr(turned, name), getattr(p, name), rtol=rtol)
        np.testing.assert_allclose(getattr(mirrored, name), getattr(p, name), rtol=rtol)


def crossing(z, steps, angle, level=0.2):
    """Lag of the first crossing along a direction, on the sum of waves of a periodic map."""
    power = np.abs(np.fft.fft2(z - z.mean())) ** 2
    power /= power.sum()
    fx, fy = (np.fft.fftfreq(n, step) for n, step in zip(z.shape, steps, strict=True))

    def correlation(lag):
        x, y = fx * lag * np.cos(angle), fy * lag * np.sin(angle)
        return (power * np.cos(2 * np.pi * np.add.outer(x, y))).sum() - level

    lags = np.linspace(0, max(n * step for n, step in zip(z.shape, steps, strict=True)) / 2, 400)
    first = next((k for k, lag in enumerate(lags) if correlation(lag) < 0), None)
    return np.inf if first is None else brentq(correlation, lags[first - 1], lags[first])


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [1, 3])
def test_autocorrelation_lengths(stretch):
    """The fastest and the slowest decay of a random map, direction by direction."""
    waves = np.fft.fft2(np.random.default_rng(3).standard_normal((96, 96)))
    f = np.fft.fftfreq(96) * 96
    waves = waves * np.exp(-((f[:, None] / 4) ** 2) - (stretch * f / 12) ** 2)
    z, steps = np.fft.ifft2(waves).real, (1e-6, 0.8e-6)
    lags = np.array([crossing(z, steps, angle) for angle in np.pi * np.arange(180) / 180])
    Sal, Str = autocorrelation_lengths(jnp.asarray(z - z.mean()), jnp.array(steps))
    assert float(Sal) == pytest.approx(lags.min(), rel=1e-4) and Sal <= lags.min() * (1 + 1e-9)
    assert float(Sal / Str) == pytest.approx(lags.max(), rel=1e-3) and Sal / Str >= lags.max() * (
        1 - 1e-9
    )


# --- derivatives, batches, refusals --------------------------------------------------------


def test_scaling():
    p = fj.areal_parameters(MAP, **GRID, cutoff=2e-5, shortest=4e-6)
    lengths = {"dx": 4e-6, "dy": 6e-6, "cutoff": 8e-5, "shortest": 1.6e-5}
    other = fj.areal_parameters(4 * MAP, **lengths)
    for name in NAMES:
        factor = 4 if name in LENGTHS | {"Sal"} else 1
        np.testing.assert_allclose(getattr(other, name), factor * getattr(p, name), rtol=1e-9)


@pytest.mark.parametrize("filters", [{}, {"cutoff": 2e-5, "shortest": 4e-6}])
def test_derivatives(filters):
    """In both modes, along two directions of heights, beside differences of the whole function."""
    directions = jnp.asarray([rough((72, 64), 5), rough((72, 64), 6) ** 2 / 3e-7])

    def values(u):
        z = MAP + jnp.tensordot(u, directions, 1)
        p = fj.areal_parameters(z, **GRID, **filters)
        return jnp.stack([getattr(p, name) for name in NAMES])

    u, step = jnp.array([0.1, -0.2]), 1e-6
    _, forward, reverse = jax.jit(lambda u: both_modes(values, u))(u)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-14)
    batch = jax.jit(jax.vmap(values))(u[None] + step * jnp.concatenate([jnp.eye(2), -jnp.eye(2)]))
    differences = np.asarray(batch[:2] - batch[2:]).T / (2 * step)
    scale = np.abs(differences).max(axis=1, keepdims=True)
    # Neighbours in the sorted heights change places within a step.
    tolerance = [1e-4 if "k" in name[1:] or "mr" in name else 1e-6 for name in NAMES]
    assert (np.abs(forward - differences) < np.array(tolerance)[:, None] * scale).all()


def test_derivative_by_the_grid_step():
    p = fj.areal_parameters(MAP, 1e-6)
    by_step = jax.jit(jax.jacrev(lambda dx: fj.areal_parameters(MAP, dx)))(1e-6)
    assert float(by_step.Sdq) == pytest.approx(-float(p.Sdq) / 1e-6, rel=1e-9)
    assert float(by_step.Sal) == pytest.approx(float(p.Sal) / 1e-6, rel=1e-6)
    assert abs(by_step.Str) < 1e-6 * p.Str / 1e-6 and by_step.Sq == 0


def test_batches():
    maps = np.stack([MAP, rough((72, 64), 8)])
    batch = jax.jit(jax.vmap(lambda z: fj.areal_parameters(z, **GRID)))(maps)
    for k in (0, 1):
        one = fj.areal_parameters(maps[k], **GRID)
        for name in NAMES:
            np.testing.assert_allclose(getattr(batch, name)[k], getattr(one, name), rtol=1e-9)


def test_flat_heights_and_not_a_number():
    p = fj.areal_parameters(np.full((72, 64), 0.1), **GRID)
    assert all(getattr(p, name) == 0 for name in LENGTHS | {"Sdq", "Sdr"})
    assert all(np.isnan(getattr(p, name)) for name in ("Ssk", "Sku", "Sal", "Str"))
    bad = jax.jit(lambda z: fj.areal_parameters(z, **GRID))(np.where(MAP > 5e-7, np.nan, MAP))
    assert all(np.isnan(getattr(bad, name)) for name in NAMES)


def test_lists_are_heights():
    listed, array = (fj.areal_parameters(z, **GRID) for z in (MAP.tolist(), MAP))
    assert all(float(getattr(listed, x)) == float(getattr(array, x)) for x in ("Sa", "Sz", "Sdq"))


def test_refusal_of_gaps_says_what_fills_them():
    z = MAP.copy()
    z[3, 5] = np.nan
    with pytest.raises(
        ValueError, match=r"got 1 NaN: .*prepare_measurement\(z, dx\).z has them fil"
    ):
        fj.areal_parameters(z, **GRID)
    filled = fj.prepare_measurement(z, GRID["dx"], GRID["dy"], level=False).z
    assert float(fj.areal_parameters(filled, **GRID).Sa) > 0


test_refusals = refusals(
    [
        ({"z": np.ones(9)}, r"^z must have shape \(n, m\) with 8 points or more .*, got \(9,\)$"),
        ({"z": np.ones((9, 7))}, r"^z must have shape \(n, m\) with 8 .*, got \(9, 7\)$"),
        (
            {"z": np.where(MAP > 5e-7, np.nan, MAP)},
            r"^z must be finite, got \d+ NaN: fill them in,",
        ),
        ({"dx": -1.0}, r"^dx must be above 0, got -1\.0$"),
        ({"dy": 0}, r"^dy must be above 0, got 0\.0$"),
        ({"shortest": 2e-6}, r"^shortest must be at least two grid steps = 3e-06 m, got 2e-06$"),
        (
            {"cutoff": 1e-5, "shortest": 2e-5},
            r"^cutoff must be at least shortest = 2e-05 m, got 1e-05$",
        ),
        (
            {"cutoff": 8e-4},
            r"^the first axis of z is 7\.2e-05 m long, too short for cutoff = 0\.0008 m: half",
        ),
    ],
    lambda change: fj.areal_parameters(**(dict(z=MAP) | GRID | change)),
    kind=(ValueError, TypeError),
)
