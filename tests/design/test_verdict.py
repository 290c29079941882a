"""What a design rests on, designs under several contact laws, and what else makes it quiet."""

from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from tools import motionless_scene, reference_scene, refusals

BRAKE = fj.brake_scene()
# The design of the README.
DESIGNED = BRAKE.replace(D=2.43197, G=1.23407e-10)


def persson(P=1.0, area=1e-4, **others):
    contact = BRAKE.contact
    L = area**0.5
    return fj.PerssonContact(contact.surface, contact.material, P, area, L, L / 100, **others)


@pytest.fixture(scope="module")
def found():
    return fj.verdict(DESIGNED, area=1e-4, tolerance={"D": 0.01, "ln G": 0.1})


def growth(scene):
    return float(fj.growth_rate(scene))


@pytest.mark.slow
def test_every_question_and_what_it_rests_on(found):
    as_is, loaded, _, revised, law, ratio, scatter = found.questions
    assert float(as_is.answer) == pytest.approx(growth(DESIGNED), rel=1e-5) and as_is.quiet
    preloaded = fj.Scene(DESIGNED.contact, DESIGNED.friction, DESIGNED.oscillator, preload=True)
    assert float(loaded.answer) == pytest.approx(growth(preloaded), rel=1e-5)
    assert loaded.name == "friction on P + K_n x2" and not loaded.quiet
    surface = DESIGNED.contact.surface
    contact = fj.PerssonContact(surface, DESIGNED.contact.material, 1907.3, 1e-4, 1e-2, 1e-4)
    assert float(law.answer) == pytest.approx(growth(DESIGNED.replace(contact=contact)), rel=1e-5)
    assert law.name == "by PerssonContact" and not law.quiet
    contact = fj.AsperityContact(surface, DESIGNED.contact.material, 1907.3, 1e-4)
    expected = growth(DESIGNED.replace(contact=contact))
    assert float(revised.answer) == pytest.approx(expected, rel=1e-5)
    assert revised.name == "by AsperityContact" and not revised.quiet
    # The worst of the stiffness ratios between the scene's own and Mindlin's.
    K_n, K_t = fj.stiffness(DESIGNED)
    rates = [
        growth(DESIGNED.replace(contact=fj.FixedContact(K_n, share * K_n)))
        for share in np.linspace(float(K_t / K_n), 1.4 / 1.7, 65)[[0, 32, 64]]
    ]
    assert rates == sorted(rates)
    assert float(ratio.answer.split()[0]) == pytest.approx(rates[-1], rel=1e-5)
    probability = fj.squeal_probability(DESIGNED, {"D": 0.01, "ln G": 0.1})
    assert f"probability {probability.value:.3g}" in scatter.answer
    assert not found.quiet and not found.incurable
    assert found.rests_on[2:] == ("K_t/K_n = 0.355", "D and ln G without scatter")
    assert found.rests_on[:2] == ("friction on K_n x2", "FractalContact")
    lines = repr(found).splitlines()
    assert lines[0].split() == ["growth", "rate", "[1/s]"]
    assert lines[-2].startswith("Quiet, but it rests on: friction on K_n x2; FractalContact; K_t")
    assert lines[-1] == "Not asked: kicks (quiet_within), wear (run_in)."
    # It was given others: those of the brake before the design, 1 N, and a softer material.
    law = persson()
    law = fj.PerssonContact(
        law.surface, fj.Material(1e10, 0.1, 1e8, 1e9), 1.0, 1e-4, law.L, law.L_s
    )
    (*_, asked, _) = fj.verdict(DESIGNED, laws=[law]).questions
    assert asked == found.questions[4]


def test_quiet_in_all():
    quiet = motionless_scene()
    found = fj.verdict(quiet, laws=[fj.FixedContact(1e7, 5e6)])
    assert found.quiet and found.rests_on == ()
    assert repr(found).splitlines()[-2:] == [
        "Quiet in all that was asked.",
        "Not asked: scatter (tolerance), kicks (quiet_within).",
    ]
    assert fj.verdict(quiet).omitted[0] == "other contact laws (laws)"
    assert [question.name for question in found.questions] == [
        "as it is (FixedContact)",
        "tangential spring in series",
        "by FixedContact",
    ]
    K_n, _ = fj.stiffness(quiet)
    in_series = growth(quiet.replace(contact=fj.FixedContact(K_n, 0.0)))
    assert float(found.questions[1].answer) == pytest.approx(in_series, rel=1e-5)


@pytest.mark.slow
def test_a_slope_that_no_damping_meets_is_incurable():
    """The sum of the growth rates is minus the trace of the damping matrix, for any stiffness."""
    scene = fj.Scene(DESIGNED.contact, DESIGNED.friction, DESIGNED.oscillator, preload=True)
    found = fj.verdict(scene)
    assert found.incurable and "No surface cures this" in repr(found)
    assert "Not quiet." in repr(found) and not found.questions[0].quiet
    assert fj.verdict(scene, friction_slope=False).incurable is False
    for D, G in ((2.2, 1e-12), (2.6, 1e-9)):
        assert growth(scene.replace(D=D, G=G)) > 0
    assert found.questions[1].name == "friction on K_n x2" and found.questions[1].quiet


@pytest.mark.slow
def test_largest_kick_survived():
    scene = motionless_scene()
    law, scatter = [fj.FixedContact(1e7, 5e6)], {"mu": 1e-3}
    found = fj.verdict(scene, laws=law, tolerance=scatter, quiet_within=0.5, progress=False)
    assert found.omitted == () and repr(found).splitlines()[-1] == "Quiet in all."
    assert found.questions[-1][:4] == (
        "smaller kicks",
        "kicks within 0.5",
        "comes to rest from 0.5 of 0.5",
        True,
    )
    squealing = fj.verdict(reference_scene(), quiet_within=0.5, progress=False)
    assert squealing.questions[-1][:4] == (
        "smaller kicks",
        "kicks within 0.5",
        "comes to rest from 0 of 0.5",
        False,
    )


def test_given_stiffness_ratio_is_doubted_up_to_the_fractal_law():
    scene = BRAKE.replace(stiffness_ratio=0.2)
    (ratio,) = (q for q in fj.verdict(scene).questions if q.name.startswith("K_t/K_n"))
    assert ratio.name == "K_t/K_n from 0.2 to 0.824"
    scene = BRAKE.replace(stiffness_ratio=0.9)
    (ratio,) = (q for q in fj.verdict(scene).questions if q.name.startswith("K_t/K_n"))
    assert ratio.name == "K_t/K_n from 0.476 to 0.9"


@pytest.mark.slow
def test_design_meets_every_law_at_once(tmp_path):
    law = persson(stiffness_ratio=0.33)
    best = fj.design(BRAKE, laws=[law], progress=False)
    assert not best.violated
    contact = best.scene.contact
    other = fj.PerssonContact(
        contact.surface, contact.material, contact.P, 1e-4, 1e-2, 1e-4, stiffness_ratio=0.33
    )
    under = growth(best.scene.replace(contact=other))
    assert max(best.growth_rate, under) <= best.target * (1 - 1e-6)
    assert growth(fj.design(BRAKE, progress=False).scene) <= best.target * (1 - 1e-6)
    best.save(tmp_path / "run.toml")
    again = fj.repeat_design(tmp_path / "run.toml", progress=False)
    assert again.scene == best.scene and again.options["laws"] == best.options["laws"]


@pytest.mark.slow
def test_a_law_that_no_surface_meets_is_named():
    best = fj.design(BRAKE, laws=[persson()], progress=False)
    assert "growth_rate <= target by PerssonContact" in best.violated


test_refuses_what_is_no_list_of_laws = refusals(
    [
        (persson(), "laws must be a list of contacts, got Pers"),
        ([3.0], r"laws\[0\] must be a Contact, got 3.0"),
    ],
    lambda laws: fj.design(BRAKE, laws=laws, progress=False),
    kind=TypeError,
)


@pytest.mark.slow
def test_suggestions_are_the_nearest_that_reach_the_target():
    bounds = {"xi_1": (0.001, 0.5), "xi_2": (0.007, 0.5), "P": (19.0, 19000.0)}
    found = fj.suggest(BRAKE, bounds, target=-1.0)
    assert found.values["xi_2"] is None  # damping of one direction alone destabilises
    for name in ("xi_1", "P"):
        value: Any = found.values[name]
        assert growth(BRAKE.replace(**{name: value})) <= -1 + 1e-6
        own = float(getattr(BRAKE.oscillator, name, BRAKE.contact.P))
        nearer = value + 0.01 * (own - value)
        assert growth(BRAKE.replace(**{name: nearer})) > -1
    swept = fj.sweep(fj.growth_rate, BRAKE, progress=False, xi_2=np.linspace(0.007, 0.5, 200))
    assert (np.asarray(swept) > -1).all()
    lines = repr(found).splitlines()
    assert lines[0] == "Quiet by one change:"
    assert "0.007 -> nothing from 0.007 to 0.5" in lines[2]


@pytest.mark.slow
def test_default_suggestions():
    found = fj.suggest(BRAKE)
    assert set(found.values) == {"xi_1", "xi_2", "mu", "mu_m", "P", "V"}
    changed = {name for name, value in found.values.items() if value is not None}
    assert changed == {"xi_1", "mu", "P"}
    assert growth(BRAKE.replace(xi_1=found.values["xi_1"])) < 0


def test_refuses_what_is_no_scene():
    with pytest.raises(TypeError, match="x must be a Scene or a Structure, got 3"):
        fj.verdict(cast(Any, 3))
    with pytest.raises(TypeError, match="scene must be a Scene, got 3"):
        fj.suggest(cast(Any, 3))
    with pytest.raises(ValueError, match="area needs a contact with a surface, got a FixedContact"):
        fj.verdict(reference_scene(), area=1e-4)
    with pytest.raises(ValueError, match=r"area must be above 0, got -1\.0"):
        fj.verdict(BRAKE, area=-1.0)
    joint = fj.Joint(fj.FixedContact(1e6, 1e6, 10.0), fj.Coulomb(0.3), 0, 1)
    x = fj.Structure(jnp.eye(2), 0.1 * jnp.eye(2), jnp.eye(2) * 1e6, {"pad": joint})
    with pytest.raises(
        ValueError, match="laws of a structure need a joint whose contact has a surface"
    ):
        fj.design(x, {"K_t": (1e5, 1e7)}, laws=[persson()], progress=False)


@pytest.mark.slow
def test_verdict_of_a_structure_changes_all_its_joints():
    from structures import fractal_joints

    x: Any = fractal_joints()
    area = {"left": 1e-4, "right": 4e-4}
    found = fj.verdict(x, area=area, tolerance={"D": 0.01})
    names = [question.name for question in found.questions]
    assert names[:5] == [
        "as it is (FractalContact)",
        "friction on P + K_n n.x",
        "tangential spring in series",
        "by AsperityContact",
        "by PerssonContact",
    ]

    def with_joints(change):
        joints = {}
        for name, joint in zip(x.joint_names, x.joints, strict=True):
            contact, preload = change(name, joint)
            rest = joint.friction, joint.tangential, joint.normal, joint.V, preload
            joints[name] = fj.Joint(contact, *rest)
        return fj.Structure(x.M, x.C, x.K, joints, F=x.F)

    def persson_of(name, joint):
        L = area[name] ** 0.5
        given = joint.contact.surface, joint.contact.material, joint.contact.P
        return fj.PerssonContact(*given, area[name], L, L / 100), False

    def loaded(name, joint):
        return joint.contact, True

    for question, change in ((1, loaded), (4, persson_of)):
        wanted = growth(with_joints(change))
        assert float(found.questions[question].answer) == pytest.approx(wanted, rel=1e-5)
    share = np.linspace(0, 1, 17)[:, None]
    stiff = np.array([[float(k) for k in joint.stiffness()] for joint in x.joints])
    own, mindlin = stiff[:, 1] / stiff[:, 0], 2 * (1 - 0.3) / (2 - 0.3)
    low, high = np.minimum(own, mindlin), np.maximum(own, mindlin)

    def fixed(row):
        kinds = {"left": 0, "right": 1}
        return lambda name, joint: (
            fj.FixedContact(stiff[kinds[name], 0], row[kinds[name]] * stiff[kinds[name], 0], 1.0),
            False,
        )

    worst = max(growth(with_joints(fixed(row))) for row in low + share * (high - low))
    assert float(found.questions[5].answer.split()[0]) == pytest.approx(worst, rel=1e-5)
    with pytest.raises(ValueError, match="area must be of the joints left, right, got left"):
        fj.verdict(x, area={"left": 1e-4})
