"""The picture of a motion over time."""

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from test_plot import assert_whole, drawn, labels

import fractaljax as fj
from tools import motionless_scene, reference_scene

START = [1e-5, 0.0, 0.0, 0.0]
TIME = 1.5e-3  # s, some five turns


@pytest.fixture(scope="module")
def motion():
    return fj.simulate(reference_scene(), START, TIME)


@pytest.mark.parametrize("direction", [1, 2])
def test_motion_is_drawn_as_it_is(motion, direction):
    """Displacements in um over ms, from the start to the end, every step among them."""
    ax = fj.plot.trajectory(motion, direction=direction)
    ((t, x),) = drawn(ax, "motion")
    assert t[0] == 0 and t[-1] == pytest.approx(1e3 * TIME) and (np.diff(t) >= 0).all()
    assert x[0] == pytest.approx(1e6 * START[direction - 1])
    assert x[-1] == pytest.approx(1e6 * float(motion.end[direction - 1]))
    at_steps = np.interp(1e3 * motion.times, t, x)
    np.testing.assert_allclose(at_steps, 1e6 * motion.states[:, direction - 1], atol=1e-6)
    where = ["along the belt", "normal to the belt"][direction - 1]
    assert ax.get_xlabel() == "time [ms]" and ax.get_ylabel() == f"x{direction}, {where} [µm]"
    assert_whole(ax.figure, [ax, ax.get_legend()])


def test_sticking_is_marked_where_it_is(motion):
    """For the time that the modes say, moving as the belt does."""
    ax = fj.plot.trajectory(motion)
    assert labels(ax) == ["motion", "sticks"]
    ((t, x),) = drawn(ax, "sticks")
    inside = np.isfinite(x[1:]) & np.isfinite(x[:-1])
    sticks = np.diff(motion.times)[np.asarray(motion.modes)[:-1, 0] == 0].sum()
    # Of the last sample before its end nothing is drawn: that is one of some 180.
    assert sticks > 0 and np.diff(t)[inside].sum() == pytest.approx(1e3 * sticks, rel=0.03)
    moved = np.diff(x)[inside].sum() / np.diff(t)[inside].sum()
    assert moved == pytest.approx(1e3 * 0.15, rel=1e-6)  # um/ms


def test_motion_without_sticking_has_no_mark():
    motion = fj.simulate(motionless_scene(), [1e-8, 0, 0, 0], TIME)
    assert labels(fj.plot.trajectory(motion)) == ["motion"]


def test_axes_and_refusals(motion):
    ax = Figure().add_subplot()
    assert fj.plot.trajectory(motion, ax) is ax
    with pytest.raises(ValueError, match="direction must be 1 or 2, got 3"):
        fj.plot.trajectory(motion, direction=3)
    with pytest.raises(ValueError, match="index the batch first"):
        fj.plot.trajectory(jax.tree.map(lambda x: x[None], motion))
