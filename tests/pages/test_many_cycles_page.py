"""The page of many cycles, run small; its errors are held, not its times."""

import numpy as np
import pytest

from benchmarks.cycles import many_cycles
from tools import quick_benchmark


def test_lanes_are_as_busy_as_their_slowest_lets_them():
    turns = np.array([1.0, 1.0, 2.0, 4.0])
    assert many_cycles.busy(turns, 1) == 1
    assert many_cycles.busy(turns, 2) == np.mean([1.0, 0.75])
    assert many_cycles.busy(turns, 4) == 0.5


def test_ratio_is_to_all_cores_at_no_larger_an_error():
    rows = [
        {"name": "fj.limit_cycle, default", "devices": 2, "error": {"worst": 1e-8}},
        {"name": "fj.limit_cycle, 24 segments", "devices": 2, "error": {"worst": 1e-10}},
        {"name": "heyoka by events", "devices": 2, "error": {"worst": 1e-10}},
    ]
    times = [[0.1, 0.1], [1.0, 2.0], [9.0, 12.0]]
    for found, own in zip(rows, times, strict=True):
        found["seconds_a_cycle"] = own[0]
    (head,) = many_cycles.headline(rows, times)
    assert head["ratio"] == 7.5 and "24 segments" in head["what"]
    assert many_cycles.headline(rows[:2], times[:2]) == []


@pytest.mark.slow  # compiles batches of limit cycles
def test_page_counts_its_batches_and_their_errors(tmp_path):
    numbers, page = quick_benchmark("many_cycles", tmp_path)
    one, two, *peers = numbers["methods"]
    assert (one["devices"], two["devices"]) == (1, 2)
    for found in (one, two):
        assert found["results"] == {"converged": found["cycles"]}
        assert found["error"]["worst"] < 1e-9
    assert len(peers) == len(numbers["headline"])
    for found in peers:  # the same cycles, by another integrator
        assert found["error"]["worst"] < 1e-8
        assert f"| {found['name']} |" in page
    assert all(0 < share <= 1 for share in numbers["lanes"]["busy"].values())
    assert numbers["batches"][-1]["cycles"] == one["cycles"]
