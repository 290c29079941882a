"""A saved design says what was asked and what came of it, and runs again to the last bit."""

import dataclasses
import math
import re
import tomllib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import fractaljax as fj
from fractaljax._base.toml import write_toml
from fractaljax._base.versions import version_text, versions
from fractaljax._design.design_file import read_design
from structures import fractal_joints

SMALL: dict[str, Any] = dict(starts=4, lattice=8, progress=False)


def coarse(scene):
    return scene.contact.surface.D - 2.45


@pytest.fixture(scope="module")
def robust():
    """Everything at once: envelope, tolerance, constraints of both kinds, an own bound."""
    return fj.design(
        fj.brake_scene(),
        {"D": (2.3, 2.8), "G": (1e-11, 1e-9)},
        constraints=[fj.constraints.Roughness(at_most=3e-6, L=1e-3, L_s=1e-6), coarse],
        envelope=fj.Envelope({"P": (1800.0, 2000.0)}, {"mu_s": (0.39, 0.41), "mu_m": (0.24, 0.26)}),
        tolerance={"D": 0.002, "ln G": 0.02},
        quantile=0.9,
        seed=3,
        search=fj.DesignSearch(exchange_rounds=11, kick_starts=(64, 512)),
        **SMALL,
    )


@pytest.mark.slow
def test_file_repeats_the_run(robust, tmp_path):
    """Scene, options and functions come back; result, history and file are the same to a bit."""
    robust.save(tmp_path / "run.toml")
    again = fj.repeat_design(tmp_path / "run.toml", {"coarse": coarse}, progress=False)
    again.save(tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_bytes() == (tmp_path / "run.toml").read_bytes()
    assert again.scene.to_toml() == robust.scene.to_toml()
    assert repr(again) == repr(robust)
    for name, column in robust.history.items():
        np.testing.assert_array_equal(again.history[name], column)


@pytest.mark.slow
def test_file_holds_all_of_it_also_from_other_versions(robust, tmp_path):
    """As plain TOML: versions, both scenes, what was found."""
    robust.save(tmp_path / "run.toml")
    document = tomllib.loads((tmp_path / "run.toml").read_text())
    assert document["jax"] == jax.__version__ and document["precision"] == "float64"
    assert fj.Scene.from_toml(document["given"]).to_toml() == robust.initial.to_toml()
    assert fj.Scene.from_toml(document["designed"]).to_toml() == robust.scene.to_toml()
    assert document["options"]["envelope"]["samples"]["mu_m"] == [0.24, 0.26]
    assert document["options"]["seed"] == 3 and document["options"]["quantile"] == 0.9
    assert document["options"]["constraints"][1] == {"function": "coarse"}
    result = document["result"]
    assert result["value"] == robust.value and result["worst"] == robust.worst
    assert result["squeal_probability"] == robust.squeal_probability
    assert result["failed_starts"] == robust.failed_starts
    assert document["history"]["D"] == robust.history["D"].tolist()
    # Read under a warning of one line; without any versions, in silence.
    path = tmp_path / "run.toml"
    own = [f'{name} = "{version}"' for name, version in versions().items()]
    text = path.read_text()
    assert text.splitlines()[2:4] == own
    path.write_text(text.replace(own[0], 'fractaljax = "0.0.9"').replace(own[1], 'jax = "3"'))
    with pytest.warns(UserWarning) as warned:
        read_design(path, {"coarse": coarse})
    message = str(warned.pop().message)
    others = f"written by fractaljax 0.0.9, jax 3, read by {version_text()}"
    assert message == f"{path} was {others}: digits may differ"
    path.write_text(text.replace(own[0], "").replace(own[1], ""))
    read_design(path, {"coarse": coarse})


@pytest.mark.slow
def test_functions_of_the_package_are_found_again(tmp_path):
    """An objective by its place in this package; a risk with its number."""
    best = fj.design(
        fj.brake_scene(),
        objective=fj.growth_rate,
        envelope={"V": (0.1, 0.2)},
        risk=("smooth", 0.05),
        **SMALL,
    )
    best.save(tmp_path / "run.toml")
    _, options = read_design(tmp_path / "run.toml")
    assert options["objective"] is fj.growth_rate and options["risk"] == ("smooth", 0.05)
    assert options["envelope"] == fj.Envelope({"V": (0.1, 0.2)})


@pytest.mark.slow
def test_an_optimiser_is_given_again(tmp_path):
    """It has no name of its own in the file."""
    optimiser = optax.adam(0.03)
    best = fj.design(fj.brake_scene(), optimiser=optimiser, **SMALL)
    assert best.sensitivity is not None  # which is not kept
    best.save(tmp_path / "run.toml")
    with pytest.raises(ValueError, match="'optimiser' is not in the file: give it in `functions`"):
        fj.repeat_design(tmp_path / "run.toml", progress=False)
    again = fj.repeat_design(tmp_path / "run.toml", {"optimiser": optimiser}, progress=False)
    assert repr(again) == repr(best)


@pytest.mark.slow
def test_a_structure_has_files_beside_it(tmp_path):
    """Its design runs again to the last bit."""
    structure = fractal_joints()
    best = fj.design(
        structure,
        {"left.D": (2.3, 2.6)},
        target=float(fj.growth_rate(structure)) * 0.98,
        K_n_min=0.0,
        **SMALL,
    )
    best.save(tmp_path / "run.toml")
    names = {"run.toml"} | {
        f"run.{x}.{kind}" for x in ("given", "designed") for kind in ("toml", "npz")
    }
    assert {file.name for file in tmp_path.iterdir()} == names
    again = fj.repeat_design(tmp_path / "run.toml", progress=False)
    assert repr(again) == repr(best) and again.value == best.value
    assert fj.Structure.load(tmp_path / "run.designed.toml").joints[0].contact.surface.D == (
        best.scene.joints[0].contact.surface.D
    )


@pytest.mark.slow
def test_single_precision_stays_single(tmp_path):
    """The scene is read in the precision it had."""
    single = jax.tree.map(lambda x: x.astype(jnp.float32), fj.brake_scene())
    fj.design(single, **SMALL).save(tmp_path / "run.toml")
    scene, _ = read_design(tmp_path / "run.toml")
    assert isinstance(scene, fj.Scene)
    assert scene.contact.surface.D.dtype == jnp.float32
    assert scene.contact.surface.G == single.contact.surface.G


EDITS = [
    ("precision = ", "accuracy = ", "not a design file, it lacks 'precision'"),
    ('kind = "Roughness"', 'kind = "Colour"', "there is no constraint 'Colour'"),
    ("P = [1800.0, 2000.0]", "P = [2000.0, 1800.0]", "must be (lower, upper), got (2000, 1800)"),
    ("D = 2.4 ", "D = 2.0 ", "[contact.surface] D must be above 2 and below 3, got 2.0"),
    ("renewals = 12", "renewals = 0", "renewals must be a whole number of at least 1, got 0"),
    ("renewals = 12", "renewal = 12", "[options.search] has the unknown key 'renewal'"),
    ("[options]", "[options", "run.toml: "),
]


@pytest.mark.parametrize(("old", "new", "message"), EDITS)
def test_bad_files(robust, tmp_path, old, new, message):
    """One line, with the name of the file."""
    robust.save(tmp_path / "run.toml")
    text = (tmp_path / "run.toml").read_text()
    assert old in text
    (tmp_path / "run.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError) as caught:
        read_design(tmp_path / "run.toml", {"coarse": coarse})
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_search_is_in_the_file_and_may_be_left_out(robust, tmp_path):
    """Files from before it had options lack it."""
    robust.save(tmp_path / "run.toml")
    _, options = read_design(tmp_path / "run.toml", {"coarse": coarse})
    assert options["search"] == robust.options["search"] != fj.DesignSearch()
    text = (tmp_path / "run.toml").read_text()
    first = text.index("[options.search]")
    older = text[:first] + text[text.index("[result]", first) :]
    (tmp_path / "older.toml").write_text(older)
    _, options = read_design(tmp_path / "older.toml", {"coarse": coarse})
    assert "search" not in options and options["seed"] == 3


def test_functions_that_are_not_in_the_file(robust, tmp_path):
    """They are named; and nothing outside the package is imported for a file."""
    robust.save(tmp_path / "run.toml")
    with pytest.raises(ValueError, match="the function 'coarse' is not in the file: give it"):
        fj.repeat_design(tmp_path / "run.toml", progress=False)
    text = (tmp_path / "run.toml").read_text()
    (tmp_path / "run.toml").write_text(text.replace('"coarse"', '"os:getcwd"'))
    with pytest.raises(ValueError, match="the function 'os:getcwd' is not in the file"):
        fj.repeat_design(tmp_path / "run.toml", progress=False)


def test_numbers_that_toml_can_hold_and_no_endless_file(robust, tmp_path):
    """Not a number and infinity are written as TOML knows them."""
    odd = dataclasses.replace(robust, value=math.nan, growth_rate=-math.inf)
    odd.save(tmp_path / "run.toml")
    result = tomllib.loads((tmp_path / "run.toml").read_text())["result"]
    assert math.isnan(result["value"]) and result["growth_rate"] == -math.inf
    with pytest.raises(ValueError, match=r"^/dev/zero: the file is larger than 10 MB"):
        read_design("/dev/zero")


WRONG = [True, -1, 1.5, 10**30, math.nan, math.inf, "", "text", [], [1], ["a"], {}, {"a": 1}, [{}]]
RIGHT = [  # of the wrong ones, what an option or a key may be after all
    ("target", (-1, 1.5, 10**30)),
    ("K_n_min", (1.5, 10**30)),
    ("area_ratio_min", (1.5, 10**30)),
    ("friction_slope", (True,)),
    ("constraints", ([],)),
    ("solver", ()),
    ("designed", ("", "text")),
    ("jax", ("", "text")),
    ("fractaljax", ("", "text")),
]


@pytest.mark.slow
def test_wrong_kinds_are_refused_before_the_search(robust, tmp_path, monkeypatch):
    """Every key of a file, and every option in it, with a value of the wrong type or sign."""
    monkeypatch.setattr("fractaljax._design.design.choose_starts", None)
    robust.save(tmp_path / "run.toml")
    document = tomllib.loads((tmp_path / "run.toml").read_text())
    document |= {"result": {}, "history": {}}
    right = dict(RIGHT)
    places = [(document, name) for name in document if name not in ("result", "history")]
    places += [(document["options"], name) for name in document["options"]]
    for table, name in places:
        for value in WRONG:
            if value in right.get(name, ()) and type(value) in map(type, right[name]):
                continue
            given, table[name] = table[name], value
            (tmp_path / "wrong.toml").write_text(write_toml("wrong", document))
            table[name] = given
            with pytest.raises((ValueError, TypeError)) as refused:
                fj.repeat_design(tmp_path / "wrong.toml", {"coarse": coarse}, progress=False)
            said = str(refused.value).replace(str(tmp_path), "")
            assert "\n" not in said and len(said) < 300


def test_unknown_and_missing_entries(robust, tmp_path):
    """Tables, options and arguments of constraints that are misspelt or gone."""
    robust.save(tmp_path / "run.toml")
    text = (tmp_path / "run.toml").read_text()
    for old, new, message in (
        ("[options]", "[option]", "the file has the unknown key 'option'"),
        ("quantile = ", "quantil = ", "[options] has the unknown key 'quantil'"),
        (
            "[options.envelope.ranges]",
            "[options.envelope.range]",
            "[options.envelope] has the unknown key 'range'",
        ),
        ("L_s = ", "L_x = ", "the constraint Roughness has the unknown key 'L_x'"),
        ("risk = ", "# risk = ", "not a design file, it lacks 'risk'"),
        (
            '"coarse"',
            '"fractaljax.nowhere:x"',
            "the package has no function 'fractaljax.nowhere:x'",
        ),
    ):
        assert old in text
        (tmp_path / "wrong.toml").write_text(text.replace(old, new, 1))
        with pytest.raises(ValueError, match=re.escape(message)):
            read_design(tmp_path / "wrong.toml", {"coarse": coarse})
