"""Programs kept on disk: the same numbers without a trace, and no wrong program."""

import os
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._base import kept, quick

pytestmark = pytest.mark.optimised


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(kept, "_folder", None)
    monkeypatch.setattr(kept, "_loaded", {})
    kept.keep_in(tmp_path / "programs")
    return tmp_path / "programs"


def counted(jit=quick.command_jit):
    """A program that counts its traces, and the count."""
    traces = []

    def program(x, power: int = 2):
        traces.append(power)
        return {"value": x**power, "scene": x}

    return jit(program, "power"), traces


def square(x):
    return x**2


def forget(monkeypatch):
    """As in a new process."""
    monkeypatch.setattr(kept, "_loaded", {})
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.parametrize("jit", [quick.quick_jit, quick.command_jit])
def test_a_program_is_loaded_without_a_trace(folder, monkeypatch, jit):
    program, traces = counted(jit)
    x = jnp.arange(3.0)
    first = program(x)
    forget(monkeypatch)
    again = program(x)
    assert len(traces) == 1 and len([*folder.iterdir()]) == 1
    np.testing.assert_array_equal(first["value"], x**2)
    np.testing.assert_array_equal(again["value"], first["value"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "other",
    [
        lambda program, x: program(x, 3),
        lambda program, x: program(x=x, power=3),
        lambda program, x: program(x[:2]),
        lambda program, x: program(x.astype(jnp.float32)),
        lambda program, x: program(2.0),
    ],
)
def test_other_arguments_are_another_program(folder, monkeypatch, other):
    program, traces = counted()
    x = jnp.arange(3.0)
    program(x)
    forget(monkeypatch)
    other(program, x)
    assert len(traces) == 2 and len([*folder.iterdir()]) == 2


def test_other_sources_are_another_program(folder, monkeypatch):
    program, traces = counted()
    program(2.0)
    forget(monkeypatch)
    monkeypatch.setattr(kept, "_surroundings", lambda: "another version")
    program(2.0)
    assert len(traces) == 2


def test_sources_settings_and_processor_are_known(monkeypatch):
    at = kept._surroundings.__wrapped__
    before = at()
    assert before == at()
    jax.config.update("jax_debug_nans", True)
    try:
        assert at() != before
    finally:
        jax.config.update("jax_debug_nans", False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert at() != before


def test_programs_of_another_user_are_not_loaded(tmp_path, monkeypatch):
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(PermissionError, match="belongs to another user"):
        kept.keep_in(tmp_path)
    assert kept._folder is None


class Elsewhere(fj.Friction):
    """A law whose code the file's name could not know."""

    mu_s: jax.Array
    mu_m: jax.Array

    def mu(self, speed):
        return self.mu_s


def test_two_ways_to_compile_one_function_are_two_programs(folder):
    for once in (False, True):
        program = quick.quick_jit(square, once=once)
        assert program(3.0) == 9
    assert len([*folder.iterdir()]) == 2


@pytest.mark.parametrize(
    ("function", "needed"),
    [(jnp.linalg.eigvals, True), (jnp.linalg.cholesky, True), (square, False)],
)
def test_programs_that_call_it_find_lapack(folder, monkeypatch, function, needed):
    """Without its addresses such a program ends the process."""
    asked, found = [], kept._find_lapack
    monkeypatch.setattr(kept, "_find_lapack", lambda: (asked.append(True), found()))
    program, x = quick.command_jit(function), jnp.eye(3) * 2
    first = program(x)
    forget(monkeypatch)
    np.testing.assert_array_equal(program(x), first)
    assert asked == [True] * needed


def test_within_a_trace_and_from_elsewhere_nothing_is_kept(folder):
    program, _ = counted()
    assert jax.grad(lambda x: program(x)["value"])(3.0) == 6
    assert jax.jit(lambda: program(3.0)["value"])() == 9
    assert (jax.vmap(program)(jnp.arange(2.0))["value"] == jnp.arange(2.0)).all()
    assert not [*folder.iterdir()]
    law = Elsewhere(jnp.asarray(0.3), jnp.asarray(0.2))
    assert quick.command_jit(lambda law: law.mu(0.0))(law) == 0.3
    applied = quick.command_jit(lambda x, function: function(x), "function")
    assert applied(2.0, function=lambda x: 3 * x) == 6
    assert not [*folder.iterdir()]


@pytest.mark.parametrize("damage", ["cut", "another result", "empty"])
def test_a_damaged_file_is_replaced(folder, monkeypatch, damage):
    program, traces = counted()
    program(2.0)
    (file,) = folder.iterdir()
    cut = file.read_bytes()[:200]
    file.write_bytes({"cut": cut, "another result": b"cnone\n.", "empty": b""}[damage])
    for _ in range(2):
        forget(monkeypatch)
        assert program(2.0)["value"] == 4 and len(traces) == 2


def test_a_folder_that_is_gone_or_full(folder, monkeypatch):
    program, _ = counted()
    folder.rmdir()
    assert program(2.0)["value"] == 4
    folder.mkdir()
    monkeypatch.setattr(kept, "_MOST_BYTES", 20_000)
    for power in range(5):
        program(2.0, power)
        for file in folder.iterdir():  # a resolution of seconds is enough
            os.utime(file, ns=(0, file.stat().st_mtime_ns - 10**10))
    sizes = [file.stat().st_size for file in folder.iterdir()]
    assert 0 < sum(sizes) <= 20_000 < 5 * min(sizes)


@pytest.mark.slow
def test_commands_in_new_processes(tmp_path):
    """The second of two processes prints the same and traces none of these programs."""
    script = """
        import sys, jax
        traced = []
        def hear(name, seconds, **what):
            if name.endswith("jaxpr_trace_duration"):
                traced.append(what.get("fun_name"))
        jax.monitoring.register_event_duration_secs_listener(hear)
        from fractaljax.__main__ import main
        main(sys.argv[1:])
        own = {"linearised", "solved", "_stability", "_growth_rate", "_numbers", "_of_scene"}
        print("scipy.linalg" in sys.modules, file=sys.stderr)
        print(sorted(own & set(traced)), file=sys.stderr)
    """
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    environment.pop("XLA_FLAGS", None)
    for command, traced in (
        (["stability"], ["_numbers", "_of_scene"]),
        (["cycle", "--out", "cycle"], ["solved", "_stability"]),
    ):
        runs = [
            subprocess.run(
                [sys.executable, "-c", textwrap.dedent(script), *command],
                cwd=tmp_path,
                env=environment,
                capture_output=True,
                text=True,
                check=True,
            )
            for _ in range(2)
        ]
        outputs = [run.stdout.replace("replaced", "written") for run in runs]
        assert outputs[0].splitlines()[:10] == outputs[1].splitlines()[:10]
        heard = [set(eval(run.stderr.splitlines()[-1])) for run in runs]
        assert heard[0] >= set(traced) and not heard[1]
        loaded = runs[1].stderr.splitlines()[-2]
        assert loaded == "False" or command != ["stability"]  # it needs no LAPACK
