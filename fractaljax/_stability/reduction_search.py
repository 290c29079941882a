"""How `reduce` searches for the smallest space that meets its tolerance."""

import dataclasses

from .._base.options import check_numbers


@dataclasses.dataclass(frozen=True)
class ReductionSearch:
    """How `reduce` chooses its points and its directions; the defaults suit most structures.

    **Fields:**

    - `line`: candidates along the range of a single quantity.
    - `candidates`, `most_candidates`: candidates for each of several quantities, and for all of
      them at most, besides the corners of their ranges.
    - `corners`: the number of quantities up to which the corners are candidates as well.
    - `compared`: fresh points at which eigenvalues are compared at the end.
    - `together`: candidates at which errors are estimated before the largest is compared with the
      tolerance; also those at which sizes are tried first.
    - `safe`: share of the tolerance that an estimate may reach, for it is right to leading order.
    - `cut`: singular value, relative to the largest and in units of sqrt(tol), below which a
      direction is left out at first.
    - `beyond`: share by which the band is widened on either side, for modes that may enter it.
    - `coarse_tol`: relative error of the eigenvalues in a coarse space, in which `growth_rate`
      looks for the rightmost one first.
    - `coarse_from`, `coarse_share`: degrees of freedom from which there is a coarse space, and the
      largest share of them that it may have. Otherwise it saves no time.

    **Raises:** `ValueError` for a count that is not a whole number of at least 1 (`corners`: 0),
    and for another number that is not above 0 and finite.
    """

    line: int = 33
    candidates: int = 32
    most_candidates: int = 128
    corners: int = 5
    compared: int = 2
    together: int = 8
    safe: float = 0.2
    cut: float = 1e-2
    beyond: float = 0.02
    coarse_tol: float = 1e-3
    coarse_from: int = 40
    coarse_share: float = 0.6

    def __post_init__(self):
        check_numbers(self, least={"corners": 0})
