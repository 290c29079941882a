"""The files of a run: all of them or none, and a line that says what they replaced."""

import errno
import os
from pathlib import Path

import pytest

from fractaljax._cli.output import output

FILES = {"run.toml": b"1", "picture.png": b"2"}


def test_what_was_written_and_what_cannot_be(tmp_path):
    with output(Path("a/b")) as write:
        assert not Path("a").exists()
        assert write(FILES) == "written to a/b: run.toml, picture.png"
        assert write(FILES) == "written to a/b: run.toml, picture.png (all replaced)"
        Path("a/b/run.toml").unlink()
        said = "written to a/b: run.toml, picture.png (picture.png replaced)"
        assert write(FILES) == said
    assert {file.name: file.read_bytes() for file in Path("a/b").iterdir()} == FILES
    Path("file").write_text("in the way")
    for name in ("file", "file/below", "c/d/" + 300 * "e"):
        with pytest.raises(OSError), output(Path(name)):
            raise AssertionError
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "file"]


@pytest.mark.parametrize("failing", [1, 2])
def test_a_full_disk_leaves_the_earlier_run(monkeypatch, failing):
    """And no folder where there was none."""
    fsync, synced = os.fsync, []

    def fail(handle):
        synced.append(handle)
        if len(synced) == failing:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(handle)

    with output(Path("old")) as write:
        write(FILES)
    monkeypatch.setattr(os, "fsync", fail)
    for folder in (Path("old"), Path("a/b")):
        synced.clear()
        said = f"No space left on device: '{folder}/"
        with pytest.raises(OSError, match=said), output(folder) as write:
            write({name: b"new" for name in FILES})
    assert {file.name: file.read_bytes() for file in Path("old").iterdir()} == FILES
    assert not Path("a").exists()
