"""Files are written whole or not at all, and read within bounds."""

import errno
import os
import resource

import pytest

from fractaljax._base.files import read_bounded, write_together, write_whole

OLD = {"a": b"old a", "b": b"old b", "notes": b"mine"}  # c is not there yet
NEW = {"a": b"new a", "b": b"new b", "c": b"new c"}
STEPS = [("fsync", k) for k in range(1, 4)] + [("replace", k) for k in range(1, 6)]
FULL = OSError(errno.ENOSPC, "No space left")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path):
    for name, content in OLD.items():
        (tmp_path / name).write_bytes(content)
    return tmp_path


def failing(name, step, error, from_then_on=False):
    """`os.name` that raises at one step; a signal (no `OSError`) comes after the step was taken."""
    call, count = getattr(os, name), [0]

    def fail(*arguments):
        count[0] += 1
        if count[0] == step or (from_then_on and count[0] > step):
            if not (isinstance(error, OSError) or from_then_on):
                call(*arguments)
            raise error
        call(*arguments)

    return fail


@pytest.mark.parametrize("error", [FULL, KeyboardInterrupt()])
@pytest.mark.parametrize(("name", "step"), STEPS)
def test_whichever_step_fails_the_folder_is_as_it_was(folder, monkeypatch, name, step, error):
    files = {folder / file: content for file, content in NEW.items()}
    with monkeypatch.context() as patch:
        patch.setattr(os, name, failing(name, step, error))
        with pytest.raises(type(error)):
            write_together(files)
    assert contents(folder) == OLD
    assert write_together(files) == [folder / "a", folder / "b"]
    assert contents(folder) == OLD | NEW


@pytest.mark.parametrize("step", range(1, 6))
def test_a_killed_process_leaves_no_mixture(folder, monkeypatch, step):
    """Old files alone or new ones alone, whichever step is the last, and the last one named
    ("b", then "c") never without those before it."""
    monkeypatch.setattr(os, "replace", failing("replace", step, KeyboardInterrupt(), True))
    with pytest.raises(KeyboardInterrupt):
        write_together({folder / file: content for file, content in NEW.items()})
    left = {name: content for name, content in contents(folder).items() if name in NEW}
    assert left.items() <= OLD.items() or left.items() <= NEW.items()
    assert set(left) == set("abc"[: len(left)])


def test_a_single_file_is_never_missing(folder, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing("replace", 1, FULL))
        with pytest.raises(OSError, match="No space left"):
            write_whole(folder / "a", b"new")
    assert contents(folder) == OLD
    write_whole(folder / "a", b"new")
    assert contents(folder) == OLD | {"a": b"new"}


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_files_have_the_mode_that_the_user_wants(folder, umask, mode):
    """Also where they replace a file."""
    before = os.umask(umask)
    try:
        for _ in range(2):
            write_whole(folder / "c", b"new")
            assert (folder / "c").stat().st_mode & 0o777 == mode
    finally:
        os.umask(before)


def test_a_full_disk_is_named_with_the_file(folder):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_together({folder / "a": b"new", folder / "b": bytes(2000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.filename == str(folder / "b")
    assert contents(folder) == OLD


def test_only_regular_files_are_replaced(tmp_path):
    """Not a folder, nor a device; a link leads to the file that is written."""
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
    with pytest.raises(OSError, match="file"):
        write_whole(tmp_path / "file" / "below", b"new")


def test_reading_is_bounded(tmp_path):
    with open(tmp_path / "large", "wb") as file:
        file.truncate(10**12)
    for path in ("/dev/zero", tmp_path / "large"):
        with pytest.raises(ValueError, match="the file is larger than 10 MB"):
            read_bounded(path)
