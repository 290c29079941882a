"""Scenes: replacing, refusing, saving and loading."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.base.parts import leaf, quantities


def scenes():
    """One scene of every kind there is."""
    brake = fj.brake_scene()
    return {
        "fractal, stribeck": brake,
        "given ratio": brake.replace(stiffness_ratio=0.5),
        "fixed, stribeck": brake.replace(contact=fj.FixedContact(4e8, 0.0)),
        "fractal, coulomb": brake.replace(friction=fj.Coulomb(0.3)),
        "fixed, coulomb": brake.replace(
            contact=fj.FixedContact(4e8, 2e8), friction=fj.Coulomb(1.2)
        ),
        "odd numbers": brake.replace(G=5e-324, P=1 / 3, F=-1.7976931348623157e308, V=0.1 + 0.2),
    }


ALL = pytest.mark.parametrize("kind", scenes())


def assert_same(first, second):
    """Equal structure and every number equal to the last bit."""
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for x, y in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert x == y and x.dtype == y.dtype


@ALL
def test_save_and_load_are_exact(kind, tmp_path):
    """A file gives back the scene to the last bit, and the same file again."""
    scene = scenes()[kind]
    scene.save(tmp_path / "scene.toml")
    loaded = fj.Scene.load(str(tmp_path / "scene.toml"))
    assert_same(loaded, scene)
    assert loaded.to_toml() == (tmp_path / "scene.toml").read_text()


@ALL
def test_pytree_round_trip(kind):
    """Flattening, jit and tree_map give the scene back."""
    scene = scenes()[kind]
    leaves, structure = jax.tree.flatten(scene)
    assert_same(jax.tree.unflatten(structure, leaves), scene)
    assert_same(jax.jit(lambda s: s)(scene), scene)
    assert_same(jax.tree.map(lambda x: x * 1, scene), scene)


@ALL
def test_replace_every_quantity_where_it_lives(kind):
    """Each named number can be changed, and nothing else changes."""
    scene = scenes()[kind]
    for name, path in quantities(scene).items():
        old = leaf(scene, path)
        if not isinstance(old, jax.Array) or name in ("G", "F"):
            continue
        new = scene.replace(**{name: 0.999999 * old})
        others = [p for p in quantities(scene).values() if p != path]
        assert leaf(new, path) == 0.999999 * old
        for other in others:
            if isinstance(leaf(scene, other), jax.Array):
                assert leaf(new, other) == leaf(scene, other)


def test_replace_whole_parts_and_several_at_once():
    """Parts have names as well; unknown names are refused with the known ones listed."""
    scene = fj.brake_scene()
    new = scene.replace(friction=fj.Coulomb(0.3), D=2.5, P=100)
    assert (float(new.friction.mu_s), float(new.contact.surface.D), float(new.contact.P)) == (
        0.3,
        2.5,
        100.0,
    )
    assert scene.replace() is scene
    for unknown in ("mu", "K_n", "d"):
        with pytest.raises(ValueError) as caught:
            scene.replace(**{unknown: 0.3})
        assert f"scene has no quantity {unknown!r}" in str(caught.value)
        assert all(name in str(caught.value) for name in ("D", "mu_s", "omega_1", "friction"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"D": 2.0}, "D must be above 2 and below 3, got 2.0"),
        ({"G": 0}, "G must be above 0, got 0.0"),
        ({"P": -3.0}, "P must be above 0, got -3.0"),
        ({"H": 1e8}, "H must be at least sigma_y = 355000000.0, got 100000000.0"),
        ({"mu_m": 0.95, "mu_s": 1.0}, "mu_m must be at most 0.9, got 0.95"),
        ({"mu_m": 0.5}, "mu_s must be at least mu_m = 0.5, got 0.4"),
        ({"friction": fj.Coulomb(0.95)}, "mu must be at most 0.9, got 0.95"),
        ({"V": math.nan}, "V must be above 0, got nan"),
        ({"F": math.inf}, "F must be finite, got inf"),
        ({"stiffness_ratio": -0.1}, "stiffness_ratio must be at least 0, got -0.1"),
    ],
)
def test_values_outside_the_domain(changes, message):
    """Replacing checks like constructing does."""
    with pytest.raises(ValueError) as caught:
        fj.brake_scene().replace(**changes)
    assert message in str(caught.value)


def test_parts_of_the_wrong_kind():
    """Each place takes its own kind of part."""
    scene = fj.brake_scene()
    for name in ("contact", "friction", "oscillator", "surface", "material"):
        with pytest.raises(TypeError, match=f"{name} must be a"):
            scene.replace(**{name: 1.0})
        with pytest.raises(TypeError, match=f"{name} must be a"):
            scene.replace(**{name: scene})


def test_large_friction_needs_a_joint_without_eq_19():
    """Above 0.9 only the fractal law has no answer."""
    scene = fj.brake_scene().replace(contact=fj.FixedContact(4e8, 2e8))
    assert fj.growth_rate(scene.replace(friction=fj.Coulomb(1.5))) > 0


def test_replace_under_transformations():
    """Inside jit, grad and vmap, and refused there when the value is out of its domain."""
    scene = fj.brake_scene()

    def growth(D, G):
        return fj.growth_rate(scene.replace(D=D, G=G))

    expected = float(growth(2.41, 1.3e-10))
    assert jax.jit(growth)(2.41, 1.3e-10) == pytest.approx(expected, rel=1e-12)
    swept = jax.vmap(growth)(jnp.array([2.41, 2.45]), jnp.array([1.3e-10, 1e-10]))
    assert swept[0] == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match=r"D must be above 2 and below 3, got 3\.5"):
        jax.grad(growth)(3.5, 1.3e-10)
    with pytest.raises((RuntimeError, ValueError), match="D must be above 2 and below 3"):
        eqx.filter_jit(growth)(jnp.array(3.5), jnp.array(1.3e-10)).block_until_ready()


def test_swept_scene_by_axes():
    """A scene that holds arrays is a batch for vmap, and refused without it."""
    scene = fj.brake_scene()
    batch = scene.replace(D=jnp.array([2.4, 2.45]), G=jnp.array([1.342e-10, 1e-10]))
    axes = jax.tree.map(lambda x: 0 if x.ndim else None, batch)
    expected = [
        fj.growth_rate(scene.replace(D=D, G=G)) for D, G in [(2.4, 1.342e-10), (2.45, 1e-10)]
    ]
    np.testing.assert_allclose(jax.vmap(fj.growth_rate, (axes,))(batch), expected, rtol=1e-12)
    for refuse in (fj.growth_rate, fj.stability, fj.stiffness, fj.Scene.to_toml):
        with pytest.raises(ValueError, match=r"D must be a scalar, got shape \(2,\); use jax.vmap"):
            refuse(batch)


def test_frozen_and_shown_with_its_numbers():
    """A scene cannot be changed in place, and prints what it holds."""
    scene = fj.brake_scene()
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.contact = fj.FixedContact(1.0, 1.0)
    assert "Surface(D=2.4, G=1.342e-10, gamma=1.5)" in repr(scene)
    assert "growth_rate=22.08011" in repr(fj.stability(scene))
    assert repr(jax.eval_shape(lambda s: s, scene))


def test_stiffness_by_structure():
    """Given stiffness is returned as it is, a given ratio multiplies K_n."""
    kinds = scenes()
    assert fj.stiffness(kinds["fixed, coulomb"]) == (4e8, 2e8)
    K_n, K_t = fj.stiffness(kinds["given ratio"])
    reference = fj.stiffness(kinds["fractal, stribeck"])
    assert K_t == 0.5 * K_n and K_n == pytest.approx(float(reference[0]), rel=1e-14)
    assert reference[0] == pytest.approx(402628934.268313, rel=1e-14)
    assert reference[1] == pytest.approx(191682502.096783, rel=1e-14)


def test_a_quantity_beside_the_part_that_holds_it():
    """It is changed in the new part; found: the new part took its place and it was forgotten."""
    scene, surface = fj.brake_scene(), fj.Surface(2.5, 1e-11)
    new = scene.replace(surface=surface, D=2.6)
    assert (new.contact.surface.D, new.contact.surface.G) == (2.6, 1e-11)
    contact = fj.FractalContact(surface, scene.contact.material, 5.0)
    new = scene.replace(contact=contact, P=7.0, G=1e-12)
    assert (new.contact.P, new.contact.surface.D, new.contact.surface.G) == (7.0, 2.5, 1e-12)
    new = scene.replace(contact=contact, surface=fj.Surface(2.7, 1e-9), D=2.8)
    assert (new.contact.P, new.contact.surface.D, new.contact.surface.G) == (5.0, 2.8, 1e-9)
    assert scene.replace(friction=fj.Coulomb(0.3), mu=0.4).friction.mu_s == 0.4
    for part, name in (({"friction": fj.Coulomb(0.3)}, "mu_s"), ({"contact": FIXED}, "P")):
        with pytest.raises(ValueError, match=f"^scene has no quantity '{name}'; it has"):
            scene.replace(**part, **{name: 0.5})


FIXED = fj.FixedContact(4e8, 2e8)
