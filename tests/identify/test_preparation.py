"""What is done to heights before their spectrum: checks, spikes, gaps."""

import numpy as np
import pytest

from fractaljax._identify.preparation import check_heights, prepare_heights, spacing
from tools import refusals

NAN = np.nan


def rough(*shape):
    return np.cumsum(np.random.default_rng(0).standard_normal(shape), axis=0)


def holed(n, *gaps):
    z = rough(n)
    for first, last in gaps:
        z[first:last] = NAN
    return z


@pytest.mark.parametrize(
    ("z", "sizes", "missing", "unused"),
    [
        (holed(300), [300], 0, 0),
        (holed(600, (100, 104), (300, 305)), [300, 295], 9, 0),
        (holed(600, (500, 520), (560, 580)), [500], 40, 60),
    ],
)
def test_long_gaps_divide(z, sizes, missing, unused):
    """Short gaps are interpolated, segments too short to be of use are counted."""
    heights = prepare_heights(z)
    assert [segment.size for segment in heights.segments] == sizes
    assert (heights.missing, heights.outliers, heights.unused) == (missing, 0, unused)
    first = heights.segments[0]
    line = np.interp(np.arange(first.size), *(x[~np.isnan(z)] for x in (np.arange(z.size), z)))
    np.testing.assert_allclose(first, line, rtol=1e-14)
    np.testing.assert_array_equal(heights.segments[-1], z[-295:] if len(sizes) > 1 else first)


def test_spikes_become_gaps_and_a_spacing_is_one_number():
    z = rough(400)
    z[[50, 200, 300]] += [60.0, -80.0, 90.0]
    heights = prepare_heights(z)
    assert heights.outliers == 3 and heights.missing == 0
    np.testing.assert_allclose(heights.segments[0][50], (z[49] + z[51]) / 2)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(heights.despiked)), [50, 200, 300])
    assert spacing("dx", 5) == 5
    for wrong in (0, -1e-6, NAN, np.inf):
        with pytest.raises(ValueError, match="dx must be above 0 and finite, in m, got"):
            spacing("dx", wrong)
    with pytest.raises(TypeError, match="dx must be a number in m, got"):
        spacing("dx", [1e-6, 2e-6])  # pyright: ignore


def test_kinks_are_no_spikes():
    """The cusps between arcs of a tip stay; spikes of one point and of two do not."""
    x = np.arange(2000.0)
    arcs = -((x % 96.7 - 48.35) ** 2) / 4000 + 1e-4 * np.random.default_rng(0).normal(size=x.size)
    assert prepare_heights(arcs).outliers == 0
    spikes = [300, 707, 1400, 1401]
    arcs[spikes] += [0.1, -0.2, 0.3, 0.3]
    found = prepare_heights(arcs)
    assert set(spikes) <= set(np.flatnonzero(np.isnan(found.despiked))) and found.outliers < 6
    both = np.add.outer(arcs[1500:1600], 0.5 * arcs[1550:1650])
    both[40, 50] += 0.5
    assert prepare_heights(both).outliers == 1


def test_gaps_of_a_map_and_masked_heights():
    """Exactly, where the map is a plane; a whole missing line as well."""
    z = rough(64, 80)
    plane = np.add.outer(0.3 * np.arange(64.0), -0.2 * np.arange(80.0))
    z[20:40] = plane[20:40]
    holes = z.copy()
    holes[25:28, 30:33] = holes[35] = NAN
    heights = prepare_heights(holes)
    assert heights.missing == 9 + 80
    np.testing.assert_allclose(heights.segments[0][22:38], z[22:38], atol=1e-12)
    z = np.ma.masked_greater(rough(200), 1e9)
    z[3] = np.ma.masked
    assert np.isnan(check_heights(z)).sum() == 1


Z = np.sin(np.arange(500.0) ** 1.5) * 1e-8
REFUSED = [
    (Z[:100], "a profile needs 128 points, got shape"),
    (np.ones((64, 20)), "each side of a map needs 48 points"),
    (np.full(500, 3e-6), "z has no roughness: it is constant"),
    (np.arange(500) * 1e-9 + 3e-6, "z has no roughness: it is a ramp"),
    (np.add.outer(np.arange(50.0), np.arange(60.0)), "z has no roughness: it is a ramp"),
    (np.full(500, NAN), "all are NaN"),
    (Z + 0j, "an array of complex128"),
    ("heights", "an array of <U"),
    (np.where(np.arange(500) == 3, np.inf, Z), "got 1 infinite"),
    (Z.reshape(5, 10, 10), r"got shape \(5, 10, 10\)"),
    (Z * 1e-60, "heights in m, got up to 1e-68"),
    (np.where(np.arange(500) % 50 < 10, NAN, Z), "too many gaps: 128 points in a row"),
    (np.where(np.arange(60) < 40, NAN, rough(60, 60)), "too many gaps: 67% of the map"),
]


test_refused = refusals(REFUSED, lambda z: prepare_heights(check_heights(z)))
