"""The page that shows all others says what they say."""

import json

import pytest

from benchmarks import index
from benchmarks.__main__ import BENCHMARKS
from benchmarks.page import held
from tools import ROOT

RESULTS = ROOT / "benchmarks" / "results"
MACHINE = {"cpu": "A processor", "cores": 2, "device": "cpu", "others_running": 0.1}


def folder_with(path, **headlines):
    """A folder with pages of these headlines."""
    for name, headline in headlines.items():
        numbers = {"machine": MACHINE, "headline": headline}
        (path / f"{name}.json").write_text(json.dumps(numbers))
        (path / f"{name}.md").write_text(f"# About {name}\n\nTake\nthis.\n\nMore.\n")
    return path


@pytest.mark.parametrize(
    ("head", "verdict"),
    [
        ({"ratio": 100.0, "wanted": 100}, True),
        ({"ratio": 99.9, "wanted": 100}, False),
        ({"ratio": float("nan"), "wanted": 100}, False),
        ({"value": 1.1, "wanted": [0.9, 1.1]}, True),
        ({"value": 1.11, "wanted": [0.9, 1.1]}, False),
        ({"value": 0.89, "wanted": [0.9, 1.1]}, False),
    ],
)
def test_a_number_is_held_or_missed(head, verdict):
    assert held(head) == verdict


def test_a_missed_ratio_is_shown_as_missed(tmp_path):
    folder = folder_with(
        tmp_path,
        quick=[{"what": "speed", "ratio": 123.0, "wanted": 100}],
        slow=[{"what": "haste", "ratio": 7.0, "wanted": 10}],
        other=[],
    )
    page = index.text(folder)
    assert "| speed | 123 times | at least 100 times | held | [quick](quick.md) |" in page
    assert "| haste | 7 times | at least 10 times | **missed** | [slow](slow.md) |" in page
    assert "Of 2 ratios and bounds to hold, 1 are held and 1 are missed" in page
    assert "- [About other](other.md). Take this." in page
    assert "A processor, 2 cores" in page and "Not measured" in page


def test_another_device_is_named(tmp_path):
    folder = folder_with(tmp_path, quick=[])
    numbers = {"machine": MACHINE | {"device": "Some accelerator"}}
    (folder / "quick.json").write_text(json.dumps(numbers))
    page = index.text(folder)
    assert "Measured on Some accelerator." in page
    assert "Some accelerator beside A processor, 2 cores" in page


def test_committed_results_are_whole_and_of_one_machine():
    """Every page is there, the index is that of the pages, and one machine made them all."""
    found = index.pages(RESULTS)
    assert set(found) == set(BENCHMARKS)
    assert (RESULTS / index.NAME).read_text() == index.text(RESULTS)
    assert len({json.dumps(named_of(numbers)) for numbers in found.values()}) == 1
    assert not any(numbers["quick"] for numbers in found.values())


def named_of(numbers):
    """The machine of a page, but for how busy it was."""
    return {key: value for key, value in numbers["machine"].items() if key != "others_running"}
