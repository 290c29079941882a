"""What a limit cycle tells: orbit, switches, multipliers and spectrum, against `simulate`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.motion.cycle import repels
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


def monodromy_of(block, rate, rng):
    """A matrix (4, 4) that maps `rate` onto itself and has the other multipliers of `block`."""
    basis = np.column_stack([rate, rng.normal(size=(4, 3))])
    inner = np.eye(4)
    inner[1:, 1:] = block
    inner[0, 1:] = rng.normal(size=3)
    return basis @ inner @ np.linalg.inv(basis)


def blocks(largest):
    """Multipliers of that modulus: real, a pair, a double one without its eigenvectors, alone."""
    turn = largest * np.array([[np.cos(1), -np.sin(1)], [np.sin(1), np.cos(1)]])
    yield np.diag([largest, 0.5, -0.2])
    yield np.diag([-largest, 0.999, 0.0])
    yield np.block([[turn, np.ones((2, 1))], [np.zeros((1, 2)), np.full((1, 1), 0.7)]])
    yield np.array([[largest, 1.0, 0.0], [0.0, largest, 0.0], [0.0, 0.0, 0.1]])
    yield np.diag([largest, 0.0, 0.0])


@pytest.mark.parametrize("largest", [0.0, 0.3, 1 - 1e-6, 1 + 1e-6, 1.0009, 30.0])
def test_orbits_that_repel(largest):
    """Decided by the largest multiplier but the one of the motion itself, in a batch."""
    rng = np.random.default_rng(1)
    rates = rng.normal(size=(5, 4))
    pairs = zip(blocks(largest), rates, strict=True)
    matrices = np.array([monodromy_of(block, rate, rng) for block, rate in pairs])
    one = jax.jit(jax.vmap(repels, in_axes=(0, 0, None)))
    found = one(jnp.asarray(matrices), jnp.asarray(rates), 1e-9)
    expected = [largest > 1 or max(abs(np.linalg.eigvals(b))) > 1 for b in blocks(largest)]
    np.testing.assert_array_equal(found, expected)
    # What is within the error of the orbit is not said.
    assert not np.any(one(jnp.asarray(matrices), jnp.asarray(rates), 1e-2)) or largest > 1.1
