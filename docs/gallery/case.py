"""A published case: numbers and curves of an article, and a function that computes ours."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxtyping import ArrayLike

import fractaljax as fj
from fractaljax._validate.check import (
    CLOSED as CLOSED,
    CORRECTED as CORRECTED,
    NUMERICAL as NUMERICAL,
    STATED as STATED,
    Check as Check,
    closed as closed,
    numerical as numerical,
    stated as stated,
)


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


def self_checked(name: str) -> list[Check]:
    """The numbers of a case that `fractaljax validate` has too."""
    return list(fj.validate(name, progress=False).cases[name])
