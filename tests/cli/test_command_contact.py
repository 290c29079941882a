"""`fractaljax contact`: the table, the picture and the numbers."""

import csv
import importlib
import itertools
import json
from pathlib import Path

import jax
import numpy as np
import pytest

import fractaljax as fj
from tools import refused_command, run_command as run

QUICK = ("--n", 32, "--seeds", 2, "--points", 2)


def test_reference_brake(capsys):
    status, out, err = run(capsys, "contact", "--area", 1e-4, *QUICK, "--quiet")
    assert (status, err) == (0, "")
    brake = fj.brake_scene().contact
    expected = fj.compare_laws(
        brake.surface, brake.material, [190.73, 19073], area=1e-4, n=32, seeds=2, progress=False
    )
    assert out == f"{expected!r}\nwritten to fractaljax-contact: contact.png, contact.csv\n"
    with open("fractaljax-contact/contact.csv", newline="") as file:
        titles, *rows = csv.reader(file)
    assert (titles, rows) == expected.rows()
    assert Path("fractaljax-contact/contact.png").read_bytes().startswith(b"\x89PNG")


def test_scene_with_a_nominal_area(capsys):
    brake = fj.brake_scene()
    law = fj.PerssonContact(brake.contact.surface, brake.contact.material, 500, 1e-4, 1e-2, 2e-3)
    brake.replace(contact=law).save("mine.toml")
    status, out, _ = run(capsys, "contact", "mine.toml", "--loads", "100:1000", *QUICK, "--quiet")
    assert status == 0 and out.splitlines()[1].startswith("100 ")
    K_n = float(law.stiffness(0.4, 0.25)[0])
    words = [line.split() for line in out.splitlines()]
    ends = [float(row[row.index("Persson") + 1]) for row in words if "Persson" in row]
    assert len(ends) == 2 and ends[0] < K_n < ends[1]


def test_scene_with_another_spectrum(capsys):
    """The laws that need D and G are left out, and a line says so."""
    ground = fj.SelfAffine(1e-6, 0.8, 1e-3, 2e-4)
    law = fj.PerssonContact(ground, fj.brake_scene().contact.material, 1e3, 4e-6)
    fj.brake_scene().replace(contact=law).save("ground.toml")
    status, out, err = run(capsys, "contact", "ground.toml", *QUICK, "--quiet")
    assert (status, err) == (0, "")
    expected = fj.compare_laws(
        ground, law.material, [100, 1e4], area=4e-6, n=32, seeds=2, progress=False
    )
    assert out.startswith(f"{expected!r}\n") and "left out: fractal and asperity, which" in out
    assert Path("fractaljax-contact/contact.png").read_bytes().startswith(b"\x89PNG")
    status, out, err = run(capsys, "contact", "ground.toml", *QUICK, "--quiet", "--json")
    assert json.loads(out)["left_out"] == ["fractal", "asperity"]
    few = ("--n", 8, "--seeds", 1, "--points", 2, "--quiet")
    assert "hold" in run(capsys, "contact", "ground.toml", *few)[2]


@pytest.fixture
def plateau():
    """A map with a plateau in map.npz."""
    ground = fj.SelfAffine(1e-6, 0.8, 2.5e-4, 5e-5)
    z = np.asarray(fj.topography(ground, 1e-3, 64, key=jax.random.key(1)))
    np.savez("map.npz", z=np.minimum(z, 2e-7), dx=1e-3 / 64)


def test_law_of_a_map(capsys, plateau):
    """A scene for every other command; the law that its spectrum has is beside it."""
    status, out, err = run(capsys, "contact", "map.npz", "--area", 1e-4)
    assert (status, err) == (0, "")
    assert "warning: heights are far from Gaussian" in out
    scene = fj.Scene.load("fractaljax-contact/scene.toml")
    assert isinstance(scene.contact, fj.MeasuredContact)
    with open("fractaljax-contact/contact.csv", newline="") as file:
        titles, *rows = csv.reader(file)
    assert titles[0] == "load [N]" and len(rows) == len(scene.contact.loads)
    assert [float(row[1]) for row in rows] == pytest.approx(scene.contact.stiffnesses, rel=1e-3)
    assert 0.1 < float(rows[0][3]) < 0.7  # a spectrum knows no plateau
    assert "fractaljax-contact: scene.toml, contact.csv" in out


def table():
    """The rows of contact.csv as numbers."""
    return np.loadtxt("fractaljax-contact/contact.csv", delimiter=",", skiprows=1)


def test_spectrum_beside_a_map_is_of_the_map_s_own_area(capsys):
    """A joint of 25 maps is 25 times one map, also by the spectrum, at each nominal pressure."""
    ground = fj.SelfAffine(1e-6, 0.8, 2.5e-4, 5e-5)
    z = np.asarray(fj.topography(ground, 1e-3, 64, key=jax.random.key(1)))
    np.savez("map.npz", z=z, dx=1e-3 / 64)
    assert run(capsys, "contact", "map.npz", "--area", 1e-6)[0] == 0
    one = table()
    assert run(capsys, "contact", "map.npz", "--area", 25e-6)[0] == 0
    many = table()
    rows = one[:, 0] * 25 >= many[0, 0] * 0.999
    np.testing.assert_allclose(many[:, :3], 25 * one[rows, :3], rtol=2e-3)
    contact = fj.brake_scene().contact
    law = fj.PerssonContact(fj.spectrum_of(z, 1e-3 / 64), contact.material, one[0, 0], 1e-6)
    assert one[0, 2] == pytest.approx(float(law.stiffness(0.4, 0.25)[0]), rel=2e-3)


def test_map_whose_steps_differ(capsys, plateau):
    """Its law is that of `from_heights`, with both steps."""
    assert run(capsys, "contact", "map.npz", "--area", 1e-4, "--dy", 2e-5)[0] == 0
    contact = fj.brake_scene().contact
    z = np.load("map.npz")["z"]
    joint = contact.material, contact.P, 1e-4
    law = fj.MeasuredContact.from_heights(z, 1e-3 / 64, *joint, dy=2e-5, prepare=True)
    written = fj.Scene.load("fractaljax-contact/scene.toml").contact
    np.testing.assert_allclose(written.stiffnesses, law.stiffnesses, rtol=1e-9)


def test_load_without_a_solution_is_left_out(capsys, plateau, monkeypatch):
    """With a warning; where two are not left, in one sentence."""
    module = importlib.import_module("fractaljax._contact.measured")
    press, calls = module.boundary_element, itertools.count()

    def first_fails(*arguments, **options):
        options |= {} if next(calls) else {"max_steps": 1}
        return press(*arguments, **options)

    monkeypatch.setattr(module, "boundary_element", first_fails)
    status, out, err = run(capsys, "contact", "map.npz", "--area", 1e-4)
    assert (status, err) == (0, "") and len(table()) == 11
    assert "warning: boundary elements did not converge at" in out

    def fails(*arguments, **options):
        return press(*arguments, **options | {"max_steps": 1})

    monkeypatch.setattr(module, "boundary_element", fails)
    said = "map.npz: boundary elements converged at 0 of 12 pressures and two are needed"
    assert said in refused_command(capsys, "contact", "map.npz", "--area", 1e-4)


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("map.npz",), "--area must be given: the law of the scene knows no nominal area"),
        (("map.npz", "--area", 1e-4, "--dx", 2e-5), "map.npz"),
        (
            ("line.csv", "--area", 1e-4, "--unit", "m"),
            "line.csv: a profile cannot be pressed, a map is needed",
        ),
        (("map.npz", "--area", 1e-4, "--scene", "fixed.toml"), "fixed.toml: a map needs the mat"),
        (("none.npy", "--area", 1e-4), "none.npy"),
    ],
)
def test_refuses_a_map(capsys, plateau, arguments, said):
    fj.brake_scene().replace(contact=fj.FixedContact(1e8, 1e8)).save("fixed.toml")
    np.savetxt("line.csv", np.column_stack([np.arange(200) * 1e-6, np.sin(np.arange(200)) * 1e-7]))
    assert said in refused_command(capsys, "contact", *arguments)
    assert not Path("fractaljax-contact").exists()


@pytest.mark.parametrize(
    "arguments, said",
    [
        ((), "--area must be given: the law of the scene knows no nominal area"),
        (("--area", 1e-4, "--loads", "2:1"), "--loads must be LOW:HIGH with 0 < LOW < HIGH"),
        (("--area", 1e-4, "--points", 1), "--points must be at least 2, got 1"),
        (("fixed.toml", "--area", 1e-4), "fixed.toml: the law of its contact takes no surface"),
        (("ground.toml", "--L-s", 1e-6), "L_s is for a Surface; a SelfAffine has a shortest"),
    ],
)
def test_refuses(capsys, arguments, said):
    fj.brake_scene().replace(contact=fj.FixedContact(1e8, 1e8)).save("fixed.toml")
    ground = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5)
    law = fj.PerssonContact(ground, fj.brake_scene().contact.material, 1e3, 1e-4)
    fj.brake_scene().replace(contact=law).save("ground.toml")
    assert said in refused_command(capsys, "contact", *arguments, "--quiet")
    assert not Path("fractaljax-contact").exists()


def test_surface_without_a_solution(capsys, monkeypatch):
    module = importlib.import_module("fractaljax._contact.compare")
    press = module.boundary_element
    monkeypatch.setattr(module, "boundary_element", lambda *x: press(*x, max_steps=1))
    said = "boundary elements did not converge: --seeds 0 leaves them out"
    assert said in refused_command(capsys, "contact", "--area", 1e-4, *QUICK, "--quiet")
