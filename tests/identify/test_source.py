"""What `identify` takes beside heights: measurements, files and topographies."""

from types import SimpleNamespace

import numpy as np
import pytest

import fractaljax as fj
from synthetic import DX, gaussian_map, gaussian_profile
from tools import refusals

PROFILE = gaussian_profile(np.random.default_rng(0), 2.5, 512)
MAP = gaussian_map(np.random.default_rng(1), 2.4, (96, 128), dy=1.25e-6)
MAP[3, 4] = np.nan
TIP = {"instrument": {"parameters": {"tip_radius": {"value": 2.0, "unit": "um"}}}}
TOPOGRAPHY = SimpleNamespace(  # what SurfaceTopography documents, in micrometres
    heights=lambda: np.ma.masked_invalid(MAP * 1e6), unit="um", pixel_size=np.array([1.0, 1.25])
)
LINE = SimpleNamespace(
    heights=lambda: PROFILE * 1e10, unit="A", positions=lambda: np.arange(512) * DX * 1e10
)
MEASURED = fj.Measurement(PROFILE, DX, None, "mine", 8e-6)


def same(found, wanted):
    np.testing.assert_allclose(
        [found.D, found.G, *found.band, found.missing],
        [wanted.D, wanted.G, *wanted.band, wanted.missing],
        rtol=1e-6,
    )


def test_a_measurement_and_its_limits():
    """Its steps and limits are taken; a limit that is given replaces it, the same step does not."""
    wanted = fj.identify(PROFILE, DX, resolution=8e-6)
    same(fj.identify(MEASURED), wanted)
    same(fj.identify(MEASURED, DX), wanted)
    same(fj.identify(MEASURED, resolution=1e-9), fj.identify(PROFILE, DX))
    assert wanted.limit < fj.identify(PROFILE, DX).limit


@pytest.mark.parametrize("kind", [str, lambda path: path])
def test_a_path(tmp_path, kind):
    """Of a file that has its steps, and of one that has not."""
    np.savez(tmp_path / "map.npz", z=MAP, dx=DX, dy=1.25e-6)
    same(fj.identify(kind(tmp_path / "map.npz")), fj.identify(MAP, DX, 1.25e-6))
    (tmp_path / "profile.csv").write_text("\n".join(["z [m]", *map(repr, PROFILE.tolist())]))
    same(fj.identify(kind(tmp_path / "profile.csv"), DX), fj.identify(PROFILE, DX))
    with pytest.raises(FileNotFoundError):
        fj.identify(kind(tmp_path / "none.csv"))


def test_a_topography():
    """In any unit, masked or not, by its pixels or its positions."""
    same(fj.identify(TOPOGRAPHY), fj.identify(MAP, DX, 1.25e-6))
    same(fj.identify(LINE), fj.identify(PROFILE, DX))
    with_tip = fj.identify(SimpleNamespace(**vars(LINE), info=TIP))
    same(with_tip, fj.identify(PROFILE, DX, stylus_radius=2e-6))


def test_topographies_of_the_package():
    package = pytest.importorskip("SurfaceTopography")
    z = np.ma.masked_invalid(MAP * 1e9)
    same(
        fj.identify(package.Topography(z, (96e3, 160e3), unit="nm")), fj.identify(MAP, DX, 1.25e-6)
    )
    line = package.UniformLineScan(PROFILE * 1e3, 512 * DX * 1e3, unit="mm")
    same(fj.identify(line), fj.identify(PROFILE, DX))
    line = package.NonuniformLineScan(np.arange(512) * DX * 1e6, PROFILE * 1e6, unit="µm")
    same(fj.identify(line), fj.identify(PROFILE, DX))


test_refused = refusals(
    [
        (PROFILE, {}, "dx is needed beside heights: the step between them in m, such as dx=1e-6"),
        (PROFILE, {"dx": DX, "dy": DX}, "dy is for maps, got 1e-06 m for a profile: leave it out"),
        (MEASURED, {"dx": 2e-6}, "dx is 1e-06 m of the measurement, got 2e-06"),
        (MEASURED, {"dy": 2e-6}, "dy is for maps, got 2e-06 m for a profile"),
        (TOPOGRAPHY, {"dy": 1e-6}, "dy is 1.25e-06 m of the topography, got 1e-06"),
        (SimpleNamespace(heights=lambda: MAP, unit=None), {}, "z must have a unit of length"),
        (SimpleNamespace(heights=lambda: MAP, unit="V"), {}, "the unit of z must be one of m, cm"),
        (SimpleNamespace(heights=lambda: MAP, unit="m"), {}, "z must have a pixel_size"),
        (SimpleNamespace(vars=1), {"dx": DX}, "z must be real heights in m"),
    ],
    lambda z, options: fj.identify(z, **options),
    plain=True,
)
