"""README and guide tell the truth: commands, examples and output, scene file, pictures, links."""

import re

import pytest

import fractaljax as fj
from fractaljax.__main__ import main
from tools import ROOT, assert_same_picture

README, GUIDE, LOOP = "README.md", "docs/guide.md", "docs/optax.md"


def blocks(page, language):
    """The texts of the fenced blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)


SLOW = [pytest.param(page, marks=pytest.mark.slow) for page in (GUIDE, LOOP)]


@pytest.mark.parametrize("page", [README, *SLOW])
def test_examples_print_what_is_printed(page, capsys, tmp_path, monkeypatch):
    """The output shown is printed digit for digit, and the picture of the guide is drawn.

    README's table of limits is what its call of `verdict` says of the design.
    """
    monkeypatch.chdir(tmp_path)
    names = {}
    for code, text in zip(blocks(page, "python"), blocks(page, "text"), strict=True):
        own = {}
        exec(compile(code, page, "exec"), own)
        assert capsys.readouterr().out == text
        names = own | names
    if page == README:
        limits = (ROOT / README).read_text().partition("## Limits")[2]
        (call,) = re.findall(r"`(fj\.verdict\(.*\))`", limits)
        shown = re.findall(r"^    (.*)$", limits, flags=re.MULTILINE)
        assert shown == repr(eval(call, names)).splitlines()
    if page == GUIDE:
        assert_same_picture(tmp_path / "cycle.png", "cycle.png")


def test_readme_has_a_short_example_the_scene_and_the_commands_of_ci():
    for code in blocks(README, "python"):
        lines = [line for line in code.splitlines() if line.strip()]
        assert len([line for line in lines if not line.startswith(("import", "jax.config"))]) <= 15
    assert blocks(GUIDE, "toml") == [fj.brake_scene().to_toml()]
    # README shows two commands for a fresh machine. CI runs both.
    text = (ROOT / README).read_text()
    first, second = re.findall(r"^    (python -m pip .*)$", text, flags=re.MULTILINE)
    ci = (ROOT / ".ci" / "run").read_text()
    assert first in ci and second in ci


@pytest.mark.parametrize("page", [README, GUIDE, LOOP, "docs/model.md", "docs/measurements.md"])
def test_links_lead_somewhere(page):
    """Every relative link has a file."""
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text())
    for target in links:
        assert "://" in target or ((ROOT / page).parent / target).is_file(), target


@pytest.mark.slow
def test_pictures_are_those_the_command_writes(tmp_path, capsys):
    """The committed pictures are what `fractaljax design` draws, up to the rendering of type."""
    assert main(["design", "--quiet", "--out", str(tmp_path)]) == 0
    for name in ("design.png", "topographies.png"):
        assert_same_picture(tmp_path / name, name)
