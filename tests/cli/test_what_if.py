"""The command changes quantities for one run, prints JSON, and suggests what was meant."""

import json

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._cli.design import add_design
from fractaljax._cli.parsing import Parser
from tools import refused_command, run_command as run

BRAKE = fj.brake_scene()


def result(capsys, *arguments) -> dict:
    """What a command prints as JSON, of which a parser of JSON takes no NaN."""

    def refuse(constant):
        raise AssertionError(constant)

    status, out, err = run(capsys, *arguments, "--json")
    assert (status, err) == (0, "")
    return json.loads(out, parse_constant=refuse)


def test_a_quantity_is_changed_for_one_run(capsys):
    BRAKE.save("brake.toml")
    arguments = "stability", "brake.toml", "--set", "mu_s=0.5", "P=1500", "--set", "mu_m=0.2"
    changed = BRAKE.replace(mu_s=0.5, P=1500.0, mu_m=0.2)
    status, out, _ = run(capsys, *arguments)
    assert status == 0 and f"{fj.growth_rate(changed):+.6g}  (it squeals)" in out
    assert fj.Scene.load("brake.toml").mu_s == 0.4  # the file stays
    _, out, _ = run(capsys, "scene", "--set", "D=2.45", "mu=0.3", "K_t/K_n=0.4")
    scene = fj.Scene.from_toml(out)
    assert (scene.D, scene.stiffness_ratio) == (2.45, 0.4)
    np.testing.assert_allclose(scene.mu, 0.3, rtol=1e-15)
    fj.Structure.from_scene(BRAKE).save("two.toml")
    _, out, _ = run(capsys, "stability", "two.toml", "--set", "joint_1.D=2.45", "--json")
    D = json.loads(out)["quantities"]["joint_1.D"]
    assert D == 2.45


def test_json(capsys):
    """The numbers of the tables at full precision; null where there is none."""
    shown = result(capsys, "stability")
    modes = fj.stability(BRAKE)
    assert shown["command"] == "stability" and shown["squeals"] is True
    np.testing.assert_allclose(shown["growth_rate"], modes.growth_rate, rtol=1e-12)
    s = [complex(x["real"], x["imag"]) for x in shown["eigenvalues"]]
    np.testing.assert_allclose(s, modes.eigenvalues, rtol=1e-12)
    assert shown["joints"]["joint"]["normal_force"] is None
    assert shown["joints"]["joint"]["regime"] == "elastic-plastic"
    # A fully plastic joint has no stiffness, so that no friction makes it squeal: infinity.
    none = result(capsys, "stability", "--set", "D=2.3")
    assert none["critical_friction"] is None and none["squeals"] is False
    quantities = result(capsys, "scene", "--set", "G=2e-10")["quantities"]
    assert (quantities["G"], quantities["stiffness_ratio"]) == (2e-10, None)


def test_without_arguments_there_is_help(capsys):
    status, out, err = run(capsys)
    assert (status, err) == (0, "") and "usage: fractaljax" in out and "identify" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stabilty"], "did you mean stability?"),
        (["brake.toml"], "fractaljax stability brake.toml"),
        (["stability", "M.mtx"], 'one with [structure], M = "M.mtx"'),
        (["stability", "--constant-fricton"], "did you mean --constant-friction?"),
        (["stability", "--colour"], "see fractaljax stability --help"),
        (["design", "--P", "100:200"], "did you mean --bounds P=LOW:HIGH or --set P=VALUE?"),
        (["design", "--bounds", "d=2.3:2.8"], "did you mean D?"),
        (["design", "--D", "2.3:2.8:3"], "argument --D: "),
        (["stability", "--set", "d=2.4"], "did you mean D?"),
        (["stability", "--set", "D=1.4"], "type D = 2.4"),
        (["stability", "--set", "D=2,5"], "--set D must be numbers, got '2,5'"),
        (["stability", "--set", "D=2.5", "b.toml"], "got 'b.toml': the file comes before it"),
        (["design", "--repeat", "run.toml", "--set", "D=2.4"], "--repeat takes everything from"),
    ],
)
def test_what_was_meant(capsys, arguments, message):
    assert message in refused_command(capsys, *arguments)


def parsed(words):
    parser = Parser()
    add_design(parser.add_subparsers(parser_class=Parser))
    return parser.parse_args(words)


def test_bounds_as_one_word():
    """--D 2.3:2.8 is --D 2.3 2.8, also after an equals sign."""
    for words in (["--D", "2.3:2.8"], ["--D=2.3:2.8"], ["--D", "2.3", "2.8"]):
        read = parsed(["design", *words, "--G", "1e-11:1e-9", "--quiet"])
        assert (read.D, read.G, read.quiet) == ([2.3, 2.8], [1e-11, 1e-9], True)


@pytest.mark.parametrize(
    ("words", "name", "wanted"),
    [
        ("--damping-ratio -0.1:0.2", "damping_ratio", "-0.1:0.2"),
        ("--damping-ratio -1e-3:", "damping_ratio", "-1e-3:"),
        ("--quiet-within -1e-3,2", "quiet_within", "-1e-3,2"),
        ("--target -1e-5", "target", -1e-5),
        ("--target -.5", "target", -0.5),
        ("--sq-lengths -1E3 -2.5e-7", "sq_lengths", [-1e3, -2.5e-7]),
    ],
)
def test_negative_numbers_are_values(words, name, wanted):
    read = parsed(["design", *words.split(), "--quiet"])
    assert getattr(read, name) == wanted and read.quiet
