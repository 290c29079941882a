"""Heights without spikes, gaps and tilt, from whatever holds them."""

from types import SimpleNamespace

import numpy as np
import pytest

import fractaljax as fj
from synthetic import DX, gaussian_map, gaussian_profile
from tools import refusals

MAP = gaussian_map(np.random.default_rng(1), 2.4, (64, 48))
PROFILE = gaussian_profile(np.random.default_rng(0), 2.5, 512)


def plane_of(z):
    """The least-squares plane or line of heights."""
    axes = [np.ones(z.size), *(i.ravel() for i in np.indices(z.shape))]
    A = np.stack(axes, 1)
    return (A @ np.linalg.lstsq(A, z.ravel(), rcond=None)[0]).reshape(z.shape)


@pytest.mark.parametrize("z", [MAP, PROFILE])
def test_takes_out_the_plane_and_nothing_else(z):
    tilted = z + 3e-7 * np.arange(len(z)).reshape(-1, *(1,) * (z.ndim - 1)) + 5e-6
    found = fj.prepare_measurement(tilted, DX)
    np.testing.assert_allclose(found.z, z - plane_of(z), atol=1e-9 * np.ptp(tilted))
    assert (found.dx, found.dy) == (DX, DX if z.ndim == 2 else None)
    assert found.source == "heights"
    kept = fj.prepare_measurement(tilted, DX, level=False)
    np.testing.assert_array_equal(kept.z, tilted)


def test_fills_gaps_and_spikes_and_says_so():
    z = MAP.copy()
    z[5, 7], z[20, 30] = np.nan, 50 * z.std()
    found = fj.prepare_measurement(z, DX, 2 * DX, level=False)
    for i, j in ((5, 7), (20, 30)):
        neighbours = MAP[i - 1, j] + MAP[i + 1, j] + MAP[i, j - 1] + MAP[i, j + 1]
        assert found.z[i, j] == pytest.approx(neighbours / 4, rel=1e-12)
    kept = np.ones(z.shape, bool)
    kept[5, 7] = kept[20, 30] = False
    np.testing.assert_array_equal(found.z[kept], MAP[kept])
    assert found.source == "heights, 2 heights filled, 1 spikes taken out" and found.dy == 2 * DX
    spiked = fj.prepare_measurement(z, DX, preprocessing=fj.Preprocessing(spike=np.inf)).z
    assert spiked.max() > 40 * MAP.std()
    assert not fj.areal_parameters(found.z, found.dx, dy=found.dy).Sq > 2 * MAP.std()


def test_the_longest_part_of_a_profile():
    z = PROFILE.copy()
    z[200:240] = np.nan
    z[400] = np.nan
    found = fj.prepare_measurement(z, DX, level=False)
    assert found.z.shape == (272,) and "272 of 512 points kept" in found.source
    np.testing.assert_array_equal(found.z[:160], PROFILE[240:400])


def test_takes_lists_files_and_topographies(tmp_path):
    expected = fj.prepare_measurement(MAP, DX).z
    np.savez(tmp_path / "map.npz", z=MAP, dx=DX)
    topography = SimpleNamespace(heights=lambda: MAP * 1e6, unit="um", pixel_size=(DX * 1e6,) * 2)
    for z in (tmp_path / "map.npz", topography, fj.Measurement(MAP, DX, DX, "mine", 1e-6)):
        np.testing.assert_allclose(fj.prepare_measurement(z).z, expected, rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(fj.prepare_measurement(MAP.tolist(), DX).z, expected)
    assert fj.prepare_measurement(fj.Measurement(MAP, DX, DX, "mine", 1e-6)).resolution == 1e-6


test_refused = refusals(
    [
        ((MAP,), {}, "dx is needed beside heights"),
        ((MAP * 0, DX), {}, "z has no roughness: it is constant"),
        ((MAP[:15], DX), {}, "z is too short: each side of a map needs 16 points"),
        ((MAP, DX), {"level": 1}, "level must be True or False, got 1"),
        ((MAP, DX), {"preprocessing": 8}, "preprocessing must be a Preprocessing, got 8"),
    ],
    lambda arguments, options: fj.prepare_measurement(*arguments, **options),
    kind=(ValueError, TypeError),
)
