from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import fractaljax as fj
from structures import matrices, two_joints

ONE = fj.Joint(fj.FixedContact(1e6, 5e5), fj.Coulomb(0.3), 0, 1)


def refused(message, *arguments, kind: type[Exception] = ValueError, **named):
    with pytest.raises(kind, match=message) as caught:
        fj.Structure(*arguments, **named)
    assert "\n" not in str(caught.value)


def test_what_a_structure_holds():
    M, C, K = matrices(3)
    structure = fj.Structure(M, C, K, ONE, F=[1.0, 2.0, 3.0], names=["x", "y", "z"])
    for name, X in {"M": M, "C": C, "K": K, "F": [1, 2, 3]}.items():
        np.testing.assert_allclose(getattr(structure, name), X, rtol=1e-15)
    assert structure.n == 3
    assert structure.joint_names == ("joint_1",)
    assert structure.index("z") == structure.index(2) == 2
    np.testing.assert_array_equal(structure.direction(("z",)), [0, 0, 1])
    np.testing.assert_array_equal(structure.direction(("x", 2)), [1, 0, -1])
    assert repr(structure).startswith("Structure(n=3, joint_1=Joint(")
    assert "\n" not in repr(structure)


def test_matrices_of_every_kind():
    M, _, K = matrices(3)
    plain = fj.Structure(M, None, K, ONE)
    np.testing.assert_array_equal(plain.C, np.zeros((3, 3)))
    for convert in (scipy.sparse.csr_matrix, np.ndarray.tolist, jnp.asarray):
        other = fj.Structure(convert(M), None, convert(K), ONE)
        np.testing.assert_array_equal(other.M, plain.M)
        np.testing.assert_array_equal(other.K, plain.K)
    assert fj.Structure([[2]], None, [[3]], []).K.dtype == jnp.float64
    small = fj.Structure(M.astype(np.float32), None, K.astype(np.float32), [])
    assert small.M.dtype == small.C.dtype == jnp.float32


def test_rounding_in_the_mass_matrix_is_evened_out():
    M, _, K = matrices(3)
    M[0, 1] *= 1 + 1e-9
    structure = fj.Structure(M, None, K, ONE)
    np.testing.assert_array_equal(structure.M, structure.M.T)


def test_forces_by_name():
    M, _, K = matrices(3)
    structure = fj.Structure(M, None, K, ONE, F={"y": -2.0, 2: 5}, names=("x", "y", "z"))
    np.testing.assert_array_equal(structure.F, [0.0, -2.0, 5.0])


def test_forces_and_joints_that_name_one_degree_of_freedom_twice_are_refused():
    M, C, K = matrices(3)
    named: Any = {"names": ("x", "y", "z")}
    twice = "F gives one degree of freedom twice, as"
    refused(f"{twice} 'x' and as 0", M, C, K, ONE, F={"x": 1.0, 0: 2.0}, **named)
    refused(f"{twice} 2 and as 'z'", M, C, K, ONE, F={np.int64(2): 1.0, "z": 2.0}, **named)
    for dof in (True, np.True_, 1.0, None, ("x",)):
        refused("must be an index or a name", M, C, K, ONE, F={dof: 1.0}, kind=TypeError)
    for tangential, normal in [("x", 0), (0, "x"), (("x", "y"), (0, 1)), ((0, 1), ("y", "x"))]:
        joint = fj.Joint(ONE.contact, ONE.friction, tangential, normal)
        refused("joint pad: tangential .* and normal", M, C, K, {"pad": joint}, **named)
    refused("names must be in an order", M, C, K, ONE, names={"x", "y", "z"}, kind=TypeError)


def test_names_that_are_numerals_are_names():
    M, C, K = matrices(3)
    structure = fj.Structure(M, C, K, ONE, F={"0": 5.0, 0: 7.0}, names=("2", "0", "1"))
    np.testing.assert_array_equal(structure.F, [7.0, 5.0, 0.0])
    with pytest.raises(TypeError, match="must be an index or a name, got True"):
        structure.index(True)


def test_joints_have_names():
    M, C, K = matrices(3)
    assert fj.Structure(M, C, K, [ONE, ONE]).joint_names == ("joint_1", "joint_2")
    assert fj.Structure(M, C, K, {"pad": ONE}).joint_names == ("pad",)
    assert fj.Structure(M, C, K, []).joint_names == ()


def test_replace():
    structure = two_joints(4)
    left, right = structure.replace(mu_s=0.6, **{"right.K_n": 7e6, "right.mu_s": 0.9}).joints
    assert left.friction.mu_s == 0.6
    assert right.friction.mu_s == 0.9
    assert (left.contact.K_n, right.contact.K_n) == (3e6, 7e6)
    moved = structure.replace(K=2 * structure.K, V=0.4)
    np.testing.assert_array_equal(moved.K, 2 * structure.K)
    assert moved.joint_names == ("left", "right")
    assert all(joint.V == 0.4 for joint in moved.joints)
    assert structure.replace().joints == structure.joints
    law = structure.replace(**{"left.friction": fj.Coulomb(0.2)})
    assert isinstance(law.joints[0].friction, fj.Coulomb)
    assert law.replace(mu=0.3).joints[0].friction.mu_s == 0.3
    assert structure.replace(**{"left.normal": 0}).joints[0].normal == (0,)
    surface, material = fj.brake_scene().contact.surface, fj.brake_scene().contact.material
    fractal = {"left.contact": fj.FractalContact(surface, material, 5.0), "left.P": 7.0, "D": 2.6}
    contact = structure.replace(**fractal).joints[0].contact
    assert (contact.P, contact.surface.D) == (7.0, 2.6)
    with pytest.raises(ValueError, match=r"structure has no quantity 'left.P'"):
        structure.replace(**fractal).replace(**{"left.contact": fj.FixedContact(1, 1), "left.P": 1})


def test_replace_refuses():
    structure = two_joints(4)
    with pytest.raises(ValueError, match=r"structure has no quantity 'D'; it has M, C, K, F, con"):
        structure.replace(D=2.4)
    with pytest.raises(ValueError, match=r"no quantity 'middle.K_n'.*left.K_n.*right.K_n"):
        structure.replace(**{"middle.K_n": 1.0})
    with pytest.raises(ValueError, match=r"K_n must be at least 0, got -1\.0"):
        structure.replace(K_n=-1.0)
    with pytest.raises(ValueError, match=r"K must have shape \(4, 4\) as M demands, got \(3, 3\)"):
        structure.replace(K=np.eye(3))
    with pytest.raises(
        ValueError, match="joint left: unknown degree of freedom 4: they are 0 to 3"
    ):
        structure.replace(**{"left.tangential": 4})


def test_under_jit_the_compiled_program_checks():
    structure = two_joints(4)

    @jax.jit
    def stiffer(M):
        return structure.replace(M=M).M

    np.testing.assert_array_equal(stiffer(2 * structure.M), 2 * structure.M)
    with pytest.raises((RuntimeError, ValueError), match="M must be positive definite"):
        jax.block_until_ready(stiffer(structure.M - 10 * jnp.eye(4)))


def test_pytree_round_trip():
    structure = two_joints(4)
    leaves, kind = jax.tree.flatten(structure)
    again = jax.tree.unflatten(kind, leaves)
    assert again.joint_names == structure.joint_names
    assert jax.tree.all(jax.tree.map(lambda x, y: (x == y).all(), again, structure))
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)


def test_a_scene_as_a_structure():
    scene = fj.brake_scene()
    structure = fj.Structure.from_scene(scene)
    np.testing.assert_array_equal(structure.M, np.eye(2))
    omega = np.array([6283.185307179586, 5026.548245743669])
    np.testing.assert_allclose(structure.K, np.diag(omega**2))
    np.testing.assert_allclose(structure.C, np.diag(2 * np.array([0.001, 0.007]) * omega))
    assert structure.F is not None
    np.testing.assert_allclose(structure.F, np.array([5.0, -5.0]) / np.sqrt(2))
    assert structure.joints[0].contact is scene.contact


# Damping.


# Bad input: one line each.


def test_matrices_that_do_not_fit_are_refused():
    M, C, K = matrices(3)
    refused(r"M must be a square matrix, got shape \(2, 3\)", M[:2], C, K, ONE)
    refused(r"M must be a square matrix, got shape \(3,\)", M[0], C, K, ONE)
    refused(r"K must have shape \(3, 3\) as M demands, got \(2, 2\)", M, C, K[:2, :2], ONE)
    refused(r"C must have shape \(3, 3\) as M demands, got \(3, 2\)", M, C[:, :2], K, ONE)
    refused(r"F must have shape \(3,\) as M demands, got \(2,\)", M, C, K, ONE, F=[1.0, 2.0])


def test_matrices_of_no_numbers_are_refused():
    M, C, K = matrices(3)
    refused("K must be finite, got nan", M, C, K * np.nan, ONE)
    refused("M must be finite, got inf", M * np.inf, C, K, ONE)
    refused("K must be an array of real numbers, got complex128", M, C, 1j * K, ONE, kind=TypeError)
    refused("K must be an array of real numbers, got str", M, C, "K.mtx", ONE, kind=TypeError)
    refused("K must be an array of real numbers, got NoneType", M, C, None, ONE, kind=TypeError)
    ragged = [[1.0], [1.0, 2.0], [3.0]]
    refused("K must be an array of real numbers, got list", M, C, ragged, ONE, kind=TypeError)


def test_masses_that_are_none_are_refused():
    M, C, K = matrices(3)
    refused(r"got -1.0 on its diagonal at 1", np.diag([1.0, -1.0, 2.0]), C, K, ONE)
    refused(r"got 0.0 on its diagonal at 2", np.diag([1.0, 1.0, 0.0]), C, K, ONE)
    refused("some motion would have no kinetic energy", np.ones((3, 3)), C, K, ONE)
    refused(
        "some motion would have no kinetic energy", np.ones((3, 3)) + np.eye(3) * -0.1, C, K, ONE
    )
    M[0, 2] += 0.1
    refused(r"M must be symmetric, got .* at \(0, 2\) and .* at \(2, 0\)", M, C, K, ONE)


def test_names_that_do_not_fit_are_refused():
    M, C, K = matrices(3)
    refused("names must be 3, one a degree of freedom, got 2", M, C, K, ONE, names=("x", "y"))
    refused("names must differ, got 'x' more than once", M, C, K, ONE, names=("x", "y", "x"))
    refused("names must be printable strings", M, C, K, ONE, names=("x", "y", "\n"))
    refused("names must be printable strings", M, C, K, ONE, names=(1, 2, 3))


def test_unknown_degrees_of_freedom_are_refused():
    M, C, K = matrices(3)

    def joint(tangential, normal):
        return fj.Joint(ONE.contact, ONE.friction, tangential, normal)

    names = ("x", "y", "z")
    refused(
        "joint pad: unknown degree of freedom 'w'; the structure has x, y, z",
        *(M, C, K, {"pad": joint("x", "w")}),
        names=names,
    )
    refused("joint joint_1: unknown degree of freedom 3: they are 0 to 2", M, C, K, joint(3, 0))
    refused("unknown degree of freedom -1: they are 0 to 2", M, C, K, joint(0, -1))
    refused("unknown degree of freedom 'x': the structure has 3 without", M, C, K, joint("x", 0))
    refused("unknown degree of freedom 'w'", M, C, K, ONE, F={"w": 1.0}, names=names)
    refused("is one degree of freedom twice", M, C, K, joint(("x", 0), 1), names=names)
    refused("F at 0 must be finite, got nan", M, C, K, ONE, F={0: np.nan})
    many = np.eye(12)
    refused(
        r"the structure has n0, n1, .*, n9, ... \(12 in all\)",
        *(many, None, many, joint("w", 0)),
        names=[f"n{i}" for i in range(12)],
    )


def test_joints_that_are_none_are_refused():
    M, C, K = matrices(3)
    refused("joints must be a Joint, several or a mapping", M, C, K, None, kind=TypeError)
    refused("joint joint_2 must be a Joint, got 3", M, C, K, [ONE, 3], kind=TypeError)
    refused("letters, digits, _ and -, got 'a.b'", M, C, K, {"a.b": ONE})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((None, fj.Coulomb(0.3), 0, 1), "contact must be a Contact, got None"),
        ((fj.FixedContact(1, 1), 0.3, 0, 1), "friction must be a Friction, got 0.3"),
        ((fj.FixedContact(1, 1), fj.Coulomb(0.3), 0, 0), "tangential and normal must differ"),
        ((fj.FixedContact(1, 1), fj.Coulomb(0.3), (0, 0), 1), "tangential must be a degree of"),
        ((fj.FixedContact(1, 1), fj.Coulomb(0.3), 0, (1, 2, 3)), "normal must be a degree of"),
        ((fj.FixedContact(1, 1), fj.Coulomb(0.3), 0.5, 1), "tangential must be a degree of"),
        ((fj.FixedContact(1, 1), fj.Coulomb(0.3), True, 1), "tangential must be a degree of"),
        ((fj.FixedContact(1, 1), fj.Coulomb(0.3), 0, 1, 0.0), "V must be above 0, got 0.0"),
        ((fj.FixedContact(1, 1), fj.Stribeck(0.4, 0.3, 1), 0, 1), "V must be given for friction"),
        ((fj.brake_scene().contact, fj.Coulomb(0.95), 0, 1), "mu must be at most 0.9, got 0.95"),
    ],
)
def test_a_joint_refuses(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        fj.Joint(*arguments)
