"""README tells the truth: its commands, its example and output, its scene file, its picture."""

import re

import fractaljax as fj
from fractaljax.__main__ import main
from tools import ROOT, assert_same_picture

README = (ROOT / "README.md").read_text()


def blocks(language):
    """The texts of the fenced blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_examples_print_what_is_printed(capsys, tmp_path, monkeypatch):
    """They run one after the other, and output and picture are those shown, digit for digit."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for code, text in zip(blocks("python"), blocks("text"), strict=True):
        assert len([line for line in code.splitlines() if line.strip()]) <= 15
        exec(compile(code, "README.md", "exec"), names)
        assert capsys.readouterr().out == text
    assert_same_picture(tmp_path / "cycle.png", "cycle.png")


def test_scene_file_is_the_one_the_command_writes():
    """The scene file shown is that of `fractaljax scene`."""
    assert blocks("toml") == [fj.brake_scene().to_toml()]


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


def test_pictures_are_those_the_command_writes(tmp_path, capsys):
    """The committed pictures are what `fractaljax design` draws, up to the rendering of type."""
    assert main(["design", "--quiet", "--out", str(tmp_path)]) == 0
    for name in ("design.png", "topographies.png"):
        assert_same_picture(tmp_path / name, name)
