"""README tells the truth: its commands, its example and output, its scene file, its picture."""

import re
from pathlib import Path

import matplotlib.image
import numpy as np

import fractaljax as fj
from fractaljax.__main__ import main

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def block(language):
    """The text of the one fenced block of a language."""
    (text,) = re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)
    return text


def test_example_prints_what_is_printed(capsys):
    """The example runs as it stands and its output is the one shown, digit for digit."""
    code = block("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == block("text")


def test_scene_file_is_the_one_the_command_writes():
    """The scene file shown is that of `fractaljax scene`."""
    assert block("toml") == fj.brake_scene().to_toml()


def test_commands_are_those_that_ci_runs():
    """The two commands for a fresh machine; CI runs the second as printed."""
    first, second = re.findall(r"^    (python -m pip .*)$", README, flags=re.MULTILINE)
    ci = (ROOT / ".ci" / "run").read_text().splitlines()
    assert second in ci
    assert any(line.startswith(first) for line in ci)


def test_links_lead_somewhere():
    """Every relative link of README has a file."""
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_picture_is_the_one_the_command_writes(tmp_path, capsys):
    """The committed picture is what `fractaljax design` draws, up to the rendering of type."""
    assert main(["design", "--quiet", "--out", str(tmp_path)]) == 0
    drawn = matplotlib.image.imread(tmp_path / "design.png")
    shown = matplotlib.image.imread(ROOT / "docs" / "design.png")
    assert drawn.shape == shown.shape
    assert np.abs(drawn - shown).mean() < 0.01
