"""Profile parameters beside closed forms, and beside ISO's definitions in plain NumPy."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import fractaljax as fj
from fractaljax._surface.gaussian_filter import low_pass
from fractaljax._surface.heights import remove_form, slope
from fractaljax._surface.material_ratio import material_ratio
from fractaljax._surface.profile_elements import mean_element_width
from tools import both_modes, refusals

WAVE, AMPLITUDE = 1e-4, 2e-6
NAMES = [*fj.ProfileParameters.__annotations__]
LENGTHS = {"Ra", "Rq", "Rz", "Rp", "Rv", "Rt", "Rk", "Rpk", "Rvk"}  # of z


def periods(shape, n=4000, count=10, phase=0.3):
    """Heights of `count` periods, and dx."""
    dx = count * WAVE / n
    return AMPLITUDE * shape(2 * np.pi * np.arange(n) * dx / WAVE + phase), dx


def triangle(x):
    return 2 / np.pi * np.arcsin(np.sin(x))


def square(x):
    return np.sign(np.sin(x))


def noise(n=4000, seed=0, smooth=4):
    """Heights with more pits than peaks."""
    white = np.random.default_rng(seed).standard_normal(n)
    kernel = np.exp(-(np.linspace(-2, 2, 4 * smooth + 1) ** 2))
    z = np.convolve(white, kernel / np.linalg.norm(kernel), mode="same")
    return 1e-6 * (z - 0.1 * z**2)


# --- closed forms --------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 3e-6])
def test_sine(offset):
    z, dx = periods(np.sin, phase=0.0)
    p = fj.profile_parameters(z + offset, dx)
    a = AMPLITUDE
    expected = dict(Ra=2 * a / math.pi, Rq=a / math.sqrt(2), Rz=2 * a, Rp=a, Rv=a, Rt=2 * a)
    expected |= dict(Rku=1.5, Rdq=math.sqrt(2) * math.pi * a / WAVE, RSm=WAVE)
    for name, value in expected.items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=5e-5), name
    assert abs(p.Rsk) < 1e-9


def test_triangle():
    """The material ratio curve is one straight line: all is core."""
    z, dx = periods(triangle, n=40000)
    p = fj.profile_parameters(z, dx)
    a = AMPLITUDE
    for name, value in dict(Ra=a / 2, Rq=a / math.sqrt(3), Rz=2 * a, Rk=2 * a).items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=1e-4), name
    assert float(p.Rku) == pytest.approx(1.8, rel=1e-4)
    assert max(p.Rpk, p.Rvk) < 1e-3 * a and p.Mr1 < 0.1 and p.Mr2 > 99.9
    assert float(p.RSm) == pytest.approx(WAVE, rel=1e-9)
    assert float(p.Rdq) == pytest.approx(4 * a / WAVE, rel=1e-2)  # rounded at each kink


def test_square_wave():
    """The least steep part of the curve is the plateau of the hills."""
    z, dx = periods(square)
    p = fj.profile_parameters(z, dx)
    a = AMPLITUDE
    for name, value in dict(Ra=a, Rq=a, Rz=2 * a, Rku=1, RSm=WAVE).items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=1e-3), name
    assert abs(p.Rsk) < 1e-9 and abs(p.Rk) < 1e-9 * a and abs(p.Rpk) < 1e-9 * a


@pytest.mark.parametrize("n", [1001, 100_000])
def test_gaussian_heights(n):
    """The line over the middle 40 % of Gaussian heights, and the triangles beside it."""
    z = 1e-6 * norm.isf((np.random.default_rng(0).permutation(n) + 0.5) / n)
    p = fj.profile_parameters(z, 1e-6)
    part = {"Rk": 2.5739561079542517, "Rpk": 0.9450307264217136, "Rvk": 0.9450307264217136}
    rtol = 3e-3 if n < 10_000 else 2e-4
    for name, value in part.items():
        assert float(getattr(p, name)) == pytest.approx(1e-6 * value, rel=rtol), name
    assert float(p.Mr1) == pytest.approx(9.90509687581113, rel=rtol)
    assert float(p.Mr2) == pytest.approx(90.09490312418886, rel=rtol)
    assert float(p.Ra / p.Rq) == pytest.approx(math.sqrt(2 / math.pi), rel=rtol)
    assert float(p.Rku) == pytest.approx(3, rel=10 * rtol)  # no height beyond 3.3 sigma at n = 1001


# --- filters and sections ------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.25, 0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("phase", [0.0, 0.7])
def test_transmission(ratio, phase):
    """Of a sine, wavelength over nesting index: 2^-(1/ratio)^2 passes S, and the rest passes L."""
    dx, length = 2e-6, 1e-3
    z = math.sqrt(2) * np.sin(2 * np.pi * np.arange(20 * 500) * dx / (ratio * length) + phase)
    share = 2 ** -(ratio**-2)
    p = fj.profile_parameters(z, dx, cutoff=length, sections=16)
    assert float(p.Rq) == pytest.approx(1 - share, rel=1e-9)
    assert float(p.RSm) == pytest.approx(ratio * length, rel=1e-6)
    both = fj.profile_parameters(z, dx, cutoff=length, shortest=length / 5, sections=16)
    assert float(both.Rq) == pytest.approx((1 - share) * 2 ** -((5 * ratio) ** -2), rel=1e-9)


def test_filter_is_the_weighted_mean_of_the_standard():
    """Sums over ISO's weights, at every point, over their sum within the profile."""
    z, dx, length = noise(400), 1e-6, 5e-5
    alpha = math.sqrt(math.log(2) / math.pi)
    x = dx * np.subtract.outer(np.arange(400), np.arange(400))
    weights = np.exp(-np.pi * (x / (alpha * length)) ** 2)
    expected = weights @ z / weights.sum(axis=1)
    passed = low_pass(jnp.asarray(z), length, (dx,))
    np.testing.assert_allclose(passed, expected, atol=1e-12 * np.abs(z).max())
    rows = low_pass(jnp.asarray(np.stack([z, 2 * z] * 4)), 1e6, (dx, dx))
    np.testing.assert_allclose(rows, np.full((8, 400), 1.5 * z.mean()), rtol=1e-9)


def test_tilt_is_no_roughness():
    z, dx = noise(), 1e-6
    tilted = z + 0.05 * dx * np.arange(z.size)
    plain, other = (fj.profile_parameters(x, dx, cutoff=5e-4) for x in (z, tilted))
    for name in NAMES:
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), rtol=1e-6)
    line = np.polyval(np.polyfit(np.arange(z.size), z, 1), np.arange(z.size))
    np.testing.assert_allclose(remove_form(jnp.asarray(tilted)), z - line, atol=1e-15)


def test_sections():
    """Rz, Rp and Rv are means over sections in the middle; Rt is of all of them together."""
    z, dx = noise(), 1e-6
    p = fj.profile_parameters(z, dx, cutoff=5e-4)
    level = remove_form(jnp.asarray(z))
    roughness = level - low_pass(level, 5e-4, (dx,))
    middle = np.asarray(roughness)[750:3250].reshape(5, 500)
    peak, pit = middle.max(axis=1), -middle.min(axis=1)
    expected = dict(Rp=peak.mean(), Rv=pit.mean(), Rz=(peak + pit).mean(), Rt=np.ptp(middle))
    expected |= dict(Ra=abs(middle).mean(), Rq=math.sqrt((middle**2).mean()))
    expected |= dict(Rsk=(middle**3).mean() / (middle**2).mean() ** 1.5)
    expected |= dict(Rku=(middle**4).mean() / (middle**2).mean() ** 2)
    expected |= dict(Rdq=math.sqrt((np.asarray(slope(roughness, dx))[750:3250] ** 2).mean()))
    for name, value in expected.items():
        assert float(getattr(p, name)) == pytest.approx(value, rel=1e-12), name
    whole = fj.profile_parameters(z, dx)
    assert whole.Rz == whole.Rt and p.Rz < p.Rt
    halves = fj.profile_parameters(z, dx, sections=2)
    np.testing.assert_allclose(halves.Rz, np.ptp(z.reshape(2, 2000), axis=1).mean(), rtol=1e-12)


def test_short_profiles_say_so():
    z, dx = noise(), 1e-6
    match = r"^z is 0.004 m long and holds 3 sections of cutoff = 0.001 m \(.*\), fewer than 5$"
    with pytest.warns(UserWarning, match=match):
        three = fj.profile_parameters(z, dx, cutoff=1e-3)
    assert three.Rz == fj.profile_parameters(z, dx, cutoff=1e-3, sections=3).Rz
    fj.profile_parameters(z, dx, cutoff=z.size * dx / 6)  # five


# --- single parts, by their definitions ----------------------------------------------------


def test_slope_has_its_order():
    """The seven-point formula inside; at the ends, lower orders."""
    errors = []
    for n in (64, 128):
        x = np.linspace(0, 3, n)
        errors.append(np.abs(slope(jnp.asarray(np.sin(x)), x[1]) - np.cos(x)))
    for i, order in ((0, 2), (1, 2), (2, 4), (32, 6)):
        for k in (i, -1 - i):
            ratio = errors[0][k] / errors[1][k if i < 32 else 2 * k]
            assert math.log2(ratio) == pytest.approx(order, abs=0.35), i


@pytest.mark.parametrize("seed", [0, 1])
def test_material_ratio_curve(seed):
    """Line, intersections and areas on the interpolated curve."""
    z = noise(20_000, seed)
    curve, p = np.sort(z)[::-1], (np.arange(20_000) + 0.5) / 20_000
    start = np.argmin(curve[:-8000] - curve[8000:])
    part = slice(start, start + 8001)
    steepness, upper = np.polyfit(p[part], curve[part], 1)
    lower = upper + steepness
    first, second = np.interp([-upper, -lower], -curve, p)
    above = np.linspace(0, first, 100_001)
    below = np.linspace(second, 1, 100_001)
    peaks = np.trapezoid(np.interp(above, p, curve) - upper, above)
    valleys = np.trapezoid(lower - np.interp(below, p, curve), below)
    m = material_ratio(jnp.asarray(z))
    assert float(m.core) == pytest.approx(-steepness, rel=1e-9)
    assert float(m.first) == pytest.approx(100 * first, rel=2e-3)
    assert float(m.second) == pytest.approx(100 * second, rel=2e-4)
    assert float(m.peaks) == pytest.approx(2 * peaks / first, rel=2e-3)
    assert float(m.valleys) == pytest.approx(2 * valleys / (1 - second), rel=2e-3)


def test_a_worn_plateau_has_no_peaks():
    z = jnp.minimum(noise(), 0.0)
    m = material_ratio(z)
    assert m.peaks == 0 == m.first and m.valleys > 0
    assert np.isfinite(jax.grad(lambda z: sum(material_ratio(z)))(z)).all()


def element_width(z, height, width):
    """RSm in grid steps by walking along the profile."""
    crossings, side, last = [], 0, 0
    for i, value in enumerate(z):
        sign = int(value >= height) - int(value <= -height)
        if sign and side and sign != side:
            j = max(k for k in range(i) if z[k] * sign <= 0)
            crossings.append((j + z[j] / (z[j] - z[j + 1]), sign))
        side = sign or side
    kept, side = [], -crossings[0][1]
    for k, (x, sign) in enumerate(crossings):
        last = k == len(crossings) - 1
        if sign != side and (last or crossings[k + 1][0] - x >= width):
            kept.append(x)
            side = sign
    elements = (len(kept) - 1) // 2
    return (kept[2 * elements] - kept[0]) / elements


@pytest.mark.parametrize("height", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("width", [0.0, 6.0, 15.0])
def test_profile_elements(height, width):
    """A profile with small and narrow hills and pits."""
    z = noise(1500, 2) / 1e-6 + 0.3
    z = z + 0.2 * np.sin(np.arange(1500) * 2.0)
    width_found = mean_element_width(jnp.asarray(z), 1.0, height, width)
    assert float(width_found) == pytest.approx(element_width(z, height, width), rel=1e-12)


def test_ripple_is_no_profile_element():
    z, dx = periods(np.sin)
    ripple = 0.05 * AMPLITUDE * np.sin(2 * np.pi * np.arange(z.size) / 20)
    p = fj.profile_parameters(z + ripple, dx)
    assert float(p.RSm) == pytest.approx(WAVE, rel=1e-3)
    assert np.isnan(fj.profile_parameters(z[:450], dx).RSm)  # one period and a part


# --- derivatives, batches, precision -------------------------------------------------------


def test_scaling():
    """Heights with a, lengths along x with b."""
    z, dx = noise(), 1e-6
    p = fj.profile_parameters(z, dx, cutoff=5e-4, shortest=5e-6)
    other = fj.profile_parameters(8 * z, 4 * dx, cutoff=2e-3, shortest=2e-5)
    for name in NAMES:
        factor = 8 if name in LENGTHS else {"Rdq": 2, "RSm": 4}.get(name, 1)
        np.testing.assert_allclose(getattr(other, name), factor * getattr(p, name), rtol=1e-9)
    upside_down = fj.profile_parameters(-z, dx, cutoff=5e-4, shortest=5e-6)
    for name, mirror in (("Rp", "Rv"), ("Rpk", "Rvk"), ("Rk", "Rk"), ("RSm", "RSm"), ("Rq", "Rq")):
        np.testing.assert_allclose(getattr(upside_down, name), getattr(p, mirror), rtol=1e-9)
    assert float(upside_down.Rsk) == pytest.approx(-float(p.Rsk), rel=1e-9)
    assert float(upside_down.Mr1) == pytest.approx(100 - float(p.Mr2), rel=1e-9)


@pytest.mark.parametrize("filters", [{}, {"cutoff": 2e-4, "shortest": 4e-6}])
def test_derivatives(filters):
    """In both modes, along two directions of heights, beside differences of the whole function."""
    z, dx = noise(1300), 1e-6
    directions = jnp.asarray([noise(1300, 5), np.sin(0.03 * np.arange(1300)) * 1e-6])

    def values(u):
        p = fj.profile_parameters(z + u @ directions, dx, **filters)
        return jnp.stack([getattr(p, name) for name in NAMES])

    u, step = jnp.array([0.1, -0.2]), 1e-6
    _, forward, reverse = jax.jit(lambda u: both_modes(values, u))(u)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-14)
    batch = jax.vmap(values)(u[None] + step * jnp.concatenate([jnp.eye(2), -jnp.eye(2)]))
    differences = np.asarray(batch[:2] - batch[2:]).T / (2 * step)
    scale = np.abs(differences).max(axis=1, keepdims=True)
    np.testing.assert_allclose(forward / scale, differences / scale, atol=2e-6)
    assert (scale > 0).all()


def test_derivative_by_the_grid_step():
    z = noise(1000)
    p = fj.profile_parameters(z, 1e-6)
    by_step = jax.jit(jax.jacrev(lambda dx: fj.profile_parameters(z, dx)))(1e-6)
    assert float(by_step.Rdq) == pytest.approx(-float(p.Rdq) / 1e-6, rel=1e-9)
    assert float(by_step.RSm) == pytest.approx(float(p.RSm) / 1e-6, rel=1e-9)
    assert by_step.Rq == 0


def test_batches_and_float32():
    z, dx = np.stack([noise(1300, seed) for seed in (0, 1)]), 1e-6
    filters: dict[str, Any] = {"cutoff": 2e-4, "shortest": 4e-6}
    batch = jax.jit(jax.vmap(lambda z: fj.profile_parameters(z, dx, **filters)))(z)
    for k in (0, 1):
        one = fj.profile_parameters(z[k], dx, **filters)
        lengths: dict[str, Any] = {name: jnp.float32(x) for name, x in filters.items()}
        single = fj.profile_parameters(jnp.float32(z[k]), jnp.float32(dx), **lengths)
        for name in NAMES:
            np.testing.assert_allclose(getattr(batch, name)[k], getattr(one, name), rtol=1e-12)
            assert getattr(single, name).dtype == jnp.float32
            np.testing.assert_allclose(
                getattr(single, name), getattr(one, name), rtol=2e-3 if name[0] == "M" else 1e-3
            )


def test_flat_heights():
    p = fj.profile_parameters(np.full(100, 0.1), 1e-6)
    assert all(getattr(p, name) == 0 for name in LENGTHS | {"Rdq"})
    assert all(np.isnan(getattr(p, name)) for name in ("Rsk", "Rku", "RSm"))


Z = noise(1300)


def test_lists_are_heights():
    listed, array = (fj.profile_parameters(z, 1e-6) for z in (Z.tolist(), Z))
    assert all(float(getattr(listed, x)) == float(getattr(array, x)) for x in ("Ra", "Rz", "RSm"))


def test_refusal_of_gaps_says_what_fills_them():
    z = np.where(Z > 1.5e-6, np.nan, Z)
    with pytest.raises(ValueError, match=r"fractaljax.prepare_measurement\(z, dx\).z has them fil"):
        fj.profile_parameters(z, 1e-6)
    found = fj.profile_parameters(fj.prepare_measurement(z, 1e-6).z, 1e-6)
    assert 0.3 * Z.std() < float(found.Ra) < Z.std()


test_refusals = refusals(
    [
        (
            {"z": np.ones((9, 9))},
            r"^z must have shape \(n,\) with 8 points or more .*, got \(9, 9\)$",
        ),
        ({"z": np.ones(7)}, r"^z must have shape \(n,\) with 8 points or more .*, got \(7,\)$"),
        ({"z": np.where(Z > 5e-7, np.nan, Z)}, r"^z must be finite, got \d+ NaN: fill them in, or"),
        ({"z": np.ma.masked_less(Z, -1e-6)}, r"^z must be finite, got \d+ NaN: fill them in, or"),
        ({"z": np.where(Z > 5e-7, np.inf, Z)}, r"^z must be finite, got inf$"),
        ({"z": "high"}, r"^z must be a number, got 'high'$"),
        ({"z": ["high"]}, r"^z must be real numbers, got \['high'\]$"),
        ({"z": [[1.0], [1.0, 2.0]]}, r"^z must be rows of as many numbers, got \[\[1.0\], "),
        ({"dx": 0}, r"^dx must be above 0, got 0\.0$"),
        ({"dx": np.ones(2)}, r"^dx must be a single number, got shape \(2,\)$"),
        ({"cutoff": -1}, r"^cutoff must be above 0, got -1\.0$"),
        ({"shortest": 1e-6}, r"^shortest must be at least two grid steps = 2e-06 m, got 1e-06$"),
        ({"cutoff": 1e-6}, r"^cutoff must be at least two grid steps = 2e-06 m, got 1e-06$"),
        (
            {"cutoff": 1e-4, "shortest": 2e-4},
            r"^cutoff must be at least shortest = 0\.0002 m, got 0\.0001$",
        ),
        (
            {"cutoff": 0.8},
            r"^z is 0\.0013 m long and holds 0 sections of cutoff = 0\.8 m .* than 1$",
        ),
        ({"cutoff": 2e-4, "sections": 7}, r"^z .* holds 5 sections of .*, fewer than 7$"),
        ({"sections": 1000}, r"^sections must be at most 650, got 1000$"),
        ({"sections": 2.5}, r"^sections must be a whole number of at least 1, got 2\.5$"),
        ({"shortest": 2e-3}, r"^z is 0\.0013 m long, too short for shortest = 0\.002 m: half"),
    ],
    lambda change: fj.profile_parameters(**(dict(z=Z, dx=1e-6) | change)),
    kind=(ValueError, TypeError),
)


def test_lengths_are_known_at_trace_time():
    with pytest.raises(TypeError, match=r"^cutoff must be known while a program is traced"):
        jax.jit(lambda cutoff: fj.profile_parameters(Z, 1e-6, cutoff=cutoff))(1e-4)
    with pytest.raises(TypeError, match=r"^dx must be known while a program is traced"):
        jax.jit(lambda dx: fj.profile_parameters(Z, dx, cutoff=1e-4))(1e-6)
    traced = jax.jit(lambda z: fj.profile_parameters(z, 1e-6, cutoff=2e-4))
    bad = traced(np.where(np.arange(Z.size) == 700, np.nan, Z))
    assert all(np.isnan(getattr(bad, name)) for name in NAMES)
