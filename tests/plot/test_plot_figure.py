"""The figure shows itself in a notebook, and belongs to nobody else."""

import io
import pickle

import matplotlib.image
import matplotlib.pyplot
import numpy as np
from IPython.core.formatters import DisplayFormatter

from fractaljax.plot.axes import new_axes, new_figure


def picture(figure):
    """What Jupyter is given, as an array (height, width, 4)."""
    return matplotlib.image.imread(io.BytesIO(figure._repr_png_()))


def test_a_notebook_is_given_the_picture():
    """Of the size asked for, with what was drawn, again after more is drawn, and no pyplot."""
    ax = new_axes()
    ax.set_axis_off()
    blank = picture(ax.figure)
    assert blank.shape[:2] == (640, 840) and np.all(blank == 1)
    ax.plot([0, 1], [0, 1], "k")
    assert picture(ax.figure).min() == 0
    assert matplotlib.pyplot.get_fignums() == []


def test_jupyter_finds_it():
    """By the formatters of a notebook, without a magic line."""
    data, _ = DisplayFormatter().format(new_figure(2, 1))
    assert data["image/png"].startswith(b"\x89PNG")


def test_figure_survives_pickling():
    figure = new_figure(3, 2)
    figure.add_subplot().plot([0, 1])
    again = pickle.loads(pickle.dumps(figure))
    assert picture(again).shape == picture(figure).shape == (200, 300, 4)
