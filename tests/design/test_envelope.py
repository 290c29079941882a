"""Ranges and samples: what they mean, where they are looked at, what is refused."""

import itertools
import math
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.envelope import condition_text
from tools import refusals


def test_ranges_and_samples_and_their_words():
    """Tuples, lists and arrays; an Envelope says the same in so many words."""
    mapped = fj.Envelope.of(
        {"P": [1500, 2500], "mu_s": jnp.array([0.3, 0.4, 0.5]), "mu_m": (0.2, 0.25, 0.3)}
    )
    said = fj.Envelope({"P": (1500.0, 2500.0)}, {"mu_s": (0.3, 0.4, 0.5), "mu_m": (0.2, 0.25, 0.3)})
    assert mapped == said and fj.Envelope.of(said) is said
    assert mapped.names == ("P", "mu_s", "mu_m") and mapped.sample_count == 3
    assert str(mapped) == "P 1500 to 2500, 3 samples of mu_s, mu_m"
    # Every condition holds one measured pair, at a load anywhere in its range.
    pairs = [(0.3, 0.2), (0.4, 0.25)]
    mu_s, mu_m = zip(*pairs, strict=True)
    envelope = fj.Envelope({"P": (1500, 2500)}, {"mu_s": mu_s, "mu_m": mu_m})
    values = envelope.values(envelope.grid())
    assert {tuple(row) for row in values[:, 1:].tolist()} == set(pairs)
    for pair in pairs:
        loads = values[(values[:, 1:] == pair).all(axis=1), 0]
        assert loads.min() == 1500 and loads.max() == 2500 and len(np.unique(loads)) == len(loads)
    # As results print them.
    envelope = fj.Envelope({"P": (1500.0, 2500.0)}, {"mu_s": (0.3, 0.5)})
    condition = envelope.condition(np.array([1.0, 0.25]))
    assert condition == {"P": 1750.0, "mu_s": 0.5}
    assert condition_text(condition) == "P = 1750, mu_s = 0.5"


@pytest.mark.parametrize("count", range(1, 7))
def test_grid_has_every_corner_and_points_inside(count):
    """Every corner of up to six ranges; the likely ones are few and of the grid's kind."""
    names = ("P", "F", "V", "xi_1", "xi_2", "m")[:count]
    envelope = fj.Envelope({name: (1.0, 2.0) for name in names})
    for places in (envelope.grid(), envelope.coarse_grid()):
        rows = {tuple(row) for row in envelope.values(places).tolist()}
        assert rows >= set(itertools.product((1.0, 2.0), repeat=count))
    inside = envelope.values(envelope.grid())
    assert ((inside > 1) & (inside < 2)).all(axis=1).any() and len(inside) < 800
    likely = envelope.values(envelope.likely(8))
    assert 2 < len(likely) <= 8 and [1.5] * count in likely.tolist()


def test_wide_ranges_are_searched_in_logarithms():
    """More than a decade: the middle is the geometric mean."""
    envelope = fj.Envelope({"xi_1": (1e-4, 1e-2), "P": (1000.0, 3000.0)})
    middle = np.array([[0, 0.5, 0.5]])
    np.testing.assert_allclose(envelope.values(middle), [[1e-3, 2000]])


def test_draws_and_cells_are_uniform():
    """Inside the ranges, every sample as often as any other, and by seed."""
    envelope = fj.Envelope({"P": (1000.0, 3000.0)}, {"mu_s": (0.3, 0.4, 0.5)})
    drawn = envelope.values(envelope.drawn(30000, seed=1))
    assert drawn[:, 0].mean() == pytest.approx(2000, rel=0.01)
    counts = [np.sum(drawn[:, 1] == mu) for mu in (0.3, 0.4, 0.5)]
    np.testing.assert_allclose(counts, 10000, rtol=0.05)
    np.testing.assert_array_equal(drawn, envelope.values(envelope.drawn(30000, seed=1)))
    # The mean over the cells is the mean over the range.
    envelope = fj.Envelope({"P": (1000.0, 3000.0), "F": (2.0, 4.0)})
    np.testing.assert_allclose(envelope.values(envelope.cells()).mean(axis=0), [2000, 3])


def test_climb_finds_a_maximum_between_the_points():
    """Two problems at once: a ridge inside, and one that rises to a corner."""
    envelope = fj.Envelope({"P": (0.0, 1.0), "F": (0.0, 1.0)})

    def height(places, i):
        x, y = places[:, 1], places[:, 2]
        ridge = -((x - 0.333) ** 2) - 3 * (y - 0.777) ** 2
        return np.where(i == 0, ridge, x - y)

    grid = envelope.grid()
    starts = np.stack([grid[height(grid, np.full(len(grid), i)).argmax()] for i in (0, 1)])
    places, values = envelope.climb(height, starts, height(starts, np.arange(2)))
    np.testing.assert_allclose(places[0, 1:], [0.333, 0.777], atol=3e-3)
    np.testing.assert_array_equal(places[1, 1:], [1, 0])
    assert values[0] > -2e-5
    np.testing.assert_array_equal(values, height(places, np.arange(2)))
    # Without ranges the places stay.
    envelope = fj.Envelope(samples={"P": (1.0, 2.0, 3.0)})
    places = envelope.grid()
    np.testing.assert_array_equal(envelope.values(places)[:, 0], [1, 2, 3])
    assert envelope.climb(lambda *_: 1 / 0, places, np.zeros(3))[0] is places


test_refusals = refusals(
    [
        (lambda: fj.Envelope.of({}), "must name at least one range or sample, got none"),
        (lambda: fj.Envelope.of({"P": (2.0, 1.0)}), "of P must be (lower, upper), got (2, 1)"),
        (lambda: fj.Envelope.of({"P": (2.0, 2.0)}), "of P must be (lower, upper), got (2, 2)"),
        (lambda: fj.Envelope.of({"P": (1.0,)}), "of P must be a range or samples, got (1)"),
        (lambda: fj.Envelope.of({"P": ()}), "of P must be a range or samples, got ()"),
        (lambda: fj.Envelope.of({"P": 3.0}), "of P must be a range or samples, got 3.0"),
        (lambda: fj.Envelope.of({"P": "12"}), "of P must be a range or samples, got '12'"),
        (lambda: fj.Envelope.of({"P": (1.0, math.nan)}), "of P must be finite, got nan"),
        (lambda: fj.Envelope.of({"P": (1.0, "two")}), "of P must be a number, got 'two'"),
        (lambda: fj.Envelope.of(cast(Any, 5)), "envelope must be a mapping or an Envelope, got 5"),
        (
            lambda: fj.Envelope.of({"P": (1.0, 2.0, 3.0), "F": (1.0, 2.0, 3.0, 4.0)}),
            "must be equally many, got 3 of P, 4 of F",
        ),
        (
            lambda: fj.Envelope({"P": (1.0, 2.0)}, {"P": (1.0, 2.0)}),
            "both a range and samples of P",
        ),
        (lambda: fj.Envelope({c: (1.0, 2.0) for c in "abcdefg"}), "at most 6 ranges, got 7"),
    ],
    kind=(ValueError, TypeError),
    plain=True,
)


test_scene_refuses = refusals(
    [
        ({"pressure": (1.0, 2.0)}, "envelope names 'pressure'; there are D, G"),
        ({"friction": (1.0, 2.0)}, "envelope names 'friction'; there are D, G"),
        ({"stiffness_ratio": (0.1, 0.2)}, "names 'stiffness_ratio'; there are D, G"),
        ({"G": (1e-10, 1e-9)}, "G cannot be both designed and in the envelope"),
        ({"P": (-1.0, 2.0)}, "envelope: P must be above 0, got -1.0"),
        ({"mu_m": (0.2, 0.5)}, "envelope: mu_s must be at least mu_m = 0.5, got 0.4"),
        ({"nu": (0.2, 0.8)}, "envelope: nu must be"),
    ],
    lambda conditions: fj.Envelope.of(conditions).check(fj.brake_scene(), ("D", "G")),
    plain=True,
)
