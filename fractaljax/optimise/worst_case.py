"""One surface against many conditions: at one, at the worst of an envelope, or on average.

The worst case is found by exchange: every start walks against a few conditions of its own; at the
end of a walk the worst of the whole envelope are sought, for each requirement, and where they are
worse than those it knew they take the place of the least pressing, and it walks on. (A. G.
Blankenship and J. E. Falk, "Infinitely constrained optimization problems", 1976.)
"""

import dataclasses

import numpy as np

from .envelope import Envelope
from .requirements import Model

_WORKING = 8  # conditions that a start walks against
_TOLERANCE = 1e-7  # by which a condition must be worse than those known
_NEAR = 0.05  # a requirement met by more than this on the grid is met between its points


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What becomes of n surfaces: objective and requirements, and where each is at its worst."""

    values: np.ndarray  # (n,)
    excess: np.ndarray  # (n, k), 0 or below where met
    places: np.ndarray | None  # (n, 1 + k, 1 + ranges): of objective and requirements

    def of(self, i: int) -> "Verdict":
        """That of one surface alone, still with a leading axis."""
        places = None if self.places is None else self.places[i : i + 1]
        return Verdict(self.values[i : i + 1], self.excess[i : i + 1], places)

    @property
    def worst(self) -> np.ndarray:
        """The most pressing requirement (n,); infinite without a number, or without a value."""
        pressing = np.nan_to_num(self.excess.max(axis=1), nan=np.inf, posinf=np.inf)
        return np.where(np.isnan(self.values), np.inf, pressing)


class OneCondition:
    """Every surface in the scene as it is.

    `limits` (n,) move the limit of the last requirement, for each surface by its own.
    """

    def __init__(self, model: Model, limits: np.ndarray | None = None):
        self.model = model
        self.limits = limits

    def linearise(self, us):
        """Objective, requirements, and their Jacobians: what a search asks of a model."""
        values, excess, slope, jacobian = self.model.linearise(us)
        return values, self._limited(excess), slope, jacobian

    def _limited(self, excess):
        """Requirements (n, k), the last of them against its own limits."""
        if self.limits is not None:
            excess = excess.copy()
            excess[:, -1] -= self.limits
        return excess

    def refine(self, us) -> bool:
        """Whether there is more to walk against than there was."""
        return False

    def verdict(self, us) -> Verdict:
        """Objective and requirements of surfaces us (n, v), evaluated afresh."""
        values, excess, _, _ = self.linearise(us)
        return Verdict(values, excess, None)

    def survey(self, us) -> np.ndarray:
        """Objective and requirements (n, 1 + k), roughly: to choose starts by."""
        if self.model.request.scatter is None:
            values, excess, _, _ = self.model.linearise(us)
            return np.column_stack([values, excess])
        return self.model.judge(us, np.zeros((len(us), 0)))


class Conditions(OneCondition):
    """What the two ways to take an envelope share."""

    def __init__(self, model: Model, envelope: Envelope):
        super().__init__(model)
        self.envelope = envelope

    def survey(self, us):
        likely = self.envelope.values(self.envelope.likely(_WORKING))
        return _largest(self.model.judge_all(us, likely), axis=1)


class OnAverage(Conditions):
    """A smooth maximum or an expected shortfall over fixed, equally likely conditions."""

    def __init__(self, model: Model, envelope: Envelope, places: np.ndarray):
        super().__init__(model, envelope)
        self.places = places
        self.values = envelope.values(places)

    def linearise(self, us):
        shared = np.broadcast_to(self.values, (len(us), *self.values.shape))
        return self.model.linearise(us, shared)

    def verdict(self, us):
        each = self.model.judge_all(us, self.values)
        average = self.model.averaged(each)
        places = self.places[np.nan_to_num(each, nan=np.inf).argmax(axis=1)]
        return Verdict(average[:, 0], average[:, 1:], places)


class WorstCase(Conditions):
    """Every requirement at every condition, the objective at its worst."""

    def __init__(self, model: Model, envelope: Envelope, count: int):
        super().__init__(model, envelope)
        likely = envelope.likely(_WORKING)
        # One shape for every envelope of the same names: the rest of the places stand empty.
        padded = np.resize(likely, (_WORKING, likely.shape[1]))
        self.places = np.tile(padded, (count, 1, 1))
        self.taken = np.tile(np.arange(_WORKING) < len(likely), (count, 1))

    def linearise(self, us):
        values, excess, slope, jacobian = self.model.linearise(us, self._values(self.places))
        each = excess.shape[1] // _WORKING
        empty = np.repeat(~self.taken, each, axis=1)
        excess, jacobian = np.where(empty, -1, excess), np.where(empty[..., None], 0, jacobian)
        return values, excess, slope, jacobian

    def _values(self, places):
        flat = self.envelope.values(places.reshape(-1, places.shape[-1]))
        return flat.reshape(*places.shape[:-1], -1)

    def verdict(self, us):
        grid = self.envelope.grid()
        each = np.nan_to_num(self.model.judge_all(us, self.envelope.values(grid)), nan=np.inf)
        best = each.argmax(axis=1)
        n, k = best.shape
        rows, columns = np.divmod(np.arange(n * k), k)

        def excess(places, i):
            judged = self.model.judge(us[rows[i]], self.envelope.values(places))
            return np.nan_to_num(judged, nan=np.inf)[np.arange(len(i)), columns[i]]

        largest = np.take_along_axis(each, best[:, None], axis=1)[:, 0]
        near = largest > -_NEAR
        near[:, 0] = self.model.problem.objective is not None
        climbing = np.flatnonzero(near)
        rows, columns = rows[climbing], columns[climbing]
        places, values = grid[best].reshape(n * k, -1), largest.ravel()
        places[climbing], values[climbing] = self.envelope.climb(
            excess, places[climbing], values[climbing]
        )
        values = values.reshape(n, k)
        return Verdict(values[:, 0], values[:, 1:], places.reshape(n, k, -1))

    def refine(self, us):
        verdict = self.verdict(us)
        assert verdict.places is not None
        n, m, _ = self.places.shape
        flat = self._values(self.places).reshape(n * m, -1)
        known = self.model.judge(np.repeat(us, m, axis=0), flat).reshape(n, m, -1)
        largest = _largest(known, axis=1)
        found = np.column_stack([verdict.values, verdict.excess])
        worse = found > largest + _TOLERANCE
        worse[:, 1:] &= verdict.excess > 0
        # What a start knows only adds to its value: one beyond the best that holds cannot win.
        holding = verdict.values[verdict.worst <= 0]
        beaten = largest[:, 0] >= holding.min(initial=np.inf)
        worse &= ~beaten[:, None]
        known[..., 0] -= largest[:, None, 0]
        pressing = np.where(self.taken, known.max(axis=2), -np.inf).argsort(axis=1)
        for i in np.flatnonzero(worse.any(axis=1)):
            new = verdict.places[i, worse[i]][:m]
            self.places[i, pressing[i, : len(new)]] = new
            self.taken[i, pressing[i, : len(new)]] = True
        return bool(worse.any())


def _largest(each, axis):
    return np.nan_to_num(each, nan=np.inf).max(axis=axis)
