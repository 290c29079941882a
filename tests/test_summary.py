"""Tables of scenes, designs and limit cycles."""

import re

import equinox as eqx
import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._base.table import table
from fractaljax._design.summary import comparison_table
from fractaljax._dynamics.summary import cycle_table
from fractaljax._stability.summary import (
    friction_remark,
    scene_rows,
    stability_table,
    verdict,
)
from tools import motionless_scene, reference_cycle, reference_scene

BRAKE = fj.brake_scene()
FIXED = BRAKE.replace(contact=fj.FixedContact(4e8, 2e8))
ROWS = [
    (BRAKE, {"regime": "elastic-plastic"}),
    # A plastic joint has no stiffness ratio, a slipping one no tangential stiffness.
    (BRAKE.replace(D=2.2, G=1e-9), {"regime": "fully plastic", "K_n [N/m]": "0", "K_t/K_n": "-"}),
    (BRAKE.replace(D=2.7, G=1e-11), {"regime": "gross slip", "K_t [N/m]": "0"}),
]


@pytest.mark.parametrize(("scene", "expected"), ROWS)
def test_rows_of_a_scene(scene, expected):
    """The printed digits are those of the functions."""
    rows, modes = scene_rows(scene), fj.stability(scene)
    assert rows | expected == rows
    assert rows["growth rate [1/s]"] == f"{modes.growth_rate:+.6g}"
    assert rows["frequency [Hz]"] == f"{modes.frequency:.6g}"
    constant = scene_rows(scene, friction_slope=False)
    assert constant["growth rate [1/s]"] == f"{fj.growth_rate(scene, False):+.6g}"


def test_roughness_where_wavelengths_are_given():
    """That of the surface, after its D and G; a joint without a surface has none of these."""
    rows = scene_rows(BRAKE, wavelengths=(1e-3, 1e-5))
    assert list(rows)[:5] == ["D", "G [m]", "Sq [m]", "Sdq", "K_n [N/m]"]
    rough = fj.roughness(BRAKE.contact.surface, 1e-3, 1e-5)
    assert (rows["Sq [m]"], rows["Sdq"]) == (f"{rough.Sq:.6g}", f"{rough.Sdq:.6g}")
    assert scene_rows(FIXED, wavelengths=(1e-3, 1e-5)) == scene_rows(FIXED)
    assert not {"D", "regime", "Sq [m]"} & set(scene_rows(FIXED))
    assert "Sq" not in comparison_table(FIXED, FIXED, True, (), (1e-3, 1e-5))


def test_stability_table_has_the_friction_that_starts_to_squeal():
    """As the library says; none where no friction does."""
    scene = fj.brake_scene().replace(contact=fj.FixedContact(4e8, 6e7), friction=fj.Coulomb(0.4))
    text = stability_table(scene)
    assert ["critical friction", "0.754017"] in [re.split("  +", x) for x in text.splitlines()]
    assert f"{fj.margin(scene):+.6g}" in text and "regime" not in text
    assert "(stable against small disturbances)" in text
    lines = stability_table(scene.replace(K_t=0.0)).splitlines()
    assert ["critical friction", "none"] in [re.split("  +", line) for line in lines]


def test_lines_and_columns_of_tables():
    """Several active constraints stand below each other."""
    scene = fj.brake_scene()
    text = comparison_table(scene, scene, True, ("one", "two", "three"))
    assert [line.split()[-1] for line in text.splitlines()[-3:]] == ["one", "two", "three"]
    assert comparison_table(scene, scene, True, ()).splitlines()[-1].split()[-1] == "-"
    # Titles stand above their columns; many columns are rows, so that lines stay short.
    text = table(["a", "b"], [{"row": "1", "longer row": "22"}, {"row": "3", "longer row": "4"}])
    assert text == "            a   b\nrow         1   3\nlonger row  22  4"
    lines = table([*"abcdef"], [{"row": str(i), "longer row": "22"} for i in range(6)]).splitlines()
    assert lines[:2] == ["   row  longer row", "a  0    22"] and len(lines) == 7


def cells(text):
    """The lines of a table, cut where two or more spaces stand."""
    return [re.split(r"  +", line.strip()) for line in text.splitlines()]


def test_cycle_tables_agree_with_their_cycles(monkeypatch):
    """Three blocks: the whole cycle, its two directions, its switches."""
    scene, cycle = reference_scene(), reference_cycle()
    whole, directions, switches = cycle_table(scene, cycle).split("\n\n")
    rows = {name: values for name, *values in cells(whole)}
    assert rows["result"] == ["a limit cycle was found"]
    assert rows["growth rate [1/s]"] == [f"{fj.growth_rate(scene):+.6g}", "(it squeals)"]
    assert float(rows["period [ms]"][0]) == pytest.approx(1e3 * float(cycle.period), rel=1e-5)
    assert float(rows["frequency [Hz]"][0]) == pytest.approx(float(cycle.frequency), rel=1e-5)
    assert rows["returns in a period"] == ["1"]
    assert rows["contact pulls"] == [f"{cycle.tension_fraction:.2%} of the period"]
    assert float(rows["estimated error"][0]) == pytest.approx(float(cycle.error), rel=0.05)
    for i, value in enumerate(cycle.multipliers.tolist(), start=1):
        shown, modulus = rows[f"Floquet multiplier {i}"]
        assert complex(shown.replace(" ", "").replace("i", "j")) == pytest.approx(value, abs=1e-6)
        assert float(modulus[9:-1]) == pytest.approx(abs(value), abs=1e-6)
    assert "-0.000000" not in whole

    titles, *lines = cells(directions)
    assert titles == ["x1, along the belt", "x2, normal to it"]
    rows = {name: values for name, *values in lines}
    for name, wanted in [
        ("peak to peak [m]", cycle.amplitude),
        ("least dx/dt [m/s]", cycle.velocity_min),
        ("largest dx/dt [m/s]", cycle.velocity_max),
    ]:
        np.testing.assert_allclose([float(cell) for cell in rows[name]], wanted, rtol=1e-5)
    assert rows["sticks"] == ["9.69% of the period", "0.00% of the period"]

    _, *lines, note = cells(switches)
    period = float(cycle.period)
    words = {"+": "slips, dx/dt < V", "-": "slips, dx/dt > V", "stick": "sticks"}
    assert len(lines) == len(cycle.switches()) == 5 and note == ["time 0: x1 is largest"]
    for (_, time, share, *rest), at in zip(lines, cycle.switches(), strict=True):
        assert float(time) == pytest.approx(1e3 * at.time, abs=1e-6)
        assert float(share[:-1]) == pytest.approx(100 * at.time / period, abs=0.01)
        assert rest == [f"x{at.direction}", words[at.before], words[at.after]]
    # Of an inaccurate cycle, of one of the regularised law, and of one without switches.
    text = cycle_table(scene, eqx.tree_at(lambda c: c.result, cycle, fj.CycleResult.inaccurate))
    assert text.startswith("result                a limit cycle was found, but not to rtol")
    assert "Floquet multiplier 4" in text and "switch 5" in text and "off the exact" not in text
    text = cycle_table(scene, eqx.tree_at(lambda c: c.regularisation_error, cycle, 0.0123))
    assert "off the exact law by  1.2e-02" in text and "switch" not in text
    monkeypatch.setattr(fj.LimitCycle, "switches", lambda _: [])
    text = cycle_table(scene, cycle)
    assert "switch" not in text and text.splitlines()[-1].startswith("sticks")


@pytest.mark.slow
def test_cycle_table_without_a_cycle():
    """Why there is none, and no row of NaN."""
    scene = motionless_scene()
    growth = f"{fj.growth_rate(scene):+.6g}"
    assert cells(cycle_table(scene, fj.limit_cycle(scene, throw=False))) == [
        ["result", "the motion dies out: the sliding equilibrium attracts it"],
        ["growth rate [1/s]", growth, "(stable against small disturbances)"],
    ]


UNCOMPUTABLE = [
    ({"v_m": 1e-150}, "the friction at V is inf"),
    ({"E": 1.7e308}, "K_n [N/m] is nan"),
    ({"xi_1": 1e40}, "the damping of x1 [1/s] is 1.25664e+44"),
    ({"mu_s": 1e100}, "the coupling mu^2 K_n K_t/m^2 [1/s^4] is 2.62034e+216"),
    ({"omega_2": 1e160}, "(K_n/m + omega_2^2) [1/s^2] is inf"),
]


@pytest.mark.parametrize(("changes", "message"), UNCOMPUTABLE)
def test_what_cannot_be_computed_is_not_called_stable(changes, message):
    """Found: NaN 1/s, (stable). Now one line that says what left the range."""
    scene = fj.brake_scene().replace(**changes)
    assert np.isnan(fj.growth_rate(scene)) and np.isnan(fj.margin(scene))
    with pytest.raises(ValueError, match=f"computed in float64: {re.escape(message)}$"):
        stability_table(scene)


def test_remarks_on_friction_beyond_its_law_and_a_growth_rate_of_zero():
    """Beyond sqrt(3) v_m the cubic exceeds mu_s."""
    scene = fj.brake_scene()
    speeds = 0.5 * np.sqrt(3) * np.array([0.0, 0.999, 1.0])
    assert friction_remark(scene, speeds) == []
    assert friction_remark(scene.replace(friction=fj.Coulomb(0.4)), 1e9) == []
    (line,) = friction_remark(scene, np.array([0.1, 0.87, 0.5]))
    assert line.startswith("remark: at a sliding speed of 0.87 m/s the friction law gives 0.40")
    assert stability_table(scene.replace(V=5.0)).splitlines()[-1].startswith("remark: at a sliding")
    assert "remark" not in stability_table(scene)
    # Without damping rounding would decide.
    scene = fj.brake_scene().replace(xi_1=0.0, xi_2=0.0, mu_s=0.01, mu_m=0.01)
    assert "+0  (0 to rounding: it neither grows nor dies out)" in stability_table(scene)


@pytest.mark.parametrize(
    ("growth", "margin", "words"),
    [
        (1e-11, 0.0, "0 to rounding: it neither grows nor dies out"),
        (-1e-11, 0.0, "0 to rounding: it neither grows nor dies out"),
        (1e-11, 0.1, "0 to rounding; by its margin stable against small disturbances"),
        (-1e-11, -0.1, "0 to rounding; by its margin it squeals"),
        (1e-8, -0.1, "it squeals"),
        (-1e-8, 0.1, "stable against small disturbances"),
    ],
)
def test_a_growth_rate_within_rounding_of_the_eigenvalues_has_no_sign(growth, margin, words):
    """They are some 1e4 1/s."""
    modes = fj.stability(BRAKE)
    numbers = jax.numpy.array([growth, margin])
    modes = eqx.tree_at(lambda m: (m.growth_rate, m.margin), modes, tuple(numbers))
    assert verdict(modes)["growth rate [1/s]"].endswith(f"({words})")


@pytest.mark.parametrize(
    ("changes", "said", "promise"),
    [
        ({"G": 1.342e-4}, "carries no stiffness: every contact is plastic", False),
        ({"D": 2.7}, "has no tangential stiffness: it slips as a whole", False),
        ({"D": 2.436}, "", True),
    ],
)
def test_a_joint_without_stiffness_is_said_first(changes, said, promise):
    """With units mistaken the brake seems quiet: it is the mechanism without its joint."""
    scene = fj.brake_scene().replace(**changes)
    structure = fj.Structure.from_scene(scene)
    cycle = fj.limit_cycle(scene, throw=False)
    tables = [cycle_table(x, cycle) for x in (scene, structure)]
    for text in (stability_table(scene), *tables, stability_table(structure)):
        assert said in text.splitlines()[0]
        assert ("stable against small disturbances" in text) == promise
