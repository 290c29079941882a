"""What every name of a scene means: its own numbers, derived ones, and two of them at once."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.quantities import (
    axis_values,
    label,
    quantity_names,
    replaced,
    require_independent,
    require_inside,
    require_quantity,
    substituted,
    unit,
    value_of,
    with_friction_times,
    with_optional,
)
from structures import two_joints
from tools import reference_scene, refusals

BRAKE = fj.brake_scene()
FIXED = BRAKE.replace(contact=fj.FixedContact(4e8, 2e8))
CONSTANT = fj.Scene(FIXED.contact, fj.Coulomb(0.4), BRAKE.oscillator)


def mu_of(mu_s, mu_m, v_m, V):
    """Eq. 38."""
    return mu_s - 1.5 * (mu_s - mu_m) * V / v_m + (mu_s - mu_m) / 2 * (V / v_m) ** 3


def test_quantities_with_names_units_and_values():
    own = BRAKE.stored_quantities()
    assert own["D"].value == 2.4 and own["V"].value == 0.15
    assert (own["omega_1"].unit, own["P"].meaning) == ("rad/s", "normal load")
    assert own["stiffness_ratio"].value is None
    stored = [name for name in own if own[name].value is not None]
    assert len(stored) == len(jax.tree.leaves(BRAKE))
    assert not {"contact", "surface", "friction"} & own.keys()
    # mu once, also where the scene stores it.
    names = ["K_n", "K_t", "P", "mu", "m", "omega_1", "omega_2", "xi_1", "xi_2", "F", "V"]
    assert quantity_names(CONSTANT) == [*names, "K_t/K_n", "omega_1/omega_2"]
    assert quantity_names(BRAKE)[-3:] == ["K_t/K_n", "omega_1/omega_2", "mu"]
    assert [unit(BRAKE, name) for name in ("G", "V", "mu", "K_t/K_n")] == ["m", "m/s", "-", "-"]
    assert label(BRAKE, "D") == "fractal dimension D [-]"
    assert label(CONSTANT, "mu") == "friction coefficient mu [-]"
    assert label(BRAKE, "mu") == "friction coefficient at the belt velocity µ [-]"
    assert label(BRAKE, "K_t/K_n") == "stiffness ratio K_t/K_n [-]"
    assert label(BRAKE, "omega_1/omega_2") == "ratio of natural frequencies ω₁/ω₂ [-]"


def test_two_names_of_one_quantity_and_unknown_ones_are_refused():
    for scene, names in (
        (CONSTANT, ("mu", "mu")),
        (CONSTANT, ("K_t", "K_t/K_n")),
        (BRAKE, ("K_t/K_n", "stiffness_ratio")),
        (BRAKE, ("D", "omega_1/omega_2", "P", "omega_1")),
        (BRAKE, ("mu_m", "mu")),
    ):
        with pytest.raises(ValueError, match=r"must be independent, got [\w/]+ and [\w/]+$"):
            require_independent(scene, names)
    require_independent(CONSTANT, ("K_n", "K_t/K_n"))
    require_independent(BRAKE, ("omega_2", "omega_1/omega_2"))
    require_independent(BRAKE, ("mu", "V", "v_m", "K_t/K_n", "D"))
    for name in ("nonsense", "contact"):
        with pytest.raises(ValueError, match=f"no quantity '{name}'; it has K_n, K_t, P, mu"):
            require_quantity(CONSTANT, name)


def test_a_structure_has_the_numbers_of_its_joints():
    structure = two_joints(4)
    own = structure.stored_quantities()
    assert own["right.K_n"].value == 5e6 and own["K_n"].value == 3e6 and own["K_n"].log
    assert quantity_names(structure)[0] == "K_n" and not {"M", "F", "mu"} & own.keys()
    assert unit(structure, "left.V") == "m/s"
    assert label(structure, "left.V") == "sliding velocity left.V [m/s]"
    moved = substituted(structure, {"V": 0.25, "right.K_n": 7e6})
    checked = replaced(structure, {"V": 0.25, "right.K_n": 7e6})
    assert [float(joint.V) for joint in moved.joints] == [0.25, 0.25]
    for name in ("left.V", "right.V", "left.K_n", "right.K_n", "V"):
        assert value_of(moved, name) == value_of(checked, name)
    assert value_of(moved, "right.K_n") == 7e6 and value_of(moved, "left.K_n") == 3e6
    with pytest.raises(ValueError, match=r"^K_n differs between the joints: name left.K_n and"):
        value_of(structure, "K_n")
    with pytest.raises(ValueError, match="structure has no quantity 'G'; it has K_n, K_t, "):
        require_quantity(structure, "G")
    with pytest.raises(ValueError, match=r"must be independent, got V and left\.V"):
        require_independent(structure, ("V", "left.V"))
    require_independent(structure, ("left.V", "right.V"))
    with pytest.raises(ValueError, match="V must be at least 0"):
        require_inside(structure, {"left.V": np.array([-0.1, 0.2])})


@pytest.mark.parametrize("name", ["K_t/K_n", "omega_1/omega_2", "mu", "D"])
def test_what_is_set_is_what_is_read(name):
    """Also of derived quantities, and of an optional one that is not given, by the law."""
    scene = replaced(BRAKE, {name: 1.01 * value_of(BRAKE, name)})
    assert value_of(scene, name) == pytest.approx(1.01 * float(value_of(BRAKE, name)), rel=1e-14)
    with pytest.raises(ValueError, match="stiffness_ratio is not given"):
        value_of(BRAKE, "stiffness_ratio")


def test_values_of_an_axis():
    """Lists as NumPy reads them, integers as numbers, and what is traced."""
    np.testing.assert_array_equal(axis_values(BRAKE, "P", [1000, 2000]), [1000.0, 2000.0])
    assert axis_values(BRAKE, "P", [1000, 2000]).dtype == jnp.float64
    assert axis_values(BRAKE, "K_t/K_n", np.array([0.1], np.float32)).dtype == jnp.float32
    found = jax.jit(lambda values: axis_values(BRAKE, "D", values))(np.array([2.3, 2.4]))
    np.testing.assert_array_equal(found, [2.3, 2.4])


test_values_that_are_no_axis_are_refused = refusals(
    [
        ("mass", [1.0], "scene has no quantity 'mass'"),
        ("D", 2.4, r"the values of D must be a list, got shape \(\)"),
        ("D", [], r"the values of D must be a list, got shape \(0,\)"),
        ("D", [[2.3, 2.4]], r"the values of D must be a list, got shape \(1, 2\)"),
        ("D", [2.3, np.nan], "D must be finite, got nan"),
    ],
    lambda name, values: axis_values(BRAKE, name, values),
)


@pytest.mark.parametrize("place", [replaced, substituted])
def test_derived_quantities_at_what_is_set_beside_them(place):
    """Whatever the order."""
    scene = place(CONSTANT, {"K_t/K_n": 0.5, "K_n": 1e8, "omega_1/omega_2": 2.0, "omega_2": 3e3})
    assert (scene.contact.K_n, scene.contact.K_t) == (1e8, 5e7)
    assert (scene.oscillator.omega_1, scene.oscillator.omega_2) == (6e3, 3e3)
    assert place(CONSTANT, {"mu": 0.2}).friction.mu_s == 0.2
    moved = place(BRAKE, {"mu": 0.3, "V": 0.25, "v_m": 0.4, "D": 2.5})
    mu_s, mu_m = moved.friction.mu_s, moved.friction.mu_m
    assert mu_s / mu_m == pytest.approx(0.4 / 0.25, rel=1e-14)
    assert mu_of(mu_s, mu_m, 0.4, 0.25) == pytest.approx(0.3, rel=1e-14)
    assert moved.contact.surface.D == 2.5


def test_ratios_scaled_laws_and_arrays_are_set():
    assert replaced(BRAKE, {"K_t/K_n": 0.3}).contact.stiffness_ratio == 0.3
    K_n, K_t = fj.stiffness(replaced(BRAKE, {"K_t/K_n": 0.3}))
    assert K_t == pytest.approx(0.3 * float(K_n), rel=1e-14)
    ready = with_optional(BRAKE, ["K_t/K_n"])
    assert substituted(ready, {"K_t/K_n": 0.3}).contact.stiffness_ratio == 0.3
    assert with_optional(ready, ["stiffness_ratio"]) is ready
    assert with_optional(BRAKE, ["D", "mu"]) is BRAKE
    scene = with_friction_times(FIXED, 0.5)
    assert float(scene.friction.mu_s) == 0.2
    assert float(scene.friction.mu_m) == 0.125
    assert float(scene.coefficient()) == pytest.approx(float(FIXED.coefficient()) / 2)
    assert FIXED.coefficient() == pytest.approx(mu_of(0.4, 0.25, 0.5, 0.15), rel=1e-15)
    assert CONSTANT.coefficient() == 0.4
    # As a grid gives them, and as `vmap` and `jit` see them.
    mu, V = np.array([[0.2, 0.3]] * 3), np.array([[0.1] * 2, [0.2] * 2, [0.3] * 2])
    grid = replaced(BRAKE, {"mu": mu, "V": V}).friction
    each = jax.jit(jax.vmap(jax.vmap(lambda mu, V: substituted(BRAKE, {"mu": mu, "V": V}))))
    np.testing.assert_allclose(grid.mu_s, each(mu, V).friction.mu_s, rtol=1e-15)
    np.testing.assert_allclose(mu_of(grid.mu_s, grid.mu_m, 0.5, V), mu, rtol=1e-14)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives(mode):
    """d mu_s/dmu and d mu_s/dV of the scaled law in closed form."""

    def mu_s(mu, V):
        return replaced(BRAKE, {"mu": mu, "V": V}).friction.mu_s

    by_mu, by_V = jax.jit(mode(mu_s, argnums=(0, 1)))(0.3, 0.2)
    at, slope = mu_of(0.4, 0.25, 0.5, 0.2), 0.15 * 1.5 / 0.5 * ((0.2 / 0.5) ** 2 - 1)
    assert by_mu == pytest.approx(0.4 / at, rel=1e-14)
    assert by_V == pytest.approx(-0.3 * 0.4 / at**2 * slope, rel=1e-13)


test_values_outside_their_domain_are_refused = refusals(
    [
        (BRAKE, {"K_t/K_n": -0.1}, "K_t/K_n must be at least 0, got -0.1"),
        (BRAKE, {"omega_1/omega_2": 0.0}, "omega_1/omega_2 must be above 0, got 0.0"),
        (CONSTANT, {"mu": 0.0}, "mu must be above 0, got 0.0"),
        (BRAKE, {"mu": np.array([0.2, 2.0])}, "mu_m must be at most 0.9, got"),
        (BRAKE, {"mu_s": 0.2}, "mu_s must be at least mu_m = 0.25, got 0.2"),
        (CONSTANT, {"K_t/K_n": np.nan}, "K_t/K_n must be at least 0, got nan"),
    ],
    replaced,
)


def test_values_outside_their_domain_are_nan_when_compiled():
    place = jax.jit(lambda ratio: replaced(CONSTANT, {"omega_1/omega_2": ratio}))
    assert place(2.0).oscillator.omega_1 == 2 * CONSTANT.oscillator.omega_2
    assert np.isnan(place(-1.0).oscillator.omega_1)
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), reference_scene())
    moved = substituted(scene, {"mu": jnp.float32(0.3), "K_t/K_n": jnp.float32(0.4)})
    assert {leaf.dtype for leaf in jax.tree.leaves(moved)} == {jnp.dtype(jnp.float32)}


def inside(check):
    try:
        check()
    except ValueError:
        return False
    return True


@pytest.mark.slow
def test_a_grid_is_inside_where_every_point_is():
    """Random axes against the whole grid at once; of some the corners alone are inside."""
    random = np.random.default_rng(3)
    ranges = {"mu": (0.1, 1.6), "V": (0.01, 1.5), "v_m": (0.01, 1.5), "D": (2.01, 2.99)}
    found = []
    for _ in range(60):
        names = random.permutation(list(ranges))[:3].tolist()
        axes = {name: random.uniform(*ranges[name], 3) for name in names}
        grid = [x.ravel() for x in np.meshgrid(*axes.values())]
        ends = [np.array([x.min(), x.max()]) for x in axes.values()]
        corners = [x.ravel() for x in np.meshgrid(*ends)]
        whole, ends, asked = (
            inside(lambda: check(BRAKE, values))  # noqa: B023
            for check, values in [
                (replaced, dict(zip(names, grid, strict=True))),
                (replaced, dict(zip(names, corners, strict=True))),
                (partial(require_inside, batch=7), axes),
            ]
        )
        assert asked == whole
        found.append((whole, ends))
    assert {(True, True), (False, False), (False, True)} <= set(found)
