"""One published number beside ours."""

from typing import Any, NamedTuple

# Where a published number comes from.
STATED = "stated"  # the article states it
CLOSED = "closed form"  # it follows from the article's equations by hand
NUMERICAL = "SciPy"  # it is SciPy's solution of the article's equations
CORRECTED = "corrected"  # what the article states is wrong: the note says both
QUADRATURE = "quadrature"  # of the equations, with 25 digits


class Check(NamedTuple):
    """One published number beside ours, in the unit that `quantity` names."""

    quantity: str
    published: float | tuple[float, float]  # or the ends of a range
    ours: float
    tolerance: float  # absolute
    basis: str
    note: str = ""

    @property
    def difference(self) -> float:
        """Ours minus the published number, or minus the nearer end of a range; 0 within it."""
        low, high = self.published if isinstance(self.published, tuple) else [self.published] * 2
        return self.ours - min(max(self.ours, low), high)

    @property
    def agrees(self) -> bool:
        """True if they differ by no more than the tolerance."""
        return abs(self.difference) <= self.tolerance


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
