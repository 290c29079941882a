"""Warnings: quantised, clipped, joined or noisy heights, wrong units, and doubtful results."""

from types import SimpleNamespace

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._identify.quantisation import quantisation_limit
from fractaljax._identify.warnings import height_warnings, quantisation_warnings, result_warnings
from synthetic import DX, cut, gaussian_map, gaussian_profile


def rounded(z, levels, rng):
    """Heights in so many levels or one more, anywhere on a grid of steps."""
    q = np.ptp(z) / (levels - 1)
    return q * np.round(z / q + rng.random())


def warned(z, high=0.25 / DX):
    steps = (DX,) * z.ndim
    limit = quantisation_limit(z, steps)
    return [*height_warnings(z, steps), *quantisation_warnings(z, limit, high, high, 1e4)]


def assert_right_or_warned(z, D, dx=DX):
    found = fj.identify(z, dx)
    assert found.warnings or abs(found.D - D) < 5 * found.D_standard_error, (D, z.shape, found)
    return found


@pytest.mark.parametrize(("levels", "prefix"), [(16, "heights have only"), (5, "too few levels: ")])
def test_few_levels(levels, prefix):
    """A file of two decimals was 25 standard errors off before steps were seen."""
    rng = np.random.default_rng(0)
    found = fj.identify(rounded(gaussian_profile(rng, 2.2, 4096), levels, rng), DX)
    assert levels < 16 or abs(found.D - 2.2) < 3 * found.D_standard_error
    (line,) = (each for each in found.warnings if each.startswith(prefix))
    assert "levels (step " in line and ("meaningless" in line) == (levels == 5)


@pytest.mark.parametrize("levelled", [False, True])
def test_a_hundred_levels_end_the_band(levelled):
    """Where the steps count, also after levelling; below, the law is found."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(6):
        z = rounded(gaussian_profile(rng, 2.3, 8192), 150, rng)
        z = z + levelled * np.linspace(0, np.pi * np.ptp(z), z.size)
        found = fj.identify(z, DX)
        assert any(line.startswith("heights ") for line in found.warnings)
        assert found.band[1] < 0.2 / DX
        errors.append((found.D - 2.3) / found.D_standard_error)
    assert np.sqrt(np.mean(np.square(errors))) < 1.6
    wide = fj.identify(z, DX, band=(5e3, 2e5)).warnings
    assert any("D and G are in doubt, the band goes beyond" in line for line in wide)
    narrow = fj.identify(z, DX, band=(1e3, found.band[1])).warnings
    assert not any(line.startswith("heights ") for line in narrow)


def harmed(harm, rng, D):
    """Surfaces in few levels, as instruments and files produce them."""
    n = int(2 ** rng.uniform(8, 13))
    if harm == "map":
        z = gaussian_map(rng, D, tuple(rng.integers(48, 160, 2)))
    else:
        z = (cut if harm == "cut" else gaussian_profile)(rng, D, n)
    if harm == "decimals":
        return np.round(z / z.std(), rng.integers(1, 5)) * 1e-7
    if harm == "float16":
        return (z / z.std()).astype("f2").astype(float) * 1e-7
    if harm == "offset in float32":
        return (z + z.std() * 10 ** rng.uniform(2, 6)).astype("f4").astype(float)
    return rounded(z, int(2 * 500 ** rng.random()), rng)


SLOW = [
    pytest.param(harm, 100, marks=pytest.mark.slow)
    for harm in ("profile", "map", "offset in float32", "float16", "decimals")
]


@pytest.mark.parametrize(("harm", "count"), [("profile", 6), ("cut", 6), *SLOW])
def test_quantised_surfaces(harm, count):
    """Two to a thousand levels of any surface: within five standard errors, or warned of."""
    for seed in range(1000, 1000 + count):
        rng = np.random.default_rng(seed)
        D = rng.uniform(2.05, 2.95)
        assert_right_or_warned(harmed(harm, rng, D), D)


def test_clean_surfaces_two_scans_and_anisotropy():
    """Gaps, tilt and an offset included."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        D, n = rng.uniform(2.05, 2.95), int(2 ** rng.uniform(7, 12))
        z = (gaussian_profile, cut)[seed % 2](rng, D, n) + 1e-4
        z = np.where(rng.random(n) < 0.05, np.nan, z + np.linspace(0, seed * 1e-6, n))
        assert not warned(z), seed
    assert not warned(gaussian_map(np.random.default_rng(0), 2.4))
    # A line of a map, or a point of a profile, from which on everything is higher.
    z = gaussian_map(np.random.default_rng(0), 2.4)
    high = z.std() * (np.arange(192) > 70)
    for joined in (z + high, z + high[:, None], z[0] + 5 * high):
        (line,) = (line for line in warned(joined) if line.startswith("a jump of"))
        assert "two scans" in line
    # Grooves along y on an isotropic map.
    rng = np.random.default_rng(0)
    z = gaussian_map(rng, 2.4, (96, 96))
    grooves = gaussian_profile(rng, 2.4, 96, 1e-8)[:, None]
    (line,) = (line for line in fj.identify(z + grooves, DX).warnings if "anisotropic" in line)
    assert "along x have" in line
    assert not any("anisotropic" in line for line in fj.identify(z, DX).warnings)


@pytest.mark.parametrize("kind", ["held", "line", "missing"])
def test_interpolated_heights(kind):
    """The band ends well below the Nyquist frequency of the true points."""
    rng = np.random.default_rng(2)
    for _ in range(3):
        z = gaussian_profile(rng, 2.5, 2048)
        fine = np.repeat(z, 2)
        if kind == "line":
            fine = np.interp(np.arange(4095) / 2, np.arange(2048), z)
        elif kind == "missing":  # no two neighbours are known
            fine = np.where(np.arange(4096) % 2, fine, np.nan)
        found = assert_right_or_warned(fine, 2.5, DX / 2)
        assert any(line.startswith("heights ") for line in found.warnings)
        if kind != "missing":
            assert abs(found.D - 2.5) < 4 * found.D_standard_error
            assert found.band[1] == pytest.approx(0.125 / DX)


@pytest.mark.parametrize("tilt", [0.0, 1e-6])
@pytest.mark.parametrize("ends", [(-0.5, 0.5), (-np.inf, 1.5), (-1.5, np.inf)])
def test_clipped_heights(ends, tilt):
    """A few percent of the heights, at either end, also if levelled afterwards."""
    z = gaussian_profile(np.random.default_rng(0), 2.4, 2048)
    z = (z - z.mean()) / z.std()
    clipped = 1e-7 * np.clip(z, *ends) + tilt * np.linspace(0, 1, z.size)
    assert any("clipped" in line for line in warned(clipped))


@pytest.mark.parametrize(
    ("height", "dx", "reason"),
    [
        (1e-6, 1e-3, "it is 2.05 m long"),
        (1e-6, 1e-18, "points are 1e-18 m apart"),
        (1e9, 1e-6, "rms height"),
        (1e-9, 1e-6, "rms height"),
        (1e4, 1e-6, "rms slope"),
    ],
)
def test_units_that_may_be_wrong(height, dx, reason):
    z = gaussian_profile(np.random.default_rng(0), 2.4, 2048, G=1e-10)
    assert not [*height_warnings(z, (DX,))]
    (line,) = height_warnings(height * z, (dx,))
    assert line.startswith("the units may be wrong") and reason in line


def bent(rng, p=2.0, corner=5e3):
    f = np.fft.rfftfreq(32768, DX)
    waves = rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)
    return np.fft.irfft((f**2 + corner**2) ** (-p / 2) * waves)[:16384] * 1e-3


MADE = {
    "noise floor": lambda z, rng: z + 0.02 * z.std() * rng.standard_normal(z.size),
    "bins scatter": lambda z, _: 0.3 * z + 2 * z.std() * np.sin(0.7 * np.arange(z.size)),
    "the slope bends": lambda z, _: np.convolve(z, np.hanning(9), "valid"),
    "plateau below": lambda _, rng: bent(rng),
    "too few decades": lambda z, _: z[:150],
    "is not between 2 and 3": lambda z, rng: 1e-8 * rng.standard_normal(z.size),
    "may be aliased": lambda *_: gaussian_profile(np.random.default_rng(2), 2.8, 400),
}


@pytest.mark.parametrize("line", MADE)
def test_warnings_of_a_profile(line):
    rng = np.random.default_rng(0)
    found = fj.identify(MADE[line](gaussian_profile(rng, 2.2, 4096), rng), DX)
    assert any(line in each for each in found.warnings), found.warnings


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, None),
        ({"errors": (1e-4, 0.1), "other": 2.44, "other_error": 1e-4}, None),  # tiny errors
        ({"D": 3.2, "other": 3.2}, "D = 3.2 is not between 2 and 3: no surface of this model"),
        ({"D": 2.01, "other": 2.01}, "D = 2.01 is within its standard error of 2 or 3"),
        ({"D": 2.99, "other": 2.99}, "D = 2.99 is within its standard error of 2 or 3"),
        ({"errors": (0.02, 2.5)}, "G is poorly known: ln G has a standard error of 2.5"),
        ({"other": 2.6}, "spectrum and structure function disagree: D = 2.4 and 2.6, 7.1 standa"),
        ({"missing": 20, "outliers": 5}, "2.5% of the heights are missing or outliers"),
    ],
)
def test_warnings_of_a_result(changes, line):
    given = {"D": 2.4, "errors": (0.02, 0.5), "other": 2.4, "other_error": 0.02}
    given |= {"missing": 0, "outliers": 0} | changes
    other = SimpleNamespace(D=given["other"], D_standard_error=given["other_error"])
    lost = {name: given[name] for name in ("missing", "outliers")}
    heights = SimpleNamespace(despiked=np.zeros(1000), **lost)
    found = [*result_warnings(given["D"], np.array(given["errors"]), other, heights)]  # pyright: ignore
    assert [each[: len(line or "")] for each in found] == [line] * (line is not None)
