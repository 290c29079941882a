"""The benchmark runs whole and small; its errors are held here, its timings are not."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The folder that `python -m benchmarks --quick` fills."""
    folder = tmp_path_factory.mktemp("benchmarks")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--quick", "--out", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_benchmark_writes_its_numbers_its_table_and_its_picture(results):
    names = {path.name for path in results.iterdir()}
    assert names == {"growth_rate.json", "growth_rate.md", "growth_rate.png"}
    assert (results / "growth_rate.png").read_bytes().startswith(b"\x89PNG")
    numbers = json.loads((results / "growth_rate.json").read_text())
    table = (results / "growth_rate.md").read_text()
    assert f"wanted >= {numbers['headline']['wanted']}" in table
    for method in numbers["methods"]:
        assert f"| {method['name']} |" in table


def test_benchmark_reports_ratios_and_its_errors_are_small(results):
    numbers = json.loads((results / "growth_rate.json").read_text())
    assert numbers["headline"]["ratio_to_loop"] > 0
    assert set(numbers["regimes_of_sample"]) == {"elastic-plastic", "fully plastic", "gross slip"}
    own = [method for method in numbers["methods"] if method["compile_s"] is not None]
    assert len(own) >= 3
    for method in own:
        assert method["ratio_to_loop"] > 0
        assert method["compile_s"] > 0
        assert method["error_to_40_digits"]["growth_rate"]["worst"] < 1e-11
        assert method["error_to_loop"]["growth_rate"]["worst"] < 1e-11
        if method["gradient"]:
            assert method["error_to_40_digits"]["gradient"]["worst"] < 1e-7
