"""Scene files: what they refuse, in one line, and that none is ever half-written."""

import os

import pytest

import fractaljax as fj
from fractaljax.base.scene_file import write_whole

GOOD = fj.brake_scene().to_toml()


def refusal(tmp_path, content):
    """The one line with which loading a file of this content is refused."""
    path = tmp_path / "scene.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError) as caught:
        fj.Scene.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("D = 2.4", "D = 3.0", "[contact.surface] D must be above 2 and below 3, got 3.0"),
        ("D = 2.4", "D = true", "[contact.surface] D must be a number, got True"),
        ("D = 2.4", 'D = "2.4"', "[contact.surface] D must be a number, got '2.4'"),
        ("D = 2.4", "D = [2.4]", "[contact.surface] D must be a real number, got [2.4]"),
        ("D = 2.4", "D = inf", "[contact.surface] D must be above 2 and below 3, got inf"),
        ("D = 2.4", "", "[contact.surface] lacks the key 'D'"),
        ("D = 2.4", "D = 2.4\nE = 1.0", "[contact.surface] has the unknown key 'E'; known are D"),
        ("P = 1907.3", "P = 0", "[contact] P must be above 0, got 0.0"),
        ('law = "fractal"', 'law = "hertz"', '[contact] law must be "fractal" or "fixed"'),
        ('law = "fractal"', "law = 1", '[contact] law must be "fractal" or "fixed", got 1'),
        ('law = "fractal"', "", '[contact] law must be "fractal" or "fixed", got nothing'),
        ('law = "fractal"', 'law = "fixed"', "[contact] has the unknown key 'P'; known are K_n"),
        ("[contact.material]", "[contact.matter]", "[contact] has the unknown key 'matter'"),
        ("[oscillator]", "[oscillators]", "the file has the unknown key 'oscillators'"),
        ("V = 0.15", "V = -0.15", "[oscillator] V must be above 0, got -0.15"),
        ("V = 0.15", "V = 0.15 m/s", "line"),
    ],
)
def test_refusals(tmp_path, old, new, message):
    """Table, key, bound and value, in one line."""
    assert old in GOOD
    assert message in refusal(tmp_path, GOOD.replace(old, new, 1))


def test_files_that_are_no_scene(tmp_path):
    """Nothing at all, a value where a table should be, not TOML, not text."""
    assert refusal(tmp_path, "") == "the table [contact] is missing"
    assert refusal(tmp_path, "contact = 1") == "[contact] must be a table, got 1"
    no_surface = GOOD[: GOOD.index("[contact.surface]")] + GOOD[GOOD.index("[contact.material]") :]
    assert refusal(tmp_path, no_surface) == "the table [contact.surface] is missing"
    assert refusal(tmp_path, "K_n,K_t\n1,2\n")
    assert "UTF-8" in refusal(tmp_path, b"\xff\xfe\x00")


def test_whole_numbers_and_defaults(tmp_path):
    """Integers are numbers, and what has a default may be left out."""
    text = GOOD.replace("P = 1907.3", "P = 2000").replace("gamma = 1.5", "")
    (tmp_path / "scene.toml").write_text(text)
    scene = fj.Scene.load(tmp_path / "scene.toml")
    assert scene.replace(P=1907.3).to_toml() == GOOD


def test_missing_file_and_unwritable_place(tmp_path):
    """The system's own errors, and nothing left behind."""
    with pytest.raises(FileNotFoundError):
        fj.Scene.load(tmp_path / "no.toml")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="file"):
        fj.brake_scene().save(tmp_path / "file" / "scene.toml")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_interrupted_write_keeps_the_old_file(tmp_path, monkeypatch):
    """A file is there whole or not at all."""

    def interrupt(*_):
        raise KeyboardInterrupt

    path = tmp_path / "scene.toml"
    path.write_text("old")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_whole(path, b"new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    write_whole(path, b"new")
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("content", ["D = = 3\n", "[contact\n", "a = 1\na = 2\n", 'x = "a\nb"\n'])
def test_what_is_not_toml_is_called_so(tmp_path, content):
    """With the place in the file, as for a file that is no text."""
    message = refusal(tmp_path, content)
    assert message.startswith("not a TOML file: ") and "line" in message
    assert refusal(tmp_path, b"m = 1\xff").startswith("not a text in UTF-8: ")
    assert refusal(tmp_path, b"m = 1\xff").endswith(" at byte 5")
