"""Heights that are not as the surface made them: steps, repetitions, clipping, jumps."""

import numpy as np
import pytest

import fractaljax as fj
from fractaljax.measured.levels import level_flags, step_limit
from synthetic import DX, cut, gaussian_map, gaussian_profile


def rounded(z, levels, rng):
    """Heights in so many levels or one more, anywhere on a grid of steps."""
    q = np.ptp(z) / (levels - 1)
    return q * np.round(z / q + rng.random())


def said(z, high=0.25 / DX):
    return [*level_flags(z, step_limit(z, (DX,) * z.ndim), high, high, 1e4)]


def assert_within_errors_or_flagged(z, D, dx=DX, most=5.0):
    found = fj.identify(z, dx)
    assert found.flags or abs(found.D - D) < most * found.D_standard_error, (D, z.shape, found)
    return found


@pytest.mark.parametrize(("levels", "flag"), [(16, "heights have only"), (5, "too few levels: ")])
def test_few_levels(levels, flag):
    """A file of two decimals: 25 standard errors off without a word, before steps were seen."""
    rng = np.random.default_rng(0)
    found = fj.identify(rounded(gaussian_profile(rng, 2.2, 4096), levels, rng), DX)
    assert levels < 16 or abs(found.D - 2.2) < 3 * found.D_standard_error
    (said,) = (each for each in found.flags if each.startswith(flag))
    assert "levels (step " in said and ("mean nothing" in said) == (levels == 5)


@pytest.mark.parametrize("levelled", [False, True])
def test_a_hundred_levels_end_the_band(levelled):
    """Where the steps count, seen in levelled heights as well; below, the law is found."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(6):
        z = rounded(gaussian_profile(rng, 2.3, 8192), 150, rng)
        z = z + levelled * np.linspace(0, np.pi * np.ptp(z), z.size)
        found = fj.identify(z, DX)
        assert any(flag.startswith("heights ") for flag in found.flags)
        assert found.band[1] < 0.2 / DX
        errors.append((found.D - 2.3) / found.D_standard_error)
    assert np.sqrt(np.mean(np.square(errors))) < 1.6
    (flag,) = (f for f in fj.identify(z, DX, band=(5e3, 2e5)).flags if "goes beyond" in f)
    assert "D and G are in doubt" in flag
    narrow = fj.identify(z, DX, band=(1e3, found.band[1]))
    assert not any(flag.startswith("heights ") for flag in narrow.flags)


def test_profiles_of_few_levels():
    """Two to a thousand levels of any surface: within five standard errors, or flagged."""
    for seed in range(25):
        rng = np.random.default_rng(seed)
        D, n = rng.uniform(2.05, 2.95), int(2 ** rng.uniform(8, 12))
        z = (gaussian_profile, cut)[seed % 2](rng, D, n)
        z = rounded(z, int(2 * 500 ** rng.random()), rng)
        assert_within_errors_or_flagged(z + rng.choice([0, 1e-3]), D)


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["profile", "map", "offset in float32", "float16", "decimals"])
def test_many_of_few_levels(harm):
    """Likewise, and as instruments and files come by few levels."""
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        D, n = rng.uniform(2.05, 2.95), int(2 ** rng.uniform(8, 13))
        if harm == "map":
            z = gaussian_map(rng, D, tuple(rng.integers(48, 160, 2)))
            assert_within_errors_or_flagged(rounded(z, int(2 * 500 ** rng.random()), rng), D)
            continue
        z = gaussian_profile(rng, D, n)
        if harm == "profile":
            z = rounded(z, int(2 * 500 ** rng.random()), rng)
        elif harm == "decimals":
            z = np.round(z / z.std(), rng.integers(1, 5)) * 1e-7
        elif harm == "float16":
            z = (z / z.std()).astype("f2").astype(float) * 1e-7
        else:
            z = (z + z.std() * 10 ** rng.uniform(2, 6)).astype("f4").astype(float)
        assert_within_errors_or_flagged(z, D)


def test_clean_surfaces_have_nothing_to_say():
    """Gaps, tilt and an offset included."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        D, n = rng.uniform(2.05, 2.95), int(2 ** rng.uniform(7, 12))
        z = (gaussian_profile, cut)[seed % 2](rng, D, n) + 1e-4
        z = np.where(rng.random(n) < 0.05, np.nan, z + np.linspace(0, seed * 1e-6, n))
        assert not said(z), seed
    assert not said(gaussian_map(np.random.default_rng(0), 2.4))


@pytest.mark.parametrize("kind", ["held", "line"])
def test_heights_put_in_between(kind):
    """Points held or interpolated: the band ends well below the true points' Nyquist frequency."""
    rng = np.random.default_rng(2)
    for _ in range(5):
        z = gaussian_profile(rng, 2.5, 2048)
        fine = np.repeat(z, 2)
        if kind == "line":
            fine = np.interp(np.arange(4095) / 2, np.arange(2048), z)
        found = assert_within_errors_or_flagged(fine, 2.5, DX / 2)
        assert abs(found.D - 2.5) < 4 * found.D_standard_error
        assert found.band[1] == pytest.approx(0.125 / DX) and "heights " in "".join(found.flags)


@pytest.mark.parametrize("tilt", [0.0, 1e-6])
@pytest.mark.parametrize("ends", [(-0.5, 0.5), (-np.inf, 1.5), (-1.5, np.inf)])
def test_clipped_heights(ends, tilt):
    """From some percent of the heights on, at either end, also if levelled afterwards."""
    z = gaussian_profile(np.random.default_rng(0), 2.4, 2048)
    z = (z - z.mean()) / z.std()
    clipped = 1e-7 * np.clip(z, *ends) + tilt * np.linspace(0, 1, z.size)
    assert np.mean((z > ends[1]) | (z < ends[0])) > 0.02
    flags = fj.identify(clipped, DX).flags
    assert any("clipped" in flag for flag in flags), flags


def test_a_map_with_a_step_across():
    """A line of a map, or a point of a profile, from which on everything lies higher."""
    z = gaussian_map(np.random.default_rng(0), 2.4)
    high = z.std() * (np.arange(192) > 70)
    for put_together in (z + high, z + high[:, None], z[0] + 5 * high):
        (flag,) = (flag for flag in said(put_together) if flag.startswith("a jump of"))
        assert "two scans" in flag


@pytest.mark.parametrize(
    ("scales", "reason"),
    [
        ((1e-6, 1e3), "m long"),
        ((1e-6, 1e-12), "points are 1e-18 m apart"),
        ((1e9, 1.0), "rms height"),
        ((1e-9, 1.0), "rms height"),
        ((1e4, 1.0), "rms slope"),
    ],
)
def test_units_that_may_be_wrong(scales, reason):
    z = gaussian_profile(np.random.default_rng(0), 2.4, 2048, G=1e-10)
    assert not any("units" in flag for flag in fj.identify(z, DX).flags)
    flags = fj.identify(scales[0] * z, scales[1] * DX).flags
    assert any("the units may be wrong" in flag and reason in flag for flag in flags), flags


def test_every_other_height_missing():
    """No two neighbours are known: lines were put in between."""
    z = gaussian_profile(np.random.default_rng(0), 2.4, 2048)
    z[::2] = np.nan
    found = assert_within_errors_or_flagged(z, 2.4)
    assert any(flag.startswith("heights ") for flag in found.flags)
