"""A published case: numbers and curves of an article, and a function that computes ours."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxtyping import ArrayLike

# Where a published number comes from.
STATED = "stated"  # the article states it
CLOSED = "closed form"  # it follows from the article's equations by hand
NUMERICAL = "SciPy"  # it is SciPy's solution of the article's equations
CORRECTED = "corrected"  # what the article states is wrong: the note says both


class Check(NamedTuple):
    """One number of an article beside ours, in the unit that `quantity` names."""

    quantity: str
    published: float | tuple[float, float]  # or the ends of a range
    ours: float | None  # None where it cannot be computed: the note says why
    tolerance: float  # absolute
    basis: str
    note: str = ""

    @property
    def difference(self) -> float | None:
        """Ours minus the published number, or minus the nearer end of a range; 0 within it."""
        if self.ours is None:
            return None
        low, high = self.published if isinstance(self.published, tuple) else [self.published] * 2
        return self.ours - min(max(self.ours, low), high)

    @property
    def agrees(self) -> bool | None:
        """True if they differ by no more than the tolerance; None if ours is missing."""
        return None if self.difference is None else abs(self.difference) <= self.tolerance


class Curve(NamedTuple):
    """A line of a picture: theirs as marks, or dashed if it is a bound; ours drawn through.

    A curve without a label continues the previous one of its kind.
    """

    x: ArrayLike | Sequence[float]
    y: ArrayLike | Sequence[float]
    label: str
    ours: bool
    dashed: bool = False


class Panel(NamedTuple):
    """One graph: curves over the same axes. `options` are those of `Axes.set`."""

    xlabel: str
    ylabel: str
    curves: Sequence[Curve]
    options: Mapping[str, Any] = {}


class CaseResult(NamedTuple):
    """The numbers and graphs that a case computes."""

    checks: Sequence[Check]
    panels: Sequence[Panel]


class Case(NamedTuple):
    """A published case. `missing` returns what it lacks to run here, an empty text if nothing."""

    name: str
    title: str
    citation: str
    doi: str | None  # None if it has none, or if it is uncertain
    run: Callable[[], CaseResult]
    missing: Callable[[], str] = lambda: ""


def stated(quantity: str, published: float, ours: Any, digit: float, note: str = "") -> Check:
    """A number as the article prints it; its last digit is worth `digit`, and half of it counts."""
    return Check(quantity, published, float(ours), 0.5 * digit, STATED, note)


def closed(quantity: str, published: Any, ours: Any, rtol: float, note: str = "") -> Check:
    """A closed form, which ours meets within the relative tolerance."""
    published = float(published)
    return Check(quantity, published, float(ours), rtol * abs(published), CLOSED, note)


def numerical(quantity: str, published: Any, ours: Any, rtol: float, note: str = "") -> Check:
    """A number by SciPy from the article's equations, met within the relative tolerance."""
    return closed(quantity, published, ours, rtol, note)._replace(basis=NUMERICAL)
