"""Where a command keeps what it compiles; without such a place it works too."""

import os
import stat

import jax
import pytest

from fractaljax._base import kept
from fractaljax._cli.compiled import FIRST_QUIET_JAX, keep_compiled

SETTINGS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    """No folder is set, by a JAX that is quiet; afterwards everything is as it was."""
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("jax.__version_info__", FIRST_QUIET_JAX)
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_private_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "cache" / "fractaljax" / "compiled"
    with keep_compiled():
        assert kept._folder == folder / "programs"
    assert kept._folder is None  # of a process that does more than one command
    assert [getattr(jax.config, name) for name in SETTINGS] == [str(folder), 0]
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))  # one that is set stays
    with keep_compiled():
        assert kept._folder == tmp_path / "programs"
    assert getattr(jax.config, SETTINGS[0]) == str(tmp_path)


@pytest.mark.parametrize("why", ["not writable", "no home", "a JAX that prints notes"])
def test_no_folder(tmp_path, monkeypatch, why):
    def nowhere():
        raise RuntimeError("no home")

    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" if why[:3] == "not" else tmp_path))
    if why == "no home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr("pathlib.Path.home", nowhere)
    if why.startswith("a JAX"):
        monkeypatch.setattr("jax.__version_info__", (0, 10, 1))
    with keep_compiled():
        assert getattr(jax.config, SETTINGS[0]) is None is kept._folder
