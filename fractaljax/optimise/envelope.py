"""The conditions that a design must withstand: ranges and samples of scene quantities.

A condition is a row of places: which sample, and where in each range, from 0 to 1. A range of a
decade or more is walked in logarithms. The worst condition is sought on a grid of all corners and
points inside, then by halving steps along every range.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from ..base.parts import brief, scalar
from ..base.ranges import within
from ..mechanism.quantities import own_quantities
from ..mechanism.scene import Scene

_SIDES = {1: 33, 2: 11, 3: 6, 4: 4, 5: 3, 6: 3}  # points along each range, by their number
_INNER_SIDES = {1: 16, 2: 6, 3: 4, 4: 3, 5: 2, 6: 2}  # the same for an average over conditions
_CORNERS = 4  # of a first guess at what is worst
_HALVINGS = 10


@dataclasses.dataclass(frozen=True)
class Envelope:
    """Ranges and samples of scene quantities, by the names that `Scene.replace` knows.

    `ranges` are independent: every combination inside them is a condition. `samples` belong
    together: the i-th of every quantity make one measured condition, combined with all ranges.
    Where a plain mapping stands for an envelope, two numbers are a range and three or more are
    samples.

    **Raises:** `ValueError` for nothing at all, an empty or inverted range, samples of unequal
    length, one name in both, and more than six ranges; `TypeError` for what is no number.
    """

    ranges: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    samples: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for which in ("ranges", "samples"):
            if not isinstance(getattr(self, which), Mapping):
                raise TypeError(f"{which} must be a mapping, got {brief(getattr(self, which))}")
        ranges, samples = {}, {}
        for name, ends in dict(self.ranges).items():
            ends = _numbers(name, ends)
            if len(ends) != 2 or not ends[0] < ends[1]:
                raise ValueError(f"envelope of {name} must be (lower, upper), got {_shown(ends)}")
            ranges[name] = (ends[0], ends[1])
        for name, values in dict(self.samples).items():
            if name in ranges:
                raise ValueError(f"envelope has both a range and samples of {name}")
            samples[name] = tuple(_numbers(name, values))
        lengths = {name: len(values) for name, values in samples.items()}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{length} of {name}" for name, length in lengths.items())
            raise ValueError(f"samples of an envelope must be equally many, got {counts}")
        if 0 in lengths.values() or not (ranges or samples):
            raise ValueError("envelope must name at least one range or sample, got none")
        if len(ranges) > len(_SIDES):
            raise ValueError(
                f"envelope takes at most {len(_SIDES)} ranges, got {len(ranges)}; use samples"
            )
        object.__setattr__(self, "ranges", ranges)
        object.__setattr__(self, "samples", samples)

    @classmethod
    def of(cls, conditions: "Envelope | Mapping[str, Any]") -> "Envelope":
        """An envelope, or a mapping of names to (lower, upper) or to three or more samples."""
        if isinstance(conditions, Envelope):
            return conditions
        if not isinstance(conditions, Mapping):
            raise TypeError(f"envelope must be a mapping or an Envelope, got {brief(conditions)}")
        given = {name: _numbers(name, values) for name, values in conditions.items()}
        for name, values in given.items():
            if len(values) < 2:
                raise ValueError(
                    f"envelope of {name} must be a range or samples, got {_shown(values)}"
                )
        return cls(
            ranges={name: (v[0], v[1]) for name, v in given.items() if len(v) == 2},
            samples={name: v for name, v in given.items() if len(v) > 2},
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities, ranges first."""
        return (*self.ranges, *self.samples)

    @property
    def sample_count(self) -> int:
        """How many samples there are; 1, of nothing, where there are ranges alone."""
        return len(next(iter(self.samples.values()))) if self.samples else 1

    def check(self, scene: Scene, designed: Sequence[str]) -> None:
        """Refuse names that the scene lacks or the design moves, and values outside a domain."""
        own = own_quantities(scene)
        known = [name for name, quantity in own.items() if quantity.value is not None]
        for name in self.names:
            if name not in known:
                raise ValueError(
                    f"envelope names {name!r}, which the scene does not have; it has "
                    + ", ".join(known)
                )
            if name in designed:
                raise ValueError(f"{name} cannot be both designed and in the envelope")
        # Domains are intervals: where all corners are inside, everything is.
        try:
            corners = self.values(_with_samples(self._corners(), range(self.sample_count)))
            scene.replace(**dict(zip(self.names, corners.T, strict=True)))
        except ValueError as error:
            raise ValueError(f"envelope: {error}") from None

    def values(self, places: np.ndarray) -> np.ndarray:
        """The quantities (n, names) at places (n, 1 + ranges)."""
        columns = [
            within(low, high, at)
            for at, (low, high) in zip(places[:, 1:].T, self.ranges.values(), strict=True)
        ]
        which = places[:, 0].astype(int)
        columns += [np.asarray(values)[which] for values in self.samples.values()]
        return np.stack(columns, axis=1)

    def condition(self, place: np.ndarray) -> dict[str, float]:
        """The quantities at one place, by name."""
        return dict(zip(self.names, self.values(place[None])[0].tolist(), strict=True))

    def grid(self) -> np.ndarray:
        """Places (n, 1 + ranges) among which the worst is sought: all corners, points inside."""
        return self._grid(lambda n: np.linspace(0, 1, n), _SIDES)

    def coarse_grid(self) -> np.ndarray:
        """Fewer places (n, 1 + ranges) than `grid`: all corners, points inside."""
        return self._grid(lambda n: np.linspace(0, 1, n), _INNER_SIDES)

    def cells(self) -> np.ndarray:
        """Equally likely places (n, 1 + ranges): the midpoints of equal cells of every range."""
        return self._grid(lambda n: (np.arange(n) + 0.5) / n, _INNER_SIDES)

    def likely(self, count: int) -> np.ndarray:
        """A first guess (at most `count`, 1 + ranges) at what is worst: middle and corners."""
        corners = self._corners()
        chosen = np.linspace(0, len(corners) - 1, min(_CORNERS, len(corners))).astype(int)
        points = np.unique(
            np.vstack([np.full((1, len(self.ranges)), 0.5), corners[chosen]]), axis=0
        )
        each = max(1, count // len(points))
        samples = np.unique(np.linspace(0, self.sample_count - 1, each).astype(int))
        return _with_samples(points, samples)[:count]

    def drawn(self, count: int, seed: int) -> np.ndarray:
        """Places (count, 1 + ranges) drawn at random, uniform in every range and over samples."""
        random = np.random.default_rng([seed, 1])
        which = random.integers(self.sample_count, size=(count, 1))
        return np.hstack([which, random.uniform(size=(count, len(self.ranges)))])

    def climb(self, excess: Callable, places: np.ndarray, values: np.ndarray):
        """Better places than `places` (n, 1 + ranges), `excess` rising from their `values` (n,).

        `excess(places, i)` gives what is to rise at places (m, 1 + ranges), row j for problem
        i[j]. Every range is tried either way, the step halving where that does not help.
        """
        k = len(self.ranges)
        if k == 0:
            return places, values
        places, values = places.copy(), values.copy()
        n = len(places)
        step = np.full(n, 1 / (_SIDES[k] - 1))
        directions = np.hstack([np.zeros((2 * k, 1)), np.vstack([np.eye(k), -np.eye(k)])])
        for _ in range(_HALVINGS):
            tried = places[:, None] + step[:, None, None] / 2 * directions[None]
            tried[..., 1:] = np.clip(tried[..., 1:], 0, 1)
            rows = np.repeat(np.arange(n), 2 * k)
            found = excess(tried.reshape(-1, 1 + k), rows).reshape(n, 2 * k)
            best = found.argmax(axis=1)
            risen = found[np.arange(n), best] > values
            places = np.where(risen[:, None], tried[np.arange(n), best], places)
            values = np.where(risen, found[np.arange(n), best], values)
            step = np.where(risen, step, step / 2)
        return places, values

    def _corners(self) -> np.ndarray:
        return np.array(list(itertools.product((0.0, 1.0), repeat=len(self.ranges))))

    def _grid(self, side, sides) -> np.ndarray:
        k = len(self.ranges)
        axis = side(sides[k]) if k else ()
        points = np.array(list(itertools.product(axis, repeat=k)))
        return _with_samples(points, range(self.sample_count))

    def __str__(self) -> str:
        shown = [f"{name} {low:g} to {high:g}" for name, (low, high) in self.ranges.items()]
        if self.samples:
            shown.append(f"{self.sample_count} samples of {', '.join(self.samples)}")
        return ", ".join(shown)


def _numbers(name, values) -> list[float]:
    """A flat list of finite numbers."""
    if not isinstance(values, (tuple, list, np.ndarray, jax.Array)) or not np.ndim(values):
        raise TypeError(f"envelope of {name} must be a range or samples, got {brief(values)}")
    return [float(scalar(f"envelope of {name}", value)) for value in values]


def _shown(values) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def _with_samples(points: np.ndarray, samples) -> np.ndarray:
    """Every sample at every point of the ranges."""
    return np.array([[which, *point] for which in samples for point in points], dtype=float)


def condition_text(condition: Mapping[str, float]) -> str:
    """A condition in words: `P = 2500, mu_s = 0.5`."""
    return ", ".join(f"{name} = {value:.6g}" for name, value in condition.items())
