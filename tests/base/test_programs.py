"""Programs that a command keeps on disk: the same numbers without a trace, and no wrong program."""

import dataclasses
import os
import stat
import subprocess
import sys
import textwrap
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._base import programs

SETTINGS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
POSIX = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows keeps folders apart")


@pytest.fixture(autouse=True)
def unset():
    """JAX has no folder for its cache; afterwards everything is as it was."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_folder", tmp_path)
    monkeypatch.setattr(programs, "_programs", {})
    # As if what is defined here were of the package.
    monkeypatch.setattr(programs, "_TRUSTED", (*programs._TRUSTED, __name__.partition(".")[0]))
    return tmp_path


class Named(NamedTuple):
    first: jax.Array
    second: tuple


class Module(eqx.Module):
    x: jax.Array
    label: str = eqx.field(static=True)


traces = []


def everything(x, power: int = 2):
    traces.append(power)
    return {
        "value": x**power,
        "named": Named(x + 1, (None, x)),
        "module": Module(2 * x, "twice"),
        "list": [True, 0.5, jnp.asarray(0.25, x.dtype)],
    }


program = programs.exported_jit(everything, "power")


@dataclasses.dataclass(frozen=True)
class Options:
    power: int = 2


def with_options(x, options: Options):
    traces.append(options)
    return x**options.power


chosen_program = programs.exported_jit(with_options, "options")


def forget(monkeypatch):
    """As in a new process."""
    monkeypatch.setattr(programs, "_programs", {})
    jax.clear_caches()
    traces.clear()


def test_a_program_is_loaded_without_a_trace(folder, monkeypatch):
    x = jnp.arange(3.0)
    expected = jax.jit(everything)(x)
    first = program(x)
    forget(monkeypatch)
    again = program(x)
    assert not traces and len([*folder.iterdir()]) == 1
    for found in (first, again):
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert (again["module"].label, again["list"][:2]) == ("twice", [True, 0.5])


def test_a_program_with_a_class_of_options_is_loaded_without_a_trace(folder, monkeypatch):
    x = jnp.arange(3.0)
    chosen_program(x, Options())
    forget(monkeypatch)
    np.testing.assert_array_equal(chosen_program(x, Options()), x**2)
    assert not traces
    np.testing.assert_array_equal(chosen_program(x, Options(3)), x**3)
    assert traces and len([*folder.iterdir()]) == 2


@pytest.mark.parametrize(
    "other",
    [
        lambda x: program(x, 3),
        lambda x: program(x=x, power=3),
        lambda x: program(x[:2]),
        lambda x: program(x.astype(jnp.float32)),
        lambda x: program(2.0),
    ],
)
def test_other_arguments_are_another_program(folder, monkeypatch, other):
    x = jnp.arange(3.0)
    program(x)
    forget(monkeypatch)
    other(x)
    assert traces and len([*folder.iterdir()]) == 2


def test_other_sources_and_settings_are_another_program(folder, monkeypatch):
    program(2.0)
    at = programs._surroundings.__wrapped__
    before = at()
    assert before == at()
    with jax.default_matmul_precision("float32"):
        assert at() != before
    forget(monkeypatch)
    monkeypatch.setattr(programs, "_surroundings", lambda: "another version")
    program(2.0)
    assert traces


def test_within_a_trace_and_from_elsewhere_nothing_is_kept(folder, monkeypatch):
    def value(x):
        return jnp.sum(program(x)["value"])

    assert jax.grad(value)(3.0) == 6 and jax.jit(value)(3.0) == 9
    assert (jax.vmap(value)(jnp.arange(2.0)) == jnp.arange(2.0)).all()
    assert programs.exported_jit(lambda x: 3 * x)(2.0) == 6  # it has no name of its own
    monkeypatch.setattr(programs, "_TRUSTED", ("fractaljax",))
    assert float(program(2.0)["value"]) == 4  # of a file that the package's sources do not cover
    assert not [*folder.iterdir()]


def flipped(content: bytes, at: float) -> bytes:
    place = int(at * (len(content) - 1))
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


@pytest.mark.parametrize("at", [0.0, 0.01, 0.1, 0.5, 0.9, 1.0])
def test_one_flipped_bit_compiles_anew(folder, monkeypatch, at):
    program(2.0)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for damaged in (flipped(whole, at), whole[: int(at * len(whole))]):
        if damaged == whole:
            continue
        file.write_bytes(damaged)
        forget(monkeypatch)
        assert float(program(2.0)["value"]) == 4 and traces
        assert file.read_bytes() == whole


@POSIX
def test_a_file_that_others_can_write_is_not_read(folder, monkeypatch):
    program(2.0)
    (file,) = folder.iterdir()
    file.chmod(0o666)
    forget(monkeypatch)
    program(2.0)
    assert traces and not stat.S_IMODE(file.stat().st_mode) & 0o022  # written anew


def test_a_folder_that_is_gone_or_full(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_folder", tmp_path / "gone")
    assert float(program(2.0)["value"]) == 4
    monkeypatch.setattr(programs, "_folder", folder)
    for power in range(3, 8):
        program(2.0, power)
    files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)
    for age, file in enumerate(reversed(files)):
        os.utime(file, (1e9 - age, 1e9 - age))
    monkeypatch.setattr(programs, "_MOST_BYTES", 2.5 * files[0].stat().st_size)
    programs._make_room(folder)
    assert sorted(folder.iterdir()) == sorted(files[-2:])


# --- where they are kept -------------------------------------------------------------------


def test_private_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_programs", {})
    monkeypatch.setattr(programs, "_TRUSTED", (*programs._TRUSTED, __name__.partition(".")[0]))
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    shared_with_a_group = os.umask(0o002)
    try:
        with programs.keep_programs():
            assert float(program(2.0)["value"]) == 4
    finally:
        os.umask(shared_with_a_group)
    folder = tmp_path / "cache" / "fractaljax" / "compiled"
    with programs.keep_programs():
        assert programs._folder == folder / "programs"
    assert programs._folder is None  # of a process that does more than one command
    assert [getattr(jax.config, name) for name in SETTINGS] == [str(folder), 0]
    (kept,) = (folder / "programs").iterdir()
    for place, mode in ((folder, 0o700), (folder / "programs", 0o700), (kept, 0o600)):
        assert stat.S_IMODE(place.stat().st_mode) == mode
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))  # one that is set stays
    with programs.keep_programs():
        assert programs._folder == tmp_path / "programs"
    assert getattr(jax.config, SETTINGS[0]) == str(tmp_path)


@POSIX
@pytest.mark.parametrize("why", ["not a folder", "no home", "of all", "of another user"])
def test_no_folder(tmp_path, monkeypatch, why):
    def nowhere():
        raise RuntimeError("no home")

    (tmp_path / "file").touch()
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" if why[:3] == "not" else tmp_path))
    if why == "no home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr("pathlib.Path.home", nowhere)
    if why == "of all":
        (tmp_path / "fractaljax" / "compiled").mkdir(parents=True)
        (tmp_path / "fractaljax" / "compiled").chmod(0o777)
    if why == "of another user":
        owner = os.getuid()
        monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with programs.keep_programs():
        assert getattr(jax.config, SETTINGS[0]) is None is programs._folder


@pytest.mark.slow
@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="another cache folder")
def test_commands_in_new_processes(tmp_path):
    """A later process prints the same and traces no program of the first, even beside damage."""
    script = """
        import sys, jax
        traced = []
        def hear(name, seconds, **what):
            if name.endswith("jaxpr_trace_duration"):
                traced.append(what.get("fun_name"))
        jax.monitoring.register_event_duration_secs_listener(hear)
        from fractaljax.__main__ import main
        status = main(sys.argv[1:])
        print(sorted(set(map(str, traced))), file=sys.stderr)
        sys.exit(status)
    """
    cache = tmp_path / "fractaljax" / "compiled"
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)

    def output(command):
        run = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script), *command],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert run.returncode == 0, run.stderr
        heard = eval(run.stderr.splitlines()[-1])
        return run.stdout.replace("replaced", "written").splitlines()[:10], "flat" in heard

    for command in (["stability"], ["cycle", "--out", "cycle"], ["design", "--quiet"]):
        first, again = output(command), output(command)
        assert first[0] == again[0]
        assert first[1] and not again[1], command
        assert [x for x in cache.iterdir() if x.is_file()]  # JAX's own entries
        for file in [x for x in cache.rglob("*") if x.is_file()]:
            file.write_bytes(flipped(file.read_bytes(), 0.5))
        assert output(command) == first
