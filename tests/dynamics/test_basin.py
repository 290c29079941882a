"""Basins: labels against brute force by SciPy, the starts, the shares, and what is refused."""

import functools

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fractaljax as fj
import hybrid_truth
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.starts import ellipsoid
from mechanisms import PROBLEMS, changed
from structures import of_problem, source_form_of
from tools import reference_scene, refusals

pytestmark = pytest.mark.optimised

# The equilibrium and a stick-slip cycle are both attracting.
V = 1.5
BELT = changed(PROBLEMS["papangelo_2017"], ["joints.0.V"], [V])
BOX = [-2.0, 0.0], [2.0, 2.0]
DESIGNED = fj.brake_scene().replace(D=2.4319698833358783, G=1.2340705508799051e-10)


def friction(w):
    return 0.5 + 0.5 * np.exp(-abs(w) / 0.5)


def comes_to_rest(x, u):
    """Whether the belt's mass ends at the sliding equilibrium: slip by slip, by DOP853."""
    y, s, sticks = np.array([x, u]), np.sign(V - u), 0

    def field(_, y):
        return [y[1], -y[0] - 0.1 * y[1] + s * friction(V - y[1])]

    def ends(_, y):
        return V - y[1]

    ends.terminal = True
    for _ in range(400):
        y[1] -= 1e-12 * s * (y[1] == V)  # off the switch that has just been
        found = solve_ivp(field, (0, 50), y, "DOP853", rtol=1e-10, atol=1e-12, events=ends)
        y = found.y[:, -1]
        if found.status == 0:
            if np.hypot(y[0] - friction(V), y[1]) < 0.3:
                return True
            continue
        y[1] = V
        if abs(y[0] + 0.1 * V) > 1:
            s = -s
            continue
        # It sticks until the limit, and slips on from one and the same state.
        y, s, sticks = np.array([1 - 0.1 * V, V]), 1.0, sticks + 1
        if sticks == 3:
            return False
    raise AssertionError("neither at rest nor sticking")


@functools.cache
def belt(starts):
    return fj.basin(of_problem(BELT), *BOX, starts=starts, progress=False)


def unlike(starts, each=1):
    """How many of each such start are labelled otherwise than by SciPy."""
    found = belt(starts)
    truth = np.array([comes_to_rest(*start) for start in found.starts[::each]])
    assert 0 < truth.mean() < 1
    return np.sum(truth != (found.labels[::each] == found.outcomes.index("equilibrium")))


def test_belt_comes_to_rest_or_not():
    found = belt(96)
    assert found.outcomes == ("equilibrium", "cycle 1", "diverges", "undecided")
    assert unlike(96) == 0
    (cycle,) = found.cycles
    alone = fj.limit_cycle(of_problem(BELT), [-1.5, 1.0])
    np.testing.assert_allclose(cycle.period, alone.period, rtol=1e-9)
    assert found.shares["equilibrium"] + found.shares["cycle 1"] == pytest.approx(1)


def test_without_full_searches_no_start_ends_in_a_cycle():
    coarse = {"max_returns": 100, "search": fj.BasinSearch(failures=0)}
    result = fj.basin(of_problem(BELT), *BOX, 8, progress=False, **coarse)
    assert result.outcomes == ("equilibrium", "diverges", "undecided")
    assert result.shares["equilibrium"] > 0 and result.shares["undecided"] > 0
    with pytest.raises(TypeError, match="search must be a BasinSearch"):
        fj.basin(of_problem(BELT), *BOX, search=0.1)  # type: ignore[arg-type]


@pytest.mark.slow
def test_starts_on_and_beside_the_belt():
    """Within the friction limits it sticks, beyond them it slips; w = 0 to rounding is no trap."""
    on_belt = np.array([[x, V] for x in np.linspace(-1.9, 1.9, 12)])
    found = fj.basin(of_problem(BELT), starts=on_belt, progress=False)
    truth = [comes_to_rest(x, V - 1e-9) for x, _ in on_belt]
    np.testing.assert_array_equal(found.labels == 0, truth)
    np.testing.assert_array_equal(found.starts, on_belt)
    assert unlike(1000, 5) <= 0.005 * 200


def repeats(mechanism, start):
    """Whether the motion of the independent solver soon has a period of three maxima of x1."""
    tops = []
    for p in hybrid_truth.phases(mechanism.scaled, start / mechanism.units, 1e-7, maxima=True):
        if p.event[0] != "maximum":
            continue
        tops.append(p.end)
        if len(tops) > 60 and len(tops) % 20 == 0:
            last = np.array(tops[-40:])
            if abs(last[[-4, -7, -10, -13, -40]] - last[-1]).max() < 2e-3:
                return True
            if len(tops) >= 160:
                return False
    raise AssertionError("it has no end")


@pytest.mark.slow
def test_designed_brake_against_the_independent_solver():
    """Kicks of three V: some end in the coexisting cycle of 24.5 um, at once or never."""
    found = fj.basin(DESIGNED, radius=3.0, starts=6, seed=3, progress=False)
    mechanism = hybrid_truth.Mechanism.of(source_form_of(DESIGNED))
    truth = [repeats(mechanism, start) for start in found.starts]
    assert [found.outcomes[label] == "cycle 1" for label in found.labels] == truth
    assert len(set(truth)) == 2
    assert float(found.cycles[0].amplitude.max()) == pytest.approx(24.47e-6, rel=1e-3)


@pytest.mark.slow
def test_labels_are_the_cycles_of_the_search():
    """Each start by itself ends in the same cycle; where it does not, the truth decides.

    `limit_cycle` takes longer steps, and may leave a start at the wrong side of a boundary.
    """
    scene = reference_scene().replace(K_n=6e8, K_t=3e8)
    found = fj.basin(scene, radius=2.0, starts=64, progress=False)
    alone = [fj.limit_cycle(scene, start, throw=False).period for start in found.starts]
    periods = np.array([np.nan, *(float(c.period) for c in found.cycles), np.nan, np.nan])
    periods = periods[found.labels]
    assert len(found.cycles) >= 2
    differ = np.flatnonzero(~np.isclose(periods, np.array(alone), rtol=1e-7, equal_nan=True))
    assert len(differ) <= 2
    mechanism, tops = hybrid_truth.Mechanism.of(source_form_of(scene)), []
    for i in differ:
        start = found.starts[i] / mechanism.units
        for p in hybrid_truth.phases(mechanism.scaled, start, 1e-9, maxima=True):
            tops += [p.t1 / mechanism.omega] if p.event[0] == "maximum" else []
            if len(tops) == 300:
                break
        assert np.diff(tops)[-40:].mean() == pytest.approx(periods[i], rel=1e-3)
        tops.clear()


@pytest.mark.slow
def test_excited_belt():
    """No equilibrium: all starts end in the periodic motion under the force."""
    problem, force = of_problem(PROBLEMS["papangelo_2017"]), fj.Excitation([0.6], 0.2)
    found = fj.basin(problem, [0.0, -0.5], [1.0, 0.5], 16, excitation=force, progress=False)
    for start, label in zip(found.starts, found.labels, strict=True):
        alone = fj.limit_cycle(problem, start, excitation=force, throw=False)
        if label in range(1, 1 + len(found.cycles)):
            cycle = found.cycles[label - 1]
            np.testing.assert_allclose(alone.amplitude, cycle.amplitude, rtol=1e-6)
        else:
            assert found.outcomes[label] == "undecided" and np.isnan(alone.period)
    assert found.shares["equilibrium"] == 0


@pytest.mark.slow
def test_starts_in_a_box_a_section_a_ball_and_an_ellipsoid():
    found = belt(96)
    low, high = np.array(BOX)
    assert found.starts.shape == (96, 2)
    assert (found.starts >= low).all() and (found.starts <= high).all()
    # A quarter of the points in a quarter of the box, as independent ones hardly ever are.
    counts, *_ = np.histogram2d(*found.starts.T, bins=2, range=np.transpose(BOX))
    assert abs(counts - 24).max() <= 2
    again = fj.basin(of_problem(BELT), *BOX, 4, max_returns=1, progress=False)
    other = fj.basin(of_problem(BELT), *BOX, 4, seed=1, max_returns=1, progress=False)
    line = fj.basin(of_problem(BELT), [-2, 0.5], [2, 0.5], 4, max_returns=1, progress=False)
    np.testing.assert_array_equal(again.starts, found.starts[:4])
    assert not np.isclose(other.starts, again.starts).any()
    assert (line.starts[:, 1] == 0.5).all() and len(set(line.starts[:, 0])) == 4
    # Evenly in the volume, about the equilibrium, in units of V/omega and V.
    found = fj.basin(of_problem(BELT), radius=0.01, starts=256, progress=False)
    # Of the belt omega is 1, and the equilibrium is at mu(V).
    away = (found.starts - [friction(V), 0.0]) / V
    r = np.linalg.norm(away, axis=1)
    assert r.max() <= 0.01 and np.mean((r / 0.01) ** 2) == pytest.approx(0.5, abs=0.01)
    assert abs(away.mean(axis=0)).max() < 2e-4
    assert found.shares["equilibrium"] == 1
    # Semi-axes of the ball give its starts; others stretch them about the equilibrium.
    ball = fj.basin(of_problem(BELT), radius=0.01, starts=64, progress=False).starts
    axes = 0.01 * V, 0.01 * V
    alike = fj.basin(of_problem(BELT), radius=axes, starts=64, progress=False).starts
    np.testing.assert_allclose(alike, ball, rtol=0, atol=1e-15)
    axes = np.array([0.03 * V, 0.02 * V])
    found = fj.basin(of_problem(BELT), radius=axes, starts=64, progress=False)
    centre = friction(V), 0.0
    np.testing.assert_allclose(found.starts - centre, (ball - centre) * [3, 2], atol=1e-15)
    assert found.shares["equilibrium"] == 1


@pytest.mark.slow
def test_long_transients_come_to_rest():
    """Starts of docs/kicks.md for which the full search finds nothing: no start is given up.

    In the independent solver they switch for the last time within 700/omega, and decay.
    """
    scene = fj.brake_scene().replace(D=2.70, G=5e-9)
    ways = np.random.default_rng(0).standard_normal((4, 4))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    system = hybrid_system(scene)
    centre, axes = ellipsoid(system, 1.0)
    starts = (centre + ways * axes)[[0, 3]]
    found = fj.basin(scene, starts=starts, progress=False)
    assert found.outcomes[found.labels[0]] == "equilibrium" and not found.labels.any()
    mechanism = hybrid_truth.Mechanism.of(source_form_of(scene))
    rest = np.asarray(system.equilibrium())[:4]
    for start in starts:
        *_, last = hybrid_truth.phases(mechanism.scaled, start / mechanism.units, 1e-8, 4000.0)
        assert last.t0 < 700 and last.event == ()
        times = np.linspace(1000, 4000, 4000)
        sizes = abs(last.dense(times).T - rest).max(axis=1).reshape(4, -1).max(axis=1)
        assert (np.diff(sizes) < 0).all()


@pytest.mark.slow
def test_shares_their_table_and_what_is_undecided_or_refused():
    found = belt(96)
    count = np.sum(found.labels == 0)
    p = count / 96
    assert found.shares["equilibrium"] == p
    assert found.standard_errors["equilibrium"] == pytest.approx(np.sqrt(p * (1 - p) / 96))
    text = str(found).splitlines()
    assert text[0].split() == ["equilibrium", "cycle", "1", "diverges", "undecided"]
    assert text[1].split() == ["starts", str(count), str(96 - count), "0", "0"]
    assert f"{found.cycles[0].frequency:.6g}" in text[3]
    found = fj.basin(of_problem(BELT), *BOX, 4, max_returns=1, progress=False)
    undecided = np.flatnonzero(found.labels == found.outcomes.index("undecided"))
    assert len(undecided) and set(found.reasons) == set(undecided.tolist())
    assert f"undecided, {len(undecided)}: the motion nearly repeats" in str(found)
    with pytest.raises(ValueError, match="call it outside of jit, vmap and grad"):
        jax.jit(lambda D: fj.basin(DESIGNED.replace(D=D), radius=1.0).labels)(2.4)


test_refusals = refusals(
    [
        ({}, r"give one of: low and high, radius, or starts of shape \(k, 2n\)"),
        ({"low": [0.0, 0.0]}, "a box needs both low and high"),
        ({"low": [0.0], "high": [1.0]}, r"low must have shape \(2,\), got \(1,\)"),
        ({"low": [0.0, 1.0], "high": [1.0, 0.0]}, "low must be at most high, got"),
        ({"low": [0.0, np.nan], "high": [1.0, 0.0]}, "low must be finite, got nan"),
        ({"radius": 0.0}, "radius must be above 0, got 0.0"),
        ({"radius": [1.0]}, "radius must have 2 semi-axes, got 1"),
        ({"radius": np.ones((2, 2))}, "radius must be a single number, got shape"),
        ({"radius": [1.0, 0.0]}, "radius must be above 0, got 0.0"),
        ({"radius": 1.0, "low": [0, 0], "high": [1, 1]}, "give one of"),
        ({"radius": 1.0, "starts": 0}, "starts must be a whole number of at least 1, got 0"),
        ({"radius": 1.0, "seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"starts": [[0.0, 0.0, 0.0]]}, r"starts must have shape \(k, 2\), got \(1, 3\)"),
        ({"radius": 1.0, "max_returns": 0}, "max_returns must be a whole number of at least 1"),
        ({"radius": 1.0, "rtol": 1.0}, "rtol must be above 0 and at most 0.1, got 1.0"),
    ],
    lambda arguments: fj.basin(of_problem(BELT), **arguments),
)
