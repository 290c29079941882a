"""Curves of events in two quantities: against the phase plane, other branches, derivatives."""

import csv
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import fractaljax as fj
from belt import least_speed
from mechanisms import PROBLEMS
from structures import of_problem
from tools import DOCS, assert_same_picture, labels, load_script, run_command

BELT = of_problem(PROBLEMS["papangelo_2017"])  # x'' + 0.1 x' + x = mu(w), mu_s 1, mu_d 0.5, v_0 0.5
WINDOW = (0.5, 2.5)


@functools.cache
def belt():
    return fj.continue_cycle(BELT, "V", WINDOW, "hopf")


@functools.cache
def grazing():
    return fj.continue_event(BELT, belt().grazings[0], "mu_s", (0.6, 2.0))


def test_grazing_of_the_belt():
    """On the phase plane's, from edge to edge, with the stable cycles at lower speeds."""
    assert bool(belt().start == fj.BranchEnd.hopf) and bool(belt().end == fj.BranchEnd.window)
    curve = grazing()
    assert curve.kind == "grazing" and curve.names == ("V", "mu_s") and "85 points" in repr(curve)
    assert bool(curve.start == fj.BranchEnd.window) and bool(curve.end == fj.BranchEnd.window)
    np.testing.assert_allclose(curve.x[[0, -1]], WINDOW, rtol=1e-12)
    for i in range(4, len(curve.x), 19):
        truth: Any = brentq(
            lambda v, i=i: least_speed(v, curve.y[i]), *(curve.x[i] + [-0.01, 0.01])
        )
        np.testing.assert_allclose(curve.x[i], truth, rtol=1e-9)
    # Walking towards larger mu_s and V, lower speeds are on the left.
    assert curve.side == 1 and curve.swapped().side == -1 and belt().grazings[0].side == -1


NAMES = ("mu_s", "mu_d", "v_0", "C", "K", "P")
AT = np.array([1.0, 0.5, 0.5, 0.1, 1.0, 1.0])


def test_events_move_with_every_number_of_the_belt():
    """The Hopf point as its closed form, the grazing as the phase plane's."""

    events = belt().hopf[0], belt().grazings[0]

    @jax.jit
    @jax.jacfwd
    def slopes_at(p):
        C, K = (jnp.reshape(x, (1, 1)) for x in p[3:5])
        x = BELT.replace(**dict(zip(NAMES, (*p[:3], C, K, p[5]), strict=True)))
        return jnp.stack([event.value_at(x) for event in events])

    slopes, (hopf, graze) = np.asarray(slopes_at(AT)), (float(event.value) for event in events)
    mu_s, mu_d, v_0, c, _, P = AT
    drop, log = mu_s - mu_d, np.log(P * (mu_s - mu_d) / (v_0 * c))
    np.testing.assert_allclose(hopf, v_0 * log, rtol=1e-9)
    by_hopf = [v_0 / drop, -v_0 / drop, log - 1, -v_0 / c, 0, v_0 / P]
    np.testing.assert_allclose(slopes[0], by_hopf, rtol=1e-8, atol=1e-9)

    # Where the least speed is 0, by the implicit function.
    at, h = np.array([graze, *AT]), 1e-5
    ends = [[least_speed(*(at + k * h * unit)) for k in (-1, 1)] for unit in np.eye(7)]
    by_V, *by_numbers = np.diff(ends, axis=1)[:, 0]
    np.testing.assert_allclose(slopes[1], -np.array(by_numbers) / by_V, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_slope_is_the_derivative_of_the_event():
    curve, event = grazing(), belt().grazings[0]
    i = int(np.argmin(np.abs(curve.y - 1)))
    near = slice(i - 3, i + 4)
    slope = np.polynomial.Polynomial.fit(curve.y[near], curve.x[near], 6).deriv()(1.0)

    def value(mu_s):
        return fj.continue_cycle(BELT.replace(mu_s=mu_s), "V", WINDOW, "hopf").grazings[0].value

    derivative = jax.jvp(value, (jnp.array(1.0),), (jnp.array(1.0),))[1]
    np.testing.assert_allclose(slope, derivative, rtol=1e-6)
    np.testing.assert_allclose(curve.x[i], event.value, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 1])
def test_a_branch_starts_from_an_event(index):
    """From the grazing and the Hopf point of the first branch to those of the second."""
    event = belt().events[index]
    other = fj.continue_cycle(BELT, "mu_s", (0.7, 2.5), event)
    V = float(event.value)
    (at,) = other.grazings
    np.testing.assert_allclose(least_speed(V, float(at.value)), 0, atol=1e-9)
    if event.kind == "Hopf":
        np.testing.assert_allclose(other.hopf[0].value, 1.0, rtol=1e-9)
    np.testing.assert_allclose(other.parameter.min(), at.value, rtol=1e-9)


@pytest.mark.slow
def test_folds_of_the_brake_meet_in_a_cusp():
    """Two folds over friction are one curve over friction and D, and lie on other branches."""
    x = fj.brake_scene()
    first, second = fj.continue_cycle(x, "mu", (0.25, 0.4)).folds[1:]
    curve = fj.continue_event(x, first, "D", (2.3, 2.6))
    cusp = int(np.argmin(curve.x))
    assert curve.x[cusp] < 0.264 and curve.y[cusp] < 2.387
    on_other_arm = np.abs(curve.y - 2.4) < 0.002
    arms = [
        np.interp(2.4, np.sort(curve.y[part]), curve.x[part][np.argsort(curve.y[part])])
        for part in (slice(0, cusp), slice(cusp, None))
    ]
    np.testing.assert_allclose(sorted(arms), sorted([first.value, second.value]), rtol=1e-3)
    i = int(np.flatnonzero(on_other_arm)[0])
    there = fj.continue_cycle(x.replace(D=curve.y[i]), "mu", (0.25, 0.4)).folds
    values = np.array([float(fold.value) for fold in there])
    np.testing.assert_allclose(
        curve.x[i], values[np.argmin(np.abs(values - curve.x[i]))], rtol=1e-8
    )


@pytest.mark.slow
def test_map(tmp_path, capsys, monkeypatch):
    """Of the belt: its Hopf boundary, the grazing once, the committed picture, and the command."""
    found = load_script(DOCS / "make_map.py").draw(tmp_path / "map.png", starts=8, lines=9)
    assert_same_picture(tmp_path / "map.png", "map.png")
    (curve,) = found.curves
    assert curve.kind == "grazing" and not found.unfollowed
    (hopf,) = found.boundary.branches
    assert bool(hopf.start == fj.BoundaryEnd.window) and bool(hopf.end == fj.BoundaryEnd.window)
    np.testing.assert_allclose(2 * (hopf.y - 0.5) * np.exp(-2 * hopf.x), 0.1, rtol=1e-8)
    ax = fj.plot.bifurcation_map(found)
    assert labels(ax)[:3] == ["small disturbances grow", "Hopf", "grazing of a cycle"]

    def mapped(x, *windows, **options):
        assert float(x.joints[0].friction.mu_d) == 0.5
        assert windows == (("V", 0.5, 2.5), ("mu_s", 0.6, 1.4))
        assert options == {"radius": [1.0, 2.0], "starts": 8, "progress": False}
        return found

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("fractaljax._dynamics.bifurcation.bifurcation_map", mapped)
    BELT.save("belt.toml")
    windows = "--x", "V=0.5:2.5", "--y", "mu_s=0.6:1.4"
    radius = "--radius", "1,2"
    status, out, _ = run_command(
        capsys, "map", "belt.toml", *windows, *radius, "--starts", 8, "--quiet", "--out", "out"
    )
    assert status == 0 and repr(found) in out
    assert sorted(path.name for path in Path("out").iterdir()) == ["map.csv", "map.png"]
    with open("out/map.csv") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["V"]) for r in rows if r["kind"] == "Hopf"] == hopf.x.tolist()
    assert [float(r["mu_s"]) for r in rows if r["kind"] == "grazing"] == curve.y.tolist()


@pytest.mark.slow
def test_refusals():
    event, hopf = belt().grazings[0], belt().hopf[0]

    def refuses(match, *arguments, error: type[Exception] = ValueError):
        with pytest.raises(error, match=match):
            fj.continue_event(*arguments)

    refuses("hopf_boundary follows those", BELT, hopf, "mu_s", (0.6, 2.0))
    refuses("event must be a BranchEvent", BELT, "grazing", "mu_s", (0.6, 2.0), error=TypeError)
    refuses("no quantity 'mu'", BELT, event, "mu", (0.6, 2.0))
    refuses("must hold mu_s = 1.0", BELT, event, "mu_s", (1.5, 2.0))
    refuses("V", BELT, event, "V", (0.5, 2.0))
    refuses("a branch of x itself", BELT.replace(mu_d=0.3), event, "mu_s", (0.6, 2.0))
    with pytest.raises(ValueError, match="must hold V = 1"):
        fj.bifurcation_map(BELT, ("V", 1.5, 2.0), ("mu_s", 0.6, 2.0))
