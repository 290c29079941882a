"""Static friction above the limit of sliding friction, and friction by a table.

Truth: the block on a belt in closed form; tests/hybrid_truth.py, which sticks where both stick and
slip agree with the state.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from hybrid_truth import Mechanism, simulate
from structures import of_problem
from tools import both_modes, refusals

M, N = 10.0, 98.1
NUMBERS = jnp.array([0.3, 0.2, 0.01, 4000.0])  # mu_s, mu_d, V, k
TABLE = {"speeds": (0.0, 0.05, 0.2, 0.5, 1.5), "coefficients": (0.42, 0.33, 0.27, 0.25, 0.29)}


class Jump(fj.Friction):
    """A user's law with a jump, constant below it."""

    mu_s: Any = fj.quantity("-", "static friction coefficient")
    mu_d: Any = fj.quantity("-", "friction coefficient of sliding")

    def mu(self, speed):
        return self.mu_d * jnp.ones_like(speed)


def block(law, V=0.01, k=4000.0) -> fj.Structure:
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=N), law, [1.0], V=V)
    return fj.Structure([[M]], None, [[k]], joint)


def closed_form(x):
    """Period, peak to peak and share of sticking of the undamped block.

    It slips from d = (mu_s - mu_d) N/k beyond the centre mu_d N/k, at V, to d before it.
    """
    mu_s, mu_d, V, k = x
    omega, d = jnp.sqrt(k / M), (mu_s - mu_d) * N / k
    stick = 2 * d / V
    period = stick + 2 * (jnp.pi - jnp.arctan(d * omega / V)) / omega
    return jnp.stack([period, 2 * jnp.hypot(d, V / omega), stick / period])


@jax.jit
def numerical(x):
    """The same of the cycle, in both modes, and the cycle."""

    def outputs(x):
        found = fj.limit_cycle(block(Jump(x[0], x[1]), x[2], x[3]), throw=False)
        numbers = [found.period, found.amplitude[0], found.stick_fraction[0]]
        return jnp.stack(numbers), found

    return both_modes(outputs, x, has_aux=True)


def test_block():
    """Period, peak to peak, share and their derivatives by mu_s, mu_d, V and k; multipliers."""
    value, forward, reverse, found = numerical(NUMBERS)
    truth, *slopes = both_modes(closed_form, NUMBERS)
    np.testing.assert_allclose(truth, [0.6676913710791836, 5.0059e-3, 0.73462], rtol=1e-5)
    np.testing.assert_allclose(value, truth, rtol=1e-11)
    for slope in (forward, reverse):
        np.testing.assert_allclose(slope, slopes[0], rtol=1e-8)
    assert found.result == fj.CycleResult.converged
    np.testing.assert_allclose(np.sort(abs(found.multipliers)), [0, 1], atol=1e-9)


@pytest.mark.slow
def test_coulomb_and_a_branch():
    """`Coulomb` with mu_s is the same law; its branch over V, at every point in closed form."""
    x = block(fj.Coulomb(0.2, mu_s=0.3))
    cycle = fj.limit_cycle(x)
    assert float(cycle.period) == pytest.approx(float(numerical(NUMBERS)[0][0]), rel=1e-11)
    branch = fj.continue_cycle(x, "V", (0.005, 0.02), cycle, step=1 / 8)
    truth = [closed_form(NUMBERS.at[2].set(V)) for V in branch.parameter]
    assert len(truth) > 5 and float(np.ptp(branch.parameter)) > 0.0149
    np.testing.assert_allclose(branch.period, [t[0] for t in truth], rtol=1e-8)
    np.testing.assert_allclose(branch.amplitude[:, 0], [t[1] for t in truth], rtol=1e-8)


def two_blocks(one, other):
    joints = [
        {"tangential": [1.0, 0.0], "V": 0.3, "P": 3.0, "friction": one},
        {"tangential": [0.0, 1.0], "V": 0.2, "P": 2.0, "friction": other},
    ]
    matrices = {"M": [[1.0, 0.0], [0.0, 1.2]], "C": [[0.02, 0.0], [0.0, 0.03]]}
    return matrices | {"K": [[3.0, -1.0], [-1.0, 2.5]], "F": [0.0, 0.0], "joints": joints}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("laws", "accuracy"),
    [
        ([("coulomb", {"mu": 0.3, "mu_s": 0.45}), ("coulomb", {"mu": 0.35, "mu_s": 0.5})], 1e-10),
        # A table has kinks in its curvature.
        ([("tabulated", TABLE | {"mu_s": 0.5}), ("tabulated", TABLE)], 1e-7),
    ],
)
def test_motion_of_two_blocks(laws, accuracy):
    """The same switches at the same times, and the same states."""
    problem, start = two_blocks(*laws), [0.5, 0.3, 0.0, 0.1]
    found = fj.simulate(of_problem(problem), start, 40.0)
    truth = simulate(Mechanism.of(problem), start, 40.0)
    switched = [
        (p.t1, i + 1, a, b)
        for p, q in itertools.pairwise(truth)
        for i, (a, b) in enumerate(zip(p.mode, q.mode, strict=True))
        if a != b
    ]
    own = found.switches()
    assert [s[1:] for s in own] == [s[1:] for s in switched] and len(own) > 10
    np.testing.assert_allclose([s[0] for s in own], [s[0] for s in switched], atol=accuracy)
    times = np.linspace(1.0, 39.0, 9)
    states = [next(p for p in truth if p.t0 <= t <= p.t1).dense(t) for t in times]
    np.testing.assert_allclose(found.at(times), states, rtol=0, atol=accuracy)


test_refusals = refusals(
    [
        (lambda: Jump(0.1, 0.2), r"^mu_s must be at least mu\(0\) = 0\.2, got 0\.1$"),
        (lambda: fj.Coulomb(0.2, mu_s=0.1), r"^mu_s must be at least mu = 0\.2, got 0\.1$"),
        (
            lambda: fj.simulate(block(Jump(0.3, 0.2)), [0.0, 0.0], 1.0, regularisation=1e-3),
            r"^friction of joint joint_1 must not have mu_s above mu\(0\) where it is regularised",
        ),
    ]
)
