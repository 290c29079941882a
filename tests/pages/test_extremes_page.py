"""The page of stiff and extreme cases, run small; its errors are held, not its times."""

import numpy as np
import pytest

from benchmarks.extreme.extremes import corner_rows, corners
from benchmarks.extreme.rows import FAMILIES, family_rows
from tools import quick_benchmark

WORST = {"plastic_share": 1e-14, "margin": 1e-12, "growth_rate": 1e-12, "real": 1e-12}


def test_page_lists_every_quantity_and_all_of_them_are_finite(tmp_path):
    numbers, page = quick_benchmark("extremes", tmp_path)
    for row in numbers["rows"]:
        double = row["float64"]
        assert double["worst"] < 1e-12 and double["worst_beside_rounding"] < 10
        assert double["not_finite"] == double["not_finite_gradient"] == 0
        assert row["float32"]["not_finite"] == 0
        assert row["slowest"] in page
    for row in numbers["others"]:
        assert f"| {row['quantity']} |" in page
        assert row["not_finite"] == 0 and row["worst"] < 1e-8
    assert all(f"- {found}" in page for found in numbers["found"])


@pytest.mark.slow  # compiles every family
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_every_family_is_exact_to_what_its_inputs_allow(family):
    for row in family_rows(family, 2000, 60, 5):
        double = row["float64"]
        # Roundings of ln a_e, of the order 1/(D - 2), cancel in the exact a_l and Q_e alone.
        if row["quantity"] not in ("a_l", "Q_e"):
            assert double["worst_beside_rounding"] < 100
        assert double["worst"] < WORST.get(row["quantity"], 1e-6)
        assert double["not_finite_gradient"] == 0
        assert double["not_finite"] == 0 or row["quantity"] == "mu_c"  # K_t = 0 never squeals


@pytest.mark.slow
def test_corners():
    """Stiffness to a hundred roundings of its inputs, growth rates to a few of their own."""
    for (corner, name, _, truth, numbers), row in zip(corners(), corner_rows(), strict=True):
        if name == "K_n":
            condition = condition_number(truth, numbers)
            wide, narrow = (100 * np.finfo(x).eps * (1 + condition) for x in ("f8", "f4"))
        else:
            # Exactly coalescing eigenvalues keep half the digits, where a rounding parts them.
            wide, narrow = (1e-7, 1e-3) if corner == "exact coalescence" else (1e-15, 1e-6)
        assert row["float64"] < wide, corner
        assert row["float32"] < narrow, corner


def condition_number(truth, numbers):
    """By how much more than themselves all relative changes of the inputs change K_n."""
    exact, total = truth(*numbers)["K_n"], 0.0
    for i, number in enumerate(numbers):
        step = 1e-9 * number  # far less than D is from 2
        high, low = (truth(*numbers[:i], at, *numbers[i + 1 :]) for at in (number + step, number))
        total += float(abs(high["K_n"] - low["K_n"])) / 1e-9
    return total / float(exact) if exact else 0.0
