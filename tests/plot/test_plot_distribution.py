"""The picture of how samples are distributed."""

import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.figure import Figure
from test_plot import assert_whole, drawn, labels

import fractaljax as fj


def test_share_below_every_value():
    """A step of 1/n at each of the sorted samples, a style for each set, and the limit."""
    given = {"wide": np.array([3.0, -1.0, 0.5, 2.0]), "narrow": [0.1, 0.2]}
    ax = fj.plot.distribution(given, label="growth rate [1/s]", limit=0.0)
    assert labels(ax) == ["wide", "narrow", "limit 0"]
    for name, values in given.items():
        ((x, y),) = drawn(ax, name)
        share = [(np.asarray(values) <= at).mean() for at in x[1:]]
        np.testing.assert_allclose(y[1:], share)
        np.testing.assert_array_equal(np.sort(values), x[1:])
    (limit,) = drawn(ax, "limit 0")
    assert (limit[0] == 0).all()
    styles = {line.get_linestyle() for line in ax.lines[:2]}
    assert len(styles) == 2
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("growth rate [1/s]", "share below [-]")
    assert_whole(ax.figure, [ax, ax.get_legend()])
    assert matplotlib.pyplot.get_fignums() == []


def test_axes_and_refusals():
    ax = Figure().add_subplot()
    assert fj.plot.distribution({"one": [1.0, 2.0]}, ax, label="x") is ax
    assert labels(ax) == ["one"]
    with pytest.raises(ValueError, match="at least one set of samples"):
        fj.plot.distribution({}, label="x")
    for bad in ([], [[1.0, 2.0]], [np.nan, 1.0]):
        with pytest.raises(ValueError, match=r"samples 'bad' must be finite numbers \(n,\)"):
            fj.plot.distribution({"bad": bad}, label="x")
