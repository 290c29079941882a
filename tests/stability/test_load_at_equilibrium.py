"""Stability about the equilibrium on a load curve: the state matrix of the forces, in 40 digits.

The laws are powers, K_n ~ N^alpha, whose load curve is closed: N = P (1 + (1 - alpha) e)^(1/(1 -
alpha)), e = K_n u/P.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from structures import matrices
from tools import both_modes

P, ALPHA, RATIO = 1907.3, 0.6, 0.7
STRIBECK = fj.Stribeck(0.4, 0.25, 0.5)
PULLS = (0.0, 1500.0, -6000.0)


def law(K_N, load=P, alpha=ALPHA):
    loads = np.array([load / 10, 10 * load])
    return fj.MeasuredContact(loads, K_N * (loads / load) ** alpha, load, RATIO)


def scene(pull, friction: fj.Friction = STRIBECK):
    return fj.Scene(law(4e8), friction, fj.brake_scene().oscillator, True).replace(F=pull)


def structure():
    M, C, K = matrices(4, 0)
    joints = {
        "a": fj.Joint(law(3e6, 400.0), STRIBECK, (0, 2), 1, 0.2, True),
        "b": fj.Joint(law(5e6, 250.0), STRIBECK, 2, {1: 0.6, 3: 0.8}, 0.3, True),
        "c": fj.Joint(fj.FixedContact(3e6, 1e6, 700.0), STRIBECK, 3, 0, 0.1, True),
    }
    return fj.Structure(M, C, K, joints, F=np.linspace(200.0, -150.0, 4))


class Oracle:
    """The forces of the joints in working precision, and what follows from them."""

    def __init__(self, x, load=None):
        if isinstance(x, fj.Scene):
            x = fj.Structure.from_scene(x)
        self.joints: Any = x.joints
        self.x, self.n, self.load = x, x.n, load
        self.M, self.C, self.K = (mp.matrix(np.asarray(X).tolist()) for X in (x.M, x.C, x.K))
        self.F = mp.matrix(np.asarray(x.F).tolist())

    def normal(self, joint, u):
        contact = joint.contact
        K_n, load = mp.mpf(float(contact.stiffness(0.4, 0.3)[0])), mp.mpf(float(contact.P))
        if isinstance(contact, fj.FixedContact):
            return load + K_n * u
        if self.load is not None:  # the same surface under another load
            K_n, load = K_n * (self.load / load) ** mp.mpf(ALPHA), self.load
        rest = 1 - mp.mpf(ALPHA)
        return load * (1 + rest * K_n * u / load) ** (1 / rest)

    def residual(self, x, v):
        total = self.F - self.K * x - self.C * v
        for joint in self.joints:
            t, n = (self.x.direction(d).tolist() for d in (joint.tangential, joint.normal))
            contact, friction = joint.contact, joint.friction
            K_t = mp.mpf(float(contact.stiffness(0.4, 0.3)[1]))
            if self.load is not None:
                K_t *= (self.load / mp.mpf(float(contact.P))) ** mp.mpf(ALPHA)
            mu_s, mu_m, v_m = (
                mp.mpf(float(y)) for y in (friction.mu_s, friction.mu_m, friction.v_m)
            )

            def mu(w, mu_s=mu_s, mu_m=mu_m, v_m=v_m):
                return mu_s + (mu_s - mu_m) / 2 * ((w / v_m) ** 3 - 3 * w / v_m)

            tx, tv, nx, nv = (mp.fdot(d, y) for d in (t, n) for y in (x, v))
            N, V = self.normal(joint, nx), mp.mpf(float(joint.V))
            load = self.normal(joint, mp.mpf(0))
            for i in range(self.n):
                total[i] += mu(V - tv) * N * t[i] - K_t * tx * t[i]
                total[i] += (load - N) * n[i] - mu(V - nv) * K_t * tx * n[i]
        return total

    def equilibrium(self):
        still = mp.matrix(self.n, 1)
        found = mp.matrix(self.n, 1)
        for _ in range(40):
            J = self.slopes(lambda x: self.residual(x, still), found)
            found = found - mp.lu_solve(J, self.residual(found, still))
        return found

    def slopes(self, function, at):
        h, J = mp.mpf(10) ** -25, mp.matrix(self.n)
        for k in range(self.n):
            up, down = at.copy(), at.copy()
            up[k] += h
            down[k] -= h
            J[:, k] = (function(up) - function(down)) / (2 * h)
        return J

    def modes(self):
        x, still = self.equilibrium(), mp.matrix(self.n, 1)
        A = mp.zeros(2 * self.n)
        A[: self.n, self.n :] = mp.eye(self.n)
        inverse = self.M**-1
        A[self.n :, : self.n] = inverse * self.slopes(lambda x: self.residual(x, still), x)
        A[self.n :, self.n :] = inverse * self.slopes(lambda v: self.residual(x, v), still)
        forces, linear = [], []
        for joint in self.joints:
            u = mp.fdot(self.x.direction(joint.normal).tolist(), x)
            forces.append(float(self.normal(joint, u)))
            K_n = mp.mpf(float(joint.contact.stiffness(0.4, 0.3)[0]))
            linear.append(float(joint.contact.P) + float(K_n * u))
        assert not np.allclose(forces, linear, rtol=1e-6)  # the curve is felt
        return mp.eig(A, left=False, right=False), forces


@pytest.fixture(autouse=True)
def _digits():
    with mp.workdps(60):
        yield


@jax.jit
def answers(x):
    """Stability and growth rate: one program."""
    return fj.stability(x), fj.growth_rate(x)


PROBLEMS = {**{f"scene, F = {F:g}": (lambda F=F: scene(F)) for F in PULLS}, "structure": structure}


@pytest.mark.parametrize(
    "name", [*list(PROBLEMS)[:-1], pytest.param("structure", marks=pytest.mark.slow)]
)
def test_eigenvalues_and_normal_forces(name):
    x = PROBLEMS[name]()
    wanted, forces = Oracle(x).modes()
    size = float(max(map(abs, wanted)))
    found, growth_rate = answers(x)
    apart = np.abs(np.array(found.eigenvalues)[:, None] - np.array(wanted, complex)[None])
    assert apart.min(axis=0).max() < 1e-10 * size and apart.min(axis=1).max() < 1e-10 * size
    np.testing.assert_allclose(found.normal_force, forces, rtol=1e-10)
    growth = max(float(s.real) for s in wanted)
    assert float(growth_rate) == pytest.approx(growth, abs=1e-10 * size)


def test_by_the_load():
    """d(growth rate)/dP in both modes, against differences of the oracle."""
    x = scene(1500.0)

    def growth(load):
        return fj.growth_rate(x.replace(P=load[0]))[None]

    _, forward, reverse = jax.jit(lambda load: both_modes(growth, load))(jnp.array([P]))
    ends = []
    for sign in (1, -1):
        load = mp.mpf(P) + sign * mp.mpf(10) ** -12
        ends.append(max(s.real for s in Oracle(x, load).modes()[0]))
    wanted = float((ends[0] - ends[1]) / (2 * mp.mpf(10) ** -12))
    np.testing.assert_allclose([forward[0, 0], reverse[0, 0]], wanted, rtol=1e-7)


def test_a_scene_is_its_structure():
    x = scene(1500.0)
    same = fj.Structure.from_scene(x)
    found, wanted = (answers(each)[0] for each in (same, x))
    size = float(np.abs(wanted.eigenvalues).max())
    np.testing.assert_allclose(found.eigenvalues, wanted.eigenvalues, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(found.normal_force, wanted.normal_force, rtol=1e-11)


def test_open_at_equilibrium():
    """Pulled off the belt there is no steady sliding."""
    x = scene(1e5)
    for each in (x, fj.Structure.from_scene(x)):
        found, growth_rate = answers(each)
        assert np.isnan(growth_rate) and found.normal_force[0] == 0


@pytest.mark.slow
def test_critical_friction_and_boundary():
    """Where friction, scaled, makes the growth rate 0; and the boundary passes through it."""
    x = scene(1500.0, fj.Coulomb(0.3))
    critical = float(fj.critical_friction(x))
    assert abs(float(fj.growth_rate(x.replace(mu=critical)))) < 1e-6
    linear = fj.Scene(x.contact, x.friction, x.oscillator, "linear")
    assert abs(float(fj.growth_rate(linear.replace(mu=critical)))) > 1e-3
    boundary = fj.hopf_boundary(x.replace(mu=critical), ("P", 1800.0, 3000.0), ("mu", 0.01, 0.89))
    points = np.concatenate([np.stack([b.x, b.y]) for b in boundary.branches], axis=1)
    near = np.abs(points[0] - P).argmin()
    rate = float(fj.growth_rate(x.replace(P=points[0, near], mu=points[1, near])))
    assert abs(rate) < 1e-3
