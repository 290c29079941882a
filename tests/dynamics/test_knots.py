"""Friction laws that are not smooth at some speeds: tables, and a user's law with a kink.

Truth: SciPy's DOP853, restarted where the block sticks and at every knot. Each piece of a law is
continued beyond its ends there.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator

import fractaljax as fj
from tools import both_modes

M, K, N = 10.0, 4000.0, 98.1
SPEEDS = np.array([0.0, 0.005, 0.01, 0.02, 0.05, 0.1])
FALLING = np.array([0.30, 0.28, 0.265, 0.25, 0.23, 0.22])
SHORT = np.array([0.0, 0.005, 0.01, 0.02, 0.04, 0.06])  # the block slides faster


class Bent(fj.Friction):
    """A user's law with a kink."""

    mu_0: Any = fj.quantity("-", "friction coefficient up to v_1")
    v_1: Any = fj.quantity("m/s", "speed from which on it falls")

    @property
    def knots(self):
        return jnp.stack([self.v_1])

    def mu(self, speed):
        return self.mu_0 / (1 + jnp.maximum(speed / self.v_1 - 1, 0))


def block(law, V, c) -> fj.Structure:
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=N), law, [1.0], V=V)
    return fj.Structure([[M]], jnp.reshape(jnp.asarray(c), (1, 1)), [[K]], joint)


def pieces_of(speeds, coefficients):
    """The cubics of a table and its constant end."""
    cubic = PchipInterpolator(speeds, coefficients)
    inner = [lambda v, a=cubic.c[:, k], at=speeds[k]: np.polyval(a, v - at) for k in range(5)]
    return [*inner, lambda v: coefficients[-1]]


def event(of, direction, terminal=True):
    of.direction, of.terminal = direction, terminal
    return of


def slide(pieces, knots, start, V, c, end=10.0):
    """Time, displacement and velocity where the block sticks or at the end, and its turns."""
    t, state, turns = 0.0, np.array(start), []
    k = int(np.searchsorted(knots, V - state[1], "right")) - 1
    while True:

        def rate(_, y, mu=pieces[k]):
            return [y[1], (mu(V - y[1]) * N - c * y[1] - K * y[0]) / M]

        events = [
            event(lambda _, y: y[1], 0, terminal=False),
            event(lambda _, y, low=knots[k]: V - y[1] - low, -1),
        ]
        if k + 1 < len(knots):
            events.append(event(lambda _, y, high=knots[k + 1]: V - y[1] - high, 1))
        found = solve_ivp(rate, (t, end), state, "DOP853", events=events, rtol=1e-13, atol=1e-16)
        turns += [y[0] for y in found.y_events[0]]
        t, state = found.t[-1], found.y[:, -1]
        down = len(found.t_events[1]) > 0
        if found.status == 0 or (down and k == 0):
            return t, *state, turns
        k += -1 if down else 1


def cycle_truth(pieces, knots, mu_s, V, c):
    """Period and peak to peak of the block, which sticks once in it."""
    release = (mu_s * N - c * V) / K
    t, x, _, turns = slide(pieces, knots, [release, V], V, c)
    return np.array([t + (release - x) / V, max(turns) - min(turns)])


def differences(function, x):
    """Derivatives of a function of x (k,), of the fourth order."""
    columns = []
    for step in np.diag(1e-4 * x):
        a, b = (function(x + d * step) - function(x - d * step) for d in (1, 2))
        columns.append((8 * a - b) / (12 * step.sum()))
    return np.stack(columns, axis=-1)


def test_cycles_of_tables():
    """Converged by default, and no farther from the truth than the stated error."""
    random = np.random.default_rng(5)
    cases = [(SPEEDS, FALLING, 0.33, V, c) for V in (0.0101, 0.03) for c in (0.0, 5.0)]
    for _ in range(4):
        # Of points much closer together the cubics are so steep that they take more meshes.
        speeds = 0.02 * (np.arange(6) + np.append(0, random.uniform(-0.4, 0.4, 5)))
        coefficients = np.sort(random.uniform(0.2, 0.4, 6))[::-1]
        V = random.uniform(0.01, 0.03)
        cases.append((speeds, coefficients, 1.1 * coefficients[0], V, 3.0))
    for speeds, coefficients, mu_s, V, c in cases:
        law = fj.TabulatedFriction(speeds, coefficients, mu_s=mu_s)
        found = fj.limit_cycle(block(law, V, c))
        truth, _ = cycle_truth(pieces_of(speeds, coefficients), speeds, mu_s, V, c)
        assert abs(float(found.period) / truth - 1) <= float(found.error) + 1e-12 < 1.1e-9


@jax.jit
def of_table(x):
    """Period and peak to peak by the speeds, the coefficients, mu_s and V, in both modes."""

    def outputs(x):
        speeds = jnp.append(0.0, x[:5])
        law = fj.TabulatedFriction(speeds, x[5:11], mu_s=x[11])
        found = fj.limit_cycle(block(law, x[12], 5.0), throw=False)
        return jnp.stack([found.period, found.amplitude[0]])

    return both_modes(outputs, x)


def table_truth(x):
    speeds = np.append(0, x[:5])
    return cycle_truth(pieces_of(speeds, x[5:11]), speeds, x[11], x[12], 5.0)


@pytest.mark.slow
def test_derivatives_of_a_table():
    """By every entry, also where the block slides faster than the last speed, at a kink."""
    x = np.concatenate([SHORT[1:], FALLING, [0.33, 0.029]])
    value, *slopes = of_table(x)
    np.testing.assert_allclose(value, table_truth(x), rtol=1e-9)
    truth = differences(table_truth, x)
    for slope in slopes:
        np.testing.assert_allclose(slope, truth, rtol=1e-6, atol=1e-8)


@jax.jit
def of_bent(x):
    """Period and peak to peak of a law with a kink by mu_0, v_1 and V, in both modes."""

    def outputs(x):
        scene = block(Bent(x[0], x[1]), x[2], 1.0)
        found = fj.limit_cycle(scene, segments=128, throw=False)
        return jnp.stack([found.period, found.amplitude[0]]), found

    return both_modes(outputs, x, has_aux=True)


def bent_truth(x):
    mu_0, v_1, V = x
    return cycle_truth([lambda v: mu_0, lambda v: mu_0 * v_1 / v], [0.0, v_1], mu_0, V, 1.0)


@pytest.mark.slow
def test_a_kink_of_a_user():
    """The kink of a user's law: values and derivatives of its cycle."""
    x = np.array([0.3, 0.02, 0.03])
    value, *slopes, found = of_bent(x)
    assert found.result == fj.CycleResult.converged
    np.testing.assert_allclose(value, bent_truth(x), rtol=1e-9)
    truth = differences(bent_truth, x)
    for slope in slopes:
        np.testing.assert_allclose(slope, truth, rtol=1e-6)


def test_motion():
    """The state at a time, to rtol, and its derivatives by the coefficients."""
    start, end = [0.001, -0.12], 0.05

    def truth(coefficients):
        *_, x, v, _ = slide(pieces_of(SHORT, coefficients), SHORT, start, 0.03, 5.0, end)
        return np.array([x, v])

    @jax.jit
    def both(coefficients):
        def motion(coefficients):
            law = fj.TabulatedFriction(SHORT, coefficients)
            found = fj.simulate(block(law, 0.03, 5.0), start, end, throw=False, max_steps=64)
            return found.end, found

        return both_modes(motion, coefficients, has_aux=True)

    value, *slopes, found = both(FALLING)
    assert found.result == fj.SimulationResult.reached
    np.testing.assert_allclose(value, truth(FALLING), rtol=1e-9)
    slopes_of_truth = differences(truth, FALLING)
    size = abs(slopes_of_truth).max(axis=1, keepdims=True)
    for slope in slopes:
        np.testing.assert_allclose(slope / size, slopes_of_truth / size, atol=1e-7)
    # Its steps end where it slides at a speed of the table.
    w = 0.03 - np.asarray(found.states)[:, 1]
    passed = SHORT[(w.min() < SHORT) & (w.max() > SHORT)]
    assert len(passed) >= 2
    for knot in passed:
        assert abs(w - knot).min() < 1e-9


@pytest.mark.slow
def test_many_cycles_of_tables():
    """Side by side under `vmap`, and in a sweep, with the mesh of each at its own knots."""

    law = fj.TabulatedFriction(SPEEDS, FALLING, 0.33)

    def cycle(V) -> fj.LimitCycle:
        return fj.limit_cycle(block(law, V, 5.0), throw=False)

    velocities = np.array([0.01, 0.02, 0.04])
    together = jax.jit(jax.vmap(cycle))(velocities)
    swept = fj.sweep(lambda x: fj.limit_cycle(x, throw=False).period, block(law, 0.02, 5.0),
                     V=velocities, progress=False)  # fmt: skip
    for i, V in enumerate(velocities):
        alone = cycle(V)
        assert alone.result == fj.CycleResult.converged
        np.testing.assert_allclose(together.period[i], alone.period, rtol=1e-9)
        np.testing.assert_allclose(together.amplitude[i], alone.amplitude, rtol=1e-8)
        np.testing.assert_allclose(swept.values[i], alone.period, rtol=1e-9)
