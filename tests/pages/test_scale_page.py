"""The page of large sweeps, run small; what it holds are values and structure, not times."""

import numpy as np
import pytest

import fractaljax as fj
from benchmarks.page import held
from benchmarks.sweeps.job import Job, at, log_begun, measured
from benchmarks.sweeps.scale import slope
from benchmarks.sweeps.scale_page import short
from fractaljax.sweeping.shards import Shards
from tools import quick_benchmark

LENGTHS = (2, 3, 2, 2)


def test_a_job_gives_the_values_at_its_points(tmp_path):
    picked = (0, 5, 23)
    found = measured(Job(LENGTHS, 2, 10, shards=str(tmp_path), picked=picked))
    each = [fj.growth_rate(fj.brake_scene().replace(**at(LENGTHS, point))) for point in picked]
    np.testing.assert_allclose(found["values"], each, rtol=1e-9)
    assert len(found["seconds"]) == 2 and found["result_bytes"] == 8 * 24
    assert sorted(file.name for file in (tmp_path / "1").glob("*.npz")) == [
        f"{k:08d}.npz" for k in range(3)
    ]
    once = measured(Job(LENGTHS, at_once=True, picked=picked))
    np.testing.assert_allclose(once["values"], found["values"], rtol=1e-9)


def test_batches_that_are_begun_are_written_down(tmp_path, monkeypatch):
    monkeypatch.setattr(Shards, "has", Shards.has)  # put back afterwards
    about = {"key": "", "axes": {}, "batch": 1, "arrays": []}
    log_begun(str(tmp_path / "begun.txt"))
    shards = Shards(tmp_path / "sweep", about)
    shards.write(1, [np.arange(3)])
    assert [shards.has(k) for k in range(3)] == [False, True, False]
    assert (tmp_path / "begun.txt").read_text().split() == ["0", "2"]


def test_slopes_and_numbers_in_words():
    rows = [{"points": n, "seconds": 2e-6 * n} for n in (10, 1000, 100_000)]
    assert slope(rows, "seconds") == pytest.approx(1)
    assert (short(100_000_000), short(4e6)) == ("1e8", "4e6")


@pytest.mark.slow  # starts Python some fifteen times
def test_scale_benchmark_keeps_every_value_and_loses_one_batch_a_kill(tmp_path):
    numbers, page = quick_benchmark("scale", tmp_path)
    for row in numbers["rows"]:
        assert f"| {row['way']} | {short(row['points'])} |" in page
        assert max(row["off_single"], row["off_exact"]) < 1e-12
        assert row["result_bytes"] == 8 * row["points"]
        assert row["files"] == (-(-row["points"] // 8192) if "shards" in row["way"] else 0)
    for entry in numbers["headline"][2:]:  # memory and batches, no times
        assert held(entry), entry
    killed = numbers["interrupted"]
    assert killed["kills"] and killed["equal_to_the_last_bit"]
    assert killed["batches_at_the_end"] == killed["batches"]
    assert killed["computed_again"] <= len(killed["kills"])
    assert [way["device_count"] for way in numbers["shared"]] == [1, 2, 1, 2]
