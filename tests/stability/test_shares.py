"""Shares of parts in modes: the balance, by hand, and against matrices put together in NumPy."""

import functools
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from structures import beam_on_pad, matrices, state_matrix, two_joints
from tools import reference_scene, refusals

shares_of: Any = fj.energy_shares


def rotor() -> fj.Structure:
    """Sums in M, C and K: gyroscopic and circulatory terms, and a joint whose friction falls."""
    M, C, K = matrices(4)
    skew = np.triu(np.ones((4, 4)), 1)
    skew = skew - skew.T
    return fj.ParametricStructure(
        M=[(None, M), ("a", np.diag([0.1, 0.0, 0.2, 0.0]))],
        C=[(None, C), ("Omega", 2.0 * skew)],
        K=[(None, K), ("Omega**2", -1.0 * M), ("mu", 2e5 * skew)],
        joints={"pad": two_joints(4).joints[0]},
        parameters={"a": 0.5, "Omega": 30.0, "mu": 0.4},
        F=[200.0, 50.0, -50.0, -150.0],
    )


def rotor_parts(structure):
    """(M, C, K) of each part, from the numbers of `rotor` and Eq. 43."""
    M, C, K = matrices(4)
    skew = np.sign(np.subtract.outer(-np.arange(4), -np.arange(4)))
    t, n = np.array([1.0, 0, -1, 0]), np.array([0, 1.0, 0, -1])
    ((K_n, K_t),), (law, V) = [(3e6, 1.4e6)], (structure.joints[0].friction, 0.2)
    mu, slope = float(law.mu(V)), (float(law.mu(V + 1e-6)) - float(law.mu(V - 1e-6))) / 2e-6
    joint = K_t * np.outer(t, t) + K_n * np.outer(n, n)
    joint = joint - mu * K_n * np.outer(t, n) + mu * K_t * np.outer(n, t)
    whole = K - 900 * M + 0.4 * 2e5 * skew + joint
    x_0 = np.linalg.solve(whole, [200.0, 50.0, -50.0, -150.0])
    falling = slope * K_n * (n @ x_0) * np.outer(t, t) - slope * K_t * (t @ x_0) * np.outer(n, n)
    none = np.zeros((4, 4))
    return {
        "M 1": (M, none, none),
        "M 2": (0.5 * np.diag([0.1, 0, 0.2, 0]), none, none),
        "C 1": (none, C, none),
        "C 2": (none, 60.0 * skew, none),
        "K 1": (none, none, K),
        "K 2": (none, none, -900 * M),
        "K 3": (none, none, 0.4 * 2e5 * skew),
        "pad": (none, falling, joint),
    }


def test_parts_of_a_rotor():
    """Forms of SciPy's eigenvectors in matrices of each part; gyroscopic terms give nothing."""
    structure = rotor()
    found, parts = shares_of(structure), rotor_parts(structure)
    assert found.parts == tuple(parts)
    M, C, K = (sum(each) for each in zip(*parts.values(), strict=True))
    solved: Any = scipy.linalg.eig(state_matrix(M, C, K))
    s, vectors = solved
    for k, own in enumerate(found.eigenvalues):
        i = np.abs(s - own).argmin()
        assert abs(s[i] - own) < 1e-8 * abs(own)
        x, omega = vectors[:4, i], own.imag
        m, c, stiff = (
            [x.conj() @ X @ x for X in column] for column in zip(*parts.values(), strict=True)
        )
        inertia = 2 * omega * sum(m).real + sum(c).imag
        growth = [-(omega * a.real + b.imag) / inertia for a, b in zip(c, stiff, strict=True)]
        np.testing.assert_allclose(found.growth[k], growth, rtol=0, atol=1e-7 * abs(own))
        np.testing.assert_allclose(found.strain[k], np.real(stiff) / sum(stiff).real, atol=1e-8)
        np.testing.assert_allclose(found.kinetic[k], np.real(m) / sum(m).real, atol=1e-9)
    assert np.abs(found.growth[:, 3]).max() < 1e-12 * np.abs(found.eigenvalues).max()
    assert np.abs(found.growth[:, [6, 7]]).min() > 1e-3  # friction and joint do something


@functools.cache
def brake():
    return beam_on_pad(
        lambda share: fj.FixedContact(2e8 * share, 1e6), 0.4, lambda M, K: 5 * M + 1e-7 * K
    )


@functools.cache
def reduced():
    M, C, K = matrices(6)
    joint = fj.Joint(fj.FixedContact(3e6, 1e6), fj.Coulomb(0.5), (0, 2), (1, 3))
    return fj.reduce(fj.Structure(M, C, K, {"pad": joint}), {"mu": (0.1, 0.6)}, (2e3, 2e4))


BALANCED = {
    "two joints": lambda: two_joints(5),
    "rotor": rotor,
    "scene": reference_scene,
    "brake": brake,
    "reduced": reduced,
}


@pytest.mark.parametrize(
    ("name", "friction_slope"),
    [*((name, True) for name in BALANCED), ("two joints", False), ("scene", False)],
)
def test_contributions_sum_to_the_growth_rate(name, friction_slope):
    x = BALANCED[name]()
    modes = fj.stability(x, friction_slope)
    found = shares_of(x, modes, friction_slope=friction_slope)
    s: Any = np.asarray(modes.eigenvalues)
    s = s[np.asarray(modes.counted) & (s.imag > 0)]
    np.testing.assert_array_equal(found.eigenvalues, s)
    assert (np.abs(found.growth.sum(axis=1) - s.real) < 1e-9 * np.abs(s)).all()
    for shares in (found.strain, found.kinetic):
        np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-12)


@pytest.mark.slow
def test_belt_and_falling_friction_by_hand():
    """Of two degrees of freedom: friction gives mu (K_n + K_t) Im(x1* x2)/(2 omega m |x|^2)."""
    m, K_n, K_t, mu = 2.0, 3e5, 1e5, 0.6
    c, k = np.array([3.0, 5.0]), np.array([4e5, 3e5])
    joint = fj.Joint(fj.FixedContact(K_n, K_t), fj.Coulomb(mu), 0, 1)
    found = shares_of(fj.Structure(m * np.eye(2), np.diag(c), np.diag(k), joint))
    assert found.parts == ("M", "C", "K", "joint_1")
    s, shapes = found.eigenvalues, []
    for each in s:  # the first line of the equations of motion
        shapes.append([mu * K_n, m * each**2 + c[0] * each + k[0] + K_t])
    x: Any = np.array(shapes)
    size = np.abs(x) ** 2
    friction = mu * (K_n + K_t) * (x[:, 0].conj() * x[:, 1]).imag
    growth = friction / (2 * s.imag * m * size.sum(axis=1))
    damping = -(size @ c) / (2 * m * size.sum(axis=1))
    np.testing.assert_allclose(
        found.growth, np.stack([0 * growth, damping, 0 * growth, growth], 1), atol=1e-9
    )
    spring = size @ [K_t, K_n] + mu * (K_t - K_n) * (x[:, 0].conj() * x[:, 1]).real
    np.testing.assert_allclose(found.strain[:, 3], spring / (spring + size @ k), rtol=1e-9)
    assert found.growth[0, 3] > 0 > found.growth[1, 3]  # it squeals in one mode only
    # A mass on a belt under the load P: mu' P is a damper, c/2m and mu' P/2m are rates.
    law = fj.ExponentialStribeck(0.6, 0.3, 0.5)
    joint = fj.Joint(fj.FixedContact(0.0, 7.0, 20.0), law, 0, None, 0.2)
    found = shares_of(fj.Structure([[2.0]], [[0.4]], [[50.0]], {"belt": joint}))
    slope = -0.3 / 0.5 * np.exp(-0.2 / 0.5)
    np.testing.assert_allclose(found.growth, [[0, -0.1, 0, -slope * 20 / 4]], atol=1e-12)
    np.testing.assert_allclose(found.strain, [[0, 0, 50 / 57, 7 / 57]])
    np.testing.assert_array_equal(found.kinetic, [[1, 0, 0, 0]])
    title, row = repr(found).splitlines()
    assert title.split("  ")[0] == "frequency [Hz]" and "fed by" in title
    assert row.split() == ["0.793356", "1.911", "belt", "+2.01", "C", "-0.1", "K", "88%"]


def test_names_and_the_table():
    """Parts of one name are added up; modes without damping have none to name."""
    structure, names = rotor(), {"K 2": "body", "K 1": "body", "pad": "lining"}
    plain, named = shares_of(structure), shares_of(structure, names=names)
    assert named.parts == ("M 1", "M 2", "C 1", "C 2", "body", "K 3", "lining")
    np.testing.assert_allclose(named.growth[:, 4], plain.growth[:, 4:6].sum(axis=1))
    np.testing.assert_allclose(named.strain[:, 4], plain.strain[:, 4:6].sum(axis=1))
    unstable = (plain.eigenvalues.real > 0).sum()
    lines = repr(shares_of(brake())).splitlines()
    assert len(repr(plain).splitlines()) == 5 and unstable > 0
    rates = [float(line.split()[1]) for line in lines[1:]]
    assert rates[0] == max(rates) and sum(rate < 0 for rate in rates) == 8
    free = shares_of(fj.Structure(np.eye(2), None, np.diag([1.0, 2.0]), ()))
    assert [line.split()[2:4] for line in repr(free).splitlines()[1:]] == [["-", "-"]] * 2


test_refusals = refusals(
    [
        ((3.0,), {}, "x must be a Scene or a Structure"),
        ((rotor(), "all"), {}, "modes must be a Stability"),
        ((rotor(), fj.stability(two_joints(5))), {}, r"modes must be of 4 degrees .* \(10, 5\)"),
        ((rotor(),), {"names": {"K 4": "pad"}}, "names must be of M 1, .* K 3, pad, got 'K 4'"),
        ((rotor(),), {"friction_slope": 1}, "friction_slope must be True or False"),
    ],
    lambda given, options: shares_of(*given, **options),
    kind=(ValueError, TypeError),
)
