"""Scenes and structures to test with, and an independent analysis of the latter in many digits.

The oracle knows nothing of Eq. 43: it writes down the forces of each joint as functions of
displacement and velocity, differentiates them by differences in 50 digits, and finds eigenvalues
as roots of the determinant.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import fractaljax as fj
import hybrid_truth
from mechanisms import PROBLEMS, source_form
from tools import ROOT, load_script

DIGITS = 50
_BRAKE = fj.brake_scene()
SCENES = {  # one of every kind
    "fractal, stribeck": _BRAKE,
    "given ratio": _BRAKE.replace(stiffness_ratio=0.5),
    "fixed, stribeck": _BRAKE.replace(contact=fj.FixedContact(4e8, 0.0)),
    "fractal, coulomb": _BRAKE.replace(friction=fj.Coulomb(0.3)),
    "fixed, coulomb": _BRAKE.replace(contact=fj.FixedContact(4e8, 2e8), friction=fj.Coulomb(1.2)),
    "odd numbers": _BRAKE.replace(G=5e-324, P=1 / 3, F=-1.7976931348623157e308, V=0.1 + 0.2),
}


def matrices(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, C, K of a structure with frequencies of about a thousand hertz and a little damping."""
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((2, n, n))
    M = 0.1 * (A @ A.T / n + np.eye(n))
    K = 4e6 * (B @ B.T / n + np.diag(np.linspace(1, 3, n)))
    return M, 2.0 * M + 2e-7 * K, K


def state_matrix(M, C, K) -> np.ndarray:
    """Of the states [x, v] (2n, 2n)."""
    n = len(M)
    return np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, np.hstack([K, C]))]])


def monodromy_of(cycle: fj.LimitCycle) -> jax.Array:
    """The monodromy matrix (2n, 2n) of a limit cycle, of states [x, v] in SI."""
    units = cycle._system.units
    return cycle._monodromy * units[:, None] / units[None]


def two_joints(n: int, seed: int = 0) -> fj.Structure:
    """A structure with a joint between two bodies and another to the ground; it has friction."""
    left = fj.Joint(fj.FixedContact(3e6, 1.4e6), fj.Stribeck(0.5, 0.3, 0.6), (0, 2), (1, 3), V=0.2)
    right = fj.Joint(fj.FixedContact(5e6, 2e6), fj.Stribeck(0.4, 0.2, 0.8), 2, 0, V=0.3)
    F = np.linspace(200.0, -150.0, n)
    return fj.Structure(*matrices(n, seed), joints={"left": left, "right": right}, F=F)


def fractal_joints() -> fj.Structure:
    """The same with four degrees of freedom, its joints with the surface of the brake."""
    plain, contact = two_joints(4), fj.brake_scene().replace(P=1500.0).contact
    joints = {
        name: fj.Joint(contact, joint.friction, joint.tangential, joint.normal, joint.V)
        for name, joint in zip(plain.joint_names, plain.joints, strict=True)
    }
    return fj.Structure(plain.M, plain.C, plain.K, joints, F=plain.F)


def beam_on_pad(contact: Callable, mu: float, damping: Callable, **joint: Any) -> fj.Structure:
    """A beam on its pad, of 150 degrees of freedom, with nine joints pair_1 to pair_9.

    `contact(share)` is that of a joint with its share of the load, and `damping(M, K)` gives C.
    """
    made = load_script(ROOT / "notebooks" / "brakes.py").beam_on_pad()
    joints = {
        f"pair_{i}": fj.Joint(contact(share), fj.Coulomb(mu), *pair, **joint)
        for i, (pair, share) in enumerate(zip(made.pairs, made.shares, strict=True), start=1)
    }
    M, K = made.matrices["M"], made.matrices["K"]
    return fj.Structure(M, damping(M, K), K, joints)


def beam(elements: int, free: bool = False, height: float = 0.01):
    """(M, K) of a steel beam 1 m long, 20 mm wide: Euler and Bernoulli, consistent mass.

    Degrees of freedom are deflection and rotation of each node, without those of the clamped end
    unless `free`.
    """
    E, rho, width, h = 2.1e11, 7800.0, 0.02, 1 / elements
    EI, mass = E * width * height**3 / 12, rho * width * height * h / 420
    k, m = np.zeros((2, 4, 4))
    k[np.triu_indices(4)] = [
        12,
        6 * h,
        -12,
        6 * h,
        4 * h**2,
        -6 * h,
        2 * h**2,
        12,
        -6 * h,
        4 * h**2,
    ]
    m[np.triu_indices(4)] = [
        *(156, 22 * h, 54, -13 * h),
        *(4 * h**2, 13 * h, -3 * h**2),
        *(156, -22 * h, 4 * h**2),
    ]
    k, m = (np.triu(x) + np.triu(x, 1).T for x in (EI / h**3 * k, mass * m))
    M, K = np.zeros((2, 2 * elements + 2, 2 * elements + 2))
    for i in range(elements):
        element = slice(2 * i, 2 * i + 4)
        M[element, element] += m
        K[element, element] += k
    return (M, K) if free else (M[2:, 2:], K[2:, 2:])


def hoffmann(C=None) -> fj.Structure:
    """The minimal model of mode coupling (Hoffmann et al. 2002): eigenvalues 2 +- (1 - 4 mu/3)^.5.

    They coalesce at mu = 3/4.
    """
    K = [(None, [[2.0, 1.0], [1.0, 2.0]]), ("-4*mu/3", [[0.0, 1.0], [0.0, 0.0]])]
    return fj.ParametricStructure(np.eye(2), C, K, parameters={"mu": 0.1})


def numbers_of(structure: fj.Structure) -> dict[str, Any]:
    """The numbers of a structure whose friction is Stribeck's, for `linearised`."""
    joints = []
    for joint in structure.joints:
        K_n, K_t = joint.stiffness()
        law: Any = joint.friction
        quantities: dict[str, Any] = {"K_n": K_n, "K_t": K_t, "V": joint.V}
        quantities |= {"mu_s": law.mu_s, "mu_m": law.mu_m, "v_m": law.v_m}
        exact = {name: mp.mpf(float(x)) for name, x in quantities.items()}
        joints.append(exact | {"t": joint.tangential, "n": joint.normal})
    arrays = {name: mp.matrix(np.asarray(getattr(structure, name)).tolist()) for name in "MCKF"}
    return arrays | {"joints": joints}


def _mu(joint, v):
    drop, u = joint["mu_s"] - joint["mu_m"], v / joint["v_m"]
    return joint["mu_s"] + drop * (u**3 - 3 * u) / 2


def _forces(numbers, x, v):
    """The forces (n,) of the joints at displacements x and velocities v."""
    force = mp.matrix(len(x), 1)

    def along(dofs, z):
        return z[dofs[0]] - (z[dofs[1]] if len(dofs) == 2 else 0)

    def push(dofs, f):
        for dof, sign in zip(dofs, (1, -1), strict=False):
            force[dof] += sign * f

    for joint in numbers["joints"]:
        t, n = joint["t"], joint["n"]
        tangential, normal = joint["K_t"] * along(t, x), joint["K_n"] * along(n, x)
        push(t, -tangential + _mu(joint, joint["V"] - along(t, v)) * normal)
        push(n, -normal - _mu(joint, joint["V"] - along(n, v)) * tangential)
    return force


def _jacobian(function, at):
    columns, h = [], mp.mpf(10) ** (-DIGITS // 3)
    for i in range(len(at)):
        ahead, behind = at.copy(), at.copy()
        ahead[i] += h
        behind[i] -= h
        columns.append((function(ahead) - function(behind)) / (2 * h))
    return mp.matrix([[column[i] for column in columns] for i in range(len(at))])


def linearised(numbers, friction_slope: bool):
    """(M, C, K) about the equilibrium."""
    zero, C = mp.matrix(numbers["M"].rows, 1), numbers["C"]
    K = numbers["K"] - _jacobian(lambda x: _forces(numbers, x, zero), zero)
    if friction_slope:
        x_0 = mp.lu_solve(K, numbers["F"])
        C = C - _jacobian(lambda v: _forces(numbers, x_0, v), zero)
    return numbers["M"], C, K


def eigenvalue_near(numbers, friction_slope: bool, start: complex):
    """The eigenvalue of the quadratic problem near `start`, in many digits: Newton on its det."""
    with mp.workdps(DIGITS):
        M, C, K = linearised(numbers, friction_slope)
        s = mp.mpmathify(start)
        for _ in range(8):
            inverse_times_slope = mp.inverse(s**2 * M + s * C + K) * (2 * s * M + C)
            step = 1 / mp.fsum(inverse_times_slope[i, i] for i in range(M.rows))
            s -= step
            if abs(step) < mp.mpf(10) ** (-DIGITS // 2 - 5) * abs(s):  # the next is exact
                return s
        raise AssertionError(f"no eigenvalue near {start}")


def slope_of(change, start: complex, scale: float, friction_slope: bool = True) -> float:
    """d(growth rate)/dp: `change(dp)` gives the numbers with a parameter moved by dp."""
    with mp.workdps(DIGITS):
        h = mp.mpf(scale) * mp.mpf(10) ** -12
        ends = [eigenvalue_near(change(sign * h), friction_slope, start) for sign in (1, -1)]
        return float((ends[0].real - ends[1].real) / (2 * h))


LAWS: dict[str, Any] = {
    "coulomb": fj.Coulomb,
    "stribeck": fj.Stribeck,
    "exponential": fj.ExponentialStribeck,
    "hyperbolic": fj.HyperbolicStribeck,
    "tabulated": fj.TabulatedFriction,
}


def of_problem(problem) -> fj.Structure:
    """A problem of mechanisms.py; a joint of the source's form says that it is not preloaded."""
    joints = []
    for joint in problem["joints"]:
        law, numbers = joint["friction"]
        contact = fj.FixedContact(joint.get("K_n", 0.0), joint.get("K_t", 0.0), joint.get("P"))
        normal = joint.get("normal")
        preload = joint.get("preload", normal is not None)
        law = LAWS[law](**numbers)
        # Backwards along t is forwards along -t.
        V, t = joint["V"], np.array(joint["tangential"])
        if not isinstance(V, jax.Array) and V < 0:
            V, t = -V, -t
        joints.append(fj.Joint(contact, law, t, normal, V, preload))
    M, C, K = (jnp.stack([jnp.stack(row) for row in problem[name]]) for name in "MCK")
    return fj.Structure(M, C, K, joints, F=jnp.asarray(problem["F"]))


@functools.cache
def belt_cycle() -> tuple[fj.Structure, fj.LimitCycle]:
    """A structure of one degree of freedom, whose joint slides along it, and its limit cycle."""
    problem = PROBLEMS["papangelo_2017"]
    structure = of_problem(problem)
    return structure, fj.limit_cycle(structure, problem["start"])


def source_form_of(scene: fj.Scene) -> dict[str, Any]:
    """A scene with Stribeck's friction in plain numbers, for the independent solver."""
    K_n, K_t = fj.stiffness(scene)
    parts = vars(scene.oscillator) | vars(scene.friction) | {"K_n": K_n, "K_t": K_t}
    return source_form(**{name: float(value) for name, value in parts.items()})


def truth_of(structure: Any) -> hybrid_truth.Mechanism:
    """The same structure in the terms of the independent solver."""
    joints = []
    for j in structure.joints:
        t, n = (np.asarray(structure.direction(d)) for d in (j.tangential, j.normal))
        K_n, K_t = map(float, j.stiffness())
        if isinstance(j.friction, fj.Coulomb):
            law = functools.partial(hybrid_truth.LAWS["coulomb"], mu=float(j.friction.mu_s))
        else:
            numbers = {name: float(getattr(j.friction, name)) for name in ("mu_s", "mu_d", "v_0")}
            law = functools.partial(hybrid_truth.LAWS["exponential"], **numbers)
        joints.append(hybrid_truth.Joint(t, float(j.V), law, n, float(j.normal_load), K_n, K_t))
    M, C, K = (np.asarray(x) for x in (structure.M, structure.C, structure.K))
    return hybrid_truth.Mechanism(M, C, K, np.zeros(structure.n), tuple(joints))
