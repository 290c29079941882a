"""Branches of limit cycles: against planar closed systems, the independent solver, differences."""

import copy
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import fractaljax as fj
import hybrid_truth
from belt import least_speed, slip
from benchmarks import transients
from fractaljax._mechanism.quantities import replaced
from mechanisms import PROBLEMS, changed
from structures import of_problem
from tools import DOCS, assert_same_picture, both_modes, labels, load_script

BELT = PROBLEMS["papangelo_2017"]


@functools.cache
def cycle(name):
    return fj.limit_cycle(of_problem(PROBLEMS[name]), PROBLEMS[name]["start"])


@functools.cache
def belt():
    """The belt's cycles in its speed: stick-slip up to a grazing, then repelling slip."""
    return fj.continue_cycle(of_problem(BELT), "V", (0.5, 2.5), cycle("papangelo_2017"))


@functools.cache
def branch(name, quantity, low, high):
    return fj.continue_cycle(of_problem(PROBLEMS[name]), quantity, (low, high), cycle(name))


@pytest.mark.slow
def test_belt():
    """Grazing and Hopf point."""
    (at,), (hopf,) = belt().grazings, belt().hopf
    graze: Any = brentq(least_speed, 1.7, 1.95, xtol=1e-13)
    np.testing.assert_allclose(at.value, graze, rtol=1e-9)
    np.testing.assert_allclose(hopf.value, 0.5 * np.log(10), rtol=1e-9)
    assert {at.before, at.after} == {"0 +", "+"} and len(belt().events) == 2
    assert float(belt().error.max()) < 1e-9
    stable = np.array([i < belt().grazings[0].index for i in range(len(belt().parameter))])
    np.testing.assert_array_equal(belt().stable[stable], True)
    np.testing.assert_array_equal(belt().stable[~stable][1:], False)
    assert belt().amplitude[-1] == 0 and "grazing at V = 1.8366" in repr(belt())


@pytest.mark.slow
def test_repelling_cycles():
    """Of the belt's slip cycles: each closes, and a deviation grows by its multiplier."""
    found = belt()
    inside = np.flatnonzero(~found.stable)[3:-3:9]
    assert len(inside) > 2
    for i in inside:
        v, state, period = found.parameter[i], found.state[i], found.period[i]
        end = slip(v, state, period).y[:, -1]
        np.testing.assert_allclose(end, state, atol=1e-9)
        # At the largest x the velocity is 0, and a deviation of x is one along the section.
        size, away = 1e-5, []
        for sign in (1, -1):
            start = state + np.array([sign * size, 0])

            def maximum(_, y):
                return y[1]

            maximum.direction = -1
            stops = slip(v, start, 1.2 * period, events=maximum)
            times, states = stops.t_events[0], stops.y_events[0]
            away.append(states[np.argmin(abs(times - period)), 0] - state[0])
        growth = (away[0] - away[1]) / (2 * size)
        np.testing.assert_allclose(found.multipliers[i, 0].real, growth, rtol=1e-6)


def values_of_events(kinds, *branch):
    """The first event of each kind on a branch as functions of the mechanism."""
    found = fj.continue_cycle(*branch, step=1 / 16)
    return jnp.stack([found.of_kind(kind)[0].value for kind in kinds])


@pytest.mark.slow
def test_derivatives_of_the_belt():
    """In both modes, of both events of one branch; and along a direction against differences."""

    def values(p):
        law = fj.ExponentialStribeck(p[3], p[4], p[5])
        joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=p[2]), law, [1.0], V=1.0)
        x = fj.Structure([[1.0]], [[p[0]]], [[p[1]]], [joint])
        return values_of_events(("grazing", "Hopf"), x, "V", (0.9, 2.0), cycle("papangelo_2017"))

    p = jnp.array([0.1, 1.0, 1.0, 1.0, 0.5, 0.5])
    _, forward, backward = both_modes(values, p)
    step, along = 1e-5, jnp.array([0.3, -0.7, 0.6, 1.0, -0.8, 0.5])
    truth = (values(p + step * along) - values(p - step * along)) / (2 * step)
    np.testing.assert_allclose(forward @ along, truth, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(backward, forward, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_picture(tmp_path):
    """The committed one, with its words, and a degree of freedom that there is not."""
    load_script(DOCS / "make_branch.py").draw(tmp_path / "branch.png", belt())
    assert_same_picture(tmp_path / "branch.png", "branch.png")
    ax = fj.plot.branch(belt())
    assert labels(ax) == ["stable", "unstable", "grazing", "Hopf"]
    assert ax.get_ylabel() == "peak-to-peak amplitude [m]"
    with pytest.raises(ValueError, match="direction must be from 1 to 1, got 2"):
        fj.plot.branch(belt(), direction=2)


def assert_truth(problem, quantity, found, i):
    """Point i of a branch in a quantity of the first joint, against SciPy's events."""
    problem = copy.deepcopy(problem)
    problem["joints"][0][quantity] = float(found.parameter[i])
    mechanism = hybrid_truth.Mechanism.of(problem)
    z, T = found.state[i] / mechanism.units, found.period[i] * mechanism.omega
    core = mechanism.scaled
    trip = list(hybrid_truth.phases(core, z, 1e-12, T))
    strength = max(1.0, float(np.abs(found.multipliers[i]).max()))
    np.testing.assert_allclose(trip[-1].end, z, atol=1e-8 * strength * np.abs(z).max())
    n = len(z) // 2
    rows = np.hstack([np.zeros((n, 1)), np.eye(n, 2 * n)])
    low, high = hybrid_truth.spread(trip, rows).T
    largest = found.amplitude[i].max()
    amplitude = (high - low) * mechanism.units[:n]
    np.testing.assert_allclose(found.amplitude[i], amplitude, atol=1e-8 * strength * largest)
    stick, _, opened = hybrid_truth.shares(core, trip) / T
    np.testing.assert_allclose(found.stick_fraction[i], stick, atol=1e-7 * strength)
    np.testing.assert_allclose(found.open_fraction[i], opened, atol=1e-7 * strength)


@pytest.mark.parametrize(
    ("name", "window", "kinds"),
    [
        pytest.param("leine_1998", (0.15, 1.2), ["grazing"], marks=pytest.mark.slow),
        # Without the phase that vanishes two faces would have to switch at once.
        pytest.param("released", (0.9, 0.95), ["grazing"], marks=pytest.mark.slow),
        pytest.param(
            "lift_off",
            (0.2, 1.0),
            ["grazing", "order of switches", "period doubling", "grazing", "fold"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_points(name, window, kinds):
    """Cycles of every itinerary on the way, and the kinds of events between them."""
    found = branch(name, "V", *window)
    assert [event.kind for event in found.events][: len(kinds)] == kinds
    assert float(found.error.max()) < 1e-8
    edges = [0, *(event.index for event in found.events), len(found.parameter) - 1]
    for before, after in itertools.pairwise(edges):
        if after - before > 3:
            assert_truth(PROBLEMS[name], "V", found, (before + after) // 2)


@pytest.mark.slow
def test_a_branch_meets_the_search():
    """What `limit_cycle` finds beside a branch of stable cycles lies on it."""
    found = branch("leine_1998", "V", 0.15, 1.2)
    x = of_problem(PROBLEMS["leine_1998"])
    for i in (5, len(found.parameter) // 2):
        other = fj.limit_cycle(x.replace(V=found.parameter[i]), found.state[i])
        np.testing.assert_allclose(found.period[i], other.period, rtol=1e-8)
        np.testing.assert_allclose(found.amplitude[i], other.amplitude, rtol=1e-8)
        np.testing.assert_allclose(found.stick_fraction[i], other.stick_fraction, rtol=1e-7)
        np.testing.assert_allclose(found.velocity_max[i], other.velocity_max, rtol=1e-8)
        sizes = [np.sort(np.abs(m)) for m in (found.multipliers[i], other.multipliers)]
        np.testing.assert_allclose(sizes[0], sizes[1], atol=1e-7)


@pytest.mark.slow
def test_derivatives_of_events():
    """Of the joint's P, against central differences of the branch itself: three on each."""
    problem, start = PROBLEMS["lift_off"], cycle("lift_off")
    kinds = "order of switches", "period doubling", "fold"

    def values(p):
        x = of_problem(changed(problem, ["joints.0.P"], [p[0]]))
        return values_of_events(kinds, x, "V", (0.3, 1.0), start)

    P, step = jnp.array([1.96]), 1e-5
    _, forward, backward = both_modes(values, P)
    truth = (values(P + step) - values(P - step)) / (2 * step)
    np.testing.assert_allclose(forward[:, 0], truth, rtol=1e-5)
    np.testing.assert_allclose(backward, forward, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["period doubling", "order of switches"])
def test_event_in_two_quantities(kind):
    """Followed in V and P, it is where a branch at another P has it."""
    x = of_problem(PROBLEMS["lift_off"])
    (event, *_) = branch("lift_off", "V", 0.2, 1.0).of_kind(kind)
    curve = fj.continue_event(x, event, "P", (1.94, 2.0), step=1 / 8)
    P, V = curve.y[-3], curve.x[-3]
    found = fj.continue_cycle(x.replace(P=P), "V", (0.3, 0.7), cycle("lift_off"))
    np.testing.assert_allclose(V, found.of_kind(kind)[0].value, rtol=1e-8)


@pytest.mark.slow
def test_a_branch_runs_away_where_friction_does():
    """The cubic law at a hundred times v_m; every point on the way keeps its accuracy."""
    found = fj.continue_cycle(transients.reference(), "V", (0.05, 1.0))
    assert bool(found.start == fj.BranchEnd.window) and bool(found.end == fj.BranchEnd.fast)
    assert np.abs(found.velocity_min[-1]).max() > 20 and float(found.error.max()) < 1e-8


BRAKE = fj.brake_scene()


@functools.cache
def squeal():
    """The reference brake's squeal over friction, to where it meets the equilibrium."""
    return fj.continue_cycle(BRAKE, "mu", (0.25, 0.4))


@pytest.mark.slow  # without optimisation it is lost near its Hopf point
def test_scene():
    """From the brake's squeal through three folds to the Hopf point, which is critical friction."""
    found = squeal()
    critical = fj.critical_friction(BRAKE)
    np.testing.assert_allclose(found.hopf[0].value, critical, rtol=1e-9)
    assert len(found.folds) == 3 and bool(found.start == fj.BranchEnd.hopf)
    assert found.stick_fraction.shape == (len(found.parameter), 2)
    stable = np.flatnonzero(found.stable)
    for i in stable[[2, len(stable) // 2, -1]]:
        scene = replaced(BRAKE, {"mu": found.parameter[i]})
        other = fj.limit_cycle(scene, found.state[i])
        np.testing.assert_allclose(found.amplitude[i], other.amplitude, rtol=1e-8)
        np.testing.assert_allclose(found.period[i], other.period, rtol=1e-8)
        np.testing.assert_allclose(found.stick_fraction[i], other.stick_fraction, atol=1e-8)


@pytest.mark.slow
def test_a_fold_moves_with_the_surface():
    """Its derivatives by D and ln G, against the folds of other surfaces."""
    start = fj.limit_cycle(BRAKE)

    def fold(p):
        scene = BRAKE.replace(D=p[0], G=jnp.exp(p[1]))
        return fj.continue_cycle(scene, "mu", (0.29, 0.4), start).folds[0].value

    p = jnp.array([2.4, jnp.log(1.342e-10)])
    _, forward, backward = both_modes(fold, p)
    h = np.array([1e-6, -1e-5])
    truth = (fold(p + h) - fold(p - h)) / 2
    np.testing.assert_allclose(forward @ h, truth, rtol=1e-5)
    np.testing.assert_allclose(backward, forward, rtol=1e-9)


def test_refusals():
    x, start = of_problem(BELT), cycle("papangelo_2017")

    def refuses(match, *arguments, error: type[Exception] = ValueError, **options):
        with pytest.raises(error, match=match):
            fj.continue_cycle(*arguments, **options)

    refuses("no quantity 'speed'", x, "speed", (0.5, 2.0), start)
    refuses("from a lower to a higher V", x, "V", (2.0, 0.5), start)
    refuses("window must be", x, "V", 2.0, start)
    refuses("must hold V = 1.0", x, "V", (1.5, 2.0), start)
    refuses("V must be", x, "V", (-0.5, 2.0), start)
    refuses("no Hopf point of V", x, "V", (0.5, 1.0), "hopf")
    refuses('"hopf", got', x, "V", (0.5, 2.0), "fold")
    refuses("a limit cycle of x itself", x.replace(P=2.0), "V", (0.5, 2.0), start)
    refuses("start must be a LimitCycle", x, "V", (0.5, 2.0), [1.0], error=TypeError)
    refuses("must be a Scene or a Structure", None, "V", (0.5, 2.0), error=TypeError)
    single = jax.tree.map(lambda leaf: leaf.astype("float32"), x)
    refuses("needs double precision", single, "V", (0.5, 2.0), error=TypeError)
    with pytest.raises(TypeError, match="cannot be compiled"):
        jax.jit(lambda x: fj.continue_cycle(x, "V", (0.5, 2.0), start).hopf[0].value)(x)
