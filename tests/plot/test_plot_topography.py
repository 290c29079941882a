"""Pictures of surfaces: heights, units and the one colour scale of two."""

import dataclasses

import matplotlib.pyplot
import numpy as np
import pytest

import fractaljax as fj
from tools import assert_whole

Z = 1e-6 * np.add.outer(np.arange(6.0), 10 * np.arange(4.0))
LABELS = ("x [µm]", "y [µm]", "height about the mean [µm]")


@pytest.fixture(scope="module")
def best():
    return fj.design(fj.brake_scene(), progress=False)


def test_topography_shows_heights_about_their_mean():
    """x along the first axis, in micrometres; a colour bar with its unit; nothing cut off."""
    ax = fj.plot.topography(Z, 2e-6, dy=3e-6)
    (image,) = ax.images
    np.testing.assert_allclose(image.get_array(), (Z - Z.mean()).T * 1e6)
    assert image.get_extent() == pytest.approx([0, 12, 0, 12]) and image.origin == "lower"
    bar = ax.figure.axes[1]
    assert (ax.get_xlabel(), ax.get_ylabel(), bar.get_ylabel()) == LABELS
    assert_whole(ax.figure)
    assert not matplotlib.pyplot.get_fignums()


def test_given_axes_and_square_points():
    """It draws where it is told, and dy is dx."""
    ax = fj.plot.new_figure().add_subplot()
    assert fj.plot.topography(Z, 1e-6, ax) is ax
    assert ax.images[0].get_extent() == pytest.approx([0, 6, 0, 4])


def test_missing_heights_are_left_out():
    """The mean and the scale are those of the rest."""
    z = Z.copy()
    z[5, 3] = np.nan
    image = fj.plot.topography(z, 1e-6).images[0]
    assert image.get_array().mask.sum() == 1
    assert image.get_array().mean() == pytest.approx(0, abs=1e-9)
    assert image.get_clim() == pytest.approx(((0 - np.nanmean(z)) * 1e6, 34 - np.nanmean(z) * 1e6))


def test_topographies_have_one_colour_scale(best):
    """Both surfaces of a design side by side, each about its mean; nothing cut off."""
    figure = fj.plot.topographies(best, n=32)
    left, right, bar = figure.axes
    surfaces = best.topographies(32)
    for ax, z in ((left, surfaces.before), (right, surfaces.after)):
        np.testing.assert_allclose(ax.images[0].get_array(), (z - z.mean()).T * 1e6)
        assert ax.images[0].get_extent() == pytest.approx([0, 1000, 0, 1000])
        assert ax.get_xlabel() == LABELS[0]
    low, high = left.images[0].get_clim()
    assert right.images[0].get_clim() == (low, high)
    heights = [image.get_array() for ax in (left, right) for image in ax.images]
    assert low == min(z.min() for z in heights) and high == max(z.max() for z in heights)
    assert (left.get_ylabel(), bar.get_ylabel()) == LABELS[1:]
    assert left.get_title() == "given surface: D = 2.4, G = 1.342e-10 m"
    assert right.get_title().startswith("designed surface: D = ")
    assert_whole(figure)


def test_infeasible_design_says_so(best):
    """What is no solution is not called designed."""
    missed = dataclasses.replace(best, violated=("K_n >= K_n_min",))
    assert fj.plot.topographies(missed, n=8).axes[1].get_title().startswith("best found: D = ")


@pytest.mark.parametrize(
    ("z", "dx", "message"),
    [
        (np.zeros(5), 1e-6, r"z must be a map \(n, m\) of heights, got shape \(5,\)"),
        (np.full((3, 3), np.nan), 1e-6, "z must be a map"),
        (np.zeros((0, 3)), 1e-6, "z must be a map"),
        (np.zeros((3, 3)), 0.0, "dx and dy must be above 0, got 0.0 and 0.0"),
        (np.zeros((3, 3)), np.nan, "dx and dy must be above 0"),
    ],
)
def test_refusals(z, dx, message):
    """One clear line."""
    with pytest.raises(ValueError, match=message):
        fj.plot.topography(z, dx)
