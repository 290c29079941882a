"""Stability under preload: M x'' + C x' + K x = F + sum_j [(P - N) n + mu(w) N t], N = P + K_n n.x.

The oracle of preloaded.py has the state matrix in 40 digits from the forces of the joints.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._stability.summary import stability_table
from preloaded import BRAKE, LEVER, PROBLEMS, PULL, measured, problem
from tools import both_gradients, mostly_slow

slow = pytest.mark.slow


def most_slow(*quick):
    """All problems, of which only these are in the default run."""
    return pytest.mark.parametrize("name", mostly_slow(PROBLEMS, *quick))


@functools.partial(jax.jit, static_argnames="slope")
def answers(x, slope=True):
    """Stability, growth rate and margin: one program."""
    return fj.stability(x, slope), fj.growth_rate(x, slope), fj.margin(x, friction_slope=slope)


# What is constant friction for one law is so for all: a scene and two structures have it.
CONSTANT = [
    ("scene", False),
    *(pytest.param(name, False, marks=slow) for name in ("lever arms", "three kinds")),
]


EACH = [pytest.param(x, True, marks=() if x in ("scene", "lever arms") else slow) for x in PROBLEMS]
SCENES = [x for x in PROBLEMS if x.startswith("scene")]


@pytest.mark.parametrize(("name", "slope"), [*EACH, *CONSTANT])
def test_eigenvalues_and_normal_forces(name, slope):
    """All eigenvalues, what follows from them, and the force on each joint at the equilibrium."""
    x, oracle = problem(name)
    wanted = sorted(oracle.eigenvalues(slope), key=lambda s: -s.real)
    room = (1e-10 if "load curve" in name else 1e-12) * float(max(map(abs, wanted)))
    found, growth_rate, margin = answers(x, slope)
    apart = np.abs(np.array(found.eigenvalues)[:, None] - np.array(wanted, complex)[None])
    assert apart.min(axis=0).max() < room and apart.min(axis=1).max() < room
    growth = float(wanted[0].real)
    assert float(growth_rate) == pytest.approx(growth, abs=room)
    assert (float(margin) > 0) == (growth < 0)
    if isinstance(x, fj.Structure):
        least = float(min(-s.real / abs(s) for s in wanted))
        assert float(found.margin) == pytest.approx(least, abs=1e-12)
    forces: Any = found.normal_force
    rtol = 1e-10 if "load curve" in name else 1e-11
    np.testing.assert_allclose(forces, oracle.normal_forces(), rtol=rtol)


@jax.jit
def slopes(x, at):
    """Of the growth rate with these quantities, in both modes: one program for a kind of joints."""
    return both_gradients(lambda values: fj.growth_rate(x.replace(**values)), at)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_gradients(name):
    """By every quantity of every joint, in both modes, against differences in 40 digits."""
    x, oracle = problem(name)
    places = {
        quantity: quantity.split(".")[1] if isinstance(x, fj.Scene) else f"j{quantity}"
        for quantity, value in oracle.numbers.items()
        if value and not (quantity.endswith("V") and name == "scene, coulomb")
    }
    at = {place: jnp.asarray(oracle.numbers[quantity]) for quantity, place in places.items()}
    wanted = {place: oracle.slope_of(quantity) for quantity, place in places.items()}
    scale = max(abs(wanted[place] * float(at[place])) for place in at)
    assert scale > 0
    for found in slopes(x, at):
        for place, slope in wanted.items():
            rounding = 1e-10 * scale / float(at[place])
            assert float(found[place]) == pytest.approx(slope, rel=1e-8, abs=rounding), place


@pytest.mark.parametrize("name", ["scene", pytest.param("three kinds", marks=slow)])
def test_vmapped_is_looped(name):
    x, _ = problem(name)
    loads = np.array([100.0, 700.0, 3000.0])
    many = jax.vmap(lambda P: fj.growth_rate(x.replace(P=P)))(loads)
    one = [answers(x.replace(P=P))[1] for P in loads]
    np.testing.assert_allclose(many, one, rtol=1e-10)
    assert len(set(np.round(np.asarray(many), 6))) == 3  # the load counts


@pytest.mark.parametrize("name", mostly_slow(SCENES, "scene"))
def test_a_scene_is_its_structure(name):
    scene, _ = problem(name)
    same = fj.Structure.from_scene(scene)
    assert same.joints[0].preload and same.joints[0].normal_load == scene.contact.P
    found, wanted = fj.stability(same), answers(scene)[0]
    size = float(np.abs(wanted.eigenvalues).max())
    np.testing.assert_allclose(found.eigenvalues, wanted.eigenvalues, rtol=0, atol=1e-12 * size)
    curved = "load curve" in name
    rtol = 1e-11 if curved else 1e-12
    np.testing.assert_allclose(found.normal_force, wanted.normal_force, rtol=rtol)
    if curved:
        return
    o, (K_n, K_t) = scene.oscillator, fj.stiffness(scene)
    x_1, x_2 = fj.equilibrium(o, K_n, K_t, scene.friction.mu(o.V), scene.contact.P)
    force = float(scene.contact.P + K_n * x_2)
    assert force == pytest.approx(float(wanted.normal_force[0]), rel=1e-11) and float(x_1) > 0


def test_the_reference_brake():
    """The load turns the slope of friction from stabilising to destabilising."""
    brake = BRAKE.replace(preload=True)
    constant = fj.Structure.from_scene(brake).replace(**{"joint_1.normal": None})
    damping = [fj.assemble(constant, slope)[1][0, 0] for slope in (True, False)]
    assert float(damping[0] - damping[1]) == pytest.approx(-781.04, abs=0.01)  # mu' P, N = P
    assert float(fj.growth_rate(BRAKE)) == pytest.approx(22.080110, abs=1e-6)
    assert float(fj.growth_rate(brake)) > 600
    designed = brake.replace(D=2.4319698833358783, G=1.2340705508799051e-10)
    assert float(fj.growth_rate(designed)) == pytest.approx(416, abs=1)


@pytest.mark.parametrize("how", ["springs", "lever", "matrix"])
def test_hoffmanns_minimal_model(how):
    """K = [[2, 1 - 4/3 mu], [1, 2]], M = I: flutter from mu = 3/4 exactly."""

    def growth(mu):
        friction, P = fj.Coulomb(mu), 1.0
        if how == "matrix":
            K, joints = [[2, 1 - 4 / 3 * mu], [1, 2]], {}
        elif how == "springs":
            K = [[2, 1], [1, 2 - 4 / 3]]
            joints = fj.Joint(fj.FixedContact(4 / 3, 0.0, P), friction, 0, 1, preload=True)
        else:  # the same joint with arms of 2 and of 1/2: t n^T is as it was, n n^T is not
            K = [[2, 1], [1, 2 - 1 / 3]]
            joints = fj.Joint(
                fj.FixedContact(4 / 3, 0.0, P), friction, {0: 2.0}, np.array([0, 0.5]), None, True
            )
        return fj.stability(fj.Structure(np.eye(2), None, K, joints))

    below, above = growth(0.75 - 1e-9), growth(0.75 + 1e-9)
    assert not below.unstable()
    # sqrt(-1 (1 - 4/3 mu))/(2 sqrt(2)) beyond coalescence
    wanted = np.sqrt(4e-9 / 3) / np.sqrt(8)
    assert float(above.growth_rate) == pytest.approx(wanted, rel=1e-6)


ONSETS = {
    "closed form": BRAKE.replace(
        contact=fj.FixedContact(4e8, 2e8, 500.0), friction=fj.Coulomb(0.3), preload=True
    ),
    "slope": BRAKE.replace(contact=fj.FixedContact(4e8, 2e8, 20.0), V=0.4, preload=True),
    "fractal": BRAKE.replace(preload=True, xi_1=0.05, xi_2=0.05),
}


@pytest.mark.parametrize("name", [pytest.param("fractal", marks=slow), "closed form", "slope"])
def test_critical_friction(name):
    """No growth below it, growth beyond."""
    scene = ONSETS[name]
    critical = float(fj.critical_friction(scene))
    here = float(scene.friction.mu(scene.oscillator.V))
    law = scene.friction
    growths = [
        float(fj.growth_rate(scene.replace(friction=law.times(critical / here * x))))
        for x in (0.5, 1 - 1e-9, 1 + 1e-9)
    ]
    assert growths[0] < 0 and growths[1] < 0 < growths[2]
    stated = float(fj.critical_friction(scene.replace(preload=False)))
    assert (stated == pytest.approx(critical, rel=1e-12)) == (name == "closed form")


@slow
def test_boundary_and_onset_on_a_load_curve():
    """Every point of it has a growth rate of 0; a scene without the load has another."""
    scene = ONSETS["slope"]
    window = ("P", 8.0, 60.0), ("mu", 0.05, 0.4)
    found = fj.hopf_boundary(scene, *window, lines=9)
    assert found.branches
    for branch in found.branches:
        for P, mu in zip(branch.x[::5], branch.y[::5], strict=True):
            law = scene.friction.times(mu / float(scene.friction.mu(0.4)))
            growth = fj.growth_rate(scene.replace(P=P, friction=law))
            assert abs(float(growth)) < 1e-6
        assert np.ptp(branch.y) > 0.01  # it depends on the load
    # Where friction, scaled, makes the growth rate 0; and the boundary passes through it.
    x = fj.Scene(measured(4e8, 1907.3), fj.Coulomb(0.3), BRAKE.oscillator, True).replace(F=1500.0)
    critical = float(fj.critical_friction(x))
    assert abs(float(fj.growth_rate(x.replace(mu=critical)))) < 1e-6
    linear = fj.Scene(x.contact, x.friction, x.oscillator, "linear")
    assert abs(float(fj.growth_rate(linear.replace(mu=critical)))) > 1e-3
    boundary = fj.hopf_boundary(x.replace(mu=critical), ("P", 1800.0, 3000.0), ("mu", 0.01, 0.89))
    points = np.concatenate([np.stack([b.x, b.y]) for b in boundary.branches], axis=1)
    near = np.abs(points[0] - 1907.3).argmin()
    rate = float(fj.growth_rate(x.replace(P=points[0, near], mu=points[1, near])))
    assert abs(rate) < 1e-3


def lifted():
    """F pulls the joint open: P - K_n x of nearly F/sqrt(2) on a stiff contact."""
    scene, _ = problem("scene")
    structure, _ = problem("lever arms")
    return scene.replace(F=5000.0), structure.replace(P=1.0, F=-np.abs(PULL) * LEVER)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_an_open_joint_has_no_number(which):
    """NaN everywhere, and the force that says why; the tables say it in a line."""
    x = lifted()[which]
    for slope in (True, False):
        found, growth_rate, margin = answers(x, slope)
        assert found.normal_force[0] < 0
        assert np.isnan(found.eigenvalues).all()
        assert np.isnan(growth_rate) and np.isnan(margin)
    with pytest.raises(
        ValueError, match=r"open at (its|the) equilibrium: (the|its) normal force is -\d"
    ):
        stability_table(x)
    closed = x.replace(P=1e5)
    assert np.isfinite(answers(closed)[1]) and "normal force [N]" in stability_table(closed)


@pytest.mark.slow
def test_where_a_joint_opens():
    """The load at which it is 0 is found from the forces; the numbers end there."""
    scene = lifted()[0]

    def at(P):
        found, growth_rate, _ = answers(scene.replace(P=P))
        return float(found.normal_force[0]), growth_rate

    low, high = at(1e3)[0], at(1e4)[0]  # it is linear in the load
    assert low < 0 < high
    P = 1e3 - low * 9e3 / (high - low)
    (below, without), (above, growth_rate) = at(P * (1 - 1e-9)), at(P * (1 + 1e-9))
    assert below < 0 < above
    assert np.isnan(without) and np.isfinite(growth_rate)
    # Below the critical friction of a nearly open joint it is open: no number.
    scene = ONSETS["closed form"].replace(F=700.0)
    assert float(answers(scene.replace(mu=0.01))[0].normal_force[0]) > 0
    assert np.isnan(fj.critical_friction(scene))
    assert np.isfinite(fj.critical_friction(scene.replace(P=5000.0)))
    with pytest.raises(ValueError, match=r"cannot be computed at .*the joint may be open there"):
        fj.hopf_boundary(scene, ("P", 100.0, 900.0), ("mu", 0.1, 0.5), lines=5)
    # Pulled off the belt there is no steady sliding.
    x = problem("scene, load curve")[0].replace(F=1e5)
    for each in (x, fj.Structure.from_scene(x)):
        found, growth_rate, _ = answers(each)
        assert np.isnan(growth_rate) and found.normal_force[0] == 0


def test_a_free_body_has_no_pressed_equilibrium():
    """Friction would carry it away."""
    contact = fj.FixedContact(4e6, 0.0, 100.0)
    free = fj.Structure(
        np.eye(2), None, np.diag([0.0, 1e6]), fj.Joint(contact, fj.Coulomb(0.3), 0, 1, preload=True)
    )
    with pytest.raises(ValueError, match="no static equilibrium"):
        fj.growth_rate(free)
    with pytest.raises(ValueError, match="friction of the preloaded joints have no static"):
        stability_table(free)


@pytest.mark.slow
def test_float32_and_no_normal_force_without_preload():
    for name in ("scene", "three kinds"):
        x, _ = problem(name)
        small = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), x)
        found = fj.growth_rate(small)
        assert found.dtype == jnp.float32
        assert float(found) == pytest.approx(float(answers(x)[1]), rel=2e-2)
    # Neither of a scene nor of a structure in the source's form.
    for x in (BRAKE, fj.Structure.from_scene(BRAKE)):
        assert jax.eval_shape(fj.stability, x).normal_force is None
