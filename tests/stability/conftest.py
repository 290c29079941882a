"""What tests of stability share."""

import pytest
from mpmath import mp

from structures import DIGITS


@pytest.fixture(autouse=True)
def many_digits():
    """The truth of every test has fifty."""
    with mp.workdps(DIGITS):
        yield
