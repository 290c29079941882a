"""Tables of scenes and designs."""

import fractaljax as fj
from fractaljax.report import comparison_table, scene_rows, stability_table, table


def test_rows_of_every_regime():
    """A plastic joint has no stiffness ratio, a slipping one no tangential stiffness."""
    scene = fj.brake_scene()
    assert scene_rows(scene)["regime"] == "elastic-plastic"
    plastic = scene_rows(scene.replace(D=2.2, G=1e-9))
    assert (plastic["regime"], plastic["K_n [N/m]"], plastic["K_t/K_n"]) == (
        "fully plastic",
        "0",
        "-",
    )
    slipping = scene_rows(scene.replace(D=2.7, G=1e-11))
    assert (slipping["regime"], slipping["K_t [N/m]"]) == ("gross slip", "0")


def test_rows_agree_with_the_library():
    """The printed digits are those of the functions."""
    scene = fj.brake_scene()
    rows, modes = scene_rows(scene), fj.stability(scene)
    assert float(rows["growth rate [1/s]"]) == float(f"{modes.growth_rate:.6g}")
    assert float(rows["frequency [Hz]"]) == float(f"{modes.frequency:.6g}")
    constant = scene_rows(scene, friction_slope=False)
    assert float(constant["growth rate [1/s]"]) == float(f"{fj.growth_rate(scene, False):.6g}")


def test_fixed_contact_has_no_surface_rows():
    """Nothing is shown that the scene does not have."""
    scene = fj.brake_scene().replace(contact=fj.FixedContact(4e8, 2e8))
    text = stability_table(scene)
    assert "D " not in text and "regime" not in text and "K_n [N/m]" in text


def test_every_active_constraint_has_a_line():
    """Several active constraints stand below each other."""
    scene = fj.brake_scene()
    text = comparison_table(scene, scene, True, ("one", "two", "three"))
    assert [line.split()[-1] for line in text.splitlines()[-3:]] == ["one", "two", "three"]
    assert comparison_table(scene, scene, True, ()).splitlines()[-1].split()[-1] == "-"


def test_columns_are_aligned():
    """Titles stand above their columns."""
    text = table(["a", "b"], [{"row": "1", "longer row": "22"}, {"row": "3", "longer row": "4"}])
    assert text == "            a   b\nrow         1   3\nlonger row  22  4"
