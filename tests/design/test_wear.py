"""The growth rate while surfaces run in, against maps worn and pressed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.wear import Worn, check_depths, worn_growth
from tools import refusals

BRAKE = fj.brake_scene()
MATERIAL, AREA = BRAKE.contact.material, 1e-6
GROUND = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5)


def pressed(strain=1e-5, surface=GROUND):
    """The brake with this surface at the pressure `strain` E; it squeals if it is stiffer."""
    contact = fj.PerssonContact(surface, MATERIAL, strain * float(MATERIAL.E) * AREA, AREA)
    return fj.Scene(contact, BRAKE.friction, BRAKE.oscillator)


@pytest.fixture(scope="module")
def worn():
    return worn_growth(pressed(), (0, 0.3), None, True, seed=3, n=32, maps=1, points=3)


def test_growth_of_a_worn_map(worn):
    """The map of the first key, worn at once to the last depth in many steps."""
    scene = pressed()
    (key,) = jax.random.split(jax.random.key(3), 1)
    L = 8e-4
    z = fj.topography(GROUND, L, 32, key=key, periodic=True)
    pressure = scene.contact.P / AREA
    before = fj.boundary_element(z, L / 32, MATERIAL, pressure * L**2).K_n
    after = fj.run_in(z, L / 32, MATERIAL, pressure, 0.3 * z.std(), steps=64).K_n
    assert after > 2 * before
    K_n, K_t = (K * after / before for K in fj.stiffness(scene))
    expected = fj.growth_rate(scene.replace(contact=fj.FixedContact(K_n, K_t)))
    assert worn.rates[-1] == pytest.approx(float(expected), rel=0.03)
    assert worn.rates[0] == pytest.approx(float(fj.growth_rate(scene)), rel=1e-9)
    assert worn.depths[0] == 0 and worn.depths[-1] == 0.3 and (np.diff(worn.depths) > 0).all()


def test_onset(worn):
    """Where the growth rate, a chord between neighbours, crosses 0."""
    assert worn.rates[0] < 0 < worn.rates[-1]
    assert np.interp(worn.onset, worn.depths, worn.rates) == pytest.approx(0, abs=1e-6)
    assert worn._replace(rates=worn.rates - 1e9).onset is None
    assert worn._replace(rates=worn.rates + 1e9).onset is None


def test_load_curve_of_a_worn_map():
    """A preloaded joint keeps its load curve: unworn it is as it was, worn its law is as stiff."""
    o = fj.Oscillator(1.0, 50.0, 40.0, 0.01, 0.02, 0.5, 0.15)
    soft = fj.Scene(pressed().contact, BRAKE.friction, o, preload=True)
    found = worn_growth(soft, (0, 0.3), None, True, seed=3, n=32, maps=1, points=2)
    assert found.rates[0] == pytest.approx(float(fj.growth_rate(soft)), rel=1e-9)
    linear = fj.Scene(soft.contact, BRAKE.friction, o, preload="linear")
    assert abs(found.rates[0] / float(fj.growth_rate(linear)) - 1) > 1e-3

    law, approach = soft.contact, np.array([-2e-7, -1e-8, 0.0, 1e-7])
    twice = Worn(law, jnp.array(2.0))
    np.testing.assert_allclose(twice.load(approach), law.load(2 * approach), rtol=1e-12)


@pytest.mark.slow
def test_verdict():
    found = fj.verdict(pressed(), run_in=(0, 0.3))
    assert found.wear is not None and found.wear.depths[-1] == 0.3
    question = found.questions[-1]
    assert question.name == "worn by 0 to 0.3 Sq" and not question.quiet
    assert "squeals from" in question.answer and found.rests_on[-1] == "surfaces without wear"
    assert "wear (run_in)" not in found.omitted


@pytest.mark.slow
def test_gaussian_heights():
    """Boundary elements: 6.9 times as stiff after a tenth of Sq at p = 0.01 E Sdq, H = 0.8."""
    surface = fj.SelfAffine(1e-6, 0.8, 1e-4, 2.5e-5)
    scene = pressed(0.01 * float(fj.roughness(surface).Sdq), surface)
    worn = worn_growth(scene, (0, 0.1), None, True, seed=0, maps=3, points=4)

    def growth(factor):
        K_n, K_t = (K * factor for K in fj.stiffness(scene))
        return float(fj.growth_rate(scene.replace(contact=fj.FixedContact(K_n, K_t))))

    assert growth(6.9 * 0.8) < worn.rates[-1] < growth(6.9 * 1.25)


FIXED = BRAKE.replace(contact=fj.FixedContact(1e8, 1e8))
test_refusals = refusals(
    [
        (lambda: check_depths(0.3), "run_in must be .* depth in units of Sq, got 0.3"),
        (lambda: check_depths((0.3, 0.1)), "run_in must be two rising depths"),
        (lambda: check_depths((-1, 0.1)), "depth of run_in must be at least 0"),
        (lambda: fj.verdict(FIXED, run_in=(0, 0.1)), "run_in needs a joint whose contact has"),
        (lambda: fj.verdict(BRAKE, run_in=(0, 0.1)), "run_in needs the nominal area of the joint"),
    ]
)
