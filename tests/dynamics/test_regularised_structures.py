"""The regularised law of structures, against SciPy's solution of the same field and the exact law.

The field is written here once more, from the numbers of the problem.
"""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fractaljax as fj
from hybrid_truth import LAWS
from mechanisms import PROBLEMS, changed
from structures import of_problem
from tools import both_modes

SLOW = pytest.mark.slow
TABLE = json.loads((Path(__file__).parents[1] / "reference" / "mechanisms.json").read_text())
ROWS = {row["name"]: row for row in TABLE["rows"]}
TOGETHER, LIFT = "stick_together", "lift_off"


def field(problem, eps, t, y, force=None):
    """y' of M x'' + C x' + K x = F + f(t) + joints, with tanh(w/eps) for sgn w.

    Joints without K_t: P + K_n n.x on t, at least 0, and its reaction on n.
    """
    M, C, K, F = (np.array(problem[name], float) for name in "MCKF")
    n = len(M)
    x, v = y[:n], y[n:]
    total = F - K @ x - C @ v + (0 if force is None else force(t))
    for joint in problem["joints"]:
        law, numbers = joint["friction"]
        d, normal = np.array(joint["tangential"]), joint.get("normal")
        w, N = joint["V"] - d @ v, joint["P"]
        if normal is not None:
            normal = np.array(normal)
            N = max(0.0, N + joint["K_n"] * (normal @ x))
            total = total + (joint["P"] - N) * normal
        static = LAWS[law](0.0, **numbers)
        mu = static * np.tanh(w / eps) + np.sign(w) * (LAWS[law](abs(w), **numbers) - static)
        total = total + mu * N * d
    return np.concatenate([v, np.linalg.solve(M, total)])


def integrate(problem, eps, y, t1, t0=0.0, force=None):
    rates = functools.partial(field, problem, eps, force=force)
    return solve_ivp(
        rates, (t0, t1), y, "LSODA", rtol=1e-11, atol=1e-12, dense_output=True, max_step=0.05
    )


@functools.cache
def cycle(name, eps) -> fj.LimitCycle:
    problem = PROBLEMS[name]
    options = {"regularisation": eps, "max_steps": 20_000, "segments": 512, "throw": False}
    return fj.limit_cycle(of_problem(problem), problem["start"], **options)


def test_motion_under_a_force():
    """From t0 on, at given times: stick, slip and the phase of the force, by Tsit5."""
    problem, eps = PROBLEMS["papangelo_2017"], 0.03
    times, start = np.linspace(1.3, 40.0, 40), [1.5, 0.0]
    given = fj.Excitation([0.7], 0.17, 0.3)
    found = fj.simulate(of_problem(problem), start, 40.0, t0=1.3, saveat=times, excitation=given,
                        regularisation=eps)  # fmt: skip
    truth = integrate(
        problem, eps, start, 40.0, 1.3, lambda t: 0.7 * np.cos(2 * np.pi * 0.17 * t + 0.3)
    )
    np.testing.assert_allclose(found.states, truth.sol(times).T, rtol=0, atol=1e-6)
    sliding = 1.0 - truth.sol(times)[1]
    expected = np.where(abs(sliding) < eps, 0, np.sign(sliding))
    np.testing.assert_array_equal(found.contact_states[:, 0], expected)
    assert 0 in expected


@SLOW
def test_long_motion_with_an_implicit_solver():
    """A fine eps, a hundred periods of the force, and only the last states."""
    import diffrax

    problem, eps, f = PROBLEMS["papangelo_2017"], 1e-4, 0.17
    end = 100 / f
    given = fj.Excitation([0.7], f, 0.3)
    options = {"excitation": given, "regularisation": eps, "solver": diffrax.Kvaerno5()}
    found = fj.simulate(of_problem(problem), [1.5, 0.0], end, saveat=[end - 1 / f, end],
                        max_steps=1_000_000, rtol=1e-8, **options)  # fmt: skip
    exact = fj.limit_cycle(of_problem(problem), [1.5, 0.0], excitation=given)
    np.testing.assert_allclose(found.states[0], found.states[1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.end, exact.state, rtol=0, atol=2e-3)


@SLOW
@pytest.mark.parametrize("name", [TOGETHER, LIFT])
def test_motion(name):
    """Two joints, and one that opens."""
    problem, times = PROBLEMS[name], np.linspace(0, 20.0, 9)
    options = {"regularisation": 0.02, "rtol": 1e-11, "max_steps": 20_000}
    found = fj.simulate(of_problem(problem), problem["start"], 20.0, **options)
    truth = integrate(problem, 0.02, problem["start"], 20.0)
    np.testing.assert_allclose(found.at(times), truth.sol(times).T, rtol=0, atol=1e-6)
    if name == LIFT:
        pressed = 1.96 + 6.5 * np.asarray(found.states)[:, 0] > 0
        np.testing.assert_array_equal(np.asarray(found.contact_states)[:, 0] != 2, pressed)
        assert 0.1 < pressed.mean() < 0.9


@SLOW
@pytest.mark.parametrize("name", [TOGETHER, LIFT])
def test_cycle_is_one_of_the_field(name):
    """SciPy's motion from `state` is back after `period`; extremes and shares are its own."""
    problem, eps = PROBLEMS[name], 0.01
    found = cycle(name, eps)
    n, period = len(found.amplitude), float(found.period)
    truth = integrate(problem, eps, np.asarray(found.state), period)
    np.testing.assert_allclose(truth.y[:, -1], found.state, rtol=0, atol=1e-6)
    y = truth.sol(np.linspace(0, period, 40_001))
    np.testing.assert_allclose(found.amplitude, np.ptp(y[:n], axis=1), rtol=1e-5)
    np.testing.assert_allclose(found.velocity_max, y[n:].max(axis=1), rtol=1e-4, atol=1e-4)
    for j, joint in enumerate(problem["joints"]):
        w = joint["V"] - np.array(joint["tangential"]) @ y[n:]
        # A passage through w = 0 within one step is not counted as stick.
        missed = 1.5e-3 if name == LIFT else 3e-4
        assert -missed < found.stick_fraction[j] - (abs(w) < eps).mean() < 3e-4
        N = joint["P"] + joint.get("K_n", 0.0) * (np.array(joint.get("normal") or [0] * n) @ y[:n])
        assert found.open_fraction[j] == pytest.approx((N < 0).mean(), abs=3e-4)
        ends = [max(0, N.min()), N.max()]
        np.testing.assert_allclose(found.normal_force[j], ends, rtol=1e-5, atol=1e-6)


@SLOW
def test_cycle_converges_unless_a_spring_lets_go():
    """Period and amplitudes approach those of the exact law as eps falls by three each time."""
    row, off = ROWS[TOGETHER], []
    for eps in (0.03, 0.01, 0.003, 0.001):
        found = cycle(TOGETHER, eps)
        own = np.array([found.period, *found.amplitude])
        off.append(abs(own / [row["period"], *row["amplitude"]] - 1).max())
        assert float(found.regularisation_error) == pytest.approx(off[-1], rel=1e-6)
    assert (np.array(off[:-1]) / off[1:] > 2).all() and off[-1] < 0.02, off
    # Where a joint with K_t opens the regularised law jumps: no cycle of it is shown.
    found = cycle("four_dof", 0.003)
    assert found.result == fj.CycleResult.jumps and np.isnan(found.period)


@SLOW
def test_derivatives():
    """Of period and amplitudes by P and V, in both modes, by the slopes of SciPy's motion."""
    places, eps, problem = ["joints.0.P", "joints.1.P", "joints.0.V"], 0.01, PROBLEMS[TOGETHER]
    start = cycle(TOGETHER, eps).state
    values = np.array([1.0, 1.0, 0.15])

    def outputs(x):
        found = fj.limit_cycle(of_problem(changed(problem, places, x)), start, throw=False,
                               regularisation=eps, max_steps=20_000)  # fmt: skip
        return jnp.append(found.state, found.period)

    def gap(x, u):
        moved = changed(problem, places, x)
        return np.append(integrate(moved, eps, u[:-1], u[-1]).y[:, -1] - u[:-1], u[3])

    at = np.append(start, cycle(TOGETHER, eps).period)
    by_x, by_u = (
        np.stack([(function(step) - function(-step)) / 4e-4 for step in 2e-4 * np.eye(n)], axis=1)
        for n, function in ((3, lambda d: gap(values + d, at)), (7, lambda d: gap(values, at + d)))
    )
    expected = -np.linalg.solve(by_u, by_x)
    _, *slopes = jax.jit(lambda x: both_modes(outputs, x))(jnp.asarray(values))
    for slope in slopes:
        np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=1e-3 * abs(expected).max())
