"""Curves of stiffness: what is on them, where the marks are, what they refuse."""

import matplotlib.pyplot
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.plot.axes import new_figure
from tools import assert_whole, labels

D = np.linspace(2.35, 2.7, 60)


@pytest.fixture(scope="module")
def curves():
    """From fully plastic through elastic-plastic to gross slip, and one that does not slip."""
    return fj.stiffness_over(fj.brake_scene(), ("D", D), ("G", [1e-10, 1e-8]))


def marks(ax, marker):
    """Places of the marks of a kind, in the order of the curves."""
    return [tuple(np.ravel(line.get_xydata())) for line in ax.lines if line.get_marker() == marker]


def test_normal_stiffness(curves):
    """Values, units, a curve for each G, and marks at the last elastic and the first slip."""
    ax = fj.plot.stiffness_curves(curves)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("D [-]", "normal stiffness K_n [N/m]")
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")
    assert labels(ax) == [
        "G = 1e-10 m",
        "G = 1e-08 m",
        "fully plastic beyond",
        "gross slip begins or ends",
    ]
    drawn = np.stack([line.get_ydata() for line in ax.lines if len(line.get_xdata()) == D.size])
    K_n = np.asarray(curves.K_n)
    np.testing.assert_array_equal(drawn, np.where(K_n > 0, K_n, np.nan))
    for (x, y), row in zip(marks(ax, "o"), K_n, strict=True):
        first = np.flatnonzero(row > 0)[0]
        assert (x, y) == (D[first], row[first])
    slips = np.asarray(curves.regime == fj.Regime.gross_slip)
    ((x, y),) = marks(ax, "X")
    last = np.flatnonzero(slips[0])[0] - 1
    assert not slips[1].any() and (x, y) == (D[last], K_n[0, last])
    assert_whole(ax.figure)


def test_slope_of_the_tangential_stiffness(curves):
    """Relative, with a line at 0, and limits that its infinite ends do not set."""
    ax = fj.plot.stiffness_curves(curves, stiffness="K_t", slope=True)
    assert ax.get_ylabel() == "d ln K_t/d D [-]" and ax.get_yscale() == "linear"
    slope = np.asarray(curves.K_t_slope)
    low, high = ax.get_ylim()
    assert low < 0 < high < np.nanmax(slope) and np.nanmin(slope) < low
    inside = (slope > low) & (slope < high)
    assert inside.sum() > 0.85 * np.isfinite(slope).sum()
    assert_whole(ax.figure)


def test_logarithmic_axis_and_dimensionless_names():
    """Over a decade or more of G* the axis is logarithmic, and the slope an exponent."""
    G = np.geomspace(1e-12, 1e-10, 30)
    curves = fj.stiffness_over(fj.brake_scene(), ("G", G), ("D", [2.4])).dimensionless(1e-4)
    ax = fj.plot.stiffness_curves(curves)
    assert (ax.get_xlabel(), ax.get_xscale()) == ("G* [-]", "log")
    assert ax.get_ylabel() == "normal stiffness K_n* [-]" and labels(ax)[0] == "D = 2.4"
    ax = fj.plot.stiffness_curves(curves, slope=True)
    assert ax.get_ylabel() == "d ln K_n/d ln G* [-]"
    np.testing.assert_allclose(ax.lines[0].get_ydata(), curves.K_n_slope[0] * curves.x)


def test_both_side_by_side(curves):
    figure = fj.plot.stiffness(curves)
    wanted = ["normal stiffness K_n [N/m]", "tangential stiffness K_t [N/m]"]
    assert [ax.get_ylabel() for ax in figure.axes] == wanted
    assert_whole(figure)
    assert matplotlib.pyplot.get_fignums() == []


def test_given_axes_and_refusal(curves):
    ax = new_figure().add_subplot()
    assert fj.plot.stiffness_curves(curves, ax) is ax
    with pytest.raises(ValueError, match="stiffness must be 'K_n' or 'K_t', got 'K'"):
        fj.plot.stiffness_curves(curves, stiffness="K")


def test_nothing_but_plastic_or_slipping():
    """Said in words, without a warning."""
    curves = fj.stiffness_over(fj.brake_scene(), ("D", D - 0.3), ("G", [1e-8, 1e-7]))
    for slope in (False, True):
        figure = fj.plot.stiffness(curves, slope=slope)
        figure.draw_without_rendering()
        words = [ax.texts[0].get_text() for ax in figure.axes]
        assert words == ["K_n = 0 everywhere", "K_t = 0 everywhere"]
