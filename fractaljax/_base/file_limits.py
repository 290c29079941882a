"""The largest measurements and matrices that are read from files."""

import dataclasses

from .parts import whole


@dataclasses.dataclass(frozen=True)
class FileLimits:
    """Sizes up to which files are read: a damaged or hostile one must not exhaust the memory.

    What a compressed file unpacks to is limited likewise.

    **Fields:**

    - `text`: bytes of a text with heights.
    - `arrays`: bytes of a .npy or .npz file with heights.
    - `instrument`: bytes of a measurement in an instrument's format.
    - `heights`: number of heights in an instrument's format.
    - `matrices`: bytes of a file with matrices.
    - `dofs`: rows and columns of a matrix.

    **Raises:** `ValueError` unless each is a whole number of at least 1.
    """

    text: int = 2**28
    arrays: int = 2**30
    instrument: int = 2**31
    heights: int = 2**27
    matrices: int = 2**30
    dofs: int = 1_000_000

    def __post_init__(self):
        for name, value in vars(self).items():
            whole(name, value, 1)
