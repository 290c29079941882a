"""Scenes: replacing, refusing, saving and loading."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._base.parts import leaf, quantities
from structures import SCENES
from tools import refusals

BRAKE, FIXED = fj.brake_scene(), fj.FixedContact(4e8, 2e8)
ALL = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


def assert_same(first, second):
    """Equal structure and every number equal to the last bit."""
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for x, y in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert x == y and x.dtype == y.dtype


@ALL
def test_round_trips_are_exact(scene, tmp_path):
    """Through a file, flattening and jit."""
    scene.save(tmp_path / "scene.toml")
    loaded = fj.Scene.load(str(tmp_path / "scene.toml"))
    assert_same(loaded, scene)
    assert loaded.to_toml() == (tmp_path / "scene.toml").read_text()
    leaves, structure = jax.tree.flatten(scene)
    assert_same(jax.tree.unflatten(structure, leaves), scene)
    assert_same(jax.jit(lambda s: s)(scene), scene)


@ALL
def test_each_quantity_is_replaced_where_it_lives(scene):
    """And nothing else changes."""
    numbers = {
        name: path
        for name, path in quantities(scene).items()
        if isinstance(leaf(scene, path), jax.Array) and name not in ("G", "F")
    }
    for name, path in numbers.items():
        new = scene.replace(**{name: 0.999999 * leaf(scene, path)})
        assert leaf(new, path) == 0.999999 * leaf(scene, path)
        assert all(leaf(new, p) == leaf(scene, p) for p in numbers.values() if p != path)


def test_quantities_beside_the_parts_that_hold_them():
    """They are changed in the new part."""
    surface = fj.Surface(2.5, 1e-11)
    contact = fj.FractalContact(surface, BRAKE.contact.material, 5.0)
    assert BRAKE.replace() is BRAKE
    new = BRAKE.replace(friction=fj.Coulomb(0.3), mu=0.4, D=2.5, P=100)
    assert (new.friction.mu_s, new.contact.surface.D, new.contact.P) == (0.4, 2.5, 100.0)
    new = BRAKE.replace(surface=surface, D=2.6)
    assert (new.contact.surface.D, new.contact.surface.G) == (2.6, 1e-11)
    new = BRAKE.replace(contact=contact, P=7.0, surface=fj.Surface(2.7, 1e-9), D=2.8)
    assert (new.contact.P, new.contact.surface.D, new.contact.surface.G) == (7.0, 2.8, 1e-9)
    assert BRAKE.replace(contact=FIXED).replace(friction=fj.Coulomb(1.5)).friction.mu_s == 1.5


test_replacing_checks_like_constructing = refusals(
    [
        ({"D": 2.0}, "D must be above 2 and below 3, got 2.0"),
        ({"H": 1e8}, "H must be at least sigma_y = 355000000.0, got 100000000.0"),
        ({"mu_m": 0.95, "mu_s": 1.0}, "mu_m must be at most 0.9, got 0.95"),
        ({"mu_m": 0.5}, "mu_s must be at least mu_m = 0.5, got 0.4"),
        ({"friction": fj.Coulomb(0.95)}, "mu must be at most 0.9, got 0.95"),
        ({"V": math.nan}, "V must be at least 0, got nan"),
        ({"nu_s": 0.3}, "scene has no quantity 'nu_s'; it has contact, surface, D, G"),
        ({"friction": fj.Coulomb(0.3), "mu_s": 0.5}, "scene has no quantity 'mu_s'; it has"),
        ({"contact": FIXED, "G": 0.5}, "scene has no quantity 'G'; it has"),
        *(({name: 1.0}, f"{name} must be a") for name in ("contact", "friction", "oscillator")),
        *(({name: BRAKE}, f"{name} must be a") for name in ("contact", "surface", "material")),
    ],
    lambda changes: BRAKE.replace(**changes),
    kind=(ValueError, TypeError),
    pattern="^{}",
    plain=True,
)


def test_replace_under_transformations_and_in_a_batch():
    """Inside jit, grad and vmap; outside the domain NaN, and refused where it is known."""

    def load(D, G):
        scene = BRAKE.replace(D=D, G=G)
        return scene.contact.surface.D * scene.contact.surface.G

    assert jax.jit(load)(2.41, 1.3) == 2.41 * 1.3
    np.testing.assert_array_equal(jax.vmap(load)(jnp.array([2.2, 2.5]), jnp.ones(2)), [2.2, 2.5])
    with pytest.raises(ValueError, match=r"D must be above 2 and below 3, got 3\.5"):
        jax.grad(load)(3.5, 1.3e-10)
    assert np.isnan(eqx.filter_jit(load)(jnp.array(3.5), jnp.array(1.3e-10)))
    np.testing.assert_array_equal(jax.vmap(load)(jnp.array([2.2, 3.5]), jnp.ones(2)), [2.2, np.nan])
    # A scene that holds arrays is a batch for vmap, and refused without it.
    batch = BRAKE.replace(D=jnp.array([2.4, 2.45]), G=jnp.array([1.342e-10, 1e-10]))
    axes = jax.tree.map(lambda x: 0 if x.ndim else None, batch)
    K_n, _ = jax.vmap(fj.stiffness, (axes,))(batch)
    one, _ = fj.stiffness(BRAKE.replace(D=2.45, G=1e-10))
    np.testing.assert_allclose(K_n[1], one, rtol=1e-12)
    for refuse in (fj.growth_rate, fj.stability, fj.stiffness, fj.Scene.to_toml):
        with pytest.raises(ValueError, match=r"D must be a scalar, got shape \(2,\); use jax.vmap"):
            refuse(batch)


def test_stiffness_and_scales_by_kind_of_contact():
    """Given stiffness is returned as it is, a given ratio multiplies K_n."""
    assert fj.stiffness(SCENES["fixed, coulomb"]) == (4e8, 2e8)
    K_n, K_t = fj.stiffness(SCENES["given ratio"])
    assert K_t == 0.5 * K_n and K_n == pytest.approx(402628934.268313, rel=1e-14)
    assert fj.stiffness(BRAKE)[0] == pytest.approx(402628934.268313, rel=1e-14)
    assert fj.stiffness(BRAKE)[1] == pytest.approx(191682502.096783, rel=1e-14)
    # What is designed and swept on a logarithmic axis.
    marked = {f.name for f in dataclasses.fields(fj.Oscillator) if f.metadata["log"]}
    assert marked == {"m", "omega_1", "omega_2", "V"}
