"""Designs held to what a drawing says of their surface."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.constraints import Ra, Rz, Sq
from fractaljax._design.drawing import quiet_factors
from tools import both_gradients, refusals

FILTERS: Any = dict(cutoff=8e-4, shortest=2.5e-6)
GROUND = fj.SelfAffine(1e-6, 0.8, 1e-4, 2e-6)
MEASURES = {
    Ra: lambda surface, **filters: fj.profile_parameters(surface, **filters).Ra,
    Rz: lambda surface, **filters: fj.profile_parameters(surface, **filters).Rz,
    Sq: lambda surface, **filters: fj.areal_parameters(surface, **filters).Sq,
}


def pressed(surface: fj.Spectrum = GROUND):
    """The brake with this surface under Persson's law."""
    brake = fj.brake_scene()
    law = fj.PerssonContact(surface, brake.contact.material, P=1907.3, area=1e-3)
    return fj.Scene(law, brake.friction, brake.oscillator)


@pytest.fixture(scope="module")
def scene():
    return pressed()


@pytest.mark.parametrize("kind", MEASURES)
def test_residuals(kind, scene):
    """ln(value/limit), with its slopes in both modes: 1 by ln Sq, and differences by ln rolloff."""
    limit = kind(at_most=5e-7, **FILTERS)
    value = float(MEASURES[kind](GROUND, **FILTERS))
    assert float(limit(scene)) == pytest.approx(math.log(value / 5e-7), rel=1e-12)
    assert float(kind(at_least=5e-7, **FILTERS)(scene)) == pytest.approx(-float(limit(scene)))
    assert limit.name == f"{kind.__name__} <= 5e-07 m"
    assert vars(kind(below=5e-7, **FILTERS)) == vars(limit)

    def residual(x):
        return limit(scene.replace(Sq=jnp.exp(x[0]), rolloff=jnp.exp(x[1])))

    x = jnp.log(jnp.array([1e-6, 1e-4]))
    step = jnp.array([0, 1e-5])
    difference = jax.jit(lambda x: (residual(x + step) - residual(x - step)) / 2e-5)(x)
    for slope in jax.jit(lambda x: both_gradients(residual, x))(x):
        np.testing.assert_allclose(slope, [1, difference], rtol=1e-7)


@pytest.mark.parametrize("kind", MEASURES)
def test_fractal_surfaces(kind):
    """L and L_s are 1 mm and 1 um unless stated."""
    brake = fj.brake_scene()
    for band in ({}, dict(L=2e-3, L_s=1e-5)):
        expected = MEASURES[kind](
            brake.contact.surface, **{"L": 1e-3, "L_s": 1e-6} | band, **FILTERS
        )
        assert kind(at_most=1.0, **FILTERS, **band).measure(brake) == expected


@pytest.fixture(scope="module")
def best(scene):
    """Ra to 0.4 um, from 0.74 um."""
    return fj.design(
        scene,
        {"Sq": (1e-7, 2e-6), "rolloff": (2e-5, 3e-4)},
        constraints=[Ra(at_most=4e-7, **FILTERS), Sq(at_most=1e-6)],
        target=1e6,
        starts=2,
        lattice=4,
        progress=False,
    )


def test_design_ends_at_the_limit(best):
    """The nearest surface that the drawing allows has all of its Ra."""
    assert best.result != fj.DesignResult.infeasible, best
    assert "Ra <= 4e-07 m" in best.active
    p = fj.profile_parameters(best.scene.contact.surface, **FILTERS)
    assert float(p.Ra) == pytest.approx(4e-7, rel=1e-5) and p.Ra <= 4e-7 * (1 + 1e-9)


def test_file(best, tmp_path):
    """The limits come back from a file, and the run with them."""
    best.save(tmp_path / "run.toml")
    again = fj.repeat_design(tmp_path / "run.toml", progress=False)
    assert repr(again) == repr(best)
    for one, other in zip(best.options["constraints"], again.options["constraints"], strict=True):
        assert type(one) is type(other) and vars(one) == vars(other)


def test_drawing(best):
    """Both surfaces behind the filters that are stated, also in print."""
    drawing = best.drawing()
    surfaces = best.initial.contact.surface, best.scene.contact.surface
    for i, surface in enumerate(surfaces):
        p, s = fj.profile_parameters(surface, **FILTERS), fj.areal_parameters(surface, **FILTERS)
        row = [drawing.Ra[i], drawing.Rz[i], drawing.Sq[i], drawing.Sdq[i]]
        assert row == [p.Ra, p.Rz, s.Sq, s.Sdq]
    assert repr(drawing) in repr(best)
    words = [line.split() for line in repr(drawing).splitlines()]
    assert ["Ra", "[m]", f"{drawing.Ra[0]:.6g}", "4e-07"] in words
    assert best.drawing(cutoff=2.5e-4).Ra[0] < drawing.Ra[0]
    fractal = dataclasses.replace(best, scene=fj.brake_scene(), initial=fj.brake_scene())
    surface = fj.brake_scene().contact.surface
    p = fj.profile_parameters(surface, L=1e-3, L_s=1e-6, **FILTERS)
    assert fractal.drawing().Rz == (p.Rz, p.Rz)
    fixed = fj.brake_scene().replace(contact=fj.FixedContact(1e8, 1e8))
    with pytest.raises(ValueError, match="a drawing needs a scene whose contact has a surface"):
        dataclasses.replace(best, scene=fixed).drawing()


test_refusals = refusals(
    [
        (lambda: Ra(**FILTERS), "Ra needs at_least or at_most"),
        (lambda: Ra(at_most=1e-6, below=1e-6, **FILTERS), "Ra takes below or at_most"),
        (lambda: Ra(at_most=1e-6, cutoff=1e-6, shortest=1e-3), "cutoff must be at least shortest"),
        (lambda: Sq(at_most=1e-6, L=1e-6, L_s=1e-3), "L must be at least L_s"),
        (
            lambda: Sq(at_most=1.0)(fj.brake_scene().replace(contact=fj.FixedContact(1e8, 1e8))),
            "Sq needs a scene whose contact has a surface",
        ),
    ]
)


QUIET = {
    "fractal": fj.brake_scene().replace(D=2.43197, G=1.23407e-10),
    "self-affine": pressed().replace(P=0.1, area=1e-6),
}
TABLE = fj.MeasuredSpectrum(np.geomspace(1e4, 1e6, 5), 1e-18 * np.geomspace(1, 1e-6, 5))
QUIET["table"] = pressed(TABLE).replace(P=0.1, area=1e-6)


@pytest.mark.parametrize("name", QUIET)
def test_heights_that_stay_quiet(name):
    """At the ends, in scenes put together again, the growth rate is 0; within, it is not."""
    scene = QUIET[name]
    factors = quiet_factors(scene, True)
    assert factors is not None and factors[0] < 1 < factors[1]
    surface = scene.contact.surface

    def growth(factor):
        if name == "table":
            other = fj.MeasuredSpectrum(surface.q, np.array(surface.C_table) * factor**2)
            return float(fj.growth_rate(pressed(other).replace(P=0.1, area=1e-6)))
        if name == "fractal":  # m is in proportion to G^(2 D - 4)
            return float(fj.growth_rate(scene.replace(G=surface.G * factor ** (1 / 0.43197))))
        return float(fj.growth_rate(scene.replace(Sq=factor * surface.Sq)))

    scale = max(abs(growth(0.5)), abs(growth(2.0)))
    for end in factors:
        if 0.1001 < end < 9.999:
            assert abs(growth(end)) < 0.02 * scale
    for inside in np.geomspace(*factors, 7)[1:-1]:
        assert growth(inside) < 0
    assert quiet_factors(pressed(), True) is None


# --- joints of a structure ------------------------------------------------------------------------


def two_joints() -> fj.Structure:
    """Two pads on one disc of two degrees of freedom; quiet where the left one is rough."""
    material = fj.brake_scene().contact.material
    surfaces = GROUND, fj.SelfAffine(3e-7, 0.7, 5e-5, 2e-6)
    joints = {
        name: fj.Joint(
            fj.PerssonContact(surface, material, P, area=1e-3), fj.Coulomb(0.1), 0, 1, V=1.0
        )
        for name, surface, P in zip(("left", "right"), surfaces, (900.0, 9.0), strict=True)
    }
    return fj.Structure(np.eye(2), np.diag([300.0, 200.0]), np.diag([2e9, 8e8]), joints)


def test_a_limit_on_one_joint_of_a_structure():
    """It is that of its surface; without a name it says which there are."""
    x = two_joints()
    for joint, part in x.joints_by_name().items():
        surface: Any = part.contact
        expected = fj.profile_parameters(surface.surface, **FILTERS).Ra
        limit = Ra(below=5e-7, joint=joint, **FILTERS)
        np.testing.assert_allclose(limit(x), np.log(expected / 5e-7), rtol=1e-12)
    with pytest.raises(ValueError, match=r"Ra needs joint=, .*: left, right; got None"):
        Ra(below=5e-7, **FILTERS)(x)
    with pytest.raises(ValueError, match=r"Ra needs joint=, .*: left, right; got 'top'"):
        Ra(below=5e-7, joint="top", **FILTERS)(x)


@pytest.mark.slow
def test_drawing_of_a_structure():
    """Ra before and after, and an interval at whose ends the growth rate changes its sign."""
    x = two_joints().replace(**{"left.Sq": 2e-7})
    limit = Ra(at_least=2e-7, joint="left", **FILTERS)
    assert fj.growth_rate(x) > 0 and limit(x) > 0
    best = fj.design(x, {"left.Sq": (1e-7, 5e-6)}, constraints=[limit], K_n_min=0, progress=False)
    assert 'drawing(joint="left") gives Ra, Rz' in repr(best) and "right" not in repr(best.bounds)
    drawing = best.drawing(joint="left")
    surfaces = (each.joints_by_name()["left"].contact.surface for each in (x, best.scene))
    expected = [float(fj.profile_parameters(surface, **FILTERS).Ra) for surface in surfaces]
    np.testing.assert_allclose(drawing.Ra, expected, rtol=1e-12)
    assert drawing.Ra[1] >= 2e-7 * (1 - 1e-6)
    Sq = float(best.scene["left.Sq"])

    def growth(factor):
        return float(fj.growth_rate(best.scene.replace(**{"left.Sq": Sq * factor})))

    assert drawing.quiet_Ra is not None
    low, high = (end / drawing.Ra[1] for end in drawing.quiet_Ra)
    for factor in np.linspace(low * 1.02, high * 0.98, 9):
        assert growth(factor) < 0
    assert low == pytest.approx(0.1) or growth(low * 0.97) > 0
    assert high == pytest.approx(10) or growth(high * 1.03) > 0
    with pytest.raises(ValueError, match="a drawing needs joint="):
        best.drawing()
