"""Where friction with memory begins to squeal, against NumPy on a field written here once more."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import fractaljax as fj
from fractaljax._stability.summary import stability_table
from tools import both_modes

BRAKE = fj.brake_scene()
DRY = BRAKE.replace(friction=fj.ExponentialStribeck(0.4, 0.25, 0.1))
FRACTAL = BRAKE.replace(friction=fj.LuGre(0.4, 0.25, 0.1, 1e6, 0.0))
FIXED = fj.Scene(fj.FixedContact(4e8, 1.9e8), fj.LuGre(0.4, 0.25, 0.1, 1e5, 1.0), BRAKE.oscillator)
LAWS = (0.5, 0.3, 1.0, 50.0, 0.1), (0.5, 0.3, 1.0, 20.0, 0.2)
CHAIN = fj.Structure(
    np.diag([1.0, 2.0, 1.5]),
    0.02 * np.eye(3),
    [[6.0, -2.0, 0.0], [-2.0, 5.0, -1.0], [0.0, -1.0, 4.0]],
    (
        fj.Joint(fj.FixedContact(2.0, 1.0), fj.LuGre(*LAWS[0]), 0, 1, V=0.7),
        fj.Joint(fj.FixedContact(1.5, 0.5), fj.LuGre(*LAWS[1]), 2, 1, V=0.7),
    ),
    F=[0.3, 3.0, -0.2],
)


def growth_rate(matrices, joints, F, factor) -> float:
    """By the Jacobian of [x, v, z] about steady sliding, with the friction times a factor.

    A joint is (t, n, K_n, K_t, law, w) with LuGre's law; its faces have the loads K_n n.x along t
    and -K_t t.x along n.
    """
    M, C, K = matrices
    faces = []
    for t, normal, K_n, K_t, law, w in joints:
        K = K + K_n * np.outer(normal, normal) + K_t * np.outer(t, t)
        faces += [(t, K_n * normal, law, w), (normal, -K_t * t, law, w)]
    coupled = np.array(K)
    for along, load, (mu_s, mu_d, v_0, *_), w in faces:
        coupled -= factor * (mu_d + (mu_s - mu_d) * np.exp(-w / v_0)) * np.outer(along, load)
    x, n, k = np.linalg.solve(coupled, F), len(M), len(faces)
    J = np.zeros((2 * n + k, 2 * n + k))
    inverse = np.linalg.inv(M)
    J[:n, n : 2 * n] = np.eye(n)
    J[n : 2 * n, : 2 * n] = -inverse @ np.hstack([K, C])
    for i, (along, load, (mu_s, mu_d, v_0, s_0, s_1), w) in enumerate(faces, start=2 * n):
        fall = (mu_s - mu_d) * np.exp(-w / v_0)
        g, slope = mu_d + fall, -fall / v_0
        # dz/dt = w - s_0 w z/g(w) with z = g/s_0, and w falls as the surface moves along.
        J[i, i], J[i, n : 2 * n] = -s_0 * w / g, -w * slope / g * along
        push = factor * inverse @ along
        J[n : 2 * n] += (load @ x) * s_1 * np.outer(push, J[i])
        J[n : 2 * n, i] += (load @ x) * s_0 * push
        J[n : 2 * n, :n] += g * np.outer(push, load)
    return float(np.linalg.eigvals(J).real.max())


def chain_growth(factor: float) -> float:
    e, joints = np.eye(3), []
    for t, K_n, K_t, law in ((e[0], 2.0, 1.0, LAWS[0]), (e[2], 1.5, 0.5, LAWS[1])):
        joints.append((t, e[1], K_n, K_t, law, 0.7))
    matrices = [np.asarray(X) for X in (CHAIN.M, CHAIN.C, CHAIN.K)]
    return growth_rate(matrices, joints, np.array([0.3, 3.0, -0.2]), factor)


def scene_growth(factor: float) -> float:
    o: Any = FIXED.oscillator
    m, F, V = float(o.m), float(o.F), float(o.V)
    omega, xi = np.array([o.omega_1, o.omega_2]), np.array([o.xi_1, o.xi_2])
    matrices = m * np.eye(2), m * np.diag(2 * xi * omega), m * np.diag(omega**2)
    joint = (*np.eye(2), 4e8, 1.9e8, (0.4, 0.25, 0.1, 1e5, 1.0), V)
    return growth_rate(matrices, [joint], F / np.sqrt(2) * np.array([1, -1]), factor)


CASES = {
    # The mechanism, its growth rate over the factor, and a quantity with its value.
    "scene": (FIXED, scene_growth, "sigma_1", 1.0),
    "structure": (CHAIN, chain_growth, "joint_1.K_n", 2.0),
}


def critical_friction(name, value):
    x, _, quantity, _ = CASES[name]
    joint = None if name == "scene" else "joint_1"
    return fj.critical_friction(x.replace(**{quantity: value}), joint=joint)


@pytest.mark.parametrize("name", CASES)
def test_critical_friction(name):
    """The factor at which an eigenvalue of the Jacobian becomes imaginary."""
    x, growth, _, value = CASES[name]
    joint = x.joints_by_name()["" if name == "scene" else "joint_1"]
    np.testing.assert_allclose(fj.growth_rate(x), growth(1.0), rtol=1e-7)
    factors = np.linspace(1e-3, 10, 400)
    above = next(i for i, f in enumerate(factors) if growth(f) > 0)
    truth = brentq(growth, factors[above - 1], factors[above], xtol=1e-14)
    np.testing.assert_allclose(
        critical_friction(name, value), truth * joint.coefficient(), rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_derivatives_of_the_critical_friction(name):
    """In both modes beside differences, under `jit` and `vmap`."""
    place = np.array([CASES[name][3]])
    critical = jax.jit(lambda x: critical_friction(name, x[0]))
    _, forward, reverse = jax.jit(lambda x: both_modes(critical, x))(place)
    places = place * (1 + 1e-3 * np.array([-2, -1, 0, 1, 2]))[:, None]
    ends = np.asarray(jax.vmap(critical)(places))
    np.testing.assert_allclose(ends[2], critical_friction(name, place[0]), rtol=1e-12)
    slope = (8 * (ends[3] - ends[1]) - (ends[4] - ends[0])) / (12 * 1e-3 * place[0])
    np.testing.assert_allclose([forward[0], reverse[0]], slope, rtol=1e-5)


def test_stiff_bristles_have_the_onset_of_dry_friction():
    """Of a fractal joint, whose stiffness follows the friction.

    The difference is a/sigma_0 + b/sigma_0^2.
    """
    dry = float(fj.critical_friction(DRY))
    sigma = np.array([1e6, 1e7, 1e8])
    off = [dry - float(fj.critical_friction(FRACTAL.replace(sigma_0=s))) for s in sigma]
    assert 0 < off[0] < 1e-5
    a, b = np.linalg.solve(np.array([1 / sigma[:2], sigma[:2] ** -2.0]).T, off[:2])
    np.testing.assert_allclose(off[2], a / sigma[2] + b / sigma[2] ** 2, rtol=0.05)
    never = fj.Scene(fj.FixedContact(4e8, 0.0), fj.Dahl(0.4, 1e5), BRAKE.oscillator)
    assert fj.critical_friction(never) == jnp.inf


@pytest.mark.slow
def test_boundary():
    """The growth rate is 0 on it, on one side below; near that of dry friction."""
    window: Any = ("D", 2.35, 2.45), ("G", 1e-10, 3e-10)
    found = fj.hopf_boundary(FRACTAL, *window, lines=9)
    dry = fj.hopf_boundary(DRY, *window, lines=9)
    assert len(found.branches) == len(dry.branches) > 0 and found.untraced == 0
    for branch, beside in zip(found.branches, dry.branches, strict=True):
        rates = jax.vmap(lambda D, G: fj.growth_rate(FRACTAL.replace(D=D, G=G)))(branch.x, branch.y)
        np.testing.assert_allclose(rates, 0, atol=1e-6)
        ends = [np.array([b.x[[0, -1]], np.log(b.y[[0, -1]])]) for b in (branch, beside)]
        np.testing.assert_allclose(*ends, rtol=1e-3)
        modes = fj.stability(FRACTAL.replace(D=branch.x[3], G=branch.y[3]))
        np.testing.assert_allclose(branch.frequency[3], modes.frequency, rtol=1e-9)


def test_tracks():
    """Each value has the eigenvalues of `stability`, and each column is one mode."""
    factors = np.linspace(0.1, 0.5, 9)
    tracks = fj.track_modes(CHAIN, "joint_2.mu_s", 0.3 + factors)
    for value, at in zip(tracks.values, np.asarray(tracks.eigenvalues), strict=True):
        modes = fj.stability(CHAIN.replace(**{"joint_2.mu_s": value})).eigenvalues
        for one in at:
            assert abs(np.asarray(modes) - one).min() < 1e-9 * abs(one)
    s: Any = np.asarray(tracks.eigenvalues)
    oscillating = s[:, np.abs(s[0].imag) > 0.1]
    assert oscillating.shape[1] == 3
    assert (np.abs(np.diff(oscillating.imag, axis=0)) < 0.2).all()
    assert np.isfinite(tracks.shapes).all()


def test_tables():
    """What the command prints of a scene and a structure; what has no steady sliding says so."""
    text = stability_table(FIXED)
    assert f"{fj.critical_friction(FIXED):.6g}" in text and "eigenvalue 6 [1/s]" in text
    assert f"{fj.growth_rate(CHAIN):+.6g}" in stability_table(CHAIN)
    with pytest.raises(ValueError, match=r"must be without memory here.* got LuGre"):
        fj.energy_shares(FIXED)
    free = fj.Structure(np.eye(1), np.zeros((1, 1)), np.zeros((1, 1)), (
        fj.Joint(fj.FixedContact(0.0, 0.0, 1.0), fj.Dahl(0.4, 10.0), [1.0], V=1.0),
    ))  # fmt: skip
    with pytest.raises(ValueError, match="does not slide steadily under F"):
        stability_table(free)
