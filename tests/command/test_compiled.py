"""Where a command keeps what it compiles, and that it never fails for want of such a place."""

import os
import stat

import jax
import pytest

from fractaljax.command.compiled import FIRST_QUIET_JAX, keep_compiled

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


def test_in_a_private_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    keep_compiled()
    folder = tmp_path / "cache" / "fractaljax" / "compiled"
    assert getattr(jax.config, SETTINGS[0]) == str(folder)
    assert getattr(jax.config, SETTINGS[1]) == 0
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700


def test_a_folder_that_is_set_stays(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    keep_compiled()
    assert getattr(jax.config, SETTINGS[0]) == str(tmp_path)


def test_without_a_folder_that_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    keep_compiled()
    assert getattr(jax.config, SETTINGS[0]) is None


def test_without_a_home(monkeypatch):
    def nowhere():
        raise RuntimeError("no home")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("pathlib.Path.home", nowhere)
    keep_compiled()
    assert getattr(jax.config, SETTINGS[0]) is None


def test_not_by_a_jax_that_fills_standard_error(tmp_path, monkeypatch):
    monkeypatch.setattr("jax.__version_info__", (0, 10, 1))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keep_compiled()
    assert getattr(jax.config, SETTINGS[0]) is None
