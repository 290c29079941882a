"""The conditions that a design must withstand: ranges and samples of named quantities.

A condition is a row of places: which sample, and where in each range, from 0 to 1. A range of a
decade or more is logarithmic. The worst condition is sought on a grid of all corners and points
inside, then by halving steps along every range.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._base.parts import Record, brief, scalar
from .._base.ranges import within
from .._base.suggest import did_you_mean
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import quantity_names, replaced


@dataclasses.dataclass(frozen=True)
class WorstCaseSearch:
    """How the worst conditions of an envelope are sought.

    **Fields:**

    - `points`: points of the grid along each range, by the number of ranges, from one to six.
    - `average_points`: the same for an average over conditions, which takes all points each time.
    - `likely`: conditions in a first guess.
    - `corners`: how many of these are corners of the ranges, for each sample.
    - `climbs`: steps of the climb from the worst point of the grid; one that fails is halved.
    - `margin`: a requirement met by more than this at all points is met between them.
    - `excess`: by how much a condition must be worse than the working ones to join them.
    """

    points: tuple[int, ...] = (33, 11, 6, 4, 3, 3)
    average_points: tuple[int, ...] = (16, 6, 4, 3, 2, 2)
    likely: int = 8
    corners: int = 4
    climbs: int = 10
    margin: float = 0.05
    excess: float = 1e-7


class Envelope(Record):
    """Ranges and samples of quantities of a scene or structure, by the names that `replace` takes.

    `ranges` are independent: every combination inside them is a condition. `samples` belong
    together: the i-th samples of all quantities are one measured condition, combined with all
    ranges. Where a plain mapping stands for an envelope, two numbers are a range and three or more
    are samples.

    **Raises:** `ValueError` for no quantity at all, an empty or inverted range, samples of unequal
    length, one name in both, and more than six ranges; `TypeError` for other than numbers.
    """

    ranges: dict[str, tuple[float, ...]]
    samples: dict[str, tuple[float, ...]]

    def __init__(
        self,
        ranges: Mapping[str, Sequence[float]] = {},
        samples: Mapping[str, Sequence[float]] = {},
    ):
        for which, mapping in (("ranges", ranges), ("samples", samples)):
            if not isinstance(mapping, Mapping):
                raise TypeError(f"{which} must be a mapping, got {brief(mapping)}")
        self.ranges = {name: _numbers(name, ends) for name, ends in ranges.items()}
        self.samples = {name: _numbers(name, values) for name, values in samples.items()}
        for name, ends in self.ranges.items():
            if len(ends) != 2 or not ends[0] < ends[1]:
                raise ValueError(f"envelope of {name} must be (lower, upper), got {_shown(ends)}")
            if name in self.samples:
                raise ValueError(f"envelope has both a range and samples of {name}")
        lengths = {name: len(values) for name, values in self.samples.items()}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{length} of {name}" for name, length in lengths.items())
            raise ValueError(f"samples of an envelope must be equally many, got {counts}")
        if 0 in lengths.values() or not (ranges or samples):
            raise ValueError("envelope must name at least one range or sample, got none")
        if len(ranges) > 6:  # 729 points at least
            raise ValueError(f"envelope takes at most 6 ranges, got {len(ranges)}; use samples")

    @classmethod
    def of(cls, conditions: "Envelope | Mapping[str, Any]") -> "Envelope":
        """An envelope from `conditions`: itself, or a mapping as in `design`.

        The mapping has names with (lower, upper), or with three or more samples.
        """
        if isinstance(conditions, Envelope):
            return conditions
        if not isinstance(conditions, Mapping):
            raise TypeError(f"envelope must be a mapping or an Envelope, got {brief(conditions)}")
        entries = {name: _numbers(name, values) for name, values in conditions.items()}
        for name, values in entries.items():
            if len(values) < 2:
                raise ValueError(
                    f"envelope of {name} must be a range or samples, got {_shown(values)}"
                )
        return cls(
            ranges={name: values for name, values in entries.items() if len(values) == 2},
            samples={name: values for name, values in entries.items() if len(values) > 2},
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities, ranges first."""
        return (*self.ranges, *self.samples)

    @property
    def sample_count(self) -> int:
        """The number of samples; 1, without quantities, where there are ranges alone."""
        return len(next(iter(self.samples.values()))) if self.samples else 1

    def check(self, x: Mechanism, designed: Sequence[str]) -> None:
        """Refuse names that `x` lacks and values outside a domain.

        Names among the `designed` are refused, too.
        """
        quantities = x.stored_quantities()
        available = [
            name
            for name in quantity_names(x)
            if name not in quantities or quantities[name].value is not None
        ]
        for name in self.names:
            if name not in available:
                near = did_you_mean(name, available)
                raise ValueError(f"envelope names {name!r}; there are {', '.join(available)}{near}")
            if name in designed:
                raise ValueError(f"{name} cannot be both designed and in the envelope")
        # Domains are intervals: where all corners are inside, everything is.
        try:
            corners = self.values(_with_samples(self._corners(), range(self.sample_count)))
            replaced(x, dict(zip(self.names, corners.T, strict=True)))
        except ValueError as error:
            raise ValueError(f"envelope: {error}") from None

    def values(self, places: np.ndarray) -> np.ndarray:
        """The quantities (n, names) at `places` (n, 1 + ranges)."""
        columns = [
            within(low, high, at)
            for at, (low, high) in zip(places[:, 1:].T, self.ranges.values(), strict=True)
        ]
        which = places[:, 0].astype(int)
        columns += [np.asarray(values)[which] for values in self.samples.values()]
        return np.array(columns).reshape(len(self.names), len(places)).T

    def condition(self, place: np.ndarray) -> dict[str, float]:
        """The quantities at one `place` (1 + ranges,), by name."""
        return dict(zip(self.names, self.values(place[None])[0].tolist(), strict=True))

    def grid(self, points: Sequence[int] = WorstCaseSearch.points) -> np.ndarray:
        """Places (n, 1 + ranges) among which the worst is sought: all corners, points inside."""
        return self._grid(lambda n: np.linspace(0, 1, n), points)

    def coarse_grid(self, points: Sequence[int] = WorstCaseSearch.average_points) -> np.ndarray:
        """Fewer places (n, 1 + ranges) than `grid`: all corners, points inside."""
        return self.grid(points)

    def cells(self, points: Sequence[int] = WorstCaseSearch.average_points) -> np.ndarray:
        """Equally likely places (n, 1 + ranges): the midpoints of equal cells of every range."""
        return self._grid(lambda n: (np.arange(n) + 0.5) / n, points)

    def likely(self, count: int, corner_count: int = WorstCaseSearch.corners) -> np.ndarray:
        """A first guess (at most `count`, 1 + ranges) at the worst places: middle and corners."""
        corners = self._corners()
        chosen = np.linspace(0, len(corners) - 1, min(corner_count, len(corners))).astype(int)
        middle = np.full((1, len(self.ranges)), 0.5)
        points = np.unique(np.vstack([middle, corners[chosen]]), axis=0)
        each = max(1, count // len(points))
        samples = np.unique(np.linspace(0, self.sample_count - 1, each).astype(int))
        return _with_samples(points, samples)[:count]

    def drawn(self, count: int, seed: int) -> np.ndarray:
        """Places (`count`, 1 + ranges) drawn by `seed`, uniform in every range and over samples."""
        random = np.random.default_rng([seed, 1])
        which = random.integers(self.sample_count, size=(count, 1))
        return np.hstack([which, random.uniform(size=(count, len(self.ranges)))])

    def climb(
        self,
        residual: Callable,
        places: np.ndarray,
        values: np.ndarray,
        options: WorstCaseSearch = WorstCaseSearch(),
    ):
        """Places and residuals after a climb from `places` (n, 1 + ranges) with `values` (n,).

        `residual` is a function: `residual(places, i)` is evaluated at places (m, 1 + ranges), row
        j for problem i[j]. Every range is tried in both directions; the step is halved where
        neither helps.
        """
        k = len(self.ranges)
        if k == 0 or not len(places):
            return places, values
        every = np.arange(len(places))
        step = np.full(len(places), 1 / (options.points[k - 1] - 1))
        directions = np.hstack([np.zeros((2 * k, 1)), np.vstack([np.eye(k), -np.eye(k)])])
        for _ in range(options.climbs):
            tried = places[:, None] + step[:, None, None] / 2 * directions[None]
            tried[..., 1:] = np.clip(tried[..., 1:], 0, 1)
            residuals = residual(tried.reshape(-1, 1 + k), np.repeat(every, 2 * k)).reshape(
                -1, 2 * k
            )
            best = residuals.argmax(axis=1)
            risen = residuals[every, best] > values
            places = np.where(risen[:, None], tried[every, best], places)
            values = np.where(risen, residuals[every, best], values)
            step = np.where(risen, step, step / 2)
        return places, values

    def _corners(self) -> np.ndarray:
        return np.array(list(itertools.product((0.0, 1.0), repeat=len(self.ranges))))

    def _grid(self, side, points) -> np.ndarray:
        k = len(self.ranges)
        places = np.array(list(itertools.product(side(points[k - 1]) if k else (), repeat=k)))
        return _with_samples(places, range(self.sample_count))

    def __str__(self) -> str:
        shown = [f"{name} {low:g} to {high:g}" for name, (low, high) in self.ranges.items()]
        if self.samples:
            shown.append(f"{self.sample_count} samples of {', '.join(self.samples)}")
        return ", ".join(shown)


class _SingleCondition(Envelope):
    def __init__(self):
        self.ranges, self.samples = {}, {}


SINGLE_CONDITION = _SingleCondition()  # a scene as it is: one condition, without quantities


def _numbers(name, values) -> tuple[float, ...]:
    """A flat list of finite numbers."""
    if not isinstance(values, (tuple, list, np.ndarray, jax.Array)) or not np.ndim(values):
        raise TypeError(f"envelope of {name} must be a range or samples, got {brief(values)}")
    return tuple(float(scalar(f"envelope of {name}", value)) for value in values)


def _shown(values) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def _with_samples(points: np.ndarray, samples) -> np.ndarray:
    """Every sample at every point of the ranges."""
    return np.array([[which, *point] for which in samples for point in points], dtype=float)


def condition_text(condition: Mapping[str, float]) -> str:
    """A condition in words: `P = 2500, mu_s = 0.5`."""
    return ", ".join(f"{name} = {value:.6g}" for name, value in condition.items())
