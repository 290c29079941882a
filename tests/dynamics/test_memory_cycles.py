"""Cycles of friction with memory, forced or not, against SciPy on equations written here."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fractaljax as fj
from tools import both_modes

SLOW = pytest.mark.slow
TIGHT: Any = {"rtol": 1e-11, "atol": 1e-13}


def damper(law, r=0.8, c=0.1, K_t=0.0, V=0.0) -> tuple[fj.Structure, fj.Excitation]:
    """x'' + c x' + x = cos(r t) - friction under a load of 1 N, on a belt or on none."""
    joint = fj.Joint(fj.FixedContact(1.0, K_t, P=1.0), law, [1.0], V=V)
    excitation = fj.Excitation([1.0], frequency=r / 2 / np.pi)
    return fj.Structure([[1.0]], jnp.reshape(c, (1, 1)), [[1.0]], joint), excitation


def elastoplastic_peaks(K_t, limit, c, r, V, periods=160) -> float:
    """Peak to peak of the last period with a spring K_t and a slider: an event at each change.

    f is the force of the spring, f' = K_t (V - x') up to |f| = limit.
    """
    stop = periods * 2 * np.pi / r
    t, y, sign = 0.0, np.zeros(3), 0
    peaks = []

    def field(t, y):
        w = V - y[1]
        sticks = K_t * w if sign == 0 else 0.0
        return [y[1], np.cos(r * t) - y[0] - c * y[1] + y[2], sticks]

    def leaves(t, y):
        return limit - abs(y[2]) if sign == 0 else sign * (V - y[1])

    leaves.terminal, leaves.direction = True, -1
    while t < stop * (1 - 1e-14):
        found = solve_ivp(field, (t, stop), y, "DOP853", events=leaves, dense_output=True, **TIGHT)
        last = stop - 2 * np.pi / r
        if found.t[-1] > last:
            times = np.linspace(max(found.t[0], last), found.t[-1], 20_001)
            peaks.append(found.sol(times)[0])
        t, y = found.t[-1], found.y[:, -1]
        if t < stop:
            sign = int(np.sign(y[2])) if sign == 0 else 0
            y[2] = np.clip(y[2], -limit, limit) * (1 - 1e-13 * (sign == 0))
    return float(np.ptp(np.concatenate(peaks)))


@pytest.mark.parametrize(
    ("K_t", "limit", "c", "r", "V"),
    [
        (5.0, 0.2, 0.1, 0.8, 0.0),
        pytest.param(5.0, 0.2, 0.01, 0.8, 0.0, marks=SLOW),
        pytest.param(0.5, 0.3, 0.02, 1.1, 0.0, marks=SLOW),
        pytest.param(5.0, 0.2, 0.1, 0.8, 0.01, marks=SLOW),
        pytest.param(5.0, 0.2, 0.1, 0.8, 1.0, marks=SLOW),
    ],
)
def test_forced_spring_and_slider(K_t, limit, c, r, V):
    """`Jenkins` without a belt, and on slow and fast ones."""
    x, excitation = damper(fj.Jenkins(limit), r, c, K_t, V)
    found = fj.limit_cycle(x, excitation=excitation)
    assert found.returns == 1 and found.error <= 1e-7
    np.testing.assert_allclose(found.period, 2 * np.pi / r, rtol=1e-14)
    # The slider yields within a thousandth of 1/omega, the square of which is left.
    truth = elastoplastic_peaks(K_t, limit, c, r, V)
    np.testing.assert_allclose(found.amplitude[0], truth, rtol=3e-6)


FORCED = {
    "dahl": (fj.Dahl(0.2, 25.0), 0.0),
    "dahl, belt": (fj.Dahl(0.2, 25.0), 0.1),
    "lugre": (fj.LuGre(0.25, 0.2, 0.1, 100.0, 1.0), 0.0),
    "lugre, belt": (fj.LuGre(0.25, 0.2, 0.1, 100.0, 1.0), 1.0),
}


def bristles(law, w, z) -> tuple[float, float]:
    """The force under 1 N, and dz/dt."""
    if isinstance(law, fj.Dahl):
        rate = w - law.sigma_0 * abs(w) / law.mu_s * z
        return float(law.sigma_0 * z), float(rate)
    fall = np.exp(-abs(w) / law.v_0)
    rate = w - law.sigma_0 * abs(w) * z / (law.mu_d + (law.mu_s - law.mu_d) * fall)
    return float(law.sigma_0 * z + law.sigma_1 * rate), float(rate)


@SLOW
@pytest.mark.parametrize("name", FORCED)
def test_forced_bristles(name):
    """SciPy's motion from the state of the cycle is back after a period, with its extremes."""
    law, V = FORCED[name]
    x, excitation = damper(law, V=V)
    found = fj.limit_cycle(x, excitation=excitation)
    assert found.returns == 1

    def field(t, y):
        force, rate = bristles(law, V - y[1], y[2])
        return [y[1], np.cos(0.8 * t) - y[0] - 0.1 * y[1] + force, rate]

    start = [*map(float, found.state), *np.asarray(found.internal)[:1]]
    period = float(found.period)
    motion = solve_ivp(field, (0, period), start, "Radau", dense_output=True, **TIGHT)
    np.testing.assert_allclose(motion.y[:, -1], start, rtol=0, atol=1e-7)
    extremes: Any = motion.sol(np.linspace(0, period, 40_001))
    np.testing.assert_allclose(found.amplitude[0], np.ptp(extremes[0]), rtol=1e-6)


def two_masses(sigma_0=1e4, V=0.1) -> fj.Structure:
    law = fj.LuGre(0.4, 0.2, 0.1, sigma_0, 3.0)
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=10.0), law, [1.0, 0.0], V=V)
    K = [[150.0, -50.0], [-50.0, 60.0]]
    return fj.Structure(np.diag([1.0, 0.5]), 0.2 * np.eye(2), K, joint)


@SLOW
def test_two_degrees_of_freedom():
    """One return a period, which is SciPy's; too few steps are said to be too few."""
    found = fj.limit_cycle(two_masses())
    assert found.returns == 1
    law = fj.LuGre(0.4, 0.2, 0.1, 1e4, 3.0)

    def field(t, y):
        force, rate = bristles(law, 0.1 - y[2], y[4])
        a_1 = -150 * y[0] + 50 * y[1] - 0.2 * y[2] + 10 * force
        return [y[2], y[3], a_1, (50 * y[0] - 60 * y[1] - 0.2 * y[3]) / 0.5, rate]

    start = np.array([*map(float, found.state), *np.asarray(found.internal)[:1]])
    period = float(found.period)
    motion = solve_ivp(field, (0, period), start, "Radau", dense_output=True, **TIGHT)
    np.testing.assert_allclose(motion.y[:, -1], start, rtol=0, atol=1e-8)
    extremes: Any = motion.sol(np.linspace(0, period, 40_001))
    np.testing.assert_allclose(found.amplitude, np.ptp(extremes[:2], axis=1), rtol=1e-6)
    few = fj.limit_cycle(two_masses(), max_steps=100, throw=False)
    assert few.result == fj.CycleResult.too_stiff and np.isnan(few.period)


@SLOW
def test_derivatives_of_a_forced_cycle():
    """The amplitude by limit, K_t, c and r, in both modes, against differences."""
    place = np.array([0.2, 5.0, 0.1, 0.8])

    @jax.jit
    def amplitude(x):
        mechanism, excitation = damper(fj.Jenkins(x[0]), x[3], x[2], x[1])
        return fj.limit_cycle(mechanism, excitation=excitation, throw=False).amplitude

    _, forward, reverse = jax.jit(lambda x: both_modes(amplitude, x))(place)
    np.testing.assert_allclose(forward, reverse, rtol=1e-6)
    for i, h in enumerate(1e-3 * place):
        ends = [float(amplitude(place + k * h * np.eye(4)[i])[0]) for k in (-2, -1, 1, 2)]
        slope = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * h)
        np.testing.assert_allclose(forward[0, i], slope, rtol=1e-3)
