"""Mechanisms with preload as forces written down, differentiated in 40 digits.

The oracle knows nothing of Eq. 43: it has the forces of every joint as functions of x and x',
solves for the sliding equilibrium, differentiates by differences, and gives the state matrix.
"""

import functools
from typing import Any

import mpmath as mp
import numpy as np

import fractaljax as fj
from structures import matrices

DIGITS = 40

LAWS: dict[type, Any] = {  # mu(w) of the numbers of a law
    fj.Coulomb: lambda w, mu: mu + 0 * w,
    fj.Stribeck: lambda w, mu_s, mu_m, v_m: (
        mu_s + (mu_s - mu_m) / 2 * ((w / v_m) ** 3 - 3 * w / v_m)
    ),
    fj.ExponentialStribeck: lambda w, mu_s, mu_d, v_0, viscous: (
        mu_d + (mu_s - mu_d) * mp.exp(-w / v_0) + viscous * w
    ),
    fj.HyperbolicStribeck: lambda w, mu_s, delta: mu_s / (1 + delta * w),
}
NAMES = {
    fj.Coulomb: ("mu",),
    fj.Stribeck: ("mu_s", "mu_m", "v_m"),
    fj.ExponentialStribeck: ("mu_s", "mu_d", "v_0", "viscous"),
    fj.HyperbolicStribeck: ("mu_s", "delta"),
}


def rows(n, direction):
    """The row of a direction, by what the documentation says of each kind."""
    if isinstance(direction, np.ndarray):
        return list(direction)
    row = [0.0] * n
    if isinstance(direction, tuple):
        row[direction[0]], row[direction[1]] = 1.0, -1.0
    elif isinstance(direction, dict):
        for dof, weight in direction.items():
            row[dof] = weight
    else:
        row[direction] = 1.0
    return row


class Oracle:
    """A mechanism in working precision; quantities by joint and name, "0.K_n", can be moved."""

    def __init__(self, M, C, K, F, joints):
        self.M, self.C, self.K, self.F = (np.asarray(x, float) for x in (M, C, K, F))
        self.n, self.joints, self.numbers = len(self.M), joints, {}
        for i, joint in enumerate(joints):
            self.numbers |= {f"{i}.{name}": float(x) for name, x in joint["numbers"].items()}

    def forces(self, numbers, x, v, frozen=None):
        """The forces of the joints; with `frozen` friction they have no slope."""
        total = mp.matrix(self.n, 1)
        for i, joint in enumerate(self.joints):
            own = {name: numbers[f"{i}.{name}"] for name in joint["numbers"]}
            mu = lambda w, own=own, law=joint["law"]: LAWS[law](w, *(own[k] for k in NAMES[law]))  # noqa: E731
            t, n = joint["t"], joint["n"]
            tx, tv = (mp.fdot(t, y) for y in (x, v))
            nx, nv = (mp.fdot(n, y) if n else mp.mpf(0) for y in (x, v))
            if frozen:
                tv = nv = mp.mpf(0)
            P = own["P"] if joint["pressed"] or not n else mp.mpf(0)
            N = P + (own["K_n"] * nx if n else 0)
            for k in range(self.n):
                total[k] += mu(own["V"] - tv) * N * t[k] - own["K_t"] * tx * t[k]
                if n:
                    total[k] += (P - N) * n[k] - mu(own["V"] - nv) * own["K_t"] * tx * n[k]
        return total

    def state_matrix(self, numbers, slope):
        """The state matrix about the equilibrium, and the equilibrium x_0."""
        zero, h = mp.matrix(self.n, 1), mp.mpf(10) ** (-DIGITS // 3)
        M, C, K, F = (mp.matrix(x.tolist()) for x in (self.M, self.C, self.K, self.F))
        K_all, base = K.copy(), self.forces(numbers, zero, zero)
        for k in range(self.n):  # affine in x
            step = zero.copy()
            step[k] = 1
            K_all[:, k] = K[:, k] - (self.forces(numbers, step, zero) - base)
        x_0 = mp.lu_solve(K_all, F + base)
        C_all = C.copy()
        for k in range(self.n):
            up, down = zero.copy(), zero.copy()
            up[k], down[k] = h, -h
            ends = [self.forces(numbers, x_0, v, not slope) for v in (up, down)]
            C_all[:, k] = C[:, k] - (ends[0] - ends[1]) / (2 * h)
        A = mp.zeros(2 * self.n)
        A[: self.n, self.n :] = mp.eye(self.n)
        A[self.n :, : self.n], A[self.n :, self.n :] = -(M**-1) * K_all, -(M**-1) * C_all
        return A, x_0

    def exact(self):
        return {name: mp.mpf(x) for name, x in self.numbers.items()}

    def eigenvalues(self, slope=True, numbers=None):
        A, _ = self.state_matrix(numbers or self.exact(), slope)
        return mp.eig(A, left=False, right=False)

    def normal_forces(self):
        numbers = self.exact()
        _, x_0 = self.state_matrix(numbers, True)
        return [
            float(numbers[f"{i}.P"] + (numbers[f"{i}.K_n"] * mp.fdot(j["n"], x_0) if j["n"] else 0))
            if j["pressed"] or not j["n"]
            else np.nan
            for i, j in enumerate(self.joints)
        ]

    def slope_of(self, name):
        """d(growth rate)/d(a quantity), by differences."""
        h, ends = mp.mpf(self.numbers[name]) * mp.mpf(10) ** -12, []
        for sign in (1, -1):
            numbers = self.exact()
            numbers[name] += sign * h
            ends.append(max(s.real for s in self.eigenvalues(numbers=numbers)))
        return float((ends[0] - ends[1]) / (2 * h))


def joint(law, numbers, K_n, K_t, t, n=None, V=0.2, P: Any = None, preload=True):
    """A joint of the program, and the same for the oracle."""
    contact = fj.FixedContact(K_n, K_t, P)
    own = dict(zip(NAMES[law], numbers, strict=True)) | {"K_n": K_n, "K_t": K_t, "V": V}
    own |= {} if P is None else {"P": P}
    pressed = preload and n is not None
    made = fj.Joint(contact, law(*numbers), t, n, V, preload)
    return made, {"law": law, "numbers": own, "t": t, "n": n, "pressed": pressed}


def structure_of(n, F, *joints, seed=0):
    M, C, K = matrices(n, seed)
    made = {f"j{i}": each for i, (each, _) in enumerate(joints)}
    exact = [
        each | {"t": rows(n, each["t"]), "n": each["n"] is not None and rows(n, each["n"])}
        for _, each in joints
    ]
    x = fj.Structure(M, C, K, made, F=F)
    return x, Oracle(M, C, K, np.zeros(n) if F is None else F, exact)


def scene_of(law, numbers, K_n, K_t, P, **changes):
    """The mass on the belt, which the oracle has as a mechanism of two degrees of freedom."""
    scene = fj.Scene(fj.FixedContact(K_n, K_t, P), law(*numbers), BRAKE.oscillator, True)
    scene = scene.replace(**changes)
    o: Any = {name: float(x) for name, x in vars(scene.oscillator).items()}
    _, exact = joint(law, numbers, K_n, K_t, 0, 1, o["V"], P)
    M, K = o["m"] * np.eye(2), np.diag([o["m"] * o["omega_1"] ** 2, o["m"] * o["omega_2"] ** 2])
    C = 2 * o["m"] * np.diag([o["xi_1"] * o["omega_1"], o["xi_2"] * o["omega_2"]])
    F = o["F"] / np.sqrt(2) * np.array([1, -1])
    exact |= {"t": rows(2, 0), "n": rows(2, 1)}
    return scene, Oracle(M, C, K, F, [exact])


BRAKE = fj.brake_scene()
LEVER, PULL = np.array([0.6, 0.0, 0.8, 0.1]), np.linspace(200.0, -150.0, 4)
STRIBECK, COULOMB = (fj.Stribeck, (0.5, 0.3, 0.6)), (fj.Coulomb, (0.45,))
EXPONENTIAL = (fj.ExponentialStribeck, (0.5, 0.2, 0.15, 0.1))
HYPERBOLIC = (fj.HyperbolicStribeck, (0.5, 1.5))
PROBLEMS = {
    "scene": lambda: scene_of(*STRIBECK, 4e8, 2e8, 1907.3),
    "scene, K_t = 0": lambda: scene_of(*EXPONENTIAL, 4e8, 0.0, 300.0, F=80.0),
    "scene, pulled": lambda: scene_of(*HYPERBOLIC, 2e8, 1e8, 500.0, F=-300.0),
    "scene, coulomb": lambda: scene_of(*COULOMB, 4e8, 1e8, 100.0, V=0.3),
    "one joint": lambda: structure_of(4, None, joint(*STRIBECK, 3e6, 1e6, (0, 2), 1, P=400.0)),
    "lever arms": lambda: structure_of(
        4, PULL, joint(*EXPONENTIAL, 3e6, 1e6, {0: 1.0, 3: -0.25}, LEVER, P=700.0)
    ),
    "constant normal force": lambda: structure_of(
        4, PULL, joint(*HYPERBOLIC, 3e6, 1e6, LEVER, P=300.0, preload=False)
    ),
    "three kinds": lambda: structure_of(
        4,
        PULL,
        joint(*STRIBECK, 3e6, 1.4e6, (0, 2), (1, 3), 0.2, 900.0),
        joint(*EXPONENTIAL, 5e6, 2e6, 2, LEVER, 0.3, preload=False),
        joint(*HYPERBOLIC, 5e6, 1e6, {1: 0.7, 2: -0.7}, None, 0.1, 250.0),
    ),
}


@functools.cache
def problem(name):
    """The mechanism of the program, and its oracle."""
    with mp.workdps(DIGITS):
        return PROBLEMS[name]()
