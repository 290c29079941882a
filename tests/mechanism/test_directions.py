"""Directions of joints by degree of freedom, pair, weights and vector; preload in files."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from structures import matrices
from tools import refusals

M, C, K = matrices(3)
PRESSED, PLAIN = fj.FixedContact(3e6, 1e6, 50.0), fj.FixedContact(3e6, 1e6)
LAW = fj.ExponentialStribeck(0.4, 0.2, 0.1)
XYZ = ("x", "y", "z")


def structure(tangential, normal=None, names: Any = XYZ, contact=PRESSED, preload: Any = True):
    joint = fj.Joint(contact, LAW, tangential, normal, 0.2, preload)
    return fj.Structure(M, C, K, {"pad": joint}, names=names)


DIRECTIONS = {  # each with its row
    "index": (1, [0, 1, 0]),
    "name": ("z", [0, 0, 1]),
    "numpy index": (np.int64(2), [0, 0, 1]),
    "pair": ((0, 2), [1, 0, -1]),
    "pair of names": (["y", "x"], [-1, 1, 0]),
    "weights": ({"x": 0.5, 2: -1.5}, [0.5, 0, -1.5]),
    "one weight": ({"y": 2}, [0, 2, 0]),
    "floats": ((0.1, 0.0, -2.5), [0.1, 0, -2.5]),
    "mixed numbers": ([1, 0.0, 2], [1, 0, 2]),
    "array": (np.array([1, 2, 0]), [1, 2, 0]),
    "jax array": (jnp.array([0.3, 0.0, 4.0]), [0.3, 0, 4]),
}


@pytest.mark.parametrize("name", DIRECTIONS)
def test_rows_and_files(name, tmp_path):
    """As a normal and as a tangential direction, in matrices, hashed, replaced, and in a file."""
    given, row = DIRECTIONS[name]
    other = [np.array([1.0, 1.0, 1.0]), {"x": 1.0, "y": 3.0}]
    for t, n in ((given, other[0]), (other[1], given), (given, None)):
        x = structure(t, n)
        np.testing.assert_array_equal(x.direction(given), row)
        np.testing.assert_array_equal(x.direction(x.joints[0].tangential), x.direction(t))
        hash(jax.tree.structure(x))
        assert x.replace(P=70.0).joints[0].tangential == x.joints[0].tangential
        x.save(tmp_path / "x.toml")
        found = fj.Structure.load(tmp_path / "x.toml")
        assert jax.tree.structure(found) == jax.tree.structure(x)
        assert all(map(np.array_equal, jax.tree.leaves(found), jax.tree.leaves(x)))
        assert found.joints[0].normal_load == 50.0 and found.joints[0].preload
    if name not in ("index", "pair", "weights", "array"):  # of each form once: a program each
        return
    t, n = np.array(row, float), other[0]
    found = fj.assemble(structure(given, n), friction_slope=False)[2]
    mu = float(LAW.mu(0.2))
    wanted = K + 1e6 * np.outer(t, t) + 3e6 * np.outer(n, n)
    wanted += -mu * 3e6 * np.outer(t, n) + mu * 1e6 * np.outer(n, t)
    np.testing.assert_allclose(found, wanted, rtol=1e-14)


def test_an_index_that_is_anothers_name(tmp_path):
    """In a file a name wins: the index is written as the name of its degree of freedom."""
    x = structure({0: 1.0, 2: -2.0}, names=("2", "a", "0"))
    x.save(tmp_path / "x.toml")
    found = fj.Structure.load(tmp_path / "x.toml")
    for one in (x, found):
        np.testing.assert_array_equal(one.direction(one.joints[0].tangential), [1, 0, -2])


def test_preload_of_scenes_and_orthogonal_directions():
    scene = fj.brake_scene()
    assert not scene.preload and scene.normal_load is None
    pressed: Any = scene.replace(preload=True, P=1500.0)
    assert pressed.preload and float(pressed.normal_load) == 1500.0
    again = fj.Scene.from_toml(pressed.to_toml())
    assert again.preload and jax.tree.structure(again) == jax.tree.structure(pressed)
    older = scene.to_toml().replace("preload = false", "# preload")
    assert not fj.Scene.from_toml(older).preload  # files of before have none
    fixed = scene.replace(contact=PLAIN)
    assert fixed.contact.P is None and "# P =  # N: normal load" in fixed.to_toml()
    held: Any = fixed.replace(P=20.0, preload=True)
    assert fj.Scene.from_toml(held.to_toml()).normal_load == 20.0
    x = structure("x", "y").replace(**{"pad.P": 30.0, "pad.preload": False})
    assert x.joints[0].normal_load is None and float(x.joints[0].contact.P) == 30.0
    x = structure((0, 1), {0: 1.0, 1: 1.0})
    assert x.joints[0].normal == ((0, 1.0), (1, 1.0))


def in_trace(weight):
    return fj.Joint(PRESSED, LAW, jnp.array([weight, 0.0, 1.0]), "y", 0.2).stiffness()[0]


TURNED = np.array([0.1, 0.2, 0.3])
NEEDS = "needs a contact with a normal load P, got FixedContact"


test_refusals = refusals(
    [
        (lambda: structure("x", contact=PLAIN), f"^preload {NEEDS}"),
        (lambda: structure("x", contact=PLAIN, preload=False), f"^a joint without normal {NEEDS}"),
        (lambda: fj.brake_scene().replace(contact=PLAIN, preload=True), f"^preload {NEEDS}"),
        (
            lambda: structure("x", "y", preload=None),
            '^preload must be True, False or "linear", got',
        ),
        (lambda: fj.FixedContact(1.0, 1.0, 0.0), "^P must be above 0, got 0.0$"),
        (lambda: structure(np.zeros(3)), "^tangential must not be zero"),
        (lambda: structure("x", {"y": 0.0}), "^normal must not be zero"),
        (lambda: structure((1.0, 2.0)), "^joint pad: a direction must have 3 weights, got 2$"),
        (lambda: structure([1, 0, 1]), "^tangential must be a degree of freedom or a pair"),
        *(
            (lambda n=n: structure("x", n), "^normal must be a degree of freedom or a pair")
            for n in ([], {}, np.eye(3), {"y": "1"}, {True: 1.0}, (1.0, None, 2.0))
        ),
        (lambda: structure("x", {"y": np.nan}), "^the weights of normal must be finite"),
        (lambda: structure({"x": 1.0, 0: 2.0}), "^joint pad: .* is one degree of freedom twice$"),
        (lambda: structure({"w": 1.0}), "^joint pad: unknown degree of freedom 'w'"),
        (lambda: structure("x", {"x": -3.0}), "^joint pad: tangential .* are one direction$"),
        (lambda: structure((0.1, 0.2, 0.3), 3 * TURNED), "^joint pad: tangential .* are one dir"),
        (lambda: jax.jit(in_trace)(1.0), "^tangential must be known when a program is traced"),
    ],
    kind=(ValueError, TypeError),
)
