"""What is done to heights before their spectrum: checks, spikes, gaps."""

import numpy as np
import pytest

from fractaljax.measured.preparation import FEWEST, checked, prepared, spacing

NAN = np.nan


def rough(*shape):
    return np.cumsum(np.random.default_rng(0).standard_normal(shape), axis=0)


def test_a_profile_without_faults_is_left_as_it_is():
    z = rough(300)
    heights = prepared(z)
    np.testing.assert_array_equal(heights.stretches[0], z)
    assert (len(heights.stretches), heights.missing, heights.outliers, heights.unused) == (
        1,
        0,
        0,
        0,
    )


def test_short_gaps_are_bridged_by_lines_and_long_ones_divide():
    z = rough(600)
    z[100:104] = z[300:305] = NAN
    heights = prepared(z)
    first, second = heights.stretches
    assert (first.size, second.size, heights.missing) == (300, 295, 9)
    np.testing.assert_allclose(first[99:105], np.linspace(z[99], z[104], 6))
    np.testing.assert_array_equal(second, z[305:])


def test_stretches_too_short_to_be_of_use_are_counted():
    z = rough(600)
    z[500:520] = NAN
    z[560:580] = NAN
    heights = prepared(z)
    assert [part.size for part in heights.stretches] == [500] and heights.unused == 60


def test_spikes_become_gaps_and_are_counted():
    z = rough(400)
    z[[50, 200, 300]] += [60.0, -80.0, 90.0]
    heights = prepared(z)
    assert heights.outliers == 3 and heights.missing == 0
    np.testing.assert_allclose(heights.stretches[0][50], (z[49] + z[51]) / 2)


def test_gaps_of_a_map_are_bridged_along_both_sides():
    """Exactly, where the map is a plane about them; a whole line that is missing as well."""
    z = rough(64, 80)
    plane = np.add.outer(0.3 * np.arange(64.0), -0.2 * np.arange(80.0))
    z[20:40] = plane[20:40]
    holed = z.copy()
    holed[25:28, 30:33] = NAN
    holed[35] = NAN
    heights = prepared(holed)
    assert heights.missing == 9 + 80
    np.testing.assert_allclose(heights.stretches[0][22:38], z[22:38], atol=1e-12)


@pytest.mark.parametrize(
    ("z", "said"),
    [
        (np.zeros(FEWEST), "z has no roughness: it is constant"),
        (np.arange(FEWEST) * 1e-9 + 3e-6, "z has no roughness: it is a ramp"),
        (np.add.outer(np.arange(50.0), np.arange(60.0)), "z has no roughness: it is a ramp"),
        (np.where(np.arange(400) % 100 < 50, rough(400), NAN), "z has too many gaps: 128 points"),
        (np.where(np.arange(60) < 40, NAN, rough(60, 60)), "z has too many gaps: 67% of the map"),
    ],
)
def test_what_leaves_nothing_is_refused(z, said):
    with pytest.raises(ValueError, match=said):
        prepared(checked(z))


def test_masked_heights_are_missing():
    z = np.ma.masked_greater(rough(200), 1e9)
    z[3] = np.ma.masked
    assert np.isnan(checked(z)).sum() == 1


def test_a_spacing_is_one_number():
    assert spacing("dx", "1e-6") == 1e-6
    for wrong in (0, -1e-6, NAN, np.inf):
        with pytest.raises(ValueError, match="dx must be above 0 and finite, in m, got"):
            spacing("dx", wrong)
    with pytest.raises(TypeError, match="dx must be a number in m, got"):
        spacing("dx", [1e-6, 2e-6])
