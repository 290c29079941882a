"""Friction that falls within a small part of the belt's velocity, against SciPy's integrator.

A block on a belt, m x'' + c x' + k x = mu(V - x') P sgn(V - x'), by one slip: its limit cycle
begins where the spring overcomes mu_s P, and all motions that stick begin to slip there. Then the
brake, and two blocks, against the independent solver of `hybrid_truth`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fractaljax as fj
import hybrid_truth
from structures import of_problem
from tools import reference_scene

SEGMENTS = 512
SLOW = pytest.mark.slow


class Falling(fj.Friction):
    """A law of the user's own: logarithmic, without a value below -v_1."""

    mu_s: jax.Array = fj.quantity("-", "static friction coefficient")
    a: jax.Array = fj.quantity("-", "fall of friction with a speed e times as high")
    v_1: jax.Array = fj.quantity("m/s", "speed where friction begins to fall")

    def mu(self, speed):
        return self.mu_s - self.a * jnp.tanh(jnp.log1p(speed / self.v_1))


def law_and_truth(kind, mu_s, mu_d, v_0, viscous=0.0):
    """A law and, for SciPy, its coefficient at sliding speeds."""
    drop = mu_s - mu_d
    if kind == "hyperbolic":
        return fj.HyperbolicStribeck(mu_s, 1 / v_0), lambda w: mu_s / (1 + w / v_0)
    if kind == "cubic":
        return fj.Stribeck(
            mu_s, mu_d, v_0
        ), lambda w: mu_s + drop * w / v_0 * ((w / v_0) ** 2 - 3) / 2
    if kind == "own":
        law = Falling(*map(jnp.asarray, (mu_s, drop, v_0)))
        return law, lambda w: mu_s - drop * np.tanh(np.log1p(w / v_0))
    law = fj.ExponentialStribeck(mu_s, mu_d, v_0, viscous)
    return law, lambda w: mu_d + drop * np.exp(-w / v_0) + viscous * w


def block(law, m, k, c, P, V) -> fj.Structure:
    joint = fj.Joint(fj.FixedContact(k, 0.0, P=P), law, tangential=[1.0], V=V, preload=True)
    return fj.Structure(M=[[m]], C=[[c]], K=[[k]], joints=[joint])


def slip(mu, m, k, c, P, V):
    """Period and peak to peak of the cycle that sticks, if there is one and it slips forward."""
    omega, start = np.sqrt(k / m), (mu(0.0) * P - c * V) / k
    unit = V / omega

    def rate(_, y):
        w = V * max(1 - y[1], 0.0)
        return [y[1], mu(w) * P / (k * unit) - c * omega / k * y[1] - y[0]]

    def ends(t, y):
        return 1 - y[1] if t > begins else 1.0

    ends.terminal = True
    # The slip starts with w = 0 itself.
    begins = 1e-3 / (1 + abs(mu(1e-6 * V) - mu(0.0)) * 1e6 * P / (m * omega * V))
    options = {"rtol": 1e-12, "atol": 1e-12 * (1 + start / unit), "max_step": 0.2}
    found = solve_ivp(
        rate, (0, 200), [start / unit, 1.0], "DOP853", events=ends, first_step=1e-9, **options
    )
    if found.status != 1:
        return None
    length = found.t[-1] + (start / unit - found.y[0, -1])
    return length / omega, found.y[0].max() * unit


def check(kind, v_0, m=10.0, k=4000.0, c=2.0, P=98.1, V=0.01, mu_s=0.3, mu_d=0.2):
    """The cycle from its own slip, once more from rest, and what it obeys."""
    law, mu = law_and_truth(kind, mu_s, mu_d, v_0, 0.02 * c / P if kind == "viscous" else 0.0)
    truth = slip(mu, m, k, c, P, V)
    start = [(mu_s * P - c * V) / k * (1 - 1e-6), V]
    cycle = fj.limit_cycle(block(law, m, k, c, P, V), start, segments=SEGMENTS, throw=False)
    if truth is None:
        assert cycle.result == fj.CycleResult.equilibrium, (kind, v_0)
        return cycle
    assert cycle.result == fj.CycleResult.converged, (kind, v_0)
    assert float(cycle.period) == pytest.approx(truth[0], rel=1e-8)
    assert float(cycle.velocity_max[0]) == pytest.approx(V, rel=1e-9)
    return cycle


@pytest.mark.parametrize(("v_0", "period"), [(5e-4, 0.6688167), (1e-4, 0.6644141)])
def test_cycle(v_0, period):
    """Once called divergence, though friction is bounded and c > 0."""
    cycle = check("exponential", v_0)
    assert float(cycle.period) == pytest.approx(period, abs=5e-8)


@SLOW
@pytest.mark.parametrize("kind", ["exponential", "viscous", "hyperbolic", "cubic", "own"])
def test_laws(kind):
    """v_0/V from 1 to 1e-3, of blocks from grams to tons; a cubic falls over more than V."""
    rng = np.random.default_rng(7)
    cycles = 0
    for share in np.geomspace(1, 1e-3, 8):
        m, k, P = 10 ** rng.uniform([-1, 2, 0], [2, 7, 4])
        mu_s = rng.uniform(0.2, 0.8)
        c = 2 * 10 ** rng.uniform(-3, -1.5) * np.sqrt(k * m)
        V = 0.12 * mu_s * P / np.sqrt(k * m)
        v_0 = V * (1.5 + share if kind == "cubic" else share)
        found = check(kind, v_0, m, k, c, P, V, mu_s, 0.5 * mu_s)
        cycles += bool(found.result == fj.CycleResult.converged)
    assert cycles >= 4


@SLOW
def test_gradient():
    """By v_0, of a steep law: both modes against differences of SciPy's period."""
    v_0, given = 2e-4, (10.0, 4000.0, 2.0, 98.1, 0.01)

    def period(v_0):
        law = fj.ExponentialStribeck(0.3, 0.2, v_0)
        start = [(0.3 * 98.1 - 0.02) / 4000 * (1 - 1e-6), 0.01]
        return fj.limit_cycle(block(law, *given), start, segments=SEGMENTS, throw=False).period

    def truth(v_0):
        found = slip(law_and_truth("exponential", 0.3, 0.2, v_0)[1], *given)
        assert found is not None
        return found[0]

    steps = [truth(v_0 + d) - truth(v_0 - d) for d in (2e-6, 4e-6)]
    slope = (8 * steps[0] - steps[1]) / 6 / 4e-6
    for mode in (jax.jacfwd, jax.jacrev):
        assert float(jax.jit(mode(period))(v_0)) == pytest.approx(slope, rel=1e-5)


@SLOW
@pytest.mark.parametrize("share", [0.05, 0.01, 1e-3])
def test_brake(share):
    """The reference brake, two directions that rub, with a steep law: it stays near 22 um."""
    law = ("exponential", {"mu_s": 0.4, "mu_d": 0.35, "v_0": 0.15 * share})
    scene = reference_scene().replace(
        contact=fj.FixedContact(4e8, 2e8), friction=fj.ExponentialStribeck(**law[1])
    )
    cycle = fj.limit_cycle(scene, segments=SEGMENTS)
    problem = scene_problem(scene, law)
    mechanism = hybrid_truth.Mechanism.of(problem)
    z = np.asarray(cycle.state) / mechanism.units
    T = float(cycle.period) * mechanism.omega
    *_, last = hybrid_truth.phases(mechanism.scaled, z, 1e-12, T)
    np.testing.assert_allclose(last.end, z, rtol=0, atol=2e-8 * abs(z).max())
    assert 1e-5 < float(cycle.amplitude[0]) < 4e-5


def scene_problem(scene, law) -> dict:
    o, (K_n, K_t) = scene.oscillator, map(float, fj.stiffness(scene))
    m, F = float(o.m), float(o.F) / np.sqrt(2)
    pairs = [(o.omega_1, o.xi_1), (o.omega_2, o.xi_2)]
    joint = {"tangential": [1.0, 0.0], "normal": [0.0, 1.0], "preload": False, "V": float(o.V)}
    return {
        "M": np.diag([m, m]),
        "C": np.diag([2 * m * float(xi * omega) for omega, xi in pairs]),
        "K": np.diag([m * float(omega) ** 2 for omega, _ in pairs]),
        "F": [F, -F],
        "joints": [joint | {"K_n": K_n, "K_t": K_t, "friction": law}],
    }


@SLOW
@pytest.mark.parametrize("share", [0.3, 0.03])
def test_two_blocks(share):
    """On two belts, coupled by a spring, with laws of different steepness."""
    joints = [
        {"tangential": [1.0, 0.0], "V": 0.05, "P": 60.0},
        {"tangential": [0.0, 1.0], "V": 0.05, "P": 80.0},
    ]
    for joint, factor in zip(joints, (1.0, 2.0), strict=True):
        numbers = {"mu_s": 0.4, "mu_d": 0.25, "v_0": factor * share * joint["V"]}
        joint["friction"] = ("exponential", numbers)
    problem = {
        "M": np.diag([1.0, 1.5]),
        "C": np.array([[3.0, -1.0], [-1.0, 3.0]]),
        "K": np.array([[1500.0, -500.0], [-500.0, 2500.0]]),
        "F": [0.0, 0.0],
        "joints": joints,
    }
    start = [0.02, 0.016, 0.05, 0.05]
    cycle = fj.limit_cycle(of_problem(problem), start, segments=SEGMENTS, max_returns=300)
    mechanism = hybrid_truth.Mechanism.of(problem)
    z = np.asarray(cycle.state) / mechanism.units
    *_, last = hybrid_truth.phases(
        mechanism.scaled, z, 1e-12, float(cycle.period) * mechanism.omega
    )
    np.testing.assert_allclose(last.end, z, rtol=0, atol=2e-8 * abs(z).max())


@SLOW
def test_basin_and_branch():
    """No start of the block diverges; its cycles are one branch over v_0, right at both ends."""
    law, _ = law_and_truth("exponential", 0.3, 0.2, 1e-4)
    given = (10.0, 4000.0, 2.0, 98.1, 0.01)
    found = fj.basin(block(law, *given), [-0.02, -0.05], [0.02, 0.05], 200, progress=False)
    assert found.shares["cycle 1"] > 0.9 and found.shares["equilibrium"] < 0.1
    assert found.shares["diverges"] == found.shares["undecided"] == 0
    branch = fj.continue_cycle(block(law, *given), "v_0", (5e-5, 1e-3), found.cycles[0])
    for value, period in zip(branch.parameter[::8], branch.period[::8], strict=True):
        truth = slip(law_and_truth("exponential", 0.3, 0.2, value)[1], *given)
        assert truth is not None and period == pytest.approx(truth[0], rel=1e-7)
