"""How the property-based tests draw and how many: the same every time, a batch an example."""

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
from hypothesis import settings

# Reproducible, and without a limit on the first example, which compiles.
QUICK = settings(derandomize=True, deadline=None, max_examples=50, database=None)
ROWS = 16  # of an example: one compiled program serves them all


def places(columns: int):
    """Places (ROWS, columns) from 0 to 1, for `benchmarks.extreme.points`."""
    return hnp.arrays(np.float64, (ROWS, columns), elements=st.floats(0, 1))
