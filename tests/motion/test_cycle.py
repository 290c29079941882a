"""What a limit cycle tells: orbit, switches, multipliers and spectrum, against `simulate`."""

import jax
import numpy as np
import pytest

import fractaljax as fj
from tools import reference_cycle, reference_scene


def test_printed_it_shows_its_numbers_and_not_the_orbit():
    shown = repr(reference_cycle())
    assert shown.startswith("LimitCycle(period=0.000323") and "a limit cycle was found" in shown
    assert "_system" not in shown and len(shown) < 1000


def test_one_period_of_the_simulated_motion_returns():
    """The orbit is the one that `simulate`, which searches its events, runs through."""
    scene, cycle = reference_scene(), reference_cycle()
    times, states = cycle.orbit(64)
    run = fj.simulate(scene, cycle.state, 1.5 * float(cycle.period))
    states, scale = np.asarray(states), np.abs(states).max(axis=0)
    np.testing.assert_allclose(np.asarray(run.at(times)) / scale, states / scale, atol=1e-10)
    again = run.at(np.array([float(cycle.period)]))[0]
    np.testing.assert_allclose(again / scale, cycle.state / scale, atol=1e-9)
    switched = [(t, i) for t, i, _, _ in run.switches() if t < cycle.period]
    assert [i for _, i in switched] == [s.direction for s in cycle.switches()]
    np.testing.assert_allclose(
        [t for t, _ in switched], [s.time for s in cycle.switches()], rtol=1e-9
    )


def test_multipliers_are_those_of_the_return_map():
    """The nontrivial ones against differences of a simulated period; the trivial one is 1."""
    scene, cycle = reference_scene(), reference_cycle()

    def end(state):
        return fj.simulate(scene, state, cycle.period).end

    values = np.linalg.eigvals(np.asarray(jax.jacfwd(end)(cycle.state)))
    order = np.argsort(-np.abs(values))
    np.testing.assert_allclose(cycle.multipliers[:3], values[order][:3], atol=1e-8)
    assert abs(cycle.multipliers[0] - 1) < 1e-9
    assert abs(cycle.multipliers[3]) < 1e-9  # sticking forgets one direction of four


def test_spectrum_rebuilds_the_orbit():
    """Harmonics at multiples of 1/period, with the variance of the orbit."""
    cycle = reference_cycle()
    frequencies, lines = cycle.spectrum(256)
    np.testing.assert_allclose(frequencies, np.arange(1, 129) * cycle.frequency, rtol=1e-12)
    _, states = cycle.orbit(256)
    variance = np.asarray(states[:, :2]).var(axis=0)
    np.testing.assert_allclose((np.asarray(lines) ** 2).sum(axis=0) / 2, variance, rtol=1e-8)


def test_switches_are_those_of_one_cycle():
    """A batch is to be indexed first."""
    many = jax.tree.map(lambda x: x[None], reference_cycle())
    with pytest.raises(ValueError, match="needs one cycle, outside of jit: index the batch first"):
        many.switches()
