"""The page of the growth rate with gradient, run small; its errors are held, not times."""

import numpy as np
import pytest

from benchmarks.growth.growth_rate_methods import D_RANGE, G_RANGE, surfaces
from benchmarks.growth.loops import arrays, brake, differences, loop_value, tuned_loop
from tools import quick_benchmark

REGIMES = {"elastic-plastic", "fully plastic", "gross slip"}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return quick_benchmark("growth_rate", tmp_path_factory.mktemp("growth_rate"))


def test_page_shows_every_method_and_what_was_wanted(results):
    numbers, page = results
    (headline,) = numbers["headline"]
    assert headline["ratio"] > 0 and f"wanted >= {headline['wanted']}" in page
    assert set(numbers["regimes"]) == REGIMES
    for method in numbers["methods"]:
        assert f"| {method['name']} |" in page and method["ratio_to_loop"] > 0
    for row in numbers["batches"]:
        assert f"| {row['points']:,} |" in page and min(row["points_per_second"].values()) > 0


def test_errors_of_the_package_are_small_and_those_of_differences_are_not(results):
    numbers, _ = results
    rows = {method["name"]: method for method in numbers["methods"]}
    for row in rows.values():
        assert row["not_finite"] == 0
        single = "float32" in row["name"]
        assert row["error_to_40_digits"]["growth_rate"]["worst"] < (1e-7 if single else 1e-14)
    for name in ("forward mode", "reverse mode"):
        assert rows[name]["compile_s"] > 0
        assert rows[name]["error_to_40_digits"]["gradient"]["worst"] < 1e-11
    assert rows["forward mode, float32"]["error_to_40_digits"]["gradient"]["worst"] < 1e-2
    peers = [row for row in rows.values() if row["gradient"] and row["compile_s"] is None]
    assert len(peers) == 4
    for row in peers:
        assert 1e-11 < row["error_to_40_digits"]["gradient"]["worst"] < 1e-4


def test_peer_gets_the_step_with_the_least_error(results):
    numbers, _ = results
    for order, step in numbers["best_steps"].items():
        worst = {r["step"]: r["worst"] for r in numbers["steps"] if r["order"] == int(order)}
        assert worst[step] == min(worst.values())
        assert 1e-7 < step < 1e-2 and min(worst) < step < max(worst)  # from both ends it is worse


def test_numpy_arrays_are_as_the_loop_is():
    D, G = surfaces(300)
    assert D_RANGE[0] <= D.min() and D.max() <= D_RANGE[1]
    assert G_RANGE[0] * (1 - 1e-7) <= G.min() and G.max() <= G_RANGE[1] * (1 + 1e-7)
    growth, loop = arrays(brake()), tuned_loop(brake())
    states = [loop(d, g) for d, g in zip(D, G, strict=True)]
    assert {state[2] for state in states} == REGIMES
    off = growth(D, G) - loop_value(loop, D.tolist(), G.tolist())
    assert np.max(np.abs(off) / [state[1] for state in states]) < 1e-14


@pytest.mark.parametrize("order", [2, 4])
def test_differences_have_their_order(order):
    def cubic(D, G):
        return D**order + np.log(G) ** order

    D, G = np.array([2.4]), np.array([1e-10])
    value, by_D, by_log_G = differences(cubic, D, G, 0.1, order)[0]
    slopes = order * D[0] ** (order - 1), order * np.log(G[0]) ** (order - 1)
    np.testing.assert_allclose([value, by_D, by_log_G], [cubic(D, G)[0], *slopes], rtol=1e-10)
