"""Options of `identify`: each does what its class says of it, and nonsense is refused."""

import math
from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._identify.spectrum import profile_spectrum
from synthetic import DX, gaussian_map, gaussian_profile
from tools import refusals

INF = math.inf
Z = gaussian_profile(np.random.default_rng(0), 2.4, 2048)
LENGTH = Z.size * DX


def with_gaps(first, last):
    z = Z.copy()
    z[first:last] = np.nan
    return z


def test_preprocessing():
    spiky = Z.copy()
    spiky[700] += 10 * Z.std()
    kept = fj.identify(spiky, DX, preprocessing=fj.Preprocessing(spike=INF))
    assert (fj.identify(spiky, DX).outliers, kept.outliers) == (1, 0)
    # A gap of 200 points divides the profile: the longest wave of the band is half as long.
    wide = fj.identify(with_gaps(900, 1100), DX, preprocessing=fj.Preprocessing(longest_gap=200))
    narrow = fj.identify(with_gaps(900, 1100), DX)
    assert 1.5 * wide.band[0] < narrow.band[0]
    short, rare = fj.Preprocessing(fewest_points=64), fj.Preprocessing(fewest_per_side=32)
    assert fj.identify(Z[:100], DX, preprocessing=short).D > 2
    map_ = gaussian_map(np.random.default_rng(0), 2.4, (40, 64))
    assert fj.identify(map_, DX, preprocessing=rare).D > 2
    usual = fj.Preprocessing()
    for few, options in ((Z[:127], usual), (map_, usual), (Z[:63], short), (map_[:31], rare)):
        with pytest.raises(ValueError, match="z is too short"):
            fj.identify(few, DX, preprocessing=options)
    holes = np.where(np.random.default_rng(1).random((64, 64)) < 0.2, np.nan, 1.0)
    holes *= gaussian_map(np.random.default_rng(0), 2.4, (64, 64))
    with pytest.raises(ValueError, match="too many gaps"):
        fj.identify(holes, DX, preprocessing=fj.Preprocessing(most_missing=0.1))


def test_spectral_analysis():
    # n times the mean fourth power of one taper is 3/2; many tapers together are nearly level.
    counts = [profile_spectrum([Z], DX, tapers).count[0] for tapers in (1, 3, 9)]
    np.testing.assert_allclose(counts, [2 / 3, 6 / 7, 18 / 19])
    errors = [
        fj.identify(Z, DX, analysis=fj.SpectralAnalysis(tapers=tapers)).D_standard_error
        for tapers in (1, 3, 9)
    ]
    assert errors[0] > 1.2 * errors[1] > 1.2 * errors[2]
    late = fj.identify(Z, DX, analysis=fj.SpectralAnalysis(fewest_periods=20))
    assert 20 <= late.band[0] * LENGTH < 20 * 1.5
    fine = fj.identify(Z, DX, resolution=1e-5, analysis=fj.SpectralAnalysis(resolutions=2))
    assert fine.band[1] == pytest.approx(5e4) == 2 * fj.identify(Z, DX, resolution=1e-5).band[1]
    noisy = Z + 0.1 * Z.std() * np.random.default_rng(0).standard_normal(Z.size)
    blind = fj.identify(noisy, DX, analysis=fj.SpectralAnalysis(sigmas=1e3))
    assert fj.identify(noisy, DX).noise_floor > 0 == blind.noise_floor
    given = fj.identify(noisy, DX, band=(3e3, 1e5), analysis=fj.SpectralAnalysis(sigmas=1e3))
    assert fj.identify(noisy, DX, band=(3e3, 1e5)).noise_floor > 0 == given.noise_floor


def grooved():
    rng = np.random.default_rng(0)
    return gaussian_map(rng, 2.4, (96, 96)) + gaussian_profile(rng, 2.4, 96, 1e-8)[:, None]


def smoothed():
    z = gaussian_profile(np.random.default_rng(0), 2.2, 4096)
    return np.convolve(z, np.hanning(9), "valid")


LOUD, ANY = {"sigmas": 0, "bend": 0, "disagreement": 0, "anisotropy": 0, "ln_G_error": 0}, {}
WARNED = [  # heights, a line of the warnings, thresholds that give it, and one that silences it
    (Z[:150], "too few decades", ANY, {"decades": 0}),
    (smoothed(), "the slope bends", ANY, {"bend": INF}),
    (smoothed(), "the slope bends", ANY, {"sigmas": INF}),
    (0.3 * Z + 2 * Z.std() * np.sin(0.7 * np.arange(2048)), "scatter", ANY, {"scatter": INF}),
    (grooved(), "anisotropic: waves", ANY, {"anisotropy": INF}),
    (grooved(), "anisotropic: waves", ANY, {"sigmas": INF}),
    (grooved(), "anisotropic: D", LOUD, {"bend": INF}),
    (Z, "disagree", LOUD, {"disagreement": INF}),
    (Z, "disagree", LOUD, {"sigmas": INF}),
    (Z, "G is poorly known", LOUD, {"ln_G_error": INF}),
    (with_gaps(500, 600), "are missing", ANY, {"missing": INF}),
    (np.clip(Z, -INF, np.quantile(Z, 0.97)), "clipped: ", ANY, {"clipped": INF}),
    (np.where(np.arange(2048) % 40 == 1, np.roll(Z, 1), Z), "equal to th", ANY, {"held": INF}),
    (grooved() + 1e-4 * (np.arange(96) > 40), "a jump of", ANY, {"jump": INF}),
]


@pytest.mark.parametrize(("z", "line", "loud", "silent"), WARNED, ids=[row[1] for row in WARNED])
def test_thresholds_of_warnings(z, line, loud, silent):
    """Each gives or silences its warning and changes no number."""
    usual = fj.identify(z, DX, thresholds=fj.WarningThresholds(**loud))
    quiet = fj.identify(z, DX, thresholds=fj.WarningThresholds(**loud | silent))
    assert any(line in each for each in usual.warnings), usual.warnings
    assert not any(line in each for each in quiet.warnings), quiet.warnings
    assert (quiet.D, quiet.G, quiet.band) == (usual.D, usual.G, usual.band)


test_bad_options_are_refused = refusals(
    [
        (fj.Preprocessing, {"fewest_points": 31}, "fewest_points must be a whole number"),
        (fj.Preprocessing, {"fewest_per_side": 20.5}, "fewest_per_side must be a whole number"),
        (fj.Preprocessing, {"longest_gap": -1}, "longest_gap must be a whole number"),
        (fj.Preprocessing, {"most_missing": 1.5}, "most_missing must be at least 0 and at most 1"),
        (fj.Preprocessing, {"spike": math.nan}, "spike must be at least 1"),
        (fj.Preprocessing, {"spike": True}, "spike must be a number"),
        (fj.SpectralAnalysis, {"tapers": 0}, "tapers must be a whole number"),
        (fj.SpectralAnalysis, {"fewest_periods": 0.5}, "fewest_periods must be at least 1"),
        (fj.SpectralAnalysis, {"level": -1.0}, "level must be at least 0"),
        (fj.SpectralAnalysis, {"gradient": 0.5}, "gradient must be at least 1"),
        (fj.SpectralAnalysis, {"resolutions": 0.0}, "resolutions must be at least 1"),
        (fj.SpectralAnalysis, {"sigmas": -1.0}, "sigmas must be at least 0"),
        (fj.WarningThresholds, {"jump": -1.0}, "jump must be at least 0"),
        (fj.WarningThresholds, {"bend": "1"}, "bend must be a number"),
        (fj.FileLimits, {"text": 0}, "text must be a whole number"),
    ],
    lambda kind, options: kind(**options),
    kind=(ValueError, TypeError),
)


@pytest.mark.parametrize("name", ["preprocessing", "analysis", "thresholds"])
def test_options_of_another_kind_are_refused(name):
    options: dict[str, Any] = {name: 3.0}
    with pytest.raises(TypeError, match=f"^{name} must be a"):
        fj.identify(Z, DX, **options)
