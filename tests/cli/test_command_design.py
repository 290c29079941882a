"""`fractaljax design`: its table, its files, and how it refuses."""

import csv
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._cli.design import _LIMITS, _OPTIONS, _remarks, _tolerance
from fractaljax._design.design_file import tolerance_text
from tools import refused_command, run_command as run

_WRITTEN = ["design.png", "design.toml", "history.csv", "run.toml"]
_WRITTEN += ["topographies.png", "topography.npy"]
_ROWS = ["D ", "G [m]", "Sq [m]", "Sdq", "K_n [N/m]", "K_t [N/m]", "K_t/K_n", "regime", "a_l/a_e"]
_ROWS += ["Q_e/(mu_s P)", "growth rate [1/s]", "frequency [Hz]", "damping ratio"]
_ROWS += ["active constraints", "Sq and Sdq: wavelengths from 0.001 to 1e-06 m", ""]
_ROWS += ["What this design hangs on:", " ", "sigma_y [Pa] = 3.55e+08", "gamma = 1.5", "mu_s = 0.4"]
_ROWS += ["E [Pa] = 1.154e+11", "mu_m = 0.25", "H [Pa] = 9.94e+08"]
_ROWS += ["multipliers: growth_rate <= target: ", "", "found: "]
_ROWS += ["", " ", "as it is (FractalContact)", "friction on P + K_n x2"]
_ROWS += ["tangential spring in series"]
_ROWS += ["K_t/K_n from 0.355 to 0.824"]
_ROWS += ["Quiet, but it rests on: friction on K_n x2; K_t/K_n = 0.355."]
_ROWS += ["Not asked: other contact laws (area), scatter (tolerance), kicks (quiet_within), "]
_ROWS += [""]
_ROWS += ["written to fractaljax-design: ", "topography.npy: 1024 x 1024 heights in m, dx = "]
_ROWS += ["stable against small disturbances; a larger kick may still end in squeal"]


def failing(error):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.slow
def test_design_without_arguments(capsys, tmp_path):
    """The main job: a progress bar, a table, and files that hold what was found."""
    status, out, err = run(capsys, "design")
    assert status == 0 and "12/12" in err
    titles, *lines = out.splitlines()
    assert titles.split() == ["before", "after"]
    wrong = [line for line, row in zip(lines, _ROWS, strict=True) if not line.startswith(row)]
    assert wrong == []
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


@pytest.mark.slow
def test_what_no_surface_cures_ends_with_what_else_does(capsys):
    """A slope of the friction beyond all damping: `suggest` of the scene as it was given."""
    scene = fj.brake_scene()
    scene = fj.Scene(scene.contact, scene.friction, scene.oscillator, preload=True)
    scene.save("loaded.toml")
    few = ("--starts", 4, "--lattice", 4, "--quiet", "--target", -1.0)
    status, out, _ = run(capsys, "design", "loaded.toml", *few)
    assert status == 1 and "No surface cures this" in out
    cure = fj.suggest(scene, target=-1.0)
    assert str(cure) in out and cure.values["xi_1"] is not None


def test_a_tolerance_comes_from_the_file_of_an_identification():
    """Correlated, as `identify` writes it, where NAME=SIGMA is independent."""
    covariance = np.array([[1e-4, 9e-4], [9e-4, 1e-2]])
    given = fj.Tolerance(("D", "ln G"), covariance)
    Path("mine.toml").write_text(tolerance_text(given, "errors"))
    found = _tolerance(["mine.toml"])
    assert found.names == given.names
    np.testing.assert_array_equal(found.covariance, given.covariance)
    assert _tolerance(["D=0.01", "lnG=0.1"]) == {"D": 0.01, "ln G": 0.1}


@pytest.mark.slow
def test_infeasible_designs_and_damaged_tolerances(capsys):
    """Exit status 1; table and file say that it is not a solution. Other files stay."""
    Path("old").mkdir()
    Path("old/notes.txt").write_text("mine")
    status, out, _ = run(capsys, "design", "--K-n-min", 1e14, "--quiet", "--out", "old")
    assert status == 1
    assert "not met: K_n >= K_n_min" in out and "infeasible" in out
    text = Path("old/design.toml").read_text()
    assert text.startswith("# infeasible") and "# not met: K_n >= K_n_min" in text
    assert sorted(p.name for p in Path("old").iterdir()) == sorted([*_WRITTEN, "notes.txt"])
    for text, said in (
        ("", "the table [tolerance] is missing"),
        ('[tolerance]\nnames = ["D"]', "[tolerance] lacks 'covariance'"),
        ("[tolerance]\nsigma = 1", "[tolerance] has the unknown key 'sigma'"),
        ('[tolerance]\nnames = ["D"]\ncovariance = [[1, 2]]', "tolerance must name the rows"),
    ):
        Path("mine.toml").write_text(text)
        err = refused_command(capsys, "design", "--tolerance", "mine.toml", "--quiet")
        assert err.startswith("mine.toml: ") and said in err


@pytest.mark.slow
def test_design_of_a_users_scene(capsys, tmp_path):
    """A scene file, bounds, options and an output folder of the user's own, made if missing."""
    fj.brake_scene().replace(P=3000.0).save(tmp_path / "mine.toml")
    arguments = ["--out", "a/b", "--D", 2.3, 2.8, "--G", 1e-11, 1e-9, "--target", -1, "--quiet"]
    status, _, err = run(capsys, "design", "mine.toml", *arguments)
    assert (status, err) == (0, "")
    scene = fj.Scene.load("a/b/design.toml")
    assert fj.growth_rate(scene) == pytest.approx(-1, abs=1e-4)
    assert scene.contact.P == 3000


@pytest.mark.slow
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


def test_limits_of_a_drawing(capsys, monkeypatch):
    """--ra and --rz are `constraints.Ra` and `Rz` of the same filters and wavelengths."""
    found = []

    def design(_, constraints, **__):
        found.append(constraints)
        raise ValueError("seen")

    monkeypatch.setattr("fractaljax._design.design.design", design)
    limits = ["--ra", "1e-7:4e-7", "--rz", ":3e-6"]
    for more in ([], ["--cutoff", 2.5e-4, 8e-6, "--sq-lengths", 1e-2, 1e-5]):
        refused_command(capsys, "design", *limits, *more, "--quiet")
    filters: Any = dict(cutoff=8e-4, shortest=2.5e-6)
    lengths: Any = dict(L=1e-3, L_s=1e-6)
    others, wide = dict(cutoff=2.5e-4, shortest=8e-6), dict(L=1e-2, L_s=1e-5)
    options: Any
    for constraints, options in zip(found, (filters | lengths, others | wide), strict=True):
        Ra, Rz = fj.constraints.Ra(1e-7, 4e-7, **options), fj.constraints.Rz(None, 3e-6, **options)
        for one, other in zip(constraints, (Ra, Rz), strict=True):
            assert type(one) is type(other) and vars(one) == vars(other)


def test_design_within_a_drawing(capsys):
    """The design has the Ra that is allowed, and the file of the run has the limit."""
    options = ["--ra", ":2.5e-7", "--starts", 2, "--lattice", 4, "--quiet", "--out", "drawn"]
    status, out, _ = run(capsys, "design", *options)
    assert status == 0 and "Ra <= 2.5e-07 m" in out
    text = Path("drawn/run.toml").read_text()
    assert "at_most = 2.5e-07" in text and "cutoff = 0.0008" in text
    surface = fj.Scene.load("drawn/design.toml").contact.surface
    p = fj.profile_parameters(surface, cutoff=8e-4, shortest=2.5e-6, L=1e-3, L_s=1e-6)
    assert float(p.Ra) == pytest.approx(2.5e-7, rel=1e-5)  # 3.4e-7 without the limit


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "file/below", "--quiet"], "not a folder: file/below"),
        (["--out", "file", "--quiet"], "File exists"),
        (["--D", 2.5, 2.3], "bounds on D must be (lower, upper), got (2.5, 2.3)"),
        (["--starts", 0], "starts must be a whole number of at least 1, got 0"),
        (["--target", "low"], "invalid float value: 'low'"),
        (["--envelope", "P"], "--envelope must be NAME=LOW:HIGH, got 'P'"),
        (["--envelope", "P=1:x"], "--envelope P must be numbers, got 'x'"),
        (["--envelope", "P=1"], "--envelope P must be LOW:HIGH or at least two samples"),
        (["--envelope", "P=1:2", "--envelope", "P=3:4"], "--envelope has P more than once"),
        (["--tolerance", "D=1", "lnG=1", "D=2"], "--tolerance has D more than once"),
        (["--tolerance", "D"], "--tolerance must be NAME=SIGMA, got 'D'"),
        (["--seed", 1, "--seed", 2], "argument --seed: given more than once"),
        (["--seed", "1e20"], "argument --seed: invalid int value: '1e20'"),
        (["--seed", 10**20], f"seed must be a whole number of at most {2**63 - 1}, got {10**20}"),
        (["--quiet-within", "x"], "--quiet-within must be numbers, got 'x'"),
        (["--risk", "cvar:x"], "--risk must be numbers, got 'x'"),
        (["--sq-lengths", 1, 2], "--sq-lengths needs --sq"),
        (["--cutoff", 8e-4, 2.5e-6], "--cutoff needs --ra or --rz"),
        (["--ra", ":1e-6", "--cutoff", 1e-6, 1e-3], "cutoff must be at least shortest"),
        (["--rz", "2:1"], "at_most"),
        (["--damping-ratio", "0:1"], "--damping-ratio has a lower limit only: LOW:"),
        (["--cycle-amplitude", "1:"], "--cycle-amplitude has an upper limit only: :HIGH"),
        (["--repeat", "nowhere.toml"], "no such file: nowhere.toml"),
        (["--repeat", "file"], "file: "),
        (["--repeat", "file", "--seed", 1], "takes everything from its file, got seed"),
    ],
)
def test_bad_arguments(capsys, tmp_path, arguments, message):
    """One line, exit status 2, and no folder left behind."""
    (tmp_path / "file").write_text("in the way")
    assert message in refused_command(capsys, "design", *arguments)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_random_arguments(capsys, tmp_path, monkeypatch):
    """Never a traceback, always one line, and refused before the search."""
    monkeypatch.setattr("fractaljax._design.design.design", failing(ValueError("accepted")))
    random, accepted = np.random.default_rng(12), 0
    values = "nan inf -inf 0 -1 1e20 1e400 x : 1: 1:1 2:1 2.5 P=1 P=nan:2 P=1:2 D=-1 =1 cvar:1 "
    values = (values + "smooth:0 1_ é 10 1e-9").split()
    options = {
        "--D": 2,
        "--G": 2,
        "--sq-lengths": 2,
        "--cutoff": 2,
        "--envelope": 1,
        "--tolerance": 1,
    }
    options |= {
        f"--{name.replace('_', '-')}": 1 for name in (*_OPTIONS, *_LIMITS, "risk", "quiet-within")
    }
    for _ in range(150):
        arguments = ["design", "--quiet"]
        for name in random.choice(list(options), random.integers(1, 3), replace=False):
            arguments += [name, *random.choice(values, options[name])]
        accepted += refused_command(capsys, *arguments) == "accepted"
    assert 0 < accepted < 75
    assert list(tmp_path.iterdir()) == []


def test_size_of_kicks(capsys, monkeypatch):
    """A radius or semi-axes; the file of the scene may follow, and --quiet is another option."""

    def design(_, quiet_within, **__):
        raise ValueError(f"{quiet_within}")

    monkeypatch.setattr("fractaljax._design.design.design", design)
    fj.brake_scene().save("mine.toml")
    for text, asked in (("2", 2.0), ("1e-5,2e-5,0.1,0.2", [1e-5, 2e-5, 0.1, 0.2])):
        _, _, err = run(capsys, "design", "--quiet", "--quiet-within", text, "mine.toml")
        assert err == f"fractaljax: {asked}\n"


@pytest.mark.parametrize(
    ("where", "error", "status", "message"),
    [
        ("_design.design.design", KeyboardInterrupt(), 130, "interrupted, nothing written"),
        ("_cli.design.picture", OSError("disk full"), 2, "disk full"),
    ],
)
def test_failure_writes_nothing(capsys, tmp_path, monkeypatch, where, error, status, message):
    """Ctrl-C, or a picture that fails: all files are ready before the first is written."""
    monkeypatch.setattr(f"fractaljax.{where}", failing(error))
    found, out, err = run(capsys, "design", "--quiet", "--out", "a/b")
    assert (found, out) == (status, "") and message in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_files_of_a_structure_are_written_together(capsys):
    """The structure, its design and all matrices; or nothing, where one of them cannot be."""
    fj.Structure.from_scene(fj.brake_scene()).save("belt.toml")
    arguments = ["design", "belt.toml", "--bounds", "D=2.3:2.8", "--target", 1e6, "--quiet"]
    Path("old").mkdir()
    Path("old/design.npz").write_text("mine")
    status, out, err = run(capsys, *arguments, "--out", "old")
    assert (status, out) == (2, "") and "design.npz is not of a structure saved as" in err
    assert {file.name: file.read_text() for file in Path("old").iterdir()} == {"design.npz": "mine"}
    status, out, err = run(capsys, *arguments, "--out", "new")
    assert (status, err) == (0, "") and "written to new: design.npz, design.toml, run." in out
    fj.Structure.load("new/design.toml")
    repeated = run(capsys, "design", "--repeat", "new/run.toml", "--out", "again", "--quiet")
    assert repeated == (0, out.replace("to new", "to again"), "")
    for file in Path("new").glob("*.toml"):
        assert Path("again", file.name).read_bytes() == file.read_bytes()


def test_repetition_of_a_run_of_other_versions(capsys, tmp_path, monkeypatch):
    """A warning is one line on standard error, and the command continues."""

    def noted(path):
        warnings.warn(f"{path} was written by another", stacklevel=1)
        raise ValueError("that is enough")

    monkeypatch.setattr("fractaljax._design.design_file.read_design", noted)
    status, out, err = run(capsys, "design", "--repeat", "run.toml")
    assert (status, out) == (2, "")
    assert err == "fractaljax: run.toml was written by another\nfractaljax: that is enough\n"


def test_remarks_on_friction_beyond_its_law():
    """At the worst of the envelope, and of the scene itself; nothing where the law holds."""
    scene = fj.brake_scene()
    assert _remarks(scene, {}) == _remarks(scene, {"envelope": {"P": (1800.0, 2000.0)}}) == []
    (line,) = _remarks(scene, {"envelope": {"V": (0.1, 2.0), "P": (1800.0, 2000.0)}})
    assert line.startswith("remark: at a sliding speed of 2 m/s the friction law gives 4.3, above")
    (line,) = _remarks(scene.replace(V=5.0), {"envelope": None})
    assert "gives 73.15, above mu_s = 0.4" in line


@pytest.mark.parametrize(
    ("contact", "area", "said"),
    [
        (None, 0, "--area must be above 0, got 0.0"),
        (fj.FixedContact(4e8, 2e8), 1e-4, "--area needs a scene whose contact has a surface"),
    ],
)
def test_area_is_checked_before_the_design(capsys, contact, area, said):
    """An error at the end would lose the table of a design that is done."""
    scene = fj.brake_scene()
    (scene if contact is None else scene.replace(contact=contact)).save("mine.toml")
    arguments = ("mine.toml", "--area", area, "--quiet")
    assert said in refused_command(capsys, "design", *arguments)
    assert not Path("fractaljax-design").exists()
