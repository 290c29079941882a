"""Units, grids and what is known of a measurement."""

import numpy as np
import pytest

from fractaljax.measured.measurement import (
    agreed,
    equal_steps,
    map_on_grid,
    measurement,
    metres,
    profile_on_grid,
)

NAN = np.nan


def test_metres():
    """Both letters mu; words in any case."""
    assert [metres(unit) for unit in ["um", "µm", "μm", "Micron", " nm ", "Å"]] == [
        1e-6,
        1e-6,
        1e-6,
        1e-6,
        1e-9,
        1e-10,
    ]
    for unknown in ["V", "Mm", "", "MM"]:
        with pytest.raises(ValueError, match=r"the unit must be one of m, cm, mm, um, .* got '"):
            metres(unknown)


def test_agreed():
    """Equal to rounding is agreement."""
    assert agreed("dx", None, 2.0) == 2 and agreed("dx", 2.0, None) == 2
    assert agreed("dx", 2.0, 2.0 + 1e-9) == 2 and agreed("dx", None, None) is None
    with pytest.raises(ValueError, match=r"dx is 2 m in the file, got 2\.1"):
        agreed("dx", 2.0, 2.1)


def test_equal_steps_of_rounded_positions():
    """The step is that of the whole length, however coarsely positions are printed."""
    x = 0.00737 * np.arange(100_001)
    dx, k = equal_steps(np.round(x, 3))
    assert dx == pytest.approx(0.00737, rel=1e-6)
    np.testing.assert_array_equal(k, np.arange(x.size))


@pytest.mark.parametrize("dx, n", [(0.15625, 9600), (0.11, 500), (0.0999, 300), (0.13, 64)])
def test_positions_rounded_to_the_size_of_a_step(dx, n):
    """As a stylus instrument writes them, 0.1 um at steps of 0.156 um."""
    step, k = equal_steps(np.round(dx * np.arange(n), 1) * 1e-6)
    assert step == pytest.approx(dx * 1e-6, rel=0.1 / n / dx)
    np.testing.assert_array_equal(k, np.arange(n))


def test_rounded_positions_are_not_confused_with_points_left_out():
    kept = np.delete(np.arange(400), [7, 100, 101, 350])
    step, k = equal_steps(0.1 * kept)
    assert step == pytest.approx(0.1)
    np.testing.assert_array_equal(k, kept)
    scattered = np.sort(np.random.default_rng(0).choice(2000, 400, replace=False)) * 0.1
    with pytest.raises(ValueError, match="positions are not equidistant"):
        equal_steps(scattered)


def test_equal_steps_with_points_left_out():
    """Runs of missing points, also where positions are rounded."""
    k = np.delete(np.arange(1000), [5, 6, 7, 400, 998])
    dx, found = equal_steps(np.round(0.0123 * k, 3))
    assert dx == pytest.approx(0.0123, rel=1e-4)
    np.testing.assert_array_equal(found, k)


@pytest.mark.parametrize(
    ("x", "message"),
    [
        ([0.0], "at least 2 positions, got 1"),
        ([0.0, 1.0, 1.0, 2.0], "positions must rise or fall throughout, got 1 and then 1 m"),
        ([0.0, 1.0, 0.5, 2.0], "positions must rise or fall throughout, got 1 and then 0.5 m"),
        (np.arange(9.0) ** 2, "positions are not equidistant, steps are 1 to 15 m: resample"),
        ([0.0, 1.0, 2.0, 2.8, 4.0], "positions are not equidistant"),
        ([0.0, 1.0, 2.0, 50.0], "positions are not equidistant"),
    ],
)
def test_unequal_steps(x, message):
    """Refused in a line with the steps."""
    with pytest.raises(ValueError, match=message):
        equal_steps(np.array(x))


def test_profile_either_way():
    """Positions that fall are turned round."""
    z, dx = profile_on_grid(np.array([3.0, 2.0, 0.0]), np.array([5.0, 6.0, 7.0]))
    np.testing.assert_array_equal(z, [7, NAN, 6, 5])
    assert dx == 1


def test_map_of_points_in_any_order():
    """x first or y first, one point missing, positions that jitter."""
    z = np.arange(20.0).reshape(5, 4)
    z[1, 2] = NAN
    x, y = np.meshgrid(0.2 * np.arange(5), 7.0 + 0.3 * np.arange(4), indexing="ij")
    random = np.random.default_rng(0)
    x, y = (axis + 1e-3 * random.uniform(size=axis.shape) for axis in (x, y))
    for x_first in (False, True):
        points = np.stack([(axis.T if x_first else axis).ravel() for axis in (x, y, z)])
        points = points[:, np.isfinite(points[2])]
        found, dx, dy = map_on_grid(*points)
        np.testing.assert_array_equal(found, z)
        assert (dx, dy) == pytest.approx((0.2, 0.3), rel=5e-3)


def test_points_on_no_grid():
    """A cloud, a line across, and one point twice."""
    cloud = np.random.default_rng(1).uniform(size=(3, 50))
    with pytest.raises(ValueError, match="equidistant"):
        map_on_grid(*cloud)
    line = np.arange(9.0)
    with pytest.raises(ValueError, match="no rectangular grid: 9 of them for 9 x 9"):
        map_on_grid(line, line, line)
    with pytest.raises(ValueError, match="two points have the same position"):
        map_on_grid(np.array([0.0, 0, 1, 1]), np.array([0.0, 0, 1, 0]), np.ones(4))


def test_measurement():
    """A map without dy has dx; one line of a map is a profile; all gaps are counted."""
    z = np.ones((3, 4))
    z[0, 0], z[0, 1] = NAN, np.inf
    read = measurement(z, 1e-6, None, "a.npy", resolution=2e-6)
    assert (read.dx, read.dy, read.missing, read.stylus_radius) == (1e-6, 1e-6, 2, None)
    assert repr(read) == (
        "Measurement(map of 3 x 4 heights, 2 of them missing, dx = 1e-06 m, dy = 1e-06 m,"
        " resolution = 2e-06 m, from a.npy)"
    )
    along_x = measurement(z[:, :1], 1e-6, 3e-6, "")
    along_y = measurement(z[:1], 1e-6, 3e-6, "")
    assert (along_x.z.shape, along_x.dx, along_x.dy) == ((3,), 1e-6, None)
    assert (along_y.z.shape, along_y.dx, along_y.dy) == ((4,), 3e-6, None)


@pytest.mark.parametrize(
    ("z", "dx", "dy", "message"),
    [
        (np.ones(9), None, None, r"the step between heights is not known: give dx in metres"),
        (np.ones(9), 0.0, None, "dx must be above 0 and finite, in m, got 0"),
        (np.ones(9), -1e-6, None, "dx must be above 0 and finite, in m, got -1e-06"),
        (np.ones(9), NAN, None, "dx must be above 0 and finite, in m, got nan"),
        (np.ones((9, 9)), 1.0, 0.0, "dy must be above 0 and finite, in m, got 0"),
        (np.ones(9), 1.0, 2.0, "dy is for maps, got 2 for a profile"),
        (np.ones((2, 2, 2)), 1.0, None, r"of shape \(n,\) or \(n, m\), got \(2, 2, 2\)"),
        (np.full(9, NAN), 1.0, None, "there is no height in it"),
    ],
)
def test_refused(z, dx, dy, message):
    """One line with the argument and what it was."""
    with pytest.raises(ValueError, match=message):
        measurement(z, dx, dy, "")
