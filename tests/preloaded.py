"""Mechanisms with preload as forces written down, differentiated in 40 digits.

The oracle knows nothing of Eq. 43: it has the forces of every joint as functions of x and x',
solves for the sliding equilibrium, differentiates by differences, and gives the state matrix.

Some joints are on a load curve, K_n ~ N^alpha, which is closed: N = P (1 + (1 - alpha) e)^(1/(1 -
alpha)), e = K_n u/P.
"""

import functools
from typing import Any

import mpmath as mp
import numpy as np

import fractaljax as fj
from structures import matrices

DIGITS, ALPHA, RATIO = 40, 0.6, 0.7

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

    def stiffness(self, i, numbers):
        """K_n and K_t at the load, which is that of the curve or another one."""
        curve = self.joints[i].get("curve")
        if curve is None:
            return numbers[f"{i}.K_n"], numbers[f"{i}.K_t"]
        K_n = mp.mpf(curve["K_n"]) * (numbers[f"{i}.P"] / curve["P"]) ** mp.mpf(ALPHA)
        return K_n, K_n * mp.mpf(RATIO)

    def normal(self, i, numbers, u):
        """The force of a pressed joint that is closed by u."""
        P, K_n = numbers[f"{i}.P"], self.stiffness(i, numbers)[0]
        if "curve" not in self.joints[i]:
            return P + K_n * u
        rest = 1 - mp.mpf(ALPHA)
        return P * (1 + rest * K_n * u / P) ** (1 / rest)

    def forces(self, numbers, x, v, frozen=None):
        """The forces of the joints; with `frozen` friction they have no slope."""
        total = mp.matrix(self.n, 1)
        for i, joint in enumerate(self.joints):
            own = [numbers[f"{i}.{name}"] for name in NAMES[joint["law"]]]
            mu = lambda w, own=own, law=joint["law"]: LAWS[law](w, *own)  # noqa: E731
            t, n, V = joint["t"], joint["n"], numbers[f"{i}.V"]
            tx, tv = (mp.fdot(t, y) for y in (x, v))
            nx, nv = (mp.fdot(n, y) if n else mp.mpf(0) for y in (x, v))
            if frozen:
                tv = nv = mp.mpf(0)
            K_n, K_t = self.stiffness(i, numbers)
            P = numbers[f"{i}.P"] if joint["pressed"] or not n else mp.mpf(0)
            N = self.normal(i, numbers, nx) if joint["pressed"] else P + (K_n * nx if n else 0)
            for k in range(self.n):
                total[k] += mu(V - tv) * N * t[k] - K_t * tx * t[k]
                if n:
                    total[k] += (P - N) * n[k] - mu(V - nv) * K_t * tx * n[k]
        return total

    def slopes(self, function, at, h):
        found = mp.matrix(self.n)
        for k in range(self.n):
            up, down = at.copy(), at.copy()
            up[k] += h
            down[k] -= h
            found[:, k] = (function(up) - function(down)) / (2 * h)
        return found

    def state_matrix(self, numbers, slope):
        """The state matrix about the equilibrium, and the equilibrium x_0."""
        still, h = mp.matrix(self.n, 1), mp.mpf(10) ** (-DIGITS // 3)
        M, C, K, F = (mp.matrix(x.tolist()) for x in (self.M, self.C, self.K, self.F))
        curved = any("curve" in joint for joint in self.joints)  # else forces are affine in x
        x_0, step = still, h if curved else mp.mpf(1)
        for _ in range(20 if curved else 1):
            push = lambda x: F - K * x + self.forces(numbers, x, still)  # noqa: E731
            move = mp.lu_solve(self.slopes(push, x_0, step), push(x_0))
            x_0 = x_0 - move
            if mp.norm(move) < mp.mpf(10) ** (5 - DIGITS) * mp.norm(x_0):
                break
        drag = lambda v: self.forces(numbers, x_0, v, not slope) - C * v  # noqa: E731
        A = mp.zeros(2 * self.n)
        A[: self.n, self.n :] = mp.eye(self.n)
        A[self.n :, : self.n] = M**-1 * self.slopes(push, x_0, step)
        A[self.n :, self.n :] = M**-1 * self.slopes(drag, still, h)
        return A, x_0

    def exact(self):
        return {name: mp.mpf(x) for name, x in self.numbers.items()}

    def eigenvalues(self, slope=True, numbers=None):
        A, _ = self.state_matrix(numbers or self.exact(), slope)
        return mp.eig(A, left=False, right=False)

    def normal_forces(self):
        numbers, found = self.exact(), []
        _, x_0 = self.state_matrix(numbers, True)
        for i, joint in enumerate(self.joints):
            if joint["pressed"]:
                u = mp.fdot(joint["n"], x_0)
                found.append(float(self.normal(i, numbers, u)))
                if "curve" in joint:  # it is felt
                    straight = numbers[f"{i}.P"] + self.stiffness(i, numbers)[0] * u
                    assert abs(found[-1] / straight - 1) > 1e-6
            else:
                found.append(np.nan if joint["n"] else float(numbers[f"{i}.P"]))
        return found

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


def on_curve(law, numbers, K_n, t, n, V: Any = 0.2, P: Any = None):
    """A joint whose stiffness is K_n under the load P and follows a power of the normal force."""
    own = dict(zip(NAMES[law], numbers, strict=True)) | {"V": V, "P": P}
    exact = {"law": law, "numbers": own, "t": t, "n": n, "pressed": True}
    made = fj.Joint(measured(K_n, P), law(*numbers), t, n, V, True)
    return made, exact | {"curve": {"K_n": K_n, "P": P}}


def measured(K_n, P):
    loads = np.array([P / 10, 10 * P])
    return fj.MeasuredContact(loads, K_n * (loads / P) ** ALPHA, P, RATIO)


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
    """The mass on the belt, which the oracle has as a mechanism of two degrees of freedom.

    Without K_t it is on a load curve.
    """
    contact = measured(K_n, P) if K_t is None else fj.FixedContact(K_n, K_t, P)
    scene = fj.Scene(contact, law(*numbers), BRAKE.oscillator, True).replace(**changes)
    o: Any = {name: float(x) for name, x in vars(scene.oscillator).items()}
    _, exact = (
        on_curve(law, numbers, K_n, 0, 1, o["V"], P)
        if K_t is None
        else joint(law, numbers, K_n, K_t, 0, 1, o["V"], P)
    )
    M, K = o["m"] * np.eye(2), np.diag([o["m"] * o["omega_1"] ** 2, o["m"] * o["omega_2"] ** 2])
    C = 2 * o["m"] * np.diag([o["xi_1"] * o["omega_1"], o["xi_2"] * o["omega_2"]])
    F = o["F"] / np.sqrt(2) * np.array([1, -1])
    exact |= {"t": rows(2, 0), "n": rows(2, 1)}
    return scene, Oracle(M, C, K, F, [exact])


BRAKE = fj.brake_scene()
LEVER, PULL = np.array([0.6, 0.0, 0.8, 0.1]), np.linspace(200.0, -150.0, 4)
STRIBECK, COULOMB = (fj.Stribeck, (0.5, 0.3, 0.6)), (fj.Coulomb, (0.45,))
LOWER = (fj.Stribeck, (0.4, 0.25, 0.5))
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
    "scene, load curve": lambda: scene_of(*LOWER, 4e8, None, 1907.3, F=1500.0),
    "scene, load curve, F = 0": lambda: scene_of(*LOWER, 4e8, None, 1907.3, F=0.0),
    "scene, load curve, pushed": lambda: scene_of(*LOWER, 4e8, None, 1907.3, F=-6000.0),
    "load curves": lambda: structure_of(
        4,
        PULL,
        on_curve(*LOWER, 3e6, (0, 2), 1, 0.2, 400.0),
        on_curve(*LOWER, 5e6, 2, {1: 0.6, 3: 0.8}, 0.3, 250.0),
        joint(*LOWER, 3e6, 1e6, 3, 0, 0.1, 700.0),
    ),
}


@functools.cache
def problem(name):
    """The mechanism of the program, and its oracle."""
    with mp.workdps(DIGITS):
        return PROBLEMS[name]()
