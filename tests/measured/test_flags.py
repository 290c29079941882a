"""Reasons for doubt, one at a time."""

from types import SimpleNamespace

import numpy as np
import pytest

from fractaljax.measured.flags import _few_decades
from fractaljax.measured.identify import _flags

HEIGHTS = SimpleNamespace(missing=0, outliers=0)


def flags(D=2.4, errors=(0.02, 0.5), other=2.4, other_error=0.02, heights=HEIGHTS):
    opinion = SimpleNamespace(D=other, D_standard_error=other_error)
    return list(_flags(D, np.array(errors), opinion, 1000, heights))


def test_nothing_to_say():
    assert flags() == [] and list(_few_decades((1e3, 1e4))) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"D": 3.2, "other": 3.2}, "D = 3.2 is not between 2 and 3: no surface of this model"),
        ({"D": 2.01, "other": 2.01}, "D = 2.01 is within its error of the end of 2 to 3"),
        ({"D": 2.99, "other": 2.99}, "D = 2.99 is within its error of the end of 2 to 3"),
        ({"errors": (0.02, 2.5)}, "G is hardly known: ln G has a standard error of 2.5"),
        (
            {"other": 2.6},
            "spectrum and structure function disagree: D = 2.4 and 2.6, 7.1 standard errors apart",
        ),
        (
            {"heights": SimpleNamespace(missing=20, outliers=5)},
            "2.5% of the heights are missing or outliers",
        ),
    ],
)
def test_one_line_each(given, said):
    assert flags(**given) == [said]


def test_tiny_errors_do_not_make_opinions_disagree():
    assert flags(errors=(1e-4, 0.1), other=2.44, other_error=1e-4) == []


def test_few_decades():
    (said,) = _few_decades((1e3, 8e3))
    assert said == "too few decades: the band spans 0.90, at least 1 is wanted"
