"""The page of the closed form, run small; its errors are held, not its times."""

import numpy as np
import pytest

from benchmarks.growth.eigenvalue_methods import TIMED, WITH_ERRORS
from benchmarks.growth.systems import COALESCING, FAMILIES, STABLE, exact_growth, state_matrices
from tools import quick_benchmark

CLOSED, NUMPY = "closed form", "numpy.linalg.eigvals"
SINGLE = f"{CLOSED}, float32"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return quick_benchmark("eigenvalues", tmp_path_factory.mktemp("eigenvalues"))


def test_rates_of_every_method_stand_beside_numpys_in_every_batch(results):
    numbers, page = results
    (headline,) = numbers["headline"]
    assert headline["ratio"] > 0 and f"wanted >= {headline['wanted']}" in page
    for name in TIMED:
        assert f"| {name} |" in page
    for row in numbers["batches"]:
        assert f"| {row['systems']:,} |" in page
        assert row["methods"][NUMPY]["ratio_to_numpy"] == 1
        assert all(method["ratio_to_numpy"] > 0 for method in row["methods"].values())


def test_closed_form_is_no_less_accurate_than_lapack(results):
    numbers, page = results
    assert "In float64 its worst error is no larger in any family." in page
    assert len(numbers["families"]) == len(FAMILIES)
    assert len(numbers["coalescing"]) == len(COALESCING)
    for row in numbers["families"] + numbers["coalescing"]:
        assert set(row["errors"]) <= set(WITH_ERRORS)
        assert row["errors"][CLOSED]["worst"] <= row["errors"][NUMPY]["worst"]
        assert not any(row["wrong_signs"].values())
    assert numbers["families"][0]["family"] == "random" and numbers["families"][0]["unstable"] > 0


def test_errors_grow_with_the_square_root_towards_coalescence_and_no_faster(results):
    numbers, _ = results
    for row in numbers["families"]:
        assert row["errors"][CLOSED]["worst"] < 1e-16
        assert row["errors"][SINGLE]["worst"] < 1e-6
    for row in numbers["coalescing"]:
        distance = row["distance"]
        for name, dtype in ((CLOSED, np.float64), (SINGLE, np.float32)):
            if name in row["errors"]:
                eps = np.finfo(dtype).eps
                bound = eps / distance**0.5 if distance else eps**0.5
                assert row["errors"][name]["worst"] < bound
    stable = [row for row in numbers["coalescing"] if row["side"] == STABLE]
    assert all(row["errors"][CLOSED]["worst"] < 1e-18 for row in stable)


@pytest.mark.parametrize("family", FAMILIES)
def test_truth_and_lapacks_matrices_are_of_the_same_systems(family):
    columns = FAMILIES[family](np.random.default_rng(2), 3)
    matrices, omega = state_matrices(columns)
    assert np.all(np.frexp(omega)[0] == 0.5)  # powers of two
    for i, row in enumerate(zip(*columns, strict=True)):
        a, b, c_1, c_2, g = row
        monic = [1, c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g]
        scaled = np.array(monic) / omega[i] ** np.arange(5)
        np.testing.assert_allclose(np.poly(matrices[i]), scaled, rtol=1e-10, atol=1e-12)
        exact, size = exact_growth(*row)
        assert abs(float(exact) - np.roots(scaled).real.max() * omega[i]) < 1e-10 * size
