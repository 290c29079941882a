"""The command: what it prints and writes, and how it refuses."""

import csv
import errno
import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.__main__ import main
from fractaljax.command.design import _LIMITS, _OPTIONS, _remarks
from fractaljax.report import cycle_table
from tools import motionless_scene, reference_cycle, reference_scene, run_command as run

_WRITTEN = ["design.png", "design.toml", "history.csv", "run.toml"]
_WRITTEN += ["topographies.png", "topography.npy"]


def test_design_without_arguments(capsys, tmp_path):
    """The main job: a progress bar, a table, and files that hold what was found."""
    status, out, err = run(capsys, "design")
    assert status == 0 and "60/60" in err
    rows = [
        "D ",
        "G [m]",
        "Sq [m]",
        "Sdq",
        "K_n [N/m]",
        "K_t [N/m]",
        "K_t/K_n",
        "regime",
        "a_l/a_e",
    ]
    rows += ["Q_e/(mu_s P)", "growth rate [1/s]", "frequency [Hz]", "damping ratio"]
    rows += ["active constraints", "Sq and Sdq: wavelengths from 0.001 to 1e-06 m", "found: "]
    rows += ["written to fractaljax-design: ", "topography.npy: 1024 x 1024 heights in m, dx = "]
    rows += ["stable against small disturbances; a larger kick may still end in squeal"]
    lines = out.splitlines()
    assert lines[0].split() == ["before", "after"]
    assert [
        line for line, row in zip(lines[1:], rows, strict=True) if not line.startswith(row)
    ] == []
    assert "+22.0801" in out and "growth_rate <= target" in out

    folder = tmp_path / "fractaljax-design"
    assert sorted(p.name for p in folder.iterdir()) == _WRITTEN
    scene = fj.Scene.load(folder / "design.toml")
    assert fj.growth_rate(scene) <= -np.pi
    with open(folder / "history.csv", newline="") as file:
        history = list(csv.DictReader(file))
    assert float(history[0]["D"]) == pytest.approx(2.4)
    assert float(history[-1]["G [m]"]) == pytest.approx(float(scene.contact.surface.G), rel=1e-12)
    assert float(history[0]["growth_rate [1/s]"]) == pytest.approx(22.0801103, rel=1e-8)
    assert [int(row["step"]) for row in history] == list(range(len(history)))
    for picture in ("design.png", "topographies.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")
    z = fj.topography(scene.contact.surface, 1e-3, 1024, key=jax.random.key(0))
    np.testing.assert_allclose(np.load(folder / "topography.npy"), z, rtol=0, atol=1e-18)


def test_design_of_a_users_scene(capsys, tmp_path):
    """A scene file, bounds, options and an output folder of the user's own, made if missing."""
    fj.brake_scene().replace(P=3000.0).save(tmp_path / "mine.toml")
    arguments = ["--out", "a/b", "--D", 2.3, 2.8, "--G", 1e-11, 1e-9, "--target", -1, "--quiet"]
    status, _, err = run(capsys, "design", "mine.toml", *arguments)
    assert (status, err) == (0, "")
    scene = fj.Scene.load("a/b/design.toml")
    assert fj.growth_rate(scene) == pytest.approx(-1, abs=1e-4)
    assert scene.contact.P == 3000


def test_design_again_replaces_its_own_files_only(capsys, tmp_path):
    """What else lies in the output folder stays."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    for _ in range(2):
        assert run(capsys, "design", "--out", "out", "--quiet")[0] == 0
    names = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert names == sorted([*_WRITTEN, "notes.txt"])


def test_robust_design_and_its_repetition(capsys):
    """Envelope, tolerance and limits as given; the file of the run gives the same files again."""
    options = ["--envelope", "P=1800:2000", "mu_s=0.39,0.4,0.41", "--tolerance", "D=0.002"]
    options += ["--sq", ":2e-6", "--sq-lengths", 1e-3, 1e-5, "--elastic-share", 0.2, "--seed", 5]
    options += ["--quantile", 0.9, "--starts", 4, "--lattice", 8, "--quiet"]
    status, out, err = run(capsys, "design", "--out", "first", *options)
    assert (status, err) == (0, "")
    assert "over P 1800 to 2000, 3 samples of mu_s; where D scatters by 0.002" in out
    assert "probability of squeal" in out and "worst at P = " in out
    text = Path("first/run.toml").read_text()
    assert "seed = 5" in text and "at_most = 2e-06, L = 0.001, L_s = 1e-05" in text
    repeated = run(capsys, "design", "--repeat", "first/run.toml", "--out", "again", "--quiet")
    assert repeated == (0, out.replace("to first", "to again"), "")
    for name in _WRITTEN:
        assert Path("first", name).read_bytes() == Path("again", name).read_bytes()


def test_infeasible_design_is_no_success(capsys):
    """Exit status 1; table, comment and picture say that it is not a solution."""
    status, out, _ = run(capsys, "design", "--K-n-min", 1e14, "--quiet")
    assert status == 1
    assert "not met: K_n >= K_n_min" in out and "infeasible" in out
    text = Path("fractaljax-design/design.toml").read_text()
    assert text.startswith("# infeasible") and "# not met: K_n >= K_n_min" in text


def test_stability(capsys, tmp_path):
    """The table of the reference brake, and of a file; the slope of the friction law left out."""
    status, out, err = run(capsys, "stability")
    assert (status, err) == (0, "")
    assert "+22.0801  (it squeals)" in out and out.count("eigenvalue") == 4
    fixed = fj.brake_scene().replace(contact=fj.FixedContact(0.0, 0.0), friction=fj.Coulomb(0.3))
    fixed.save(tmp_path / "fixed.toml")
    status, out, _ = run(capsys, "stability", "fixed.toml")
    assert status == 0 and "(stable against small disturbances)" in out and "regime" not in out
    status, out, _ = run(capsys, "stability", "--constant-friction")
    assert status == 0 and "+23.311" in out


def test_cycle(capsys, tmp_path):
    """The table, the picture, and one period as numbers that are those of the orbit."""
    reference_scene().save("mine.toml")
    status, out, err = run(capsys, "cycle", "mine.toml")
    table = cycle_table(reference_scene(), reference_cycle())
    assert (status, err) == (0, "")
    assert out == f"{table}\nwritten to fractaljax-cycle: cycle.png, cycle.csv\n"

    folder = tmp_path / "fractaljax-cycle"
    assert sorted(p.name for p in folder.iterdir()) == ["cycle.csv", "cycle.png"]
    with open(folder / "cycle.csv", newline="") as file:
        titles, *rows = csv.reader(file)
    assert titles == ["time [s]", "x1 [m]", "x2 [m]", "v1 [m/s]", "v2 [m/s]"]
    t, states = reference_cycle().orbit(512)
    np.testing.assert_array_equal(np.array(rows, float), np.column_stack([t, states]))
    assert (folder / "cycle.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_cycle_with_options(capsys, tmp_path):
    """Negative numbers with an exponent are numbers; other files in the folder stay."""
    reference_scene().save("mine.toml")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    start = ["--start", "-1e-5", "-2.5e-6", "0", "-1.5E-1"]
    options = ["--out", "out", "--rtol", 1e-9, "--max-turns", 500]
    status, out, err = run(capsys, "cycle", "mine.toml", *start, *options)
    assert (status, err) == (0, "") and "3092.41" in out
    assert sorted(p.name for p in Path("out").iterdir()) == ["cycle.csv", "cycle.png", "notes.txt"]


def test_cycle_options_reach_the_search(capsys, monkeypatch):
    """Scene, start, rtol and max_turns as given; an inaccurate cycle is one, with a warning."""
    asked = {}

    def search(scene, start, **options):
        asked.update(options, V=float(scene.oscillator.V), start=start)
        return eqx.tree_at(lambda c: c.result, reference_cycle(), fj.CycleResult.inaccurate)

    monkeypatch.setattr(sys.modules["fractaljax.motion.limit_cycle"], "limit_cycle", search)
    options = ["--start", 1, "-2e-3", 3, 4, "--rtol", 1e-6, "--max-turns", 7]
    status, out, _ = run(capsys, "cycle", *options)
    start = [1.0, -0.002, 3.0, 4.0]
    assert asked == {"V": 0.15, "start": start, "rtol": 1e-6, "max_turns": 7, "throw": False}
    assert status == 0 and "but not to rtol" in out
    assert sorted(p.name for p in Path("fractaljax-cycle").iterdir()) == ["cycle.csv", "cycle.png"]


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


def test_scene_is_a_scene_file(capsys, tmp_path):
    """What `fractaljax scene` prints is the reference brake, to the last bit."""
    status, out, _ = run(capsys, "scene")
    (tmp_path / "scene.toml").write_text(out)
    assert status == 0
    assert fj.Scene.load("scene.toml").to_toml() == fj.brake_scene().to_toml() == out


EDITS = [
    ("D = 2.4", "D = 2.0", "[contact.surface] D must be above 2 and below 3, got 2.0"),
    ("D = 2.4", "D = 3", "[contact.surface] D must be above 2 and below 3, got 3.0"),
    ("G = 1.342e-10", "G = 0.0", "[contact.surface] G must be above 0, got 0.0"),
    ("P = 1907.3", "P = -5.0", "[contact] P must be above 0, got -5.0"),
    ("H = 994000000.0", "H = 3e8", "H must be at least sigma_y = 355000000.0, got 300000000.0"),
    ("mu_m = 0.25", "mu_m = nan", "[friction] mu_m must be at least 0, got nan"),
    ("mu_s = 0.4 ", "mu_s = '0.4' ", "[friction] mu_s must be a number, got '0.4'"),
    ("v_m = 0.5", "v_n = 0.5", "[friction] has the unknown key 'v_n'"),
    ("v_m = 0.5", "", "[friction] lacks the key 'v_m'"),
    ("[oscillator]", "[oscilator]", "the file has the unknown key 'oscilator'"),
    ("[friction]", "[friction", "bad.toml: "),
]


@pytest.mark.parametrize(("old", "new", "message"), EDITS)
@pytest.mark.parametrize("command", ["design", "stability", "cycle"])
def test_bad_scene_files(capsys, tmp_path, command, old, new, message):
    """One line with file, table, bound and value; exit status 2; nothing written."""
    text = fj.brake_scene().to_toml()
    assert old in text
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    status, out, err = run(capsys, command, "bad.toml")
    assert (status, out) == (2, "")
    assert err.startswith("fractaljax: bad.toml: ") and message in err and err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["bad.toml"]


def test_friction_beyond_its_law(capsys, tmp_path):
    """mu_m above 0.9 is beyond Eq. 19."""
    text = fj.brake_scene().to_toml().replace("mu_s = 0.4", "mu_s = 1.0")
    (tmp_path / "bad.toml").write_text(text.replace("mu_m = 0.25", "mu_m = 0.95"))
    status, _, err = run(capsys, "stability", "bad.toml")
    assert status == 2 and "mu_m must be at most 0.9, got 0.95" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["design", "--out", "file/below", "--quiet"], "not a folder: file/below"),
        (["design", "--out", "file", "--quiet"], "File exists"),
        (["design", "nowhere.toml"], "no such file: nowhere.toml"),
        (["stability", "."], "a folder, not a file: ."),
        (["design", "--D", 2.5, 2.3], "bounds on D must be (lower, upper), got (2.5, 2.3)"),
        (["design", "--D", 2.5, 2.9], "D must lie inside its bounds [2.5, 2.9], got 2.4"),
        (
            ["design", "--starts", 0],
            "starts must be a whole number of at least 1, got 0",
        ),
        (["design", "--target", "low"], "invalid float value: 'low'"),
        (["design", "--envelope", "P"], "--envelope must be NAME=LOW:HIGH, got 'P'"),
        (["design", "--envelope", "P=1:x"], "--envelope P must be numbers, got 'x'"),
        (["design", "--envelope", "P=1"], "--envelope P must be LOW:HIGH or at least two samples"),
        (["design", "--envelope", "P=1:1"], "envelope of P must be (lower, upper), got (1, 1)"),
        (["design", "--envelope", "P=nan:2"], "envelope of P must be finite, got nan"),
        (
            ["design", "--envelope", "P=1:2", "--envelope", "P=3:4"],
            "--envelope has P more than onc",
        ),
        (["design", "--tolerance", "D=1", "lnG=1", "D=2"], "--tolerance has D more than once"),
        (["design", "--seed", 1, "--seed", 2], "argument --seed: given more than once"),
        (["design", "--seed", "1e20"], "argument --seed: invalid int value: '1e20'"),
        (
            ["design", "--seed", 10**20],
            f"seed must be a whole number of at most {2**63 - 1}, got {10**20}",
        ),
        (["design", "--lattice", 200000], "lattice must be a whole number of at most 1000, got"),
        (["design", "--lattice", 2, "--starts", 5], "starts must be at most the 4 of the lattice"),
        (["design", "--quantile", "nan"], "quantile must be at least 0.5 and at most 0.999, got "),
        (["design", "--envelope", "P=2:1"], "envelope of P must be (lower, upper), got (2, 1)"),
        (["design", "--envelope", "Q=1:2"], "envelope names 'Q', which the scene does not have"),
        (["design", "--tolerance", "D"], "--tolerance must be NAME=SIGMA, got 'D'"),
        (["design", "--tolerance", "D=-1"], "tolerance of D must be at least 0, got -1.0"),
        (["design", "--risk", "cvar:x"], "--risk must be numbers, got 'x'"),
        (["design", "--sq", "2:1"], "Sq at_least must be below at_most, got 2.0, 1.0"),
        (["design", "--sq-lengths", 1, 2], "--sq-lengths needs --sq"),
        (["design", "--damping-ratio", "0:1"], "--damping-ratio has a lower limit only: LOW:"),
        (["design", "--repeat", "nowhere.toml"], "no such file: nowhere.toml"),
        (["design", "--repeat", "file"], "file: "),
        (["design", "--repeat", "file", "--seed", 1], "takes everything from its file, got seed"),
        (["cycle", "nowhere.toml"], "no such file: nowhere.toml"),
        (["cycle", "--out", "file/below"], "not a folder: file/below"),
        (["cycle", "--rtol", 0], "rtol must be above 0 and at most 0.1, got 0.0"),
        (["cycle", "--rtol", "nan"], "rtol must be above 0 and at most 0.1, got nan"),
        (["cycle", "--max-turns", 0], "max_turns must be at least 1, got 0"),
        (["cycle", "--max-turns", 1.5], "invalid int value: '1.5'"),
        (["cycle", "--start", 1, 2, 3], "--start: expected 4 arguments"),
        (["cycle", "--start", 0, 0, "nan", 0], "start must be finite, got nan"),
        (["cycle", "--constant-friction"], "unrecognized arguments: --constant-friction"),
        (["polish"], "invalid choice: 'polish'"),
        ([], "required: command"),
    ],
)
def test_bad_arguments(capsys, tmp_path, arguments, message):
    """One line, exit status 2, and no folder left behind."""
    (tmp_path / "file").write_text("in the way")
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("fractaljax: ") and message in err and err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_interrupted_design_writes_nothing(capsys, tmp_path, monkeypatch):
    """Ctrl-C: one line, exit status 130, the new folder gone."""

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("fractaljax.optimise.search._sqp", interrupt)
    status, out, err = run(capsys, "design", "--quiet")
    assert (status, out) == (130, "") and "interrupted, nothing written" in err
    assert list(tmp_path.iterdir()) == []


def test_picture_that_fails_leaves_no_half_result(capsys, tmp_path, monkeypatch):
    """All three files are ready before the first is written."""

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr("fractaljax.command.design.picture", fail)
    status, _, err = run(capsys, "design", "--quiet", "--out", "a/b")
    assert status == 2 and "disk full" in err
    assert list(tmp_path.iterdir()) == []


def test_second_file_that_fails_says_why(capsys, tmp_path, monkeypatch):
    """The reason is that of the file, not that the folder could not be removed; no file is left."""
    fsync, synced = os.fsync, []

    def fail(handle):
        synced.append(handle)
        if len(synced) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(handle)

    reference_scene().save("mine.toml")
    monkeypatch.setattr(os, "fsync", fail)
    status, out, err = run(capsys, "cycle", "mine.toml")
    said = "fractaljax: No space left on device: fractaljax-cycle/cycle.csv\n"
    assert (status, out, err) == (2, "", said)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.toml"]


def test_repetition_of_a_run_of_other_versions(capsys, tmp_path):
    """One line on standard error; the run goes on to what else is wrong with the file."""
    from fractaljax.optimise.design_file import read_design

    def noted(path):
        warnings.warn(f"{path} was written by another", stacklevel=1)
        raise ValueError("that is enough")

    (tmp_path / "run.toml").write_text("")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fractaljax.optimise.design_file.read_design", noted)
        status, out, err = run(capsys, "design", "--repeat", "run.toml")
    assert read_design is not noted
    assert (status, out) == (2, "")
    assert err == "fractaljax: run.toml was written by another\nfractaljax: that is enough\n"


_PROGRAM = """
import os, signal, sys, time
import fractaljax.motion.limit_cycle as search
from fractaljax.__main__ import main

def limit_cycle(*_, **__):
    print(sorted(os.listdir()), flush=True)
    time.sleep(60)

search.limit_cycle = limit_cycle
sys.exit(main(["cycle", "--out", "a/b"]))
"""


def test_termination_leaves_nothing(tmp_path):
    """SIGTERM as Ctrl-C: one line, exit status 143; a folder is made when there is what goes in."""
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
    assert list(tmp_path.iterdir()) == []


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


def test_runs_as_a_module_in_double_precision():
    """`python -m fractaljax` is the same command, and chooses float64 itself."""
    done = subprocess.run(
        [sys.executable, "-m", "fractaljax", "stability"], capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stderr == ""
    assert "+22.0801" in done.stdout


def test_version(capsys):
    """That of the package, and nothing else."""
    assert run(capsys, "--version") == (0, f"fractaljax {fj.__version__}\n", "")


def test_a_scene_that_cannot_be_computed(capsys, tmp_path):
    """Exit status 2 and one line; found: NaN 1/s, (stable), exit status 0."""
    fj.brake_scene().replace(v_m=1e-150).save("small.toml")
    for command in ("stability", "cycle", "design"):
        status, out, err = run(capsys, command, "small.toml")
        assert (status, out) == (2, "")
        assert err == "fractaljax: stability cannot be computed in float64: " + (
            "the friction at V is inf\n"
        )
    assert [p.name for p in tmp_path.iterdir()] == ["small.toml"]


def test_a_design_remarks_on_friction_beyond_its_law():
    """At the worst of the envelope, and of the scene itself; nothing where the law holds."""
    scene = fj.brake_scene()
    assert _remarks(scene, {}) == _remarks(scene, {"envelope": {"P": (1800.0, 2000.0)}}) == []
    (line,) = _remarks(scene, {"envelope": {"V": (0.1, 2.0), "P": (1800.0, 2000.0)}})
    assert line.startswith("remark: at a sliding speed of 2 m/s the friction law gives 4.3, above")
    (line,) = _remarks(scene.replace(V=5.0), {"envelope": None})
    assert "gives 73.15, above mu_s = 0.4" in line


def failing(error):
    def fail(*_):
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError("1 TiB"), "not enough memory: 1 TiB"),
        (RecursionError("maximum recursion depth"), "a file is too deeply nested"),
        (OverflowError("int too large"), "a number is out of range: int too large"),
        (ZeroDivisionError("division by zero"), "a number is out of range: division by zero"),
        (PermissionError(13, "Permission denied", "x"), "no permission for: x"),
        (OSError(28, "No space left on device", "x"), "No space left on device: x"),
        (OSError("disk full"), "disk full"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: of 1 TiB"), "not enough memory: RESO"),
    ],
)
def test_every_expected_failure_is_one_line(capsys, monkeypatch, error, line):
    monkeypatch.setattr("fractaljax.report.stability_table", failing(error))
    status, out, err = run(capsys, "stability")
    assert (status, out) == (2, "")
    assert err.startswith(f"fractaljax: {line}") and err.count("\n") == 1


@pytest.mark.parametrize("compile", [jax.jit, eqx.filter_jit])
def test_a_check_that_fails_at_run_time_is_one_line(capsys, monkeypatch, compile):
    """Not JAX's and Equinox's own accounts of the program, 18 lines of them."""
    program = compile(lambda x: eqx.error_if(x, x > 0, "F must be below 0"))
    monkeypatch.setattr(
        "fractaljax.report.stability_table", lambda *_: jax.block_until_ready(program(np.ones(())))
    )
    assert run(capsys, "stability") == (2, "", "fractaljax: F must be below 0\n")


def test_a_defect_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("fractaljax.report.stability_table", failing(AttributeError("no x")))
    with pytest.raises(AttributeError, match="no x"):
        main(["stability"])


def test_bad_values_for_any_option(capsys, tmp_path, monkeypatch):
    """Random command lines: never a traceback, always one line, and refused before the search."""
    monkeypatch.setattr("fractaljax.optimise.task.Task.judge", failing(ValueError("accepted")))
    random, accepted = np.random.default_rng(12), 0
    values = ["nan", "inf", "-inf", "0", "-1", "1e20", "1e400", "x", ":", "1:", "1:1", "2:1", "2.5"]
    values += [
        "P=1",
        "P=nan:2",
        "P=1:2",
        "D=-1",
        "=1",
        "cvar:1",
        "smooth:0",
        "1_",
        "é",
        "10",
        "1e-9",
    ]
    options = {"--D": 2, "--G": 2, "--sq-lengths": 2, "--envelope": 1, "--tolerance": 1}
    options |= {f"--{name.replace('_', '-')}": 1 for name in (*_OPTIONS, *_LIMITS, "risk")}
    for _ in range(150):
        arguments = ["design", "--quiet"]
        for name in random.choice(list(options), random.integers(1, 3), replace=False):
            arguments += [name, *random.choice(values, options[name])]
        status, out, err = run(capsys, *arguments)
        assert (status, out) == (2, ""), arguments
        assert err.startswith("fractaljax: ") and err.count("\n") == 1, arguments
        accepted += err == "fractaljax: accepted\n"
    assert 0 < accepted < 30
    assert list(tmp_path.iterdir()) == []
