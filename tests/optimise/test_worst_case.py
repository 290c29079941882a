"""The exchange of conditions, on a problem whose worst case is known in closed form."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from fractaljax.optimise.search import search
from fractaljax.optimise.worst_case import OnAverage, OneCondition, WorstCase

SLACK = 1e-9


class _Disc:
    """Stay outside a disc that travels along a curve with the condition s in [0, 1].

    Least (u - centre)^2 subject to radius - |u - (s, 0.5 + bulge sin(pi s))| <= 0 for every s.
    """

    class problem:
        objective = None

    class request:
        scatter = None

    def __init__(self, centre=(0.5, 0.55), radius=0.2, bulge=0.15):
        self.centre, self.radius, self.bulge = np.array(centre), radius, bulge

    def judge(self, us, conditions):
        s = conditions[:, 0]
        at = np.stack([s, 0.5 + self.bulge * np.sin(np.pi * s)], axis=1)
        value = ((us - self.centre) ** 2).sum(axis=1)
        return np.stack([value, self.radius - np.linalg.norm(us - at, axis=1)], axis=1)

    def judge_all(self, us, conditions):
        n, m = len(us), len(conditions)
        flat = self.judge(np.repeat(us, m, axis=0), np.tile(conditions, (n, 1)))
        return flat.reshape(n, m, -1)

    def linearise(self, us, conditions):
        n, m, _ = conditions.shape
        flat = np.repeat(us, m, axis=0), conditions.reshape(n * m, -1)
        excess = self.judge(*flat)[:, 1].reshape(n, m)
        away = us[:, None] - np.stack(
            [conditions[..., 0], 0.5 + self.bulge * np.sin(np.pi * conditions[..., 0])], axis=2
        )
        jacobian = -away / np.linalg.norm(away, axis=2, keepdims=True)
        value = ((us - self.centre) ** 2).sum(axis=1)
        return value, excess, 2 * (us - self.centre), jacobian

    def averaged(self, each):
        return each.mean(axis=1)


Disc: Any = _Disc  # in place of a Model
ENVELOPE = fj.Envelope({"P": (0.0, 1.0)})


def test_exchange_finds_the_worst_between_all_points():
    """The nearest point of the envelope's edge, which no condition of the first guess touches."""
    model = Disc()
    us = np.random.default_rng(1).uniform(size=(8, 2))
    judge = WorstCase(model, ENVELOPE, len(us))
    ends, _ = search(judge.linearise, us, SLACK, False, refine=judge.refine)
    verdict = judge.verdict(ends)
    s = np.linspace(0, 1, 20001)
    dense = model.judge_all(ends, s[:, None])[..., 1].max(axis=1)
    np.testing.assert_allclose(verdict.excess[:, 0], dense, atol=1e-6)
    assert (verdict.worst <= 1e-6).sum() >= 6

    # The edge: the least distance to a fine scan of the unit square outside every disc.
    side = np.linspace(0, 1, 161)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    outside = model.judge_all(grid, np.linspace(0, 1, 101)[:, None])[..., 1].max(axis=1) <= 0
    expected = model.judge(grid[outside], np.zeros((outside.sum(), 1)))[:, 0].min()
    found = verdict.values[verdict.worst <= 1e-6].min()
    assert expected * 0.9 < found < expected * 1.002


def test_first_guess_alone_is_not_enough():
    """Without exchange the answer violates conditions between those it knew."""
    us = np.random.default_rng(1).uniform(size=(8, 2))
    judge = WorstCase(Disc((0.25, 0.6), radius=0.12), ENVELOPE, len(us))
    ends, _ = search(judge.linearise, us, SLACK, False)
    assert (judge.verdict(ends).worst > 1e-3).any()


def test_verdict_names_the_worst_condition():
    """The place nearest to the disc's path, between the points of the grid."""
    judge = WorstCase(Disc(bulge=0.0), ENVELOPE, 1)
    verdict = judge.verdict(np.array([[0.3217, 0.55]]))
    assert verdict.places is not None
    assert ENVELOPE.condition(verdict.places[0, 1])["P"] == pytest.approx(0.3217, abs=1e-3)
    assert verdict.excess[0, 0] == pytest.approx(0.15, abs=1e-5)


def test_places_stand_empty_until_taken():
    """The first guess fills some; empty ones do not press, full ones make room for the worst."""
    judge = WorstCase(Disc(), ENVELOPE, 2)
    us = np.array([[0.5, 0.6], [0.2, 0.6]])
    first = judge.taken.sum()
    assert first == 2 * 3
    _, excess, _, jacobian = judge.linearise(us)
    assert (excess[~judge.taken] == -1).all() and (jacobian[~judge.taken] == 0).all()
    for _ in range(12):
        us = us + np.array([0.013, 0.004])
        judge.refine(us)
    assert judge.taken.shape == (2, 8) and judge.taken.sum() > first


def test_no_number_is_the_worst():
    """NaN at one condition is no design."""

    class Broken(_Disc):
        def judge(self, us, conditions):
            judged = super().judge(us, conditions)
            return np.where(conditions > 0.9, np.nan, judged)

    broken: Any = Broken()
    assert WorstCase(broken, ENVELOPE, 1).verdict(np.array([[0.5, 0.95]])).worst == np.inf


def test_average_is_that_of_its_places():
    """All the same conditions for every start."""
    judge = OnAverage(Disc(), ENVELOPE, ENVELOPE.cells())
    us = np.array([[0.5, 0.9], [0.1, 0.1]])
    each = Disc().judge_all(us, ENVELOPE.values(ENVELOPE.cells()))
    np.testing.assert_allclose(judge.verdict(us).excess, each.mean(axis=1)[:, 1:])
    assert judge.linearise(us)[1].shape == (2, 16) and not judge.refine(us)


def test_one_condition_has_nothing_to_refine():
    """The scene as it is."""
    assert not OneCondition(Disc()).refine(np.zeros((1, 2)))
