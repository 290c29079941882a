"""Limit cycles on meshes: the drawn places, marks and lanes against the orbit itself."""

from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba

import fractaljax as fj
from fractaljax import plot
from structures import belt_cycle, two_joints
from tools import assert_whole, mostly_slow, refusals

BLOCK: dict[str, Any] = {  # moves along x, with a held edge
    "points": [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.0]],
    "dofs": [[0, -1], [0, -1], [0, -1], [-1, -1]],
    "cells": [[0, 1, 2, 3]],
}
COLOURS = {1: "tab:blue", -1: "tab:cyan", 0: "tab:orange", 2: "tab:red"}


def displaced(cycle, share, samples=256):
    """The displacements at a share of the period from their mean."""
    x = np.asarray(cycle.orbit(samples)[1])[:, : len(cycle.amplitude)]
    return x[round(share * samples) % samples] - x.mean(axis=0)


@pytest.mark.parametrize("at", mostly_slow([0.0, 0.25, 0.5], 0.25))
def test_places_marks_and_lanes(at):
    structure, cycle = belt_cycle()
    figure: Any = plot.cycle_motion(cycle, structure, at=at, scale=0.5, **BLOCK)
    top, lanes = figure.axes[0], next(ax for ax in figure.axes if "period" in ax.get_xlabel())
    x = 0.5 * displaced(cycle, at)[0]
    (outline, drawn), (mark,) = top.collections, top.lines
    points = np.array(BLOCK["points"])
    np.testing.assert_allclose(outline.get_paths()[0].vertices[:4], points)
    shifted = points + np.array([[x, 0], [x, 0], [x, 0], [0, 0]])
    np.testing.assert_allclose(drawn.get_paths()[0].vertices[:4], shifted, rtol=1e-12, atol=1e-12)
    # The joint is at the mean place of the three nodes that it moves, in the colour of its state.
    assert_whole(figure)
    np.testing.assert_allclose(mark.get_xydata(), [shifted[:3].mean(axis=0)], rtol=1e-12)
    states = np.asarray(cycle.contact_states(256))[:, 0]
    colour = to_rgba(COLOURS[int(states[round(at * 256)])])
    np.testing.assert_allclose(to_rgba(mark.get_markerfacecolor()), colour)
    # The lane: as long in stick as the cycle says.
    lane = lanes.collections[0]
    ends = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in lane.get_paths()]
    sticks = [tuple(c) == to_rgba("tab:orange") for c in lane.get_facecolor()]
    share = sum(end - begin for (begin, end), s in zip(ends, sticks, strict=True) if s)
    assert ends[0][0] == 0 and ends[-1][1] == pytest.approx(1)
    assert share == pytest.approx(float(cycle.stick_fraction[0]), rel=1e-9)
    assert lanes.lines[0].get_xdata()[0] == at
    assert f"{float(cycle.frequency):.4g} Hz" in top.get_title()


def test_contact_states_are_those_of_the_switches():
    _, cycle = belt_cycle()
    times, states = np.asarray(cycle.orbit(999)[0]), np.asarray(cycle.contact_states(999))
    names = {"+": 1, "-": -1, "stick": 0}
    switches = cycle.switches()
    for time, state in zip(times, states[:, 0], strict=True):
        last = [s for s in switches if s.time <= time] or switches[-1:]
        assert names[last[-1].after] == state


@pytest.mark.slow
def test_motion_as_files(tmp_path):
    structure, cycle = belt_cycle()
    path = tmp_path / "squeal.html"
    moving: Any = plot.animate_cycle(cycle, structure, frames=3, path=path, **BLOCK)
    text = path.read_text()
    assert text.count("data:image/png") == 3 and "http" not in text.split("<script", 1)[0]
    drawn = moving._fig.axes[0].collections[1]
    moving._func(1 / 3)
    x = drawn.get_paths()[0].vertices[0, 0]
    assert x != 0
    plot.animate_cycle(cycle, structure, frames=2, path=tmp_path / "squeal.gif", **BLOCK)
    assert (tmp_path / "squeal.gif").read_bytes()[:3] == b"GIF"


test_refusals = refusals(
    [
        ({"at": 1.0}, "at must be at least 0 and below 1"),
        ({"scale": 0.0}, "scale must be above 0"),
        ({"dofs": [[1, -1]] * 4}, "dofs must be whole numbers from -1 to 0"),
        ({"structure": two_joints(4)}, "structure must be that of the cycle, with 1 degrees of"),
    ],
    lambda change: plot.cycle_motion(
        belt_cycle()[1], **{"structure": belt_cycle()[0], **BLOCK, **change}
    ),
)


@pytest.mark.slow
def test_a_reduced_structure_moves_the_whole_mesh():
    """Its cycle on the nodes of the large one; the marks are where its joints are there."""
    from dynamics.test_reduced_cycles import TIPS, N, rods

    reduced = fj.reduce(rods(), {}, (0, 6.0), tol=1e-9, progress=False)
    cycle = fj.limit_cycle(reduced)
    points = np.array([[i, y] for y in (0.0, 1.0) for i in range(N)])
    dofs = np.array([[i, N + i] for _ in range(2) for i in range(N)])
    cells = [[i, i + 1, N + i + 1, N + i] for i in range(N - 1)]
    mesh: dict[str, Any] = {"points": points, "dofs": dofs, "cells": cells}
    figure: Any = plot.cycle_motion(cycle, reduced, at=0.25, scale=0.2, **mesh)
    (_, drawn), marks = figure.axes[0].collections, figure.axes[0].lines
    x = 0.2 * np.asarray(reduced.full(displaced(cycle, 0.25)))
    shifted = points + x[dofs]
    corner = drawn.get_paths()[-1].vertices[1]
    np.testing.assert_allclose(corner, shifted[N - 1], rtol=1e-12)
    tip = (shifted[TIPS[0]] + shifted[N + TIPS[0]]) / 2
    np.testing.assert_allclose(marks[0].get_xydata(), [tip], rtol=1e-12)
