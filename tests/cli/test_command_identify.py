"""`fractaljax identify`: from a file of heights to a scene that can be designed."""

import math
from pathlib import Path

import jax
import numpy as np
import pytest

import fractaljax as fj
import instrument_files as files
from fractaljax._cli.identify import _bounds
from fractaljax._design.design_file import read_tolerance
from fractaljax._identify.warnings import DISQUALIFYING
from synthetic import gaussian_map, gaussian_profile
from tools import refused_command, run_command as run

D, G, DX = 2.4, 1.342e-10, 1e-6
SCENE = Path("fractaljax-identification/scene.toml")


def profile(n, D=D):
    """Heights [m] of a Gaussian profile."""
    return gaussian_profile(np.random.default_rng(0), D=D, n=n, G=G, dx=DX)


def write_profile(name, z):
    """A CSV file of positions in um and heights in nm."""
    rows = [f"{i * DX * 1e6!r},{h * 1e9!r}" for i, h in enumerate(z.tolist())]
    Path(name).write_text("\n".join(["x [um],z [nm]", *rows]))


def test_identify_a_profile(capsys):
    """What is printed and written; D and G within three standard errors of the truth."""
    z = profile(4096)
    z[100:140] = np.nan
    write_profile("mine.csv", z)
    status, out, err = run(capsys, "identify", "mine.csv", "--quiet")  # which changes nothing here
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[:2] == [
        "mine.csv: text of 4096 lines and 2 columns",
        "profile of 4096 heights, 40 missing, dx = 1e-06 m",
    ]
    written = "identification.png, scene.toml, tolerance.toml"
    assert f"written to fractaljax-identification: {written}" in lines
    assert lines[-1] == f"next: fractaljax design {SCENE}"
    assert ", ".join(sorted(path.name for path in SCENE.parent.iterdir())) == written
    assert (SCENE.parent / "identification.png").read_bytes().startswith(b"\x89PNG")
    found, scene = fj.identify(z, DX), fj.Scene.load(SCENE)
    assert f"{found}" in out
    errors = read_tolerance(SCENE.parent / "tolerance.toml")
    assert errors.names == ("D", "ln m(q)") and errors.q is not None
    assert errors.q == pytest.approx(found.q)
    np.testing.assert_allclose(errors.covariance, found.scatter.covariance, rtol=1e-9)
    surface = scene.contact.surface
    np.testing.assert_allclose([surface.D, surface.G], [found.D, found.G], rtol=1e-9)
    assert abs(found.D - D) < 3 * found.D_standard_error
    assert abs(math.log(found.G / G)) < 3 * found.ln_G_standard_error
    assert scene.to_toml() == fj.brake_scene().replace(surface=surface).to_toml()
    comments = SCENE.read_text().split("# A fractaljax scene")[0]
    assert "# surface identified from mine.csv" in comments and "standard error" in comments


@pytest.mark.slow
def test_identify_a_map_for_a_scene(capsys):
    """An instrument's file, a band, limits and a scene of the user's own."""
    z = gaussian_map(np.random.default_rng(0), D, (64, 48))
    Path("map.x3p").write_bytes(files.x3p(z, DX, DX))
    fj.brake_scene().replace(P=3000.0, gamma=1.4).save("mine.toml")
    options = ["--band", 8e4, 4e5, "--resolution", 1e-7, "--scene", "mine.toml", "--out", "a/b"]
    status, out, err = run(capsys, "identify", "map.x3p", *options)
    assert (status, err) == (0, "")
    assert "map of 64 x 48 heights, 0 missing, dx = 1e-06 m, dy = 1e-06 m" in out
    scene = fj.Scene.load("a/b/scene.toml")
    found = fj.identify(z, DX, band=(8e4, 4e5), resolution=1e-7, gamma=1.4)
    np.testing.assert_allclose(scene.contact.surface.D, found.D, rtol=1e-9)
    assert scene.contact.P == 3000 and scene.contact.surface.gamma == 1.4


def test_options_reach_reading_and_identification(capsys, monkeypatch):
    """The instrument's limits are the file's unless given."""
    asked = {}

    def read(path, **options):
        asked.update(options, path=path)
        return fj.Measurement(np.ones(3), 1e-6, None, "mine", 3e-6, 4e-6)

    def identify(z, dx, dy, **options):
        asked.update(options, steps=(dx, dy))
        raise ValueError("enough")

    monkeypatch.setattr("fractaljax._identify.files.read_measurement", read)
    monkeypatch.setattr("fractaljax._identify.identify.identify", identify)
    reading = {"dx": 1.0, "dy": 2.0, "unit": "um", "position_unit": "mm", "channel": "Z"}
    limits = {"stylus_radius": 5e-6}
    options = [
        word
        for name, value in (reading | limits).items()
        for word in (f"--{name.replace('_', '-')}", value)
    ]
    options += ["--band", 1, "2e3", "--aliased", "no", "--columns", "x=X", "z=1"]
    assert run(capsys, "identify", "f", *options) == (2, "", "fractaljax: enough\n")
    fitting = {"band": [1.0, 2000.0], "aliased": False, "gamma": 1.5, "resolution": 3e-6}
    expected = {"path": Path("f"), "steps": (1e-6, None), "columns": {"x": "X", "z": "1"}}
    assert asked == reading | limits | fitting | expected


WAVY = 1e-6 * np.sin(2 * np.pi * DX * np.arange(4096) / 3e-4)
WAVY += 1e-9 * np.random.default_rng(1).normal(size=4096)


@pytest.mark.parametrize(
    ("z", "message"),
    [
        (profile(1024, 3.4), "no surface fits this profile (H = "),
        (WAVY, "measure a map, whose spectrum is taken as it is"),
        (1e-8 * np.round(4 * profile(1024) / np.ptp(profile(1024))), DISQUALIFYING[1]),
    ],
)
def test_no_scene(capsys, z, message):
    """Exit status 1, the reason, the picture that shows it, and no scene."""
    np.save("z.npy", z)
    SCENE.parent.mkdir()
    SCENE.write_text("")
    status, out, err = run(capsys, "identify", "z.npy", "--dx", DX, "--unit", "m")
    lines = out.splitlines()
    assert (status, err) == (1, "") and "next" not in out
    assert lines[-1].startswith("no scene: ") and message in lines[-1]
    assert lines[-2] == f"{SCENE} is from an earlier run"
    assert lines[-3] == "written to fractaljax-identification: identification.png"
    assert SCENE.read_text() == ""


@pytest.mark.slow
def test_force_writes_a_scene_all_the_same(capsys):
    """The power law of a surface that is none."""
    ripple = 3e-7 * np.sin(2 * np.pi * DX * np.arange(4096) / 3e-5)
    np.save("z.npy", profile(4096) + ripple)
    arguments = ("identify", "z.npy", "--dx", DX, "--unit", "m")
    assert run(capsys, *arguments)[0] == 1
    status, out, _ = run(capsys, *arguments, "--force")
    assert status == 0 and DISQUALIFYING[0] in SCENE.read_text() and "no scene" not in out


def test_bounds_for_the_design():
    """Only where the default ones leave the surface out."""
    for D, G, options in (
        (2.4, 1e-10, ""),
        (2.06, 1e-10, " --D 2.03 2.16"),
        (2.95, 1e-7, " --D 2.85 2.975 --G 1e-08 1e-06"),
    ):
        assert _bounds(fj.Surface(D, G)) == options
    ground = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-6)
    assert _bounds(ground) == " --bounds Sq=1e-07:1e-05 hurst=0.3:1"
    assert _bounds(fj.MeasuredSpectrum([1e4, 1e5], [1e-20, 1e-24])) == (
        " --bounds height_factor=0.1:10"
    )


@pytest.mark.slow
def test_a_roll_off_takes_an_area_and_its_tolerance_a_design(capsys):
    """The command ends in a design where the surface has a roll-off, with its errors."""
    ground = fj.SelfAffine(1e-6, 0.7, 8e-6, 1e-6)
    z = fj.topography(ground, 96e-6, 96, key=jax.random.key(1))
    np.save("map.npy", np.asarray(z))
    arguments = ("identify", "map.npy", "--dx", DX, "--unit", "m", "--tolerance", "errors.toml")
    status, out, _ = run(capsys, *arguments)
    assert status == 1 and out.splitlines()[-1].startswith("no scene: a SelfAffine takes Persson")
    assert not Path("errors.toml").exists()
    status, out, err = run(capsys, *arguments, "--area", 1e-6)
    assert (status, err) == (0, "") and "K_n = " in out and "squeals with probability" in out
    scene, errors = fj.Scene.load(SCENE), read_tolerance("errors.toml")
    assert isinstance(scene.contact.surface, fj.SelfAffine) and errors.names[:2] == (
        "ln Sq",
        "hurst",
    )
    words = out.splitlines()[-1].removeprefix("next: fractaljax design ").split()
    options = ["--tolerance", "errors.toml", "--starts", 1, "--lattice", 2, "--quiet"]
    # The growth rate that it has is allowed: a search for a quiet surface takes minutes.
    status, out, err = run(capsys, "design", *words, *options, "--target", 2e4)
    assert (status, err) == (0, "") and "probability of squeal" in out and "Ra [m]" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "required: file"),
        (["nowhere.csv"], "no such file"),
        (["words.csv"], "words.csv: there is no line of numbers in it"),
        (["flat.npy", "--dx", 1], "in which unit heights are: give it (--unit um)"),
        (["flat.npy", "--unit", "um", "--dx", 1], "z has no roughness: it is constant"),
        (["flat.npy", "--scene", "fixed.toml"], "takes no surface"),
        (["good.csv", "--band", 1e9, 2e9], "band must rise and lie between"),
        (["good.csv", "--out", "words.csv"], "File exists"),
    ],
)
def test_bad_input(capsys, tmp_path, arguments, message):
    """One line, exit status 2, and no folder left behind."""
    Path("words.csv").write_text("nothing\n")
    np.save("flat.npy", np.ones(500))
    write_profile("good.csv", profile(512))
    fj.brake_scene().replace(contact=fj.FixedContact(1.0, 1.0)).save("fixed.toml")
    before = sorted(path.name for path in tmp_path.iterdir())
    assert message in refused_command(capsys, "identify", *arguments)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.slow
def test_from_a_measurement_to_a_design(capsys):
    """`fractaljax design` makes the scene stable."""
    write_profile("mine.csv", profile(4096))
    assert run(capsys, "identify", "mine.csv")[0] == 0
    status, out, err = run(capsys, "design", SCENE, "--starts", 8, "--lattice", 8, "--quiet")
    assert err == "" and (status, "found: " in out) in [(0, True), (1, False)]
    start, end = fj.Scene.load(SCENE), fj.Scene.load("fractaljax-design/design.toml")
    assert fj.growth_rate(start) > 0 > fj.growth_rate(end)


@pytest.mark.slow
def test_the_joint_of_the_measured_surface_and_what_it_rests_on(capsys):
    """K_n, K_t and growth rate with the errors of D and ln G; the verdict with their scatter."""
    np.save("map.npy", gaussian_map(np.random.default_rng(1), D, (256, 256), G=G, dx=DX))
    arguments = ("map.npy", "--dx", DX, "--unit", "m")
    status, out, _ = run(capsys, "identify", *arguments, "--area", 1e-4)
    scene = fj.Scene.load(SCENE)
    found = fj.identify(np.load("map.npy"), DX)
    assert status == 0 and str(fj.verdict(scene, tolerance=found, area=1e-4)) in out
    assert "by PerssonContact" in out and "D and ln m(q) scatter" in out
    over = ("--envelope", "P=1500:2500", "V=0.1,0.15")
    status, ranged, _ = run(capsys, "identify", *arguments, *over)
    envelope = fj.Envelope({"P": (1500, 2500)}, {"V": (0.1, 0.15)})
    assert status == 0 and str(fj.verdict(scene, tolerance=found, envelope=envelope)) in ranged
    assert "D and ln m(q) scatter over P" in ranged
    (line,) = (line for line in out.splitlines() if line.startswith("K_n = "))
    shown, _, ends = line.removeprefix("K_n = ").partition(" N/m (")
    value, low, high = map(float, [shown, *ends.partition(")")[0].split(" to ")])
    assert value == pytest.approx(float(fj.stiffness(scene)[0]), rel=1e-3)
    drawn = fj.Tolerance.of(found)
    shifts = drawn.shifts(np.random.default_rng(1).standard_normal((400, 2)))
    at = drawn.scattered(scene, drawn.base(scene), shifts.T)
    K_n = [
        float(fj.stiffness(scene.replace(D=a, G=b))[0])
        for a, b in zip(at["D"], at["G"], strict=True)
    ]
    np.testing.assert_allclose([low, high], np.quantile(K_n, [0.16, 0.84]), rtol=0.1)
    status, _, err = run(capsys, "identify", *arguments, "--area", 0)
    assert status == 2 and "--area must be above 0, got 0.0" in err
