"""Structures and joints: what they hold, replacing, and bad input in one line each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

import fractaljax as fj
from structures import matrices, two_joints
from tools import refusals

M, C, K = matrices(3)
FIXED, COULOMB = fj.FixedContact(1e6, 5e5), fj.Coulomb(0.3)
ONE = fj.Joint(FIXED, COULOMB, 0, 1)
BRAKE = fj.brake_scene().contact
XYZ = ("x", "y", "z")


def joint(tangential, normal):
    return {"pad": fj.Joint(FIXED, COULOMB, tangential, normal)}


def test_what_a_structure_holds_and_its_pytree():
    structure = fj.Structure(M, C, K, ONE, F=[1.0, 2.0, 3.0], names=list(XYZ))
    for name, X in {"M": M, "C": C, "K": K, "F": [1, 2, 3]}.items():
        np.testing.assert_allclose(getattr(structure, name), X, rtol=1e-15)
    assert structure.n == 3
    assert structure.index("z") == structure.index(2) == structure.index(np.int64(2)) == 2
    np.testing.assert_array_equal(structure.direction(("z",)), [0, 0, 1])
    np.testing.assert_array_equal(structure.direction(("x", 2)), [1, 0, -1])
    assert repr(structure).startswith("Structure(n=3, joint_1=Joint(")
    assert "\n" not in repr(structure)
    small = fj.Structure(
        M.astype(np.float32), None, scipy.sparse.csr_matrix(K, dtype=np.float32), []
    )
    assert small.M.dtype == small.C.dtype == small.K.dtype == jnp.float32
    assert not small.C.any()
    for joints, names in [([ONE, ONE], ("joint_1", "joint_2")), ({"pad": ONE}, ("pad",)), ([], ())]:
        assert fj.Structure(M, C, K, joints).joint_names == names
    structure = two_joints(4)
    leaves, kind = jax.tree.flatten(structure)
    again = jax.tree.unflatten(kind, leaves)
    assert again.joint_names == structure.joint_names
    assert jax.tree.all(jax.tree.map(lambda x, y: (x == y).all(), again, structure))
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)


@pytest.mark.parametrize(
    ("F", "names", "expected"),
    [
        ({"y": -2.0, 2: 5}, XYZ, [0.0, -2.0, 5.0]),
        ({"0": 5.0, 0: 7.0}, ("2", "0", "1"), [7.0, 5.0, 0.0]),  # numerals can be names
        ({}, None, [0.0, 0.0, 0.0]),
    ],
)
def test_forces_by_name(F, names, expected):
    structure = fj.Structure(M, C, K, ONE, F=F, names=names)
    assert structure.F is not None
    np.testing.assert_array_equal(structure.F, expected)


test_replace_refuses = refusals(
    [
        ({"D": 2.4}, r"^structure has no quantity 'D'; it has M, C, K, F, con"),
        ({"middle.K_n": 1.0}, r"no quantity 'middle.K_n'.*left.K_n.*right.K_n"),
        ({"left.contact": FIXED, "left.G": 1}, r"structure has no quantity 'left.G'"),
        ({"K_n": -1.0}, r"K_n must be at least 0, got -1\.0"),
        ({"K": np.eye(3)}, r"K must have shape \(4, 4\) as M demands, got \(3, 3\)"),
        ({"left.tangential": 4}, "joint left: unknown degree of freedom 4; .* has 0, 1, 2, 3$"),
    ],
    lambda changes: two_joints(4).replace(**changes),
)


def test_replace_and_its_nan_under_jit():
    structure = two_joints(4)
    stiffer = jax.jit(lambda M: structure.replace(M=M).M)
    np.testing.assert_array_equal(stiffer(2 * structure.M), 2 * structure.M)
    assert np.isnan(stiffer(structure.M - 10 * jnp.eye(4))).all()
    # Of a sum of matrices the whole counts.
    parts = jax.jit(
        lambda m: fj.ParametricStructure([(1, m), ("k", m)], None, jnp.eye(2), [], {"k": 1.0}).M
    )
    assert np.isnan(parts(-jnp.eye(2))).all() and (parts(jnp.eye(2)) == 2 * jnp.eye(2)).all()
    left, right = structure.replace(mu_s=0.6, **{"right.K_n": 7e6, "right.mu_s": 0.9}).joints
    assert (left.friction.mu_s, right.friction.mu_s) == (0.6, 0.9)
    assert (left.contact.K_n, right.contact.K_n) == (3e6, 7e6)
    moved = structure.replace(K=2 * structure.K, V=0.4)
    np.testing.assert_array_equal(moved.K, 2 * structure.K)
    assert moved.joint_names == ("left", "right")
    assert all(joint.V == 0.4 for joint in moved.joints)
    assert structure.replace().joints == structure.joints
    law = structure.replace(**{"left.friction": COULOMB, "left.normal": 0})
    assert law.replace(mu=0.4).joints[0].friction.mu_s == 0.4
    assert law.joints[0].normal == (0,)
    fractal = {"left.contact": BRAKE, "left.P": 7.0, "D": 2.6}
    contact = structure.replace(**fractal).joints[0].contact
    assert (contact.P, contact.surface.D) == (7.0, 2.6)


def test_a_scene_as_a_structure():
    scene = fj.brake_scene()
    structure = fj.Structure.from_scene(scene)
    omega = np.array([6283.185307179586, 5026.548245743669])
    np.testing.assert_array_equal(structure.M, np.eye(2))
    np.testing.assert_allclose(structure.K, np.diag(omega**2))
    np.testing.assert_allclose(structure.C, np.diag(2 * np.array([0.001, 0.007]) * omega))
    assert structure.F is not None
    np.testing.assert_allclose(structure.F, np.array([5.0, -5.0]) / np.sqrt(2))
    assert structure.joints[0].contact is scene.contact
    K_n, K_t = structure.joints[0].stiffness()
    np.testing.assert_allclose([K_n, K_t], fj.stiffness(scene), rtol=1e-14)
    assert structure.joints[0].coefficient() == scene.friction.mu(0.15)


TWELVE = dict(M=np.eye(12), C=None, K=np.eye(12), joints=joint(0, 12), names=None)
BAD = [
    ({"M": M[:2]}, r"M must be a square matrix, got shape \(2, 3\)"),
    ({"C": C[:, :2]}, r"C must have shape \(3, 3\) as M demands, got \(3, 2\)"),
    ({"F": [1.0, 2.0]}, r"F must have shape \(3,\) as M demands, got \(2,\)"),
    ({"K": K * np.nan}, "K must be finite, got nan"),
    ({"M": -M}, "M must be positive definite"),
    ({"F": {"x": 1.0, 0: 2.0}}, "F gives one degree of freedom twice: 'x', 0"),
    ({"F": {"w": 1.0}}, "unknown degree of freedom 'w'"),
    ({"F": {0: np.nan}}, "F at 0 must be finite, got nan"),
    *(({"F": {dof: 1.0}}, "must be an index or a name, got") for dof in (np.True_, 1.0)),
    ({"names": ("x", "y")}, "names must be 3 printable strings, .*, got 2: 'x', 'y'$"),
    ({"names": ("x", "y", "x")}, "names must differ, got 'x' more than once"),
    ({"names": ("x", "y", "\n")}, "names must be 3 printable strings"),
    ({"names": {"x", "y", "z"}}, "names must be in an order"),
    ({"joints": None}, "joints must be a Joint, several or a mapping"),
    ({"joints": [ONE, 3]}, "joint joint_2 must be a Joint, got 3"),
    ({"joints": {"a.b": ONE}}, "letters, digits, _ and -, got 'a.b'"),
    ({"joints": joint("x", "w")}, "joint pad: unknown degree of freedom 'w'; .* has x, y, z$"),
    ({"joints": joint("x", 0), "names": None}, "degree of freedom 'x'; .* has no names"),
    ({"joints": joint((0, 1), ("y", "x"))}, "joint pad: .* are one direction"),
    (TWELVE, r"has 0, 1, .*, 9, ... \(12 in all\)"),
]


test_a_structure_refuses = refusals(
    BAD,
    lambda changes: fj.Structure(**dict(M=M, C=C, K=K, joints=ONE, names=XYZ) | changes),
    kind=(ValueError, TypeError),
)


test_a_joint_refuses = refusals(
    [
        ({"contact": None}, "contact must be a Contact, got None"),
        ({"friction": 0.3}, "friction must be a Friction, got 0.3"),
        ({"normal": 0}, "tangential and normal must differ"),
        *(({"tangential": x}, "tangential must be a degree of") for x in ((0, 0), 0.5, True)),
        ({"V": -0.1}, "V must be at least 0, got -0.1"),
        ({"friction": fj.Stribeck(0.4, 0.3, 1)}, "V must be given for friction"),
        ({"contact": BRAKE, "friction": fj.Coulomb(0.95)}, "mu must be at most 0.9, got 0.95"),
    ],
    lambda changes: fj.Joint(
        **dict(contact=FIXED, friction=COULOMB, tangential=0, normal=1) | changes
    ),
    kind=(ValueError, TypeError),
)
