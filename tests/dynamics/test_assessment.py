"""The three rules of the search for a limit cycle, each alone, with made-up returns."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._dynamics import attractors
from fractaljax._dynamics.assessment import (
    NearEquilibrium,
    NearOrbit,
    Problem,
    Progress,
    Returns,
    near_equilibrium,
    near_orbit,
    patience,
)
from fractaljax._dynamics.contact_state import OPEN
from fractaljax._dynamics.guard import NONE, SECTION, UNUSED
from fractaljax._dynamics.hybrid import HybridSystem
from fractaljax._dynamics.record import Record
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.search import _kept_steps
from fractaljax._dynamics.segments import Segments
from fractaljax._dynamics.status import Status
from tools import reference_scene, refusals

INTERVAL = 6.0  # between two returns, in 1/omega


@functools.cache
def system_of(kind: str = "stribeck") -> HybridSystem:
    scene = reference_scene()
    if kind == "coulomb":
        scene = scene.replace(friction=fj.Coulomb(0.4))
    if kind == "preloaded":
        contact = fj.FixedContact(4e8, 2e8, P=100.0)
        scene = fj.Scene(contact, scene.friction, scene.oscillator, preload=True)
    return jax.jit(hybrid_system)(scene)


def problem_of(growth=-0.01, kind="stribeck", max_returns=100.0, length=64, **options) -> Problem:
    """One lane, assessed after every step, with its equilibrium at zero."""
    lane = [jnp.array([float(x)]) for x in (growth, 1e3, max_returns, 0.25, 1e-9)]
    search = fj.CycleSearch(round_steps=1, **options)
    return Problem(system_of(kind), jnp.zeros((4, 1)), *lane, length=length, search=search)


def progress_of(**changes) -> Progress:
    """A lane as it begins, but for some numbers."""
    start = dict.fromkeys(("status", "period_returns", "approach", "idle", "calm"), 0)
    start |= {"distance": jnp.inf, "widest": [0.0, 0.0], "tried": jnp.inf}
    start |= {"returns": 0.0, "size": 0.0}
    fields = {name: jnp.asarray(x)[..., None] for name, x in (start | changes).items()}
    return Progress(**fields)


def record_of(states, switches=0, quiet=0, known=None, s=1.0) -> Record:
    """One lane whose last returns have these states (k, 4), oldest first, a step from each other.

    There are `switches` between two returns, and `quiet` steps after the last one. `known` is the
    number of steps that are of this motion, by default all.
    """
    rows, sums, y = [], np.zeros(4), np.asarray(states[0], float)

    def add(guard, duration, after):
        nonlocal y
        sums[:] += duration, duration, guard != NONE, guard == SECTION
        rows.append([*y, s, s, guard, *sums])
        y = np.asarray(after, float)

    for _ in range(20):
        add(NONE, 0.1, y)
    for state in states:
        for _ in range(switches):
            add(1, INTERVAL / (switches + 1), y)
        add(SECTION, INTERVAL / (switches + 1), state)
    for _ in range(quiet):
        add(NONE, 0.1, y)
    lane = {"y": y, "s": [s, s], "guard": rows[-1][6], "sums": sums}
    lane["count"] = len(rows) if known is None else known
    steps = jnp.asarray(rows).T[:, :, None]
    lane = {name: jnp.asarray(value)[..., None] for name, value in lane.items()}
    return Record(steps, jnp.asarray(0), reach=None, **lane)


def returns_of(states, problem, previous=None, rounds=0, **options) -> Returns:
    previous = progress_of() if previous is None else previous
    record = record_of(states, **options)
    return Returns.from_record(record, jnp.asarray(rounds), previous, problem)


def along(sizes):
    """States of these distances from the equilibrium."""
    return np.multiply.outer(np.asarray(sizes, float), [1.0, 0.0, 0.0, 0.0])


def geometric(first, rate, count=8):
    """Distances that grow by `rate` in each return, in ln."""
    return along(first * np.exp(rate * np.arange(count)))


def ending(states, growth=-0.01, kind="stribeck", **options):
    problem = problem_of(growth, kind)
    conclusion = near_equilibrium(problem, returns_of(states, problem, **options))
    return Status(int(conclusion.status[0])), conclusion


# --- near the equilibrium -------------------------------------------------------------------

LINEAR = -0.01 * INTERVAL


@pytest.mark.parametrize(
    ("states", "options", "status"),
    [
        (geometric(0.3, LINEAR), {}, Status.EQUILIBRIUM),
        (geometric(0.3, LINEAR), {"switches": 1}, Status.RUNNING),
        (geometric(0.9, LINEAR), {}, Status.RUNNING),  # too far for the linear rate to be its own
        (geometric(0.3, 0.6 * LINEAR), {}, Status.RUNNING),  # towards something else
        (along([0.4, 0.4, 0.4, 0.4, 0.4, 0.36, 0.3]), {}, Status.RUNNING),  # not steady
        (geometric(0.009, 0.1 * LINEAR), {}, Status.EQUILIBRIUM),
        (geometric(0.009, 0.1 * LINEAR), {"switches": 2}, Status.RUNNING),
        (geometric(0.005, 0.1), {}, Status.RUNNING),  # small, but it grows
        (geometric(1e-8, 0.0), {"switches": 1}, Status.EQUILIBRIUM),  # at rest
        (geometric(2e3, LINEAR), {}, Status.DIVERGED),
        (geometric(np.nan, LINEAR), {}, Status.NOT_FINITE),
    ],
)
def test_a_motion_dies_out_near_an_attracting_equilibrium(states, options, status):
    assert ending(states, **options)[0] == status


@pytest.mark.parametrize("states", [geometric(1e-9, 0.02), geometric(1e-8, -1e-4)])
def test_a_motion_that_starts_at_a_repelling_equilibrium_does_not_die_out(states):
    """However near it is, it will leave: at rest everything is small and almost constant."""
    assert ending(states, growth=0.004)[0] == Status.RUNNING
    assert ending(states, growth=-0.004)[0] == Status.EQUILIBRIUM  # the growth decides


def test_a_motion_at_rest_with_a_joint_open_has_ended():
    system = system_of("preloaded")
    s = jnp.full((2, 1), float(OPEN))
    slope = jax.jacfwd(lambda y: system.field(y[:, None], s)[:, 0])(jnp.zeros(4))
    rest = -np.linalg.solve(slope, system.field(jnp.zeros((4, 1)), s)[:, 0])
    options: dict[str, Any] = {"growth": 0.01, "kind": "preloaded", "s": float(OPEN)}
    assert ending([rest] * 6, **options)[0] == Status.EQUILIBRIUM
    assert ending([rest + 1e-3] * 6, **options)[0] == Status.RUNNING
    assert ending([rest] * 6, growth=0.01, kind="preloaded")[0] == Status.RUNNING


def test_a_slow_steady_change_is_extrapolated():
    def factor(states, **options):
        _, conclusion = ending(states, **options)
        assert bool(conclusion.extrapolates[0]) == (conclusion.y[0, 0] != states[-1][0])
        return float(conclusion.y[0, 0] / states[-1][0])

    slow = geometric(2.0, 0.001)
    assert factor(slow) == pytest.approx(np.exp(0.2))  # as after 200 returns
    assert factor(geometric(2.0, -0.01)) == pytest.approx(np.exp(-0.25))
    # By half of what is left, where each step is 0.95 of the last one: it ends 20 steps ahead.
    slowing = along(2 * np.exp(0.01 * np.cumsum(0.95 ** np.arange(8))))
    left = 0.01 * 0.95**7 / 0.05
    assert factor(slowing) == pytest.approx(np.exp(left * 0.95 / 2 / 0.95))
    assert factor(slow, switches=1) == factor(geometric(2.0, 0.03)) == 1
    assert factor(slow, previous=progress_of(status=Status.CONVERGED)) == 1


# --- near an orbit --------------------------------------------------------------------------


def segments_at(y) -> Segments:
    """An orbit whose first state is this far from the equilibrium along the first axis."""
    shape = 3, 1
    states = jnp.zeros((4, *shape)).at[0].set(y)
    return Segments(states, jnp.zeros(shape), jnp.ones((2, *shape)), jnp.full(shape, UNUSED))


def candidate(states, rounds, growth=-0.01, kind="stribeck", previous=None, orbit=9.0, **options):
    """What is near, with a switch in each return unless said otherwise."""
    previous = progress_of() if previous is None else previous
    problem = problem_of(growth, kind)
    options = {"switches": 1} | options
    returns = returns_of(states, problem, previous, rounds, **options)
    rest = NearEquilibrium(jnp.zeros(1, int), jnp.zeros(1, bool), returns.record.y)
    return near_orbit(problem, returns, previous, segments_at(orbit), rest)


TWO = along([1.0, 2.003, 1.001, 2.002, 1.0, 2.001, 1.0, 2.0])  # they repeat after two returns


def test_returns_of_period_two_are_tried_in_every_other_round():
    one, two = candidate(TWO, rounds=0), candidate(TWO, rounds=1)
    assert (int(one.period_returns[0]), bool(one.ready[0])) == (1, False)
    assert (int(two.period_returns[0]), bool(two.ready[0])) == (2, True)
    np.testing.assert_allclose([one.gap[0], two.gap[0]], [1.0, 1e-3], atol=1e-12)
    np.testing.assert_allclose(two.scale, 3.0)  # 1 and the largest component
    # The candidate begins two returns, of two steps each, before its end.
    assert int(two.first[0]) == 20 + 2 * len(TWO) - 1 - 4
    assert not candidate(along([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), rounds=1).ready[0]
    assert not candidate(TWO, rounds=1, previous=progress_of(status=Status.CONVERGED)).ready[0]


def test_distances_between_small_returns_are_relative_to_their_size():
    small = candidate(1e-3 * TWO, rounds=1)
    np.testing.assert_allclose(small.scale, 4 * 2e-3)
    assert small.ready[0] and not candidate(1e-3 * along([1.0, 2.0] * 4), rounds=2).ready[0]


def test_a_single_return_waits_until_its_end_is_near():
    """Each step is 0.9 of the last: more than 1 is left in all, which is too far at first."""
    states = along(3 - 0.3 * np.cumsum(0.9 ** np.arange(9)))
    assert not candidate(states, rounds=2).ready[0]
    assert candidate(states, rounds=8).ready[0]
    fast = along(2 + 0.1 ** np.arange(5))
    assert candidate(fast, rounds=2).ready[0]


def test_after_a_failure_returns_have_to_be_closer():
    states = along([1.0, 2.05, 1.0, 2.0, 1.0, 2.02])
    for tried, rounds, ready in [(0.1, 3, True), (0.021, 3, False), (0.021, 9, True)]:
        failed = progress_of(tried=tried)
        assert bool(candidate(states, rounds, previous=failed).ready[0]) == ready
    assert not candidate(states, 73, previous=progress_of(tried=0.021)).ready[0]  # less often


def test_an_orbit_that_the_motion_approaches_is_accepted_and_no_other_is_tried():
    for approach, ok in [(1, False), (2, True)]:
        previous = progress_of(distance=0.3, approach=approach)
        near = candidate(TWO, rounds=1, previous=previous, orbit=2.2)
        assert (int(near.approach[0]), bool(near.ok[0])) == (approach + 1, ok)
        assert not near.ready[0]
        np.testing.assert_allclose(near.distance, 0.197)  # of the nearest return
    near = candidate(TWO, rounds=1, previous=progress_of(distance=0.1, approach=2), orbit=2.2)
    assert (int(near.approach[0]), bool(near.ok[0]), bool(near.ready[0])) == (0, False, True)
    assert np.isinf(near.distance[0])


def test_motions_without_a_switch_that_are_linear_have_no_orbit():
    growing = geometric(0.5, 0.06)
    assert not candidate(growing, rounds=4, growth=0.01, switches=0).ready[0]
    assert candidate(growing, rounds=4, growth=0.01).ready[0]
    assert candidate(growing, rounds=4, growth=0.03, switches=0).ready[0]  # by then it is slower
    still = along([1.0] * 6)
    assert candidate(still, rounds=4, switches=0).ready[0]
    assert not candidate(still, rounds=4, kind="coulomb", switches=0).ready[0]
    assert candidate(still, rounds=4, kind="coulomb").ready[0]


# --- patience -------------------------------------------------------------------------------


def outcome(
    count=100, states=TWO, growth=0.01, closest=0.01, length=64, previous=None, **options
) -> Status:
    """With 100 returns allowed, after `count` of them."""
    previous = progress_of() if previous is None else previous
    previous = eqx.tree_at(lambda x: x.returns, previous, jnp.array([count - 1.0]))
    problem = problem_of(growth, length=length)
    options = {"switches": 1} | options
    returns = returns_of(states, problem, previous, **options)
    fields: dict[str, Any] = dict.fromkeys([f.name for f in dataclasses.fields(NearOrbit)])
    fields |= {"closest": jnp.array([closest]), "scale": jnp.ones(1), "repeated": jnp.array([2])}
    return Status(int(patience(problem, returns, previous, NearOrbit(**fields)).over[0]))


@pytest.mark.parametrize(
    ("widest", "closest", "status"),
    [
        ([0.015, 0.01], 0.01, Status.EXHAUSTED),
        ([0.0, 0.01], 0.01, Status.EXHAUSTED),  # a single quarter tells nothing else
        ([0.01, 0.01], 0.01, Status.NOT_PERIODIC),  # on a torus it comes no nearer
        ([0.1, 0.05], 0.01, Status.NOT_PERIODIC),
        ([0.015, 0.01], 0.1, Status.NOT_PERIODIC),
    ],
)
def test_a_motion_that_still_settles_is_exhausted(widest, closest, status):
    assert outcome(closest=closest, previous=progress_of(widest=widest)) == status
    assert outcome(99, closest=closest, previous=progress_of(widest=widest)) == Status.RUNNING


def test_a_decay_without_switches_is_exhausted():
    assert outcome(closest=0.5, growth=-0.01, switches=0) == Status.EXHAUSTED
    assert outcome(closest=0.5, growth=-0.01) == Status.NOT_PERIODIC
    assert outcome(closest=0.5, growth=0.01, switches=0) == Status.NOT_PERIODIC


def test_a_motion_that_repeats_in_too_many_segments_is_too_long():
    """Two returns take 48 segments, and four phases."""
    assert outcome(closest=1e-7, length=51) == Status.TOO_LONG
    assert outcome(closest=1e-7, length=52) == Status.EXHAUSTED
    assert outcome(closest=1e-3, length=51) == Status.EXHAUSTED  # it has not settled


def test_a_motion_without_returns_is_given_up():
    for idle, status in [(511, Status.RUNNING), (512, Status.NOT_PERIODIC)]:
        previous = progress_of(idle=idle, widest=[0.1, 0.0])
        assert outcome(50, closest=0.5, quiet=2, previous=previous) == status


def test_a_period_longer_than_the_record_is_too_long():
    """The motion has one return in the whole record, and has long ceased to grow."""
    once: dict[str, Any] = {"count": 50, "states": along([1.0])}
    calm = progress_of(size=1.0, calm=7)
    assert outcome(**once, previous=calm) == Status.TOO_LONG
    assert outcome(**once, previous=progress_of(size=1.0, calm=6)) == Status.RUNNING
    assert outcome(**once, previous=progress_of(size=0.9, calm=7)) == Status.RUNNING  # it grows
    assert outcome(**once, previous=calm, known=21) == Status.RUNNING  # not full yet
    assert outcome(50, along([1.0, 1.0]), previous=calm) == Status.RUNNING
    # Once it is given up, fewer than four returns tell nothing.
    assert outcome(100, along([1.0] * 4)) == Status.TOO_LONG


# --- options --------------------------------------------------------------------------------


def test_states_and_the_results_that_report_them():
    assert [status.value for status in Status] == [*range(8)]
    for status in Status:
        name = "exhausted" if status == Status.RUNNING else status.name.lower()
        assert status.result is getattr(fj.CycleResult, name)


def test_a_record_holds_whole_rounds():
    default, odd = fj.CycleSearch(), fj.CycleSearch(round_steps=100, kept_steps=1)
    assert [_kept_steps(n, default) for n in (16, 64, 65, 512)] == [2048, 2048, 2176, 16384]
    assert _kept_steps(17, odd) == 600
    assert _kept_steps(16, fj.CycleSearch(round_steps=5000)) == 10000


def test_options_reach_the_search(monkeypatch):
    """Where no returns count as near the motion nearly repeats, but no orbit is solved for."""
    strict = fj.CycleSearch(near=1e-12)
    cycle = fj.limit_cycle(reference_scene(), search=strict, max_returns=40, throw=False)
    assert cycle.result != fj.CycleResult.converged and np.isnan(cycle.period)
    seen = []

    def find_cycle(*arguments, **static):
        seen.append(static["search"])
        raise InterruptedError

    monkeypatch.setattr(attractors, "find_cycle", find_cycle)
    with pytest.raises(InterruptedError):
        fj.attractors(reference_scene(), search=strict)
    assert seen == [strict]


def test_options_are_plain_numbers():
    """So that equal ones share a program, also on disk."""
    options: Any = {"step": np.float64(0.3), "group": np.int64(16), "near": 1}
    search = fj.CycleSearch(**options)
    assert search == fj.CycleSearch(near=1.0) and hash(search) == hash(fj.CycleSearch(near=1.0))
    assert [type(x) for x in (search.step, search.group, search.near)] == [float, int, float]


test_refusals = refusals(
    [
        ({"step": -0.1}, "step must be a number above 0, got -0.1"),
        ({"step": 0}, "step must be a number above 0, got 0"),
        ({"step": np.nan}, "step must be a number above 0, got nan"),
        ({"near": "1"}, "near must be a number above 0, got '1'"),
        ({"accepted": True}, "accepted must be a number above 0, got True"),
        ({"reach": np.inf}, "reach must be a number above 0, got inf"),
        ({"round_steps": 0}, "round_steps must be a whole number of at least 1, got 0"),
        ({"meshes": 1.5}, "meshes must be a whole number of at least 1, got 1.5"),
        ({"longest_period": 2}, "longest_period must be a whole number of at least 3, got 2"),
    ],
    lambda bad: fj.CycleSearch(**bad),
)
test_searches_of_another_kind = refusals(
    [
        (fj.limit_cycle, "search must be a CycleSearch, got 0.3"),
        (fj.attractors, "search must be a CycleSearch, got 0.3"),
    ],
    lambda function: function(reference_scene(), search=0.3),
    TypeError,
)
