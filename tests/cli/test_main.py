"""The command: what it prints and writes, and how it refuses."""

import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.__main__ import main
from fractaljax._dynamics.summary import cycle_table
from tools import (
    motionless_scene,
    reference_cycle,
    reference_scene,
    refused_command,
    run_command as run,
)

_CYCLE = ["cycle.csv", "cycle.png"]
_SEARCH = "fractaljax._dynamics.limit_cycle.limit_cycle"
_TABLE = "fractaljax._stability.summary.stability_table"


def names(folder) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def test_stability_scene_and_version(capsys, tmp_path):
    """The table of the reference brake, and of a file with the slope of its law left out."""
    status, out, err = run(capsys, "stability")
    assert (status, err) == (0, "")
    assert "+22.0801  (it squeals)" in out and out.count("eigenvalue") == 4
    fj.brake_scene().save(tmp_path / "brake.toml")
    status, out, _ = run(capsys, "stability", "brake.toml", "--constant-friction")
    assert status == 0 and "+23.311" in out
    # What `fractaljax scene` prints is the reference brake, to the last bit.
    status, out, _ = run(capsys, "scene")
    Path("scene.toml").write_text(out)
    assert status == 0
    assert fj.Scene.load("scene.toml").to_toml() == fj.brake_scene().to_toml() == out
    assert run(capsys, "--version") == (0, f"fractaljax {fj.__version__}\n", "")


def test_a_jax_newer_than_tested_is_a_note(capsys, monkeypatch):
    monkeypatch.setattr("jax.__version_info__", (0, 13, 1))
    monkeypatch.setattr("jax.__version__", "0.13.1")
    status, out, err = run(capsys, "--version")
    assert (status, out) == (0, f"fractaljax {fj.__version__}\n")
    assert err.startswith("fractaljax: JAX 0.13.1 is newer than 0.12, the newest that was tested")
    assert run(capsys, "scene")[2] == ""  # elsewhere there is none


def assert_same_orbit(rows, cycle):
    """Up to rounding: the command compiles the same program with other options of XLA."""
    wanted = np.column_stack(cycle.orbit(512))
    found = np.array(rows, float)
    assert (abs(found - wanted) <= 4e-15 * abs(wanted).max(axis=0)).all()


def test_cycle(capsys):
    """The table, the picture, and one period as numbers that are those of the orbit."""
    reference_scene().save("mine.toml")
    status, out, err = run(capsys, "cycle", "mine.toml")
    table = cycle_table(reference_scene(), reference_cycle())
    assert (status, err) == (0, "")
    assert out == f"{table}\nwritten to fractaljax-cycle: cycle.png, cycle.csv\n"
    assert names("fractaljax-cycle") == _CYCLE
    with open("fractaljax-cycle/cycle.csv", newline="") as file:
        titles, *rows = csv.reader(file)
    assert titles == ["time [s]", "x1 [m]", "x2 [m]", "v1 [m/s]", "v2 [m/s]"]
    assert_same_orbit(rows, reference_cycle())
    assert Path("fractaljax-cycle/cycle.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_cycle_of_a_structure(capsys):
    """Its joints and degrees of freedom; the start has a number for each state."""
    law = fj.ExponentialStribeck(1.0, 0.5, 0.5)
    joint = fj.Joint(fj.FixedContact(0.0, 0.0, 1.0), law, "block", None, 1.0)
    matrices = [[1.0]], [[0.1]], [[1.0]]
    belt = fj.Structure(*matrices, {"pad": joint}, F=[0.0], names=["block"])
    belt.save("belt.toml")
    status, out, err = run(capsys, "cycle", "belt.toml", "--start", 1.5, 0)
    cycle = fj.limit_cycle(belt, [1.5, 0.0])
    assert (status, err) == (0, "")
    assert out == f"{cycle_table(belt, cycle)}\nwritten to fractaljax-cycle: cycle.png, cycle.csv\n"
    for words in ("pad", "block", "sticks", "15.66% of the period", "6431.38"):
        assert words in out
    with open("fractaljax-cycle/cycle.csv", newline="") as file:
        titles, *rows = csv.reader(file)
    assert titles == ["time [s]", "x1 [m]", "v1 [m/s]"]
    assert_same_orbit(rows, cycle)
    said = "fractaljax: start must have shape (2,), got (1,)\n"
    assert run(capsys, "cycle", "belt.toml", "--start", 1.5) == (2, "", said)


def test_cycle_options(capsys, monkeypatch):
    """Options as given, none otherwise; an inaccurate cycle is one; other files stay."""
    asked = []

    def search(scene, **options):
        asked.append(options)
        return eqx.tree_at(lambda c: c.result, reference_cycle(), fj.CycleResult.inaccurate)

    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    monkeypatch.setattr(_SEARCH, search)
    # Negative numbers with an exponent are numbers, no options.
    options = ["--start", 1, "-2E-3", "-.5e1", 4, "--rtol", 1e-6, "--max-returns", 7]
    status, out, _ = run(capsys, "cycle", *options, "--out", "out")
    assert status == 0 and "but not to rtol" in out
    assert names("out") == [*_CYCLE, "notes.txt"]
    assert run(capsys, "cycle")[0] == 0
    start = [1.0, -0.002, -5.0, 4.0]
    options = {"start": start, "rtol": 1e-6, "max_returns": 7, "throw": False}
    assert asked == [options, {"throw": False}]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "start", "message"),
    [
        (motionless_scene, [], "the motion dies out"),
        (reference_scene, ["--start", "6e-4", 0, 0, 0], "the motion grows beyond all bounds"),
    ],
)
def test_no_cycle_is_no_success(capsys, tmp_path, scene, start, message):
    """Exit status 1, the reason, and nothing written: a new folder is gone, an old one as was."""
    scene().save("mine.toml")
    (tmp_path / "old").mkdir()
    for folder in ["a/b", "old"]:
        status, out, err = run(capsys, "cycle", "mine.toml", *start, "--out", folder)
        assert (status, err) == (1, "")
        assert out.startswith("result  ") and message in out and "written" not in out
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["mine.toml", "old"]


EDITS = [
    ("D = 2.4", "D = 2.0", "bad.toml: [contact.surface] D must be above 2 and below 3, got 2.0"),
    ("mu_s = 0.4 ", "mu_s = '0.4' ", "bad.toml: [friction] mu_s must be a number, got '0.4'"),
    ("v_m = 0.5", "v_n = 0.5", "bad.toml: [friction] has the unknown key 'v_n'"),
    ("v_m = 0.5", "", "bad.toml: [friction] lacks the key 'v_m'"),
    ("[friction]", "[friction", "bad.toml: "),
    ("v_m = 0.5", "v_m = 1e-150", "stability cannot be computed in float64: the friction at V is"),
]


@pytest.mark.parametrize(
    ("command", "old", "new", "message"),
    [
        *(("stability", *edit) for edit in EDITS),
        *((command, *EDITS[i]) for command in ("design", "cycle") for i in (0, -1)),
    ],
)
def test_bad_scene_files(capsys, tmp_path, command, old, new, message):
    """One line with file, table, bound and value; exit status 2; nothing written."""
    text = fj.brake_scene().to_toml()
    assert old in text
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    assert refused_command(capsys, command, "bad.toml").startswith(message)
    assert names(tmp_path) == ["bad.toml"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stability", "."], "a folder, not a file: ."),
        (["cycle", "nowhere.toml"], "no such file: nowhere.toml"),
        (["cycle", "--out", "file/below"], "not a folder: file/below"),
        (["cycle", "--rtol", "nan"], "rtol must be above 0 and at most 0.1, got nan"),
        (["cycle", "--max-returns", 1.5], "invalid int value: '1.5'"),
        (["cycle", "--start", 1, 2, 3], "start must have shape (4,), got (3,)"),
        (["cycle", "--rtol", 1, "--rtol", 2], "argument --rtol: given more than once"),
        (["map", "--x", "D"], "--x must be NAME=LOW:HIGH, got 'D'"),
        (["map", "--y", "G=1:x"], "--y G must be numbers, got 'x'"),
        (["map", "--x", "speed=1:2"], "no quantity 'speed'"),
        (["cycle", "--constant-friction"], "unrecognized arguments: --constant-friction"),
        (["polish"], "invalid choice: 'polish'"),
    ],
)
def test_bad_arguments(capsys, tmp_path, arguments, message):
    """One line, exit status 2, and no folder left behind."""
    (tmp_path / "file").write_text("in the way")
    assert message in refused_command(capsys, *arguments)
    assert names(tmp_path) == ["file"]


def raising(error):
    def fail(*_):
        raise error

    return fail


@pytest.mark.parametrize(
    ("fail", "line"),
    [
        (raising(MemoryError("1 TiB")), "not enough memory: 1 TiB"),
        (raising(RecursionError("maximum recursion depth")), "a file is too deeply nested"),
        (raising(OverflowError("int too large")), "a number is out of range: int too large"),
        (raising(ZeroDivisionError("by zero")), "a number is out of range: by zero"),
        (raising(PermissionError(13, "Permission denied", "x")), "no permission for: x"),
        (raising(OSError(28, "No space left on device", "x")), "No space left on device: x"),
        (raising(OSError("disk full")), "disk full"),
        (raising(jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: of")), "not enough memory: RESO"),
    ],
)
def test_expected_failures_are_one_line(capsys, monkeypatch, fail, line):
    monkeypatch.setattr(_TABLE, fail)
    assert refused_command(capsys, "stability").startswith(line)


def test_defect_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr(_TABLE, raising(AttributeError("no x")))
    with pytest.raises(AttributeError, match="no x"):
        main(["stability"])


_PROGRAM = """
import os, sys, time
import fractaljax._dynamics.limit_cycle as search
from fractaljax.__main__ import main

def limit_cycle(*_, **__):
    print(sorted(os.listdir()), flush=True)
    time.sleep(60)

search.limit_cycle = limit_cycle
sys.exit(main(["cycle", "--out", "a/b"]))
"""


@pytest.mark.slow
def test_termination_leaves_nothing(tmp_path):
    """SIGTERM as Ctrl-C: one line, exit status 143, and no folder before there are files."""
    with tempfile.TemporaryFile("w+") as errors:  # a pipe that nobody reads may fill up
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM], stdout=subprocess.PIPE, stderr=errors, text=True
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "[]\n"
        process.terminate()
        process.communicate(timeout=60)
        errors.seek(0)
        err = errors.read()
    assert (process.returncode, err) == (143, "fractaljax: terminated, nothing written\n")
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ("scene | true", 141, "standard output was closed"),
        ("scene > /dev/full", 2, "No space left on device"),
        ("stability nowhere.toml >&-", 2, "nowhere.toml"),
    ],
)
def test_output_that_cannot_be_written(arguments, status, message):
    """One line, however much is printed and whenever it fails."""
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m fractaljax {arguments}; exit ${{PIPESTATUS[0]}}"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == status
    assert message in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.slow
def test_module_in_double_precision():
    """`python -m fractaljax` is the same command, and chooses float64 itself."""
    done = subprocess.run(
        [sys.executable, "-m", "fractaljax", "stability"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "") and "+22.0801" in done.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="no signals between processes")
@pytest.mark.parametrize("place", ["in_a_collection", "in_a_library"])
def test_an_interrupt_is_not_lost(tmp_path, place):
    """Neither where Python only reports an exception nor where a library makes another of it."""
    script = f"""
import gc, os, signal, sys, time
from fractaljax._cli import commands
from fractaljax.__main__ import command

def interrupt(*_):
    if interrupt in gc.callbacks:
        gc.callbacks.remove(interrupt)
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.001)  # here the signal is handled

def in_a_collection(arguments):
    gc.callbacks.append(interrupt)
    gc.collect()
    time.sleep(5)
    return 0

def in_a_library(arguments):
    try:
        interrupt()
    except KeyboardInterrupt:
        raise ValueError("an error of its own")

commands._stability = {place}
sys.argv = ["fractaljax", "stability"]
sys.exit(command())
"""
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert (run.returncode, run.stdout) == (130, "")
    assert run.stderr == "fractaljax: interrupted, nothing written\n"


@pytest.mark.skipif(sys.platform == "win32", reason="no signals between processes")
@pytest.mark.parametrize("after", [0.0, 0.1, 0.3, 0.6])
def test_an_interrupt_at_any_time_is_one_line(tmp_path, after):
    """Also while the modules load, in the first second."""
    script = f"""
import os, signal, sys, threading
from fractaljax.__main__ import command
sys.argv = ["fractaljax", "design", "--quiet", "--out", "out"]
timer = threading.Timer({after}, os.kill, (os.getpid(), signal.SIGINT))
set_handler = signal.signal

def first_handler(*arguments):
    signal.signal = set_handler
    set_handler(*arguments)
    timer.start()

signal.signal = first_handler
sys.exit(command())
"""
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert (run.returncode, run.stdout) == (130, "")
    assert run.stderr == "fractaljax: interrupted, nothing written\n"
    assert not [*tmp_path.iterdir()]
