"""Modes over a quantity: closed forms of crossing, veering and coalescence, and brute force."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import ortho_group

import fractaljax as fj
from structures import beam_on_pad, hoffmann, matrices, state_matrix, two_joints
from tools import reference_scene, refusals

track: Any = fj.track_modes
ODD, EVEN = np.linspace(-0.5, 0.5, 5), np.linspace(-0.5, 0.5, 6)  # through 0 and past it
TURN = ortho_group.rvs(2, random_state=0)


def oscillators(coupling, turn=None) -> fj.Structure:
    """Two of unit mass and stiffness 1 + a and 1 - a, with a spring between them."""
    T = np.eye(2) if turn is None else turn
    fixed, split = np.array([[1, coupling], [coupling, 1]]), np.diag([1.0, -1.0])
    K = [(None, T.T @ fixed @ T), ("a", T.T @ split @ T)]
    return fj.ParametricStructure(np.eye(2), None, K, parameters={"a": 0.3})


def assert_modal(structure, tracks):
    """Every pair (s, x) solves the equation of the structure at its value, and the largest is 1."""
    for value, row, shapes in zip(tracks.values, tracks.eigenvalues, tracks.shapes, strict=True):
        M, C, K = map(np.asarray, fj.assemble(structure.replace(**{tracks.name: value})))
        for s, x in zip(row, shapes, strict=True):
            if np.isfinite(s):
                residual = (s**2 * M + s * C + K) @ x
                assert np.abs(residual).max() < 2e-7 * np.abs(K).max()
                assert x[np.abs(x).argmax()] == pytest.approx(1)


@pytest.mark.parametrize("coupling", [0.3, 0.02, 1e-3])
@pytest.mark.parametrize("grid", [ODD, EVEN], ids=["odd", "even"])
def test_veering(coupling, grid):
    """Frequencies stay apart and shapes change sides, also far narrower than the steps."""
    found = track(oscillators(coupling), "a", grid)
    root = np.sqrt(grid**2 + coupling**2)
    exact = np.sqrt(np.stack([1 - root, 1 + root], axis=1))
    np.testing.assert_allclose(found.eigenvalues, 1j * exact, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.frequencies, exact / (2 * np.pi), atol=1e-9)
    # Of the lower mode, coupling x2 = -(a + root) x1.
    x = found.shapes[:, 0]
    np.testing.assert_allclose(coupling * x[:, 1], -(grid + root) * x[:, 0], atol=1e-9)
    assert found.mac.shape == (len(grid) - 1, 2) and found.mac.min() > 0.8
    assert_modal(oscillators(coupling), found)


@pytest.mark.parametrize("turn", [None, TURN], ids=["plain", "turned"])
@pytest.mark.parametrize("grid", [ODD, EVEN, [-0.5, 0.0, 1e-13, 0.4]], ids=str)
def test_crossing_keeps_identity(grid, turn):
    """Without coupling, frequencies cross, also at a value; shapes do not change."""
    structure = oscillators(0.0, turn)
    found, a = track(structure, "a", grid), np.array(grid)
    exact = np.sqrt(np.stack([1 + a, 1 - a], axis=1))
    np.testing.assert_allclose(found.eigenvalues, 1j * exact, atol=1e-9)
    shapes = np.eye(2) if turn is None else turn
    shapes = shapes / shapes[np.arange(2), np.abs(shapes).argmax(axis=1)][:, None]
    np.testing.assert_allclose(found.shapes, np.broadcast_to(shapes, (len(a), 2, 2)), atol=1e-6)
    assert found.mac.min() > 0.95


def test_equal_modes_stay_apart():
    """Two that are equal everywhere and a third that crosses both."""
    T = ortho_group.rvs(3, random_state=1)
    K = [(None, T.T @ np.diag([2.0, 2.0, 1.0]) @ T), ("a", T.T @ np.diag([0.0, 0.0, 1.0]) @ T)]
    structure = fj.ParametricStructure(np.eye(3), None, K, parameters={"a": 0.0})
    a = np.linspace(0, 2, 6)
    found = track(structure, "a", a)
    exact = np.sqrt(np.stack([1 + a, 2 + 0 * a, 2 + 0 * a], axis=1))
    np.testing.assert_allclose(found.eigenvalues.imag, exact, atol=1e-7)
    assert found.mac.min() > 0.9
    # Each of the equal shapes is the same at all values, and at a = 1 all three are equal.
    np.testing.assert_allclose(found.shapes, found.shapes[:1].repeat(6, axis=0), atol=1e-6)


GRIDS = {
    "past it": np.linspace(0.3, 1.2, 8),
    "on it": np.linspace(0.3, 1.2, 7),
    "about it": np.array([0.5, 1.0]),
    "on it at once": np.array([0.1, 0.75, 1.2]),
}


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("backward", [False, True])
def test_coalescence(name, backward):
    """The higher frequency and the faster growth are one mode, in both directions."""
    mu = GRIDS[name][::-1] if backward else GRIDS[name]
    found = track(hoffmann(), "mu", mu)
    root = np.sqrt(1 - 4 * mu / 3 + 0j).conj()  # past it -i |root|, so that i sqrt(2 + root) grows
    exact = 1j * np.sqrt(np.stack([2 - root, 2 + root], axis=1))
    upper = found.eigenvalues[0].imag + found.eigenvalues[0].real
    np.testing.assert_allclose(found.eigenvalues[:, np.argsort(upper)], exact, atol=1e-7)
    past = np.sign(np.round(mu - 0.75, 9))
    across = past[1:] * past[:-1] <= 0
    assert (found.mac[across] <= 0.5).all() and (found.mac[~across] > 0.8).all()
    ratio = -found.eigenvalues.real / np.abs(found.eigenvalues)
    np.testing.assert_array_equal(found.damping_ratios, ratio)


@pytest.mark.parametrize("c", [1e-3, 0.1])
@pytest.mark.parametrize("backward", [False, True])
def test_crossing_of_flutter(c, backward):
    """s^2 + c s + 2 -+ (1 - 4 mu/3)^.5 = 0 has the root i sqrt(2) where mu = 3/4 (1 + 2 c^2)."""
    mu = np.linspace(0.4, 1.2, 6)[:: -1 if backward else 1]
    found = track(hoffmann(c * np.eye(2)), "mu", mu)
    (crossing,) = found.crossings()
    assert crossing.value == pytest.approx(0.75 * (1 + 2 * c**2), rel=1e-12)
    assert crossing.frequency == pytest.approx(np.sqrt(2) / (2 * np.pi), rel=1e-10)
    assert crossing.starts
    grows = found.growth_rates[0 if backward else -1] > 0
    assert np.flatnonzero(grows).tolist() == [crossing.mode]


@pytest.mark.parametrize("c", [0.02, 3.0])
def test_crossing_of_divergence(c):
    """A spring that loses its stiffness, with little damping and with much."""
    K = [(None, [[0.3, 0.0], [0.0, 2.0]]), ("-a", [[1.0, 0.0], [0.0, 0.0]])]
    structure = fj.ParametricStructure(np.eye(2), c * np.eye(2), K, parameters={"a": 0.0})
    (crossing,) = track(structure, "a", np.linspace(0, 1, 4)).crossings()
    assert crossing.value == pytest.approx(0.3, abs=1e-12)
    assert crossing.frequency == 0 and crossing.starts


@pytest.mark.slow
def test_crossings_without_damping_and_of_a_joint():
    """Neutral modes change no sign, whatever their rounding."""
    assert track(hoffmann(), "mu", np.linspace(0.1, 0.7, 6)).crossings() == []
    found = track(two_joints(6), "mu_s", np.linspace(0.31, 1.2, 6))
    for crossing in found.crossings():
        s: Any = np.asarray(fj.stability(two_joints(6).replace(mu_s=crossing.value)).eigenvalues)
        near = s[np.abs(s - 2j * np.pi * crossing.frequency).argmin()]
        assert abs(near.real) < 1e-11 * abs(near)
    assert len(found.crossings()) > 0


def brute_force(structure, name, values, steps):
    """Eigenvalues (p, k) at the values, each nearest to its own one small step before."""
    at = np.arange((len(values) - 1) * steps + 1) / steps
    fine, found = jnp.interp(at, np.arange(len(values)), values), []

    def matrices_at(value):
        return fj.assemble(structure.replace(**{name: value}))

    for M, C, K in zip(*map(np.asarray, jax.jit(jax.vmap(matrices_at))(fine)), strict=True):
        s = np.linalg.eigvals(state_matrix(M, C, K))
        if found:
            s = s[linear_sum_assignment(np.abs(found[-1][:, None] - s[None]))[1]]
        found.append(s)
    s = np.stack(found)[::steps]
    return s[:, s[0].imag > 0]


def assert_same_tracks(found, exact, rtol):
    order = np.argsort(found.eigenvalues[0].imag), np.argsort(exact[0].imag)
    left, right = found.eigenvalues[:, order[0]], exact[:, order[1]]
    assert np.abs(left - right).max() < rtol * np.abs(right).max()
    assert found.mac.min() > 0.8


UNEQUAL = {  # a coalescence that is missed, a crossing of friction, and much of both
    "hoffmann": (hoffmann(np.diag([0.01, 0.1])), "mu", np.linspace(0.3, 1.2, 6), 400),
    "two joints": (two_joints(6), "mu_s", np.linspace(0.31, 1.2, 6), 200),
    "one joint": (two_joints(4), "left.K_n", np.linspace(1e5, 1e7, 4), 400),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", UNEQUAL)
def test_brute_force(name):
    """Unequal damping leaves one continuation, which small steps find as well."""
    structure, quantity, values, steps = UNEQUAL[name]
    found = track(structure, quantity, values)
    assert_same_tracks(found, brute_force(structure, quantity, values, steps), 1e-8)
    assert_modal(structure, found)


def brake() -> fj.Structure:
    return beam_on_pad(
        lambda share: fj.FixedContact(2e8 * share, 0.0), 0.3, lambda M, K: 5 * M + 1e-7 * K
    )


@pytest.mark.slow
def test_coarse_steps_of_a_brake_are_those_of_fine_ones():
    """150 modes, of which four become unstable."""
    structure = brake()
    fine = track(structure, "mu", np.linspace(0.26, 0.38, 5))
    coarse = track(structure, "mu", [0.26, 0.38])
    assert fine.eigenvalues.shape == (5, 150) and (fine.growth_rates > 0).any(axis=0).sum() == 4
    np.testing.assert_allclose(fine.eigenvalues[::4], coarse.eigenvalues, rtol=1e-9)
    assert fine.mac.min() > 0.8


@pytest.mark.slow
@pytest.mark.optimised
def test_brake_by_brute_force():
    structure, values = brake(), np.linspace(0.02, 0.6, 4)
    found = track(structure, "mu", values)
    assert_same_tracks(found, brute_force(structure, "mu", values, 100), 1e-8)


def test_modes_leave_and_enter_a_band():
    """The eigenvalues of the whole structure where they are in the band, and NaN where not."""
    M, C, K = matrices(5)
    whole = fj.ParametricStructure(M, C, [("k", K)], parameters={"k": 1.0})
    band, k = (6000.0, 1.3e4), np.linspace(0.7, 2.0, 6)
    reduced = fj.reduce(whole, {"k": (0.7, 2.0)}, band, 1e-8)
    found, exact = track(reduced, "k", k), track(whole, "k", k).eigenvalues
    inside = (exact.imag > band[0]) & (exact.imag <= band[1])
    exact = np.where(inside, exact, np.nan)[:, inside.any(axis=0)]
    assert np.isnan(exact).any() and found.eigenvalues.shape == exact.shape
    # Columns are in the order of the frequencies at which modes appear.
    first = np.isfinite(exact).argmax(axis=0), range(exact.shape[1])
    exact = exact[:, np.argsort(np.imag(exact[first]), kind="stable")]
    np.testing.assert_allclose(found.eigenvalues, exact, rtol=1e-7)
    there = np.isfinite(found.eigenvalues)
    np.testing.assert_array_equal(np.isfinite(found.mac), there[1:] & there[:-1])
    np.testing.assert_array_equal(np.isfinite(found.shapes).all(axis=2), there)


@pytest.mark.slow
def test_scene_rigid_body_open_joint_and_critical_damping():
    """A scene has the modes of its `stability`; what K does not hold is left out."""
    scene = reference_scene()
    found = track(scene, "mu_s", [0.3, 0.5])
    for value, s in zip(found.values, found.eigenvalues, strict=True):
        exact: Any = np.asarray(fj.stability(scene.replace(mu_s=value)).eigenvalues)
        exact = exact[exact.imag > 0]
        np.testing.assert_allclose(np.sort_complex(s), np.sort_complex(exact), rtol=1e-9)
    free: Any = [("k", [[1.0, -1.0], [-1.0, 1.0]])]
    structure = fj.ParametricStructure(np.eye(2), None, free, parameters={"k": 1.0})
    found = track(structure, "k", [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.eigenvalues[:, 0], 1j * np.sqrt([2, 4, 6]))
    assert found.eigenvalues.shape == (3, 1) and "k: 3 values, modes: 1" in repr(found)
    assert track(structure, "k", [1.0]).mac.shape == (0, 1)
    # And those beyond it are the ones before.
    joint = fj.Joint(fj.FixedContact(1.0, 0.5, 3.0), fj.Coulomb(0.3), 0, 1, preload=True)
    M, K = np.eye(2), np.diag([2.0, 3.0])
    structure = fj.Structure(M, 0.01 * K, K, joint, F=[0.0, -4.0])
    found = track(structure, "P", [3.0, 0.5, 2.0])
    assert np.isnan(found.eigenvalues[1]).all() and np.isnan(found.mac).all()
    np.testing.assert_allclose(found.eigenvalues[0], found.eigenvalues[2], rtol=1e-12)
    # A mode goes on as the slower of two real eigenvalues; the other one appears.
    c = np.array([0.5, 1.5, 3.0, 4.0])
    structure = fj.ParametricStructure([[1.0]], [("c", [[1.0]])], [[1.0]], parameters={"c": 1.0})
    found = track(structure, "c", c)
    root = np.sqrt(c**2 / 4 - 1 + 0j)
    other = np.where(c > 2, -c / 2 - root, np.nan)
    columns = np.argsort(np.isnan(found.eigenvalues).sum(axis=0))
    np.testing.assert_allclose(found.eigenvalues[:, columns[0]], -c / 2 + root, atol=1e-9)
    np.testing.assert_allclose(found.eigenvalues[:, columns[1]], other, atol=1e-9)


test_refusals = refusals(
    [
        ("brake", "mu", [1.0], "x must be a Scene or a Struct"),
        (hoffmann(), "nu", [1.0], "no quantity 'nu'"),
        (hoffmann(), "mu", [[1.0]], "mu must be a list"),
        (two_joints(4), "V", [0.1, -1], "V must be at least 0"),
        (hoffmann(), "mu", [1.0], 1, "friction_slope must be True or False"),
    ],
    lambda x, name, values, slope=True: track(x, name, values, friction_slope=slope),
    kind=(ValueError, TypeError),
)


@pytest.mark.parametrize(("a", "b"), [(2.0, 1.5), (3.0, 7.1), (1e8, 1.3e8)])
@pytest.mark.parametrize("damping", [0.0, 1e-11])
def test_undamped_modes_cross_where_their_frequencies_meet(a, b, damping):
    """[[a, -mu], [mu, b]] has equal eigenvalues at |a - b| = 2 mu, in any order of the values."""
    exact, scale = abs(a - b) / 2, np.sqrt((a + b) / 2)
    x = fj.ParametricStructure(
        np.eye(2),
        damping * scale * np.eye(2),
        [(1, [[a, 0.0], [0.0, b]]), ("mu", [[0.0, -1.0], [1.0, 0.0]])],
        parameters={"mu": 0.1 * exact},
    )
    values = np.linspace(0.0, 2.4, 7) * exact
    for order in (values, values[::-1]):
        (found,) = fj.track_modes(x, "mu", order).crossings()
        assert found.value == pytest.approx(exact, rel=1e-11) and found.starts
        assert found.frequency == pytest.approx(scale / (2 * np.pi), rel=1e-7)
