"""`fractaljax contact`: the table, the picture and the numbers."""

import csv
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


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("map.npz",), "--area must be given: the law of the scene knows no nominal area"),
        (("map.npz", "--area", 1e-4, "--dy", 2e-5), "map.npz"),
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
        (
            ("ground.toml", "--area", 1e-4),
            "laws are compared on a fractal surface, not a SelfAffine",
        ),
    ],
)
def test_refuses(capsys, arguments, said):
    fj.brake_scene().replace(contact=fj.FixedContact(1e8, 1e8)).save("fixed.toml")
    ground = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5)
    law = fj.PerssonContact(ground, fj.brake_scene().contact.material, 1e3, 1e-4)
    fj.brake_scene().replace(contact=law).save("ground.toml")
    assert said in refused_command(capsys, "contact", *arguments, "--quiet")
    assert not Path("fractaljax-contact").exists()
