"""Derivatives of limit cycles of random mechanisms, against differences of the independent solver.

Three degrees of freedom and one joint with oblique lever arms, which sticks, lifts off and rubs
along its normal. Each direction of the derivative changes every number of the mechanism.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
import hybrid_truth
from structures import of_problem
from tools import both_modes

TANGENTIAL, NORMAL = [1.0, 0.0, -0.4], [0.3, 1.0, 0.0]
SEEDS = 0, 1, 2, 3, 10, 11  # 1, 3 and 10 lift off
STEPS = 1e-3, 5e-4


def numbers(seed) -> dict:
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((2, 3, 3))
    M = np.diag(rng.uniform(0.5, 1.5, 3)) + 0.05 * A @ A.T
    K = np.diag(rng.uniform(0.5, 3.0, 3)) + 0.15 * B @ B.T
    mu = rng.uniform(0.3, 1.0)
    return {
        "M": M,
        "C": rng.uniform(0, 0.06) * M + rng.uniform(0, 0.04) * K,
        "K": K,
        "F": 0.5 * rng.standard_normal(3),
        "P": rng.uniform(0.5, 5.0),
        "V": rng.uniform(0.1, 1.0),
        "K_n": rng.uniform(0.5, 6.0),
        "K_t": rng.uniform(0.1, 1.0),
        "mu_s": mu,
        "mu_d": mu * rng.uniform(0.3, 0.8),
        "v_0": rng.uniform(0.1, 0.8),
    }


def directions(given, seed) -> dict:
    """Two for each number (2, ...), symmetric for matrices."""
    rng = np.random.default_rng([seed, 1])

    def of(value):
        d = rng.standard_normal((2, *np.shape(value))) * np.abs(value).max()
        return 0.3 * (d + np.swapaxes(d, 1, 2) if np.ndim(value) == 2 else d)

    return {name: of(value) for name, value in given.items()}


def problem(given) -> dict:
    """As both solvers take it."""
    joint = {name: given[name] for name in ("P", "V", "K_n", "K_t")}
    law = {name: given[name] for name in ("mu_s", "mu_d", "v_0")}
    joint |= {"tangential": TANGENTIAL, "normal": NORMAL, "preload": True}
    joint["friction"] = "exponential", law
    return {"joints": [joint], **{name: given[name] for name in "MCKF"}}


@jax.jit
def derivatives(given, by, start):
    """Outputs, their derivatives (k, 2) in both modes, and the cycle."""

    def outputs(theta):
        at = {name: given[name] + jnp.tensordot(theta, by[name], 1) for name in given}
        structure = of_problem(problem(at))
        found = fj.limit_cycle(structure, start, segments=128, max_returns=1500, throw=False)
        shares = found.stick_fraction, found.open_fraction
        extremes = found.amplitude, found.velocity_min, found.velocity_max
        row = jnp.concatenate([found.period[None], *extremes, *shares, found.normal_force[0]])
        return row, found

    return both_modes(outputs, jnp.zeros(2), has_aux=True)


def truth(given, state, period, flow) -> tuple[np.ndarray, list]:
    """The same outputs, and the modes passed through."""
    mechanism = hybrid_truth.Mechanism.of(problem(given))
    core, unit = mechanism.scaled, mechanism.units
    z, T = hybrid_truth.close(core, state / unit, period * mechanism.omega, 1e-13, flow)
    trip = list(hybrid_truth.phases(core, z, 1e-13, T))
    rows = np.eye(7)[1:]
    low, high = np.array([hybrid_truth.spread(trip, row) for row in rows]).T * unit
    stick, _, opened = hybrid_truth.shares(core, trip) / T
    forces = np.maximum(hybrid_truth.spread(trip, core.normal(0)), 0) * mechanism.omega * unit[-1]
    row = [[T / mechanism.omega], (high - low)[:3], low[3:], high[3:], stick, opened, forces]
    return np.concatenate(row), [p.mode for p in trip]


@pytest.mark.slow
def test_derivatives():
    """One test for all seeds: a worker of its own for each would compile the same again."""
    for seed in SEEDS:
        assert_derivatives(seed)


def assert_derivatives(seed):
    given = numbers(seed)
    by = directions(given, seed)
    start = np.random.default_rng([seed, 2]).standard_normal(6)
    row, forward, reverse, found = derivatives(given, by, start)
    assert found.result == fj.CycleResult.converged
    state, period = np.asarray(found.state), float(found.period)
    flow = np.asarray(found._monodromy)
    value, modes = truth(given, state, period, flow)
    # Velocities, lengths and forces by the largest of their kind; shares by 1.
    ends = np.cumsum([1, 3, 6, 2, 2])[:-1]
    sizes = [np.full(len(part), abs(part).max()) for part in np.split(value, ends)]
    sizes[3][:] = 1
    size = np.concatenate(sizes)
    np.testing.assert_allclose(row / size, value / size, rtol=0, atol=1e-9)
    for k in range(2):
        slopes = []
        for h in STEPS:
            ends = []
            for sign in (1, -1):
                at = {name: given[name] + sign * h * by[name][k] for name in given}
                shifted, passed = truth(at, state, period, flow)
                assert passed == modes
                ends.append(shifted)
            slopes.append((ends[0] - ends[1]) / (2 * h))
        expected = (4 * slopes[1] - slopes[0]) / 3
        scale = 1e-6 * (abs(expected) + size)
        assert (abs(forward[:, k] - expected) < scale).all()
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-9 * abs(forward).max())
