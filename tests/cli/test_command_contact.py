"""`fractaljax contact`: the table, the picture and the numbers."""

import csv
from pathlib import Path

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
