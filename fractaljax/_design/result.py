"""How a design ends."""

from typing import Any

import equinox as eqx


class DesignResult(eqx.Enumeration):
    """How a design ended; an outcome, never raised."""

    found = "found: the best surface that meets every requirement"
    unchanged = "unchanged: the given surface meets every requirement already"
    infeasible = "infeasible: no surface inside the bounds was found to meet every requirement"
    undetermined = "undetermined: nowhere inside the bounds is there a growth rate"


def is_met(result: Any) -> Any:
    """True where a design, or each of a batch, meets every requirement."""
    return (result == DesignResult.found) | (result == DesignResult.unchanged)
