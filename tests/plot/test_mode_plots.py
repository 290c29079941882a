"""Pictures of modes: tracks, charts, and complex shapes at one phase and in motion."""

import base64
import functools
import io
import re
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import matplotlib.animation
import matplotlib.image
import numpy as np
import pytest

import fractaljax as fj
from structures import hoffmann, two_joints
from tools import assert_whole, labels, refusals

plot: Any = fj.plot
WAVE = 2 * np.pi / 0.5  # 1/m, along a strip of one metre
NODES = np.stack(np.meshgrid(np.linspace(0, 1, 21), [0.0, 0.1], indexing="ij"), -1).reshape(-1, 2)
CELLS = 2 * np.arange(20)[:, None] + [0, 2, 3, 1]
DOFS = np.stack([np.full(42, -1), np.arange(42)], axis=1)  # held along x
SHAPE: Any = np.exp(-1j * WAVE * NODES[:, 0])
STRIP: dict[str, Any] = {"points": NODES, "dofs": DOFS, "cells": CELLS, "scale": 0.02}
BLOCK = np.array(np.meshgrid([0.0, 1], [0.0, 2], [0.0, 3], indexing="ij")).reshape(3, -1).T
FACES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
)
SOLID: dict[str, Any] = {"points": BLOCK, "dofs": np.arange(24).reshape(8, 3), "cells": FACES}


@functools.cache
def modes():
    return fj.stability(two_joints(4))


@functools.cache
def tracks():
    return fj.track_modes(hoffmann(), "mu", np.linspace(0.3, 1.2, 8))


@functools.cache
def chart(**axes):
    """A sweep of what a chart needs."""

    def measure(x):
        modes_at = fj.stability(x)
        names = "growth_rate", "eigenvalues", "resolutions", "counted"
        return SimpleNamespace(**{name: getattr(modes_at, name) for name in names})

    values = {name: np.linspace(*ends) for name, ends in axes.items()}
    return fj.sweep(measure, two_joints(4), progress=False, **values)


def batch():
    return jax.tree.map(lambda x: np.asarray(x)[None], modes())


def one_point():
    return fj.Sweep(batch(), (np.array([0.5]),), ("mu_s",), two_joints(4))


def rates():
    return fj.sweep(fj.growth_rate, fj.brake_scene(), progress=False, P=np.array([1e3, 2e3]))


jax.tree_util.register_pytree_node(
    SimpleNamespace,
    lambda x: (tuple(vars(x).values()), tuple(vars(x))),
    lambda names, values: SimpleNamespace(**dict(zip(names, values, strict=True))),
)


class Recorder(matplotlib.animation.AbstractMovieWriter):
    """A writer of animations that keeps what `look` says of the figure at each frame."""

    def __init__(self, look):
        super().__init__()
        self.look, self.frames = look, []

    def setup(self, fig, outfile, dpi=None):
        self.fig = fig

    def grab_frame(self, **_):
        self.frames.append(self.look(self.fig))

    def finish(self):
        pass


def recorded(moving, look):
    writer = Recorder(look)
    moving.save("nowhere", writer)
    return writer.frames


def corners(ax):
    """The deformed cells (cells, corners, 2)."""
    return np.stack([path.vertices[:4] for path in ax.collections[-1].get_paths()])


def test_tracks():
    """All modes of few, thick where they grow; their labels have units."""
    figure = plot.mode_tracks(tracks())
    assert_whole(figure)
    rate, frequency = figure.axes
    assert (rate.get_ylabel(), frequency.get_ylabel()) == ("growth rate [1/s]", "frequency [Hz]")
    assert frequency.get_xlabel() == "parameter mu [-]" and frequency.get_xlim() == (0.3, 1.2)
    for ax, values in ((rate, tracks().growth_rates), (frequency, tracks().frequencies)):
        thin = [line.get_ydata() for line in ax.lines if line.get_linewidth() == 1.6]
        np.testing.assert_array_equal(np.transpose(thin), values)
        thick = np.transpose([line.get_ydata() for line in ax.lines if line.get_linewidth() == 4])
        grows = (tracks().values[:, None] > 0.75) & (tracks().growth_rates > 0)
        np.testing.assert_array_equal(thick, np.where(grows, values, np.nan))
    s = np.tile(tracks().eigenvalues, (1, 5)) * 1e4
    many = eqx.tree_at(lambda t: (t.eigenvalues,), tracks(), (s,))
    rate, frequency = plot.mode_tracks(many).axes
    assert labels(rate) == [f"mode {i}" for i in (2, 4, 6, 8, 10)]
    assert frequency.get_ylabel() == "frequency [kHz]" and rate.get_ylim()[0] > -1000


@pytest.mark.slow
def test_charts_over_one_and_two_quantities():
    """A colour for each number of unstable modes, and the stability boundary."""
    result = chart(mu_s=(0.31, 1.2, 5), v_m=(0.3, 3.0, 4))
    ax = plot.stability_chart(result)
    assert_whole(ax.figure)
    expected = np.zeros((5, 4), int)
    for place in np.ndindex(5, 4):
        varied = {name: v[i] for (name, v), i in zip(result.axes.items(), place, strict=True)}
        expected[place] = len(fj.stability(two_joints(4).replace(**varied)).unstable())
    shown = ax.collections[0].get_array().reshape(4, 5)
    np.testing.assert_array_equal(shown, expected.T)
    assert len(np.unique(expected)) > 2
    assert ax.get_xlabel() == "static friction coefficient mu_s [-]"
    result = chart(mu_s=(0.31, 1.2, 9))
    ax = plot.stability_chart(result)
    assert_whole(ax.figure)
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), result.values.growth_rate)
    assert list(ax.lines[0].get_ydata()) == [0, 0] and ax.get_ylabel() == "growth rate [1/s]"
    count = ax.collections[0].get_array().reshape(2, 9)
    s, error = result.values.eigenvalues, result.values.resolutions
    np.testing.assert_array_equal(count, [((s.imag >= 0) & (s.real > error)).sum(axis=1)] * 2)


def test_deformed_mesh():
    """Re(shape exp(i phase)) at the corners; amplitudes are those of ellipses."""
    ax = plot.complex_mode(SHAPE, phase=0.7, **STRIP)
    assert_whole(ax.figure)
    deformed = NODES + 0.02 * np.stack([0 * SHAPE.real, (SHAPE * np.exp(0.7j)).real], axis=1)
    np.testing.assert_allclose(corners(ax), deformed[CELLS], atol=1e-12)
    np.testing.assert_allclose(ax.collections[-1].get_array(), 1)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    both = np.arange(84).reshape(42, 2)
    ellipse = np.tile([1.0, 0.6j], 42) * np.linspace(1, 2, 84)  # axes along x and y
    ellipse[:2] = [3.0, 3.0]  # a line, of length 3 sqrt(2) to each side
    shown = plot.complex_mode(ellipse, points=NODES, dofs=both, cells=CELLS[:, :3])
    whole = np.array([max(abs(ellipse[2 * i : 2 * i + 2])) for i in range(42)])
    whole[0] = 3 * np.sqrt(2)
    expected = (whole / whole.max())[CELLS[:, :3]].mean(axis=1)
    np.testing.assert_allclose(shown.collections[-1].get_array(), expected, rtol=1e-12)


@pytest.mark.slow
def test_solid_and_bars():
    """A solid is drawn in space; without a mesh there is a bar for each degree of freedom."""
    ax = plot.complex_mode(np.arange(24) * 1j, phase=np.pi / 2, **SOLID)
    assert_whole(ax.figure)
    assert (ax.name, ax.get_zlabel()) == ("3d", "z [m]")
    ax = plot.new_figure().add_subplot()
    assert plot.complex_mode(modes(), 0, ax, phase=0.4) is ax
    assert_whole(ax.figure)
    s, shape = complex(modes().eigenvalues[0]), np.asarray(modes().shapes[0])
    words = f"{abs(s.imag) / 2e3 / np.pi:.4g} kHz, growth rate {s.real:.3g} 1/s, phase 23°"
    assert ax.get_title(loc="left") == words
    heights = [bar.get_height() for bar in ax.patches]
    np.testing.assert_allclose(heights[:4], 2 * np.abs(shape), rtol=1e-12)
    np.testing.assert_allclose(heights[4:], (shape * np.exp(0.4j)).real, rtol=1e-12)
    named = fj.stability(fj.Structure.from_scene(fj.brake_scene()))
    ticks = plot.complex_mode(named).get_xticklabels()
    assert [tick.get_text() for tick in ticks] == ["x1", "x2"]


@pytest.mark.slow
def test_travelling_wave_travels():
    """exp(i (omega t - k x)): in a quarter of a period crests move by a quarter of a wave."""
    moving = plot.animate_mode(SHAPE, frames=8, **STRIP)
    frames = np.array(recorded(moving, lambda figure: corners(figure.axes[0])[:, 0, 1]))
    x = NODES[CELLS[:, 0], 0]
    phases = 2 * np.pi * np.arange(8)[:, None] / 8
    np.testing.assert_allclose(frames, 0.02 * np.cos(phases - WAVE * x), atol=1e-12)
    crest = x[frames[:4, :10].argmax(axis=1)]
    assert crest[0] == 0 and crest[2] == pytest.approx(0.125, abs=0.026)
    bars = plot.animate_mode(modes(), 2, frames=5)
    heights = recorded(bars, lambda figure: [b.get_height() for b in figure.axes[0].patches[4:]])
    turns: Any = np.exp(2j * np.pi * np.arange(5) / 5)
    np.testing.assert_allclose(heights, np.real(np.outer(turns, modes().shapes[2])), rtol=1e-9)


def test_files(tmp_path):
    """A GIF with all frames; a page with all frames inside that names no other address."""
    from PIL import Image

    plot.animate_mode(SHAPE, frames=4, fps=10, path=tmp_path / "wave.gif", **STRIP)
    with Image.open(tmp_path / "wave.gif") as opened:
        gif: Any = opened
        assert gif.n_frames == 4 and gif.info["duration"] == 100
        shown = []
        for i in range(4):
            gif.seek(i)
            shown.append(np.asarray(gif.convert("L"), float))
    differences = [np.abs(shown[0] - other).mean() for other in shown]
    assert differences[0] == 0 and min(differences[1:]) > 0.1
    plot.animate_mode(SHAPE, frames=3, path=tmp_path / "wave.html", **STRIP)
    page = (tmp_path / "wave.html").read_text(encoding="utf-8")
    images = re.findall(r'data:image/png;base64,([^"]*)"', page)
    assert len(images) == 3
    frame = matplotlib.image.imread(io.BytesIO(base64.b64decode(images[1].replace("\\\n", ""))))
    assert frame.shape[1] == 840
    rest = re.sub(r'base64,[^"]*"', '"', page)
    assert not re.search(r"https?:|//[a-z]|<link|fa-|src=", rest) and "⏸" in rest


def test_shape_of_a_reduced_structure():
    """`full` leads to the degrees of freedom of the mesh."""
    n = 42
    K = 1e6 * (2.1 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    reduced = fj.reduce(fj.Structure(np.eye(n), 1e-6 * K, K, ()), band=(0.0, 600.0))
    shape: Any = reduced.full(fj.stability(reduced).shapes[0])
    ax = plot.complex_mode(shape, **STRIP)
    expected = NODES[:, 1] + 0.02 * np.real(shape)
    np.testing.assert_allclose(corners(ax)[:, 0, 1], expected[CELLS[:, 0]])


test_refusals = refusals(
    [
        (lambda: plot.complex_mode(np.eye(2)), r"one number a degree of freedom, got \(2, 2\)"),
        (lambda: plot.complex_mode(["a"]), "one number a degree of freedom"),
        (lambda: plot.complex_mode(modes(), 8), "index must be a whole number of at most 7"),
        (lambda: plot.complex_mode(modes(), -1), "index must be a whole number of at least 0"),
        (lambda: plot.complex_mode(batch()), "a picture shows one result, got a batch"),
        (lambda: plot.complex_mode(SHAPE, points=NODES), "points need dofs and cells"),
        (lambda: plot.complex_mode(SHAPE, **STRIP | {"points": [1.0]}), r"points must be \(nodes"),
        (lambda: plot.complex_mode(SHAPE, **STRIP | {"dofs": DOFS[1:]}), "dofs must have shape"),
        (lambda: plot.complex_mode(SHAPE[1:], **STRIP), "dofs must be whole numbers from -1 to 40"),
        (lambda: plot.complex_mode(SHAPE, **STRIP | {"cells": CELLS[0]}), "cells must be"),
        (
            lambda: plot.complex_mode(SHAPE, **STRIP | {"cells": CELLS + 1}),
            "cells must be whole numbers from 0 to 41",
        ),
        (lambda: plot.animate_mode(SHAPE, path="a.mp4"), "path must end in .gif or .html"),
        (lambda: plot.animate_mode(SHAPE, frames=1), "frames must be a whole number of at least 2"),
        (lambda: plot.stability_chart(rates()), "a chart needs a sweep of stability"),
        (lambda: plot.stability_chart(one_point()), "a chart needs two values or more"),
    ]
)
