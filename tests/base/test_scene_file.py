"""Scene files: what they refuse, in one line, and that none is ever half-written."""

import errno
import os
import resource

import pytest

import fractaljax as fj
from fractaljax.base.scene_file import write_together, write_whole

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
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_files_have_the_mode_that_the_user_wants(tmp_path, umask, mode):
    """Also where they replace a file."""
    before = os.umask(umask)
    try:
        for _ in range(2):
            write_whole(tmp_path / "scene.toml", b"new")
            assert (tmp_path / "scene.toml").stat().st_mode & 0o777 == mode
    finally:
        os.umask(before)


OLD = {"a": b"old a", "b": b"old b", "notes": b"mine"}  # c is not there yet
NEW = {"a": b"new a", "b": b"new b", "c": b"new c"}
CALLS = [("fsync", k) for k in range(1, 4)] + [("replace", k) for k in range(1, 6)]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def put(folder, files=OLD):
    for name, content in files.items():
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
@pytest.mark.parametrize(("name", "failing"), CALLS)
def test_files_of_a_run_replace_those_of_another_together(
    tmp_path, monkeypatch, name, failing, error
):
    """Whichever step fails, before or after it was taken, the folder is as it was."""
    put(tmp_path)
    call, count = getattr(os, name), [0]

    def fail(*arguments):
        count[0] += 1
        if count[0] == failing:
            if isinstance(error, KeyboardInterrupt):
                call(*arguments)
            raise error
        call(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, name, fail)
        with pytest.raises(type(error)):
            write_together({tmp_path / file: content for file, content in NEW.items()})
    assert count[0] >= failing and contents(tmp_path) == OLD
    replaced = write_together({tmp_path / file: content for file, content in NEW.items()})
    assert replaced == [tmp_path / "a", tmp_path / "b"]
    assert contents(tmp_path) == OLD | NEW


@pytest.mark.parametrize("failing", range(1, 6))
def test_a_run_that_is_killed_leaves_no_mixture(tmp_path, monkeypatch, failing):
    """Whatever the step after which nothing more is done: old files alone, or new ones alone."""
    put(tmp_path)
    replace, count = os.replace, [0]

    def killed(*arguments):
        count[0] += 1
        if count[0] >= failing:
            raise KeyboardInterrupt
        replace(*arguments)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_together({tmp_path / file: content for file, content in NEW.items()})
    left = {name: content for name, content in contents(tmp_path).items() if name in NEW}
    assert left.items() <= OLD.items() or left.items() <= NEW.items()


def test_the_disk_is_full(tmp_path):
    """A limit on the size of files, as the system sets one: the message names the file."""
    put(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_together({tmp_path / "a": b"new", tmp_path / "b": bytes(2000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.filename == str(tmp_path / "b")
    assert contents(tmp_path) == OLD


def test_what_is_no_file_is_not_replaced(tmp_path):
    """A folder, and a device, which would become a file; a link leads to what is written."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("folder", "pipe"):
        with pytest.raises(OSError, match=f"not a regular file: .*{name}"):
            write_together({tmp_path / "a": b"new", tmp_path / name: b"new"})
    assert not (tmp_path / "a").exists() and (tmp_path / "pipe").is_fifo()
    (tmp_path / "file").write_bytes(b"old")
    (tmp_path / "link").symlink_to("file")
    write_whole(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "file").read_bytes() == b"new"


@pytest.mark.parametrize("content", ["D = = 3\n", "[contact\n", "a = 1\na = 2\n", 'x = "a\nb"\n'])
def test_what_is_not_toml_is_called_so(tmp_path, content):
    """With the place in the file, as for a file that is no text."""
    message = refusal(tmp_path, content)
    assert message.startswith("not a TOML file: ") and "line" in message
    assert refusal(tmp_path, b"m = 1\xff").startswith("not a text in UTF-8: ")
    assert refusal(tmp_path, b"m = 1\xff").endswith(" at byte 5")
