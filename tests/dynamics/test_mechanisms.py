"""Limit cycles of mechanisms with several joints, lift-off and lever arms, against the table.

The table is that of the independent event-driven solver (tests/hybrid_truth.py).
"""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
import hybrid_truth
from fractaljax._dynamics.scaled import degrees_of_freedom
from mechanisms import PROBLEMS, changed
from structures import of_problem
from tools import both_modes, mostly_slow

TABLE = json.loads((Path(__file__).parents[1] / "reference" / "mechanisms.json").read_text())
ROWS = {row["name"]: row for row in TABLE["rows"]}
QUICK = ("papangelo_2017",)
# A joint slides forwards (V > 0). Backwards, with a second face along n, it is another joint.
BACKWARDS = {
    name
    for name, problem in PROBLEMS.items()
    if any(joint["V"] < 0 and joint.get("K_t") for joint in problem["joints"])
}
NAMES = mostly_slow([name for name in PROBLEMS if name not in BACKWARDS], *QUICK)
DIFFERENTIATED = ("stick_together", "four_dof")


@functools.cache
def cycle(name):
    if name in DIFFERENTIATED:
        return differentiated(name)[-1]
    return fj.limit_cycle(of_problem(PROBLEMS[name]), PROBLEMS[name]["start"], throw=False)


@functools.cache
def differentiated(name):
    """Derivatives of period, amplitudes and shares in both modes, and the cycle: one program."""
    problem = PROBLEMS[name]

    def outputs(values):
        x = of_problem(changed(problem, problem["by"], values))
        # As many as the search takes by itself outside of a compiled program.
        found = fj.limit_cycle(x, problem["start"], segments=512, throw=False)
        shares = found.stick_fraction, found.open_fraction
        return jnp.concatenate([found.period[None], found.amplitude, *shares]), found

    values = jnp.array([_at(problem, place) for place in problem["by"]])
    return jax.jit(lambda values: both_modes(outputs, values, has_aux=True)[1:])(values)


@pytest.mark.parametrize("name", NAMES)
def test_cycle(name):
    """Period, amplitudes, shares, forces, state and multipliers."""
    row, found = ROWS[name], cycle(name)
    assert found.result == fj.CycleResult.converged
    assert found.returns == row["maxima"] and float(found.error) < 1e-9
    close = functools.partial(np.testing.assert_allclose, rtol=1e-8)
    close(found.period, row["period"])
    largest = max(row["amplitude"])
    close(found.amplitude, row["amplitude"], atol=1e-9 * largest)
    for velocity in ("velocity_min", "velocity_max"):
        close(getattr(found, velocity), row[velocity], atol=1e-9 * max(row["velocity_max"]))
    for share in ("stick_fraction", "open_fraction"):
        close(getattr(found, share), row[share], atol=1e-9)
    forces = np.array(row["normal_force"])
    close(found.normal_force, forces, atol=1e-8 * abs(forces).max())
    truth = np.sort(abs(np.array([complex(*z) for z in row["multipliers"]])))
    np.testing.assert_allclose(np.sort(abs(np.asarray(found.multipliers))), truth, atol=1e-6)
    if row["maxima"] == 1:
        n = len(row["amplitude"])
        scale = np.repeat([largest, max(row["velocity_max"])], n)
        np.testing.assert_allclose(found.state / scale, row["state"] / scale, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_derivatives(name):
    """Of period, amplitudes and shares by the numbers in `by`, forward and reverse."""
    places = PROBLEMS[name]["by"]
    expected = [ROWS[name]["derivatives"][place] for place in places]
    shown = [
        [of["period"], *of["amplitude"], *of["stick_fraction"], *of["open_fraction"]]
        for of in expected
    ]
    truth, error = np.array(shown).transpose(2, 0, 1)
    for slope in differentiated(name)[:2]:
        off = abs(np.asarray(slope).T - truth)
        assert (off < 10 * error + 1e-6 * (abs(truth) + 1e-2)).all(), (places, off)


def _at(problem, place) -> float:
    found = problem
    for key in place.split("."):
        found = found[int(key)] if key.isdigit() else found[key]
        found = found[1] if isinstance(found, tuple) else found
    return found


@pytest.mark.slow
def test_motion_on_a_torus():
    """Its returns come ever nearer to earlier ones, never after 16: more of them change nothing."""
    joint = {"tangential": [1.0, 0.0], "normal": [0.0, 1.0], "V": 0.545, "P": 0.94, "K_n": 2.805}
    law = "hyperbolic", {"mu_s": 0.868, "delta": 0.23}  # the program of lift_off
    problem = {
        "M": [[0.759, -0.122], [-0.122, 0.738]],
        "C": [[0.052, -0.001], [-0.001, 0.055]],
        "K": [[1.174, 0.096], [0.096, 1.341]],
        "F": [0.507, 0.476],
        "joints": [joint | {"friction": law, "K_t": 0.0, "preload": True}],
    }
    start = np.array([-0.39, -0.76, 0.01, -0.69])
    found = fj.limit_cycle(of_problem(problem), start, max_returns=1500, throw=False)
    assert found.result == fj.CycleResult.not_periodic
    mechanism, returns = hybrid_truth.Mechanism.of(problem), []
    phases = hybrid_truth.phases(mechanism.scaled, start / mechanism.units, 1e-9, maxima=True)
    while len(returns) < 250:
        end = next(phases).end
        if abs(end[2]) < 1e-9:  # the velocity along t
            returns.append(end)
    later = np.array(returns[100:])
    gaps = [np.abs(later[k:] - later[:-k]).max(axis=1).min() for k in range(1, 100)]
    assert min(gaps[:16]) > 0.05 and min(gaps[16:]) < 0.005


@pytest.mark.slow
def test_rest_with_an_open_joint():
    """A force that pulls the joint open leaves the rest to its damping."""
    pulled = changed(PROBLEMS["two_maxima"], ["F.0"], [-30.0])
    found = fj.limit_cycle(of_problem(pulled), pulled["start"], throw=False)
    assert found.result == fj.CycleResult.equilibrium


def test_a_joint_without_speed_is_named():
    """Constant friction has no V of its own, but the motion has."""
    contact = fj.FixedContact(1.0, 0.0, 1.0)
    joint = fj.Joint(contact, fj.Coulomb(0.3), 0)
    still = fj.Structure(np.eye(1), None, np.eye(1), {"pad": joint})
    for call in (fj.limit_cycle, lambda x: fj.simulate(x, [0.0, 0.0], 1.0)):
        with pytest.raises(ValueError, match="joint pad: V must be given"):
            call(still)


@pytest.mark.parametrize("call", [fj.limit_cycle, lambda x: fj.simulate(x, [0.0, 0.0], 1.0)])
def test_joints_that_share_a_force_are_named(call):
    """Two pads on one direction at one speed stick together: their forces are not determined."""
    contact = fj.FixedContact(1.0, 0.0, 1.0)
    inner = fj.Joint(contact, fj.Coulomb(0.3), [1.0], V=0.5)
    outer = fj.Joint(contact, fj.Coulomb(0.3), [2.0], V=1.0)
    both = {"inner": inner, "outer": outer}
    disc = fj.Structure(np.eye(1), None, np.eye(1), both)
    with pytest.raises(ValueError, match="joints inner and outer slide in one direction at one V"):
        call(disc)


def test_a_joint_that_rubs_along_another_ones_tangent_is_named():
    """With a tangential spring it sticks there as well; at another V or without one it may."""

    def check(V, K_t):
        first = fj.Joint(fj.FixedContact(1.0, 0.5, 1.0), fj.Coulomb(0.3), 0, 1, V=0.5, preload=True)
        other = fj.FixedContact(1.0, K_t, 1.0)
        second = fj.Joint(other, fj.Coulomb(0.3), 2, 0, V=V, preload=True)
        degrees_of_freedom(fj.Structure(np.eye(3), None, np.eye(3), [first, second]))

    check(0.5, 0.0)
    check(0.6, 0.5)
    with pytest.raises(ValueError, match="joints joint_1 and joint_2 slide in one direction"):
        check(0.5, 0.5)
