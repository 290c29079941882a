"""`fractaljax identify`: from a file of heights to a scene that can be designed."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

import fractaljax as fj
import instrument_files as files
from fractaljax.command.identify import _MEANINGLESS, _bounds
from synthetic import gaussian_profile
from tools import run_command as run

D, G = 2.4, 1.342e-10
DX = 1e-6
WRITTEN = ["identification.png", "scene.toml"]


def profile(n, p=7 - 2 * D, seed=0):
    """Heights [m] of a Gaussian profile with the spectrum of D and G, or with its slope p."""
    return gaussian_profile(np.random.default_rng(seed), D=(7 - p) / 2, n=n, G=G, dx=DX)


def write_profile(name, z):
    """A CSV file of positions in um and heights in nm."""
    rows = [f"{i * DX * 1e6!r},{h * 1e9!r}" for i, h in enumerate(z.tolist())]
    Path(name).write_text("\n".join(["x [um],z [nm]", *rows]))


def test_identify_a_profile(capsys, tmp_path):
    """What is printed and written; D and G within three standard errors of what was put in."""
    z = profile(4096)
    z[100:140] = np.nan
    write_profile("mine.csv", z)
    status, out, err = run(capsys, "identify", "mine.csv")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "mine.csv: text of 4096 lines and 2 columns"
    assert lines[1] == "profile of 4096 heights, 40 of them missing, dx = 1e-06 m"
    assert "written to fractaljax-identification: identification.png, scene.toml" in out
    assert lines[-1] == "next: fractaljax design fractaljax-identification/scene.toml"

    folder = tmp_path / "fractaljax-identification"
    assert sorted(p.name for p in folder.iterdir()) == WRITTEN
    assert (folder / "identification.png").read_bytes().startswith(b"\x89PNG")
    found = fj.identify(z, DX)
    assert f"{found}" in out
    scene = fj.Scene.load(folder / "scene.toml")
    surface = scene.contact.surface
    np.testing.assert_allclose([surface.D, surface.G], [found.D, found.G], rtol=1e-9)
    assert abs(found.D - D) < 3 * found.D_standard_error
    assert abs(math.log(found.G / G)) < 3 * found.ln_G_standard_error
    rest = fj.brake_scene().replace(surface=scene.contact.surface)
    assert scene.to_toml() == rest.to_toml()
    comments = (folder / "scene.toml").read_text().split("# A fractaljax scene")[0]
    assert "# surface identified from mine.csv" in comments and "standard error" in comments


def test_identify_a_map_for_a_scene(capsys):
    """An instrument's file, a band, limits and a scene of the user's own."""
    f = np.hypot(np.fft.fftfreq(128)[:, None], np.fft.rfftfreq(128)[None])
    f[0, 0] = np.inf
    noise = np.fft.rfft2(np.random.default_rng(0).normal(size=(128, 128)))
    z = 1e-8 * np.fft.irfft2(noise * f ** (D - 4))[:64, :48]
    Path("map.x3p").write_bytes(files.x3p(z, DX, DX))
    fj.brake_scene().replace(P=3000.0, gamma=1.4).save("mine.toml")
    options = ["--band", 8e4, 4e5, "--resolution", 1e-7, "--scene", "mine.toml", "--out", "a/b"]
    status, out, err = run(capsys, "identify", "map.x3p", *options)
    assert (status, err) == (0, "")
    assert "map of 64 x 48 heights, 0 of them missing, dx = 1e-06 m, dy = 1e-06 m" in out
    scene = fj.Scene.load("a/b/scene.toml")
    found = fj.identify(z, DX, band=(8e4, 4e5), resolution=1e-7, gamma=1.4)
    np.testing.assert_allclose(scene.contact.surface.D, found.D, rtol=1e-9)
    assert scene.contact.P == 3000 and scene.contact.surface.gamma == 1.4


def test_options_reach_reading_and_identification(capsys, monkeypatch):
    """The instrument's limits are the file's where none are given."""
    asked = {}

    def read(path, **options):
        asked.update(options, path=path)
        return fj.Measurement(np.ones(3), 1e-6, None, "mine", 3e-6, 4e-6)

    def identify(z, dx, dy, **options):
        asked.update(options, steps=(dx, dy))
        raise ValueError("enough")

    monkeypatch.setattr("fractaljax.measured.files.read_measurement", read)
    monkeypatch.setattr("fractaljax.measured.identify.identify", identify)
    options = ["--dx", 1, "--dy", 2, "--unit", "um", "--position-unit", "mm", "--channel", "Z"]
    options += ["--stylus-radius", 5e-6, "--band", 1, "2e3", "--folded", "no"]
    assert run(capsys, "identify", "f", *options) == (2, "", "fractaljax: enough\n")
    assert asked == {
        "path": Path("f"),
        "dx": 1.0,
        "dy": 2.0,
        "unit": "um",
        "position_unit": "mm",
        "channel": "Z",
        "steps": (1e-6, None),
        "band": [1.0, 2000.0],
        "folded": False,
        "gamma": 1.5,
        "resolution": 3e-6,
        "stylus_radius": 5e-6,
    }


@pytest.mark.parametrize(("p", "message"), [(0.5, "below 3"), (4.5, "above 2")])
def test_no_surface_of_the_model(capsys, p, message):
    """D outside (2, 3): exit status 1, the reason, the picture that shows it, and no scene."""
    np.save("z.npy", profile(2048, p))
    status, out, err = run(capsys, "identify", "z.npy", "--dx", DX, "--unit", "m", "--out", "out")
    assert (status, err) == (1, "")
    assert out.splitlines()[-1].startswith("no scene: ") and message in out.splitlines()[-1]
    assert "next" not in out
    assert [p.name for p in Path("out").iterdir()] == ["identification.png"]
    Path("out/scene.toml").write_text("")
    lines = run(capsys, "identify", "z.npy", "--dx", DX, "--unit", "m", "--out", "out")[
        1
    ].splitlines()
    assert lines[-3:-1] == [
        "written to out: identification.png (all replaced)",
        "out/scene.toml is of an earlier run",
    ]


def test_no_scene_for_what_is_not_fractal(capsys, monkeypatch):
    """A wavy surface is not: that flag stands in place of the scene, others in its comments."""
    x = DX * np.arange(4096)
    wavy = 1e-6 * np.sin(2 * np.pi * x / 3e-4) + 1e-9 * np.random.default_rng(1).normal(size=4096)
    assert any(flag.startswith(_MEANINGLESS) for flag in fj.identify(wavy, DX).flags)
    found = fj.identify(profile(1024), DX)
    write_profile("mine.csv", profile(1024))
    for flag, status, written in [
        ("not fractal: peaks", 1, WRITTEN[:1]),
        ("too few levels: heights have only 3", 1, WRITTEN[:1]),
        ("odd", 0, WRITTEN),
    ]:
        flagged = dataclasses.replace(found, flags=(flag,))
        monkeypatch.setattr("fractaljax.measured.identify.identify", lambda *_, f=flagged, **__: f)
        assert run(capsys, "identify", "mine.csv", "--out", flag)[::2] == (status, "")
        assert sorted(p.name for p in Path(flag).iterdir()) == written
    assert "# odd\n" in Path("odd/scene.toml").read_text()


@pytest.mark.parametrize(
    ("D", "G", "options"),
    [
        (2.4, 1e-10, ""),
        (2.06, 1e-10, " --D 2.03 2.16"),
        (2.95, 1e-7, " --D 2.85 2.975 --G 1e-08 1e-06"),
    ],
)
def test_bounds_for_the_design(D, G, options):
    """Only where the default ones leave the surface out."""
    assert _bounds(fj.Surface(D, G)) == options


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "required: file"),
        (["nowhere.csv"], "no such file"),
        (["words.csv"], "words.csv: there is no line of numbers in it"),
        (["short.npy", "--dx", 1], "in which unit heights are: give it (--unit um)"),
        (["short.npy", "--unit", "um"], "give dx in metres (--dx 1e-6)"),
        (["short.npy", "--unit", "um", "--dx", 0], "dx must be above 0 and finite, in m, got 0"),
        (["short.npy", "--unit", "um", "--dx", "1um"], "invalid float value: '1um'"),
        (["short.npy", "--unit", "um", "--dx", 1], "z is too short"),
        (["flat.npy", "--unit", "um", "--dx", 1], "z has no roughness: it is constant"),
        (["flat.npy", "--unit", "um", "--dx", 1, "--scene", "fixed.toml"], "takes no surface"),
        (["flat.npy", "--scene", "nowhere.toml"], "no such file"),
        (["good.csv", "--band", 1e9, 2e9], "band must rise and lie between"),
        (["good.csv", "--resolution", 0], "resolution must be above 0"),
        (["good.csv", "--out", "words.csv"], "File exists"),
    ],
)
def test_bad_input(capsys, tmp_path, arguments, message):
    """One line, exit status 2, and no folder left behind."""
    Path("words.csv").write_text("nothing\n")
    np.save("short.npy", np.arange(5.0))
    np.save("flat.npy", np.ones(500))
    write_profile("good.csv", profile(512))
    fixed = fj.brake_scene().replace(contact=fj.FixedContact(1.0, 1.0))
    fixed.save("fixed.toml")
    before = sorted(p.name for p in tmp_path.iterdir())
    status, out, err = run(capsys, "identify", *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("fractaljax: ") and message in err and err.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.slow
def test_from_a_measurement_to_a_design(capsys):
    """The scene that is written is one that `fractaljax design` makes stable."""
    write_profile("mine.csv", profile(4096))
    assert run(capsys, "identify", "mine.csv")[0] == 0
    path = "fractaljax-identification/scene.toml"
    status, out, err = run(capsys, "design", path, "--starts", 8, "--lattice", 8, "--quiet")
    assert err == "" and (status, "found: " in out) in [(0, True), (1, False)]
    start, end = fj.Scene.load(path), fj.Scene.load("fractaljax-design/design.toml")
    assert fj.growth_rate(start) > 0 > fj.growth_rate(end)
