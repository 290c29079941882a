"""Classes of options refuse numbers that mean nothing, in one line with the field's name."""

import dataclasses

import numpy as np
import pytest

import fractaljax as fj

CLASSES = [fj.BasinSearch, fj.CycleSearch, fj.DesignSearch, fj.ReductionSearch]
NUMBERS = [
    (kind, field.name, type(field.default))
    for kind in CLASSES
    for field in dataclasses.fields(kind)
    if type(field.default) in (int, float)
]


@pytest.mark.parametrize(("kind", "name", "plain"), NUMBERS)
def test_fields_are_checked_and_plain(kind, name, plain):
    for bad in (
        -1,
        float("nan"),
        float("inf"),
        "1",
        None,
        *([1.5] if plain is int else [0.0, True]),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^{name} must be") as caught:
            kind(**{name: bad})
        assert "\n" not in str(caught.value)
    good = kind(**{name: np.int64(4) if plain is int else np.float64(0.5)})
    assert type(getattr(good, name)) is plain and hash(good) == hash(dataclasses.replace(good))
