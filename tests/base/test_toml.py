"""TOML files: read back as they were written, and refused in one line that names the key."""

import pytest

import fractaljax as fj
from fractaljax._base.toml import Noted, part_table, read_toml, write_toml

GOOD = fj.brake_scene().to_toml()
DEEP = f"contact = {'[' * 9000}{']' * 9000}"


def test_every_value_is_read_back():
    document = {
        "text": 'a "quoted" \\ one, dünn, \x00\x1f\x7f\u2028',
        "lines": "x\n[y] = 'z'\n",
        "odd lines": "'''\n",
        "table": {"values": [1, -2.5e-300, True, float("inf"), {"k": 5e-324, "a b": []}]},
        "outer": {"inner": {"x": 1}, "empty": {}, "a.b": {"é": "y"}},
    }
    assert read_toml(write_toml("A comment", document).encode()) == document
    noted = {"absent": None, "unset": Noted(None, "m: length"), "set": Noted(2, "kg: mass")}
    written = "# A comment\n\n# unset =  # m: length\nset = 2  # kg: mass\n"
    assert write_toml("A comment", noted) == written


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("D = 2.4", "D = 3.0", "[contact.surface] D must be above 2 and below 3, got 3.0"),
        ("D = 2.4", "D = true", "[contact.surface] D must be a number, got True"),
        ("D = 2.4", 'D = "2.4"', "[contact.surface] D must be a number, got '2.4'"),
        ("D = 2.4", "D = [2.4]", "[contact.surface] D must be a real number, got [2.4]"),
        ("D = 2.4", "D = inf", "[contact.surface] D must be above 2"),
        ("D = 2.4", "", "[contact.surface] lacks the key 'D'"),
        ("D = 2.4", "D = 2.4\nE = 1.0", "[contact.surface] has the unknown key 'E'; known are D"),
        ('law = "fractal"', 'law = "hertz"', '[contact] law must be "asperity" or "fixed" or'),
        ('law = "fractal"', "law = [1]", '[contact] law must be "asperity" or'),
        ('law = "fractal"', "", '[contact] law must be "asperity" or'),
        (
            'law = "fractal"',
            'law = "fixed"',
            "[contact] has the unknown key 'surface'; known are K_n, K_t, P",
        ),
        ("[contact.material]", "[contact.matter]", "[contact] has the unknown key 'matter'"),
        ("[oscillator]", "[oscillators]", "the file has the unknown key 'oscillators'"),
        ("V = 0.15", "V = -0.15", "[oscillator] V must be at least 0, got -0.15"),
        ("V = 0.15", "V = 0.15 m/s", "not a TOML file: Expected newline"),
        (GOOD, "", "the table [contact] is missing"),
        (GOOD, "contact = 1", "[contact] must be a table, got 1"),
        (GOOD, "a = 1\na = 2", "not a TOML file: Cannot overwrite a value"),
        (GOOD, "K_n,K_t\n1,2\n", "not a TOML file"),
        (GOOD, "m = 1\udcff", "not a TOML file: 'utf-8' codec can't decode byte 0xff"),
        (GOOD, DEEP, "its tables or arrays are nested too deeply"),
    ],
)
def test_refusals(tmp_path, old, new, message):
    """File, table, key, bound and value, in one line."""
    assert old in GOOD
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace(old, new, 1), errors="surrogateescape")
    with pytest.raises(ValueError) as caught:
        fj.Scene.load(path)
    assert str(caught.value).startswith(f"{path}: {message}") and "\n" not in str(caught.value)


def test_whole_numbers_defaults_and_parts_without_a_name():
    """Integers are numbers, and what has a default may be left out."""
    text = GOOD.replace("P = 1907.3", "P = 2000").replace("gamma = 1.5", "")
    assert fj.Scene.from_toml(text).replace(P=1907.3).to_toml() == GOOD


def test_a_law_without_a_name():
    class Linear(fj.Contact):
        def stiffness(self, mu_s, mu_m):
            return 1e8, 1e8

    with pytest.raises(
        ValueError, match=r"a file holds as contact one of Asp.*Contact, got Linear"
    ):
        part_table(fj.brake_scene().replace(contact=Linear()))
