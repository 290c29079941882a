"""The benchmark runs whole and small; its errors are held here, its timings are not."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ENDINGS = "json", "md", "png"


def quick(name, folder):
    """What `python -m benchmarks NAME --quick` writes to a folder."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", name, "--quick", "--out", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert {path.name for path in folder.iterdir()} == {f"{name}.{end}" for end in ENDINGS}
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    return folder


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return quick("growth_rate", tmp_path_factory.mktemp("growth_rate"))


@pytest.fixture(scope="module")
def eigenvalue_results(tmp_path_factory):
    return quick("eigenvalues", tmp_path_factory.mktemp("eigenvalues"))


@pytest.fixture(scope="module")
def cycle_results(tmp_path_factory):
    return quick("limit_cycle", tmp_path_factory.mktemp("limit_cycle"))


def test_benchmark_writes_its_numbers_and_its_table(results):
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


def test_eigenvalue_benchmark_is_no_less_accurate_than_lapack(eigenvalue_results):
    numbers = json.loads((eigenvalue_results / "eigenvalues.json").read_text())
    table = (eigenvalue_results / "eigenvalues.md").read_text()
    assert f"wanted >= {numbers['headline']['wanted']}" in table
    assert "no larger in any family" in table
    for method in numbers["methods"]:
        assert f"| {method['name']} |" in table and method["ratio_to_numpy"] > 0
    families = {row["family"]: row for row in numbers["families"]}
    assert len(families) == 6 and families["random"]["unstable"] > 0
    for name, row in families.items():
        assert f"| {name} |" in table and row["wrong_signs"] == 0
        worst = row["errors"]["closed form"]["worst"]
        assert worst <= row["errors"]["numpy.linalg.eigvals"]["worst"]
        assert worst < (1e-8 if "coalescence" in name else 1e-15)


@pytest.mark.slow
def test_limit_cycle_benchmark_lists_every_method_with_its_error(cycle_results):
    numbers = json.loads((cycle_results / "limit_cycle.json").read_text())
    table = (cycle_results / "limit_cycle.md").read_text()
    for row in numbers["methods"] + numbers["extreme"]:
        assert f"| {row['name']} |" in table
    assert {m["group"] for m in numbers["methods"]} >= {"package", "tanh"}
    for method in numbers["methods"]:
        assert method["seconds"] > 0
        if method["group"] == "package":
            assert method["error"] < 1e-8
            assert method["gradient_error"] is None or method["gradient_error"] < 1e-8
        elif method["group"] == "tanh":  # of a wide layer here
            assert method["error"] < 0.3
        elif method["periods"] == 120:  # by events
            assert method["error"] < 1e-11


@pytest.mark.slow
def test_limit_cycle_benchmark_counts_its_batch_and_explains_what_is_not_finite(cycle_results):
    numbers = json.loads((cycle_results / "limit_cycle.json").read_text())
    batch = numbers["batch"]
    assert batch["cycles_per_second"] > 0
    assert sum(batch["results"].values()) == batch["cycles"]
    assert batch["not_converged"] == 0
    assert batch["error"]["worst"] < 1e-9
    for row in numbers["extreme"]:
        assert (row["result"] in ("converged", "inaccurate")) == (row["non_finite"] is None)
        if row["non_finite"] is None:
            assert row["trivial_multiplier_off"] < 1e-9
