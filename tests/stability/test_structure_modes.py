"""Modes of structures: 50-digit eigenvalues and slopes, SciPy, beams, rigid bodies, rounding."""

import copy
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import fractaljax as fj
from fractaljax._stability.quadratic import leading
from structures import (
    DIGITS,
    beam,
    eigenvalue_near,
    linearised,
    matrices,
    numbers_of,
    slope_of,
    state_matrix,
    two_joints,
)
from tools import both_gradients, both_modes, reference_scene

slow = pytest.mark.slow


def arrays_of(structure, friction_slope=True):
    return [np.asarray(X) for X in fj.assemble(structure, friction_slope)]


def scipy_modes(M, C, K, **options) -> Any:
    """Eigenvalues of the quadratic problem by SciPy, as a generalised linear one."""
    n = len(M)
    zero, one = np.zeros((n, n)), np.eye(n)
    scale, unit = np.sqrt(np.abs(K).max() / np.abs(M).max()), np.abs(M).max()
    A = np.block([[zero, one], [-K / unit / scale**2, -C / unit / scale]])
    return scale * scipy.linalg.eig(A, scipy.linalg.block_diag(one, M / unit), right=False)


def paired(left, right, size: Any = 1.0):
    """Distances (k, k), and the places in it of the nearest pairs."""
    left, right = np.asarray(left), np.asarray(right)
    assert left.shape == right.shape
    apart = np.abs(left[:, None] - right[None])
    return apart, scipy.optimize.linear_sum_assignment(apart / size)


def assert_same_set(left, right, atol):
    apart, pairs = paired(left, right)
    assert apart[pairs].max() <= atol


# --- against many digits ------------------------------------------------------------------

STRUCTURE = two_joints(4)
JOINT_QUANTITIES = ("K_n", "K_t", "mu_s", "mu_m", "v_m", "V")
PLACES = {
    "M": [(0, 0), (1, 3), (2, 2)],
    "C": [(0, 0), (1, 2), (3, 0)],
    "K": [(1, 1), (0, 3), (2, 1)],
    "F": [(0,), (2,)],
}


@functools.cache
def critical():
    """The critical eigenvalue of `STRUCTURE` by SciPy."""
    s = scipy_modes(*arrays_of(STRUCTURE))
    s = s[s.imag > 0]
    return complex(s[s.real.argmax()])


def moved(name, *place):
    """A function from dp to the numbers of `STRUCTURE` with one of them moved by dp."""

    def change(dp):
        new = copy.deepcopy(numbers_of(STRUCTURE))
        if name in "MCKF":
            entry = place if len(place) == 2 else (place[0], 0)
            new[name][entry] += dp
            if name == "M" and entry[0] != entry[1]:
                new[name][entry[::-1]] += dp
        else:
            new["joints"][place[0]][name] += dp
        return new

    return change


@pytest.mark.parametrize("friction_slope", [True, False])
def test_the_assembled_matrices_are_the_jacobians_of_the_joints_forces(friction_slope):
    with mp.workdps(DIGITS):
        expected = linearised(numbers_of(STRUCTURE), friction_slope)
    for X, exact in zip(arrays_of(STRUCTURE, friction_slope), expected, strict=True):
        exact = np.array(exact.tolist(), dtype=float)
        np.testing.assert_allclose(X, exact, rtol=0, atol=1e-13 * np.abs(exact).max())


@pytest.mark.slow
def test_growth_rate_and_its_derivatives():
    """By every quantity of each joint and by entries of the matrices, in both modes."""
    exact = float(eigenvalue_near(numbers_of(STRUCTURE), True, critical()).real)
    assert exact > 0  # or the test would be of little use
    assert fj.growth_rate(STRUCTURE) == pytest.approx(exact, abs=1e-12 * abs(critical()))
    joints = numbers_of(STRUCTURE)["joints"]
    at: dict[str, Any] = {name: getattr(STRUCTURE, name) for name in "MCKF"}
    slopes = {}
    for i, joint in enumerate(STRUCTURE.joint_names):
        for name in JOINT_QUANTITIES:
            x = at[f"{joint}.{name}"] = float(joints[i][name])
            slopes[f"{joint}.{name}"] = slope_of(moved(name, i), critical(), x)
    entries = {
        (name, place): slope_of(
            moved(name, *place), critical(), float(np.abs(getattr(STRUCTURE, name)).max())
        )
        for name, places in PLACES.items()
        for place in places
    }
    rate = lambda x: fj.growth_rate(STRUCTURE.replace(**x))  # noqa: E731
    for found in jax.jit(lambda x: both_gradients(rate, x))(at):
        for name, slope in slopes.items():
            assert float(found[name]) == pytest.approx(slope, rel=1e-9), name
        for (name, place), slope in entries.items():
            # M is symmetric: its two entries move together.
            twice = 2 if name == "M" and place[0] != place[1] else 1
            scale = np.abs(found[name]).max()
            assert found[name][place] * twice == pytest.approx(slope, abs=1e-9 * scale)
        np.testing.assert_array_equal(found["M"], found["M"].T)


@slow
def test_derivatives_of_all_eigenvalues_and_shapes():
    def everything(K_n):
        modes = fj.stability(STRUCTURE.replace(**{"left.K_n": K_n[0]}))
        s, shapes = modes.eigenvalues, modes.shapes.ravel()
        parts = s.real, s.imag, shapes.real, shapes.imag, modes.damping_ratios, modes.margin[None]
        return jnp.concatenate(parts)

    found = jax.jit(lambda K_n: both_modes(everything, K_n))
    at, h, ends = jnp.array([3e6]), 3.0, [16, 80, 88]
    wanted = np.split((found(at + h)[0] - found(at - h)[0]) / (2 * h), ends)
    for slopes in found(at)[1:]:
        for slope, truth in zip(np.split(slopes[:, 0], ends), wanted, strict=True):
            np.testing.assert_allclose(slope, truth, rtol=0, atol=1e-5 * np.abs(truth).max())


# --- against the closed form --------------------------------------------------------------


@slow
def test_derivatives_of_every_order_are_those_of_the_closed_form():
    names, at = ("K_n", "K_t", "mu_s", "mu_m", "v_m", "V"), [4e8, 2e8, 0.4, 0.25, 0.5, 0.15]
    scene = reference_scene()
    first, higher = [], []
    for x in (fj.Structure.from_scene(scene), scene):

        def rate(values, x=x):
            return fj.growth_rate(x.replace(**dict(zip(names, values, strict=True))))

        def of_stiffness(K_n, x=x):
            return fj.growth_rate(x.replace(K_n=K_n), False)

        second = jax.grad(jax.grad(of_stiffness))
        first.append(jax.jit(lambda x, rate=rate: both_gradients(rate, x))(at))
        higher.append([jax.jit(f)(4e8) for f in (second, jax.jacfwd(second))])
    np.testing.assert_allclose(*first, rtol=1e-10)
    np.testing.assert_allclose(*higher, rtol=1e-10)


@jax.jit
@jax.grad
def slope_by_friction(mu, x):
    return fj.growth_rate(x.replace(mu=mu))


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-9])
def test_derivatives_towards_coalescing_modes_are_those_of_the_closed_form(distance):
    scene = reference_scene().replace(friction=fj.Coulomb(0.5), xi_1=0.003, xi_2=0.003)
    a, b = scene.oscillator.omega_1**2, scene.oscillator.omega_2**2
    K_n, K_t = 4e8, 2e8
    mu = float(abs(a + K_t - b - K_n) / (2 * np.sqrt(K_n * K_t))) * (1 + distance)
    slopes = [float(slope_by_friction(mu, x)) for x in (fj.Structure.from_scene(scene), scene)]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-14 / distance + 1e-9)


# --- against SciPy, and structures of known modes -----------------------------------------


@pytest.mark.parametrize("n", [4, pytest.param(12, marks=slow)])
def test_eigenvalues_and_shapes(n):
    structure = two_joints(n)
    M, C, K = arrays_of(structure)
    modes = fj.stability(structure)
    omega = np.abs(modes.eigenvalues).max()
    assert_same_set(modes.eigenvalues, scipy_modes(M, C, K), 1e-12 * omega)
    assert (np.diff(modes.eigenvalues.real) <= 0).all()
    assert fj.growth_rate(structure) == pytest.approx(modes.growth_rate, abs=1e-12 * omega)
    for s, x in zip(np.asarray(modes.eigenvalues), np.asarray(modes.shapes), strict=True):
        assert np.abs(x).max() == pytest.approx(1)
        assert x[np.abs(x).argmax()] == pytest.approx(1)
        assert np.abs((s**2 * M + s * C + K) @ x).max() <= 1e-12 * np.abs(K).max()
    unstable, least = modes.unstable(), modes.least_damped()
    assert unstable[0].growth_rate == modes.growth_rate
    assert unstable[0].largest == np.abs(modes.shapes[0]).argmax()
    assert (len(least), len(modes.least_damped(2))) == (min(n, 10), 2)
    assert least[0].damping_ratio == pytest.approx(float(modes.margin))
    assert [m.damping_ratio for m in least] == sorted(m.damping_ratio for m in least)


def test_no_common_mode_of_a_joint_and_far_beyond_critical_damping():
    joint = fj.Joint(fj.FixedContact(4e6, 2e6), fj.Coulomb(0.3), (0, 1), (2, 3))
    _, _, K = arrays_of(fj.Structure(np.eye(4), None, np.zeros((4, 4)), joint))
    np.testing.assert_array_equal(K @ np.ones(4), np.zeros(4))
    t, n, x = np.array([1, -1, 0, 0]), np.array([0, 0, 1, -1]), np.array([2.0, 1.0, 7.0, 4.0])
    # K x = K_t t (t.x) + K_n n (n.x) - mu K_n t (n.x) + mu K_t n (t.x)
    expected = (2e6 - 0.3 * 4e6 * 3) * t + (4e6 * 3 + 0.3 * 2e6) * n
    np.testing.assert_allclose(K @ x, expected, rtol=1e-15)
    structure = fj.Structure(np.eye(2), np.diag([1e6, 2e6]), np.diag([1.0, 3.0]), [])
    exact = [-2e6 + 1.5e-6, -1e6 + 1e-6, -1.5e-6, -1e-6]
    s = jnp.sort(fj.stability(structure).eigenvalues.real)
    np.testing.assert_allclose(s, exact, rtol=0, atol=1e-15 * 2e6)
    assert fj.growth_rate(structure) == pytest.approx(-1e-6, abs=1e-15 * 2e6)


@pytest.mark.slow
def test_a_clamped_beam_and_modes_of_a_band():
    """omega = (beta L)^2 sqrt(E I/(rho A)), and damping (alpha + beta omega^2)/2."""
    M, K = beam(50)
    modes = fj.stability(fj.Structure(M, fj.rayleigh_damping(M, K, 3.0, 1e-7), K, []))
    low = modes.eigenvalues[modes.frequencies < 200]
    low = low[low.imag > 0]
    low = low[low.imag.argsort()]
    roots = np.array([1.875104068711961, 4.694091132974175, 7.854757438237612])
    omega = roots**2 * np.sqrt(2.1e11 * 0.01**2 / 12 / 7800)
    np.testing.assert_allclose(np.abs(low), omega, rtol=1e-6)
    np.testing.assert_allclose(low.real, -(3.0 + 1e-7 * np.abs(low) ** 2) / 2, atol=1e-7)
    assert modes.eigenvalues.shape == (200,)
    assert modes.unstable() == []
    assert modes.margin > 0
    # Modes that are not there are more damped than any in the band.
    M, C, K = jnp.eye(3), jnp.diag(jnp.array([6.0, 4.0, 2.0])), jnp.diag(jnp.array([1e4, 4e4, 1e6]))
    bands = (50.0, 500.0), None
    in_band, all_of_them = jax.jit(
        lambda M, C, K: [leading(M, C, K, 3, band).s.real for band in bands]
    )(M, C, K)
    np.testing.assert_allclose(in_band, [-2, -3, -500], rtol=1e-9)
    np.testing.assert_allclose(all_of_them, [-1, -2, -3], rtol=1e-9)


@slow
def test_two_beams_squeal_as_scipy_says():
    """Two clamped beams of 50 elements each, tip against tip: 200 degrees of freedom."""
    (M_1, K_1), (M_2, K_2) = beam(50), beam(50, height=0.0115)
    M, K = scipy.linalg.block_diag(M_1, M_2), scipy.linalg.block_diag(K_1, K_2)
    joint = fj.Joint(fj.FixedContact(2e5, 1e5), fj.Coulomb(0.6), 98, 198)
    structure = fj.Structure(M, fj.rayleigh_damping(M, K, 3.0, 1e-7), K, joint)
    M, C, K = arrays_of(structure)
    found: Any = scipy.linalg.eig(state_matrix(M, C, K), left=True)
    s, left, right = found
    critical = np.lexsort((-s.imag, -s.real))[0]
    omega, modes = np.abs(s).max(), fj.stability(structure)
    assert_same_set(modes.eigenvalues, s, 1e-9 * omega)
    # A third from plain M^-1 K, whose rows differ by the units of deflection and rotation.
    assert modes.growth_rate == pytest.approx(s[critical].real, abs=1e-13 * omega)
    (unstable,) = modes.unstable()
    assert unstable.growth_rate == pytest.approx(s[critical].real, abs=1e-13 * omega)
    assert unstable.frequency == pytest.approx(abs(s[critical].imag) / 2 / np.pi)
    x = right[:200, critical] / right[unstable.largest, critical]
    np.testing.assert_allclose(unstable.shape, x, rtol=0, atol=1e-6)

    slope = jax.jit(jax.grad(lambda K_n: fj.growth_rate(structure.replace(K_n=K_n))))(2e5)
    t, n = np.eye(200)[[98, 198]]
    dA = -np.linalg.solve(M, np.outer(n, n) - 0.6 * np.outer(t, n))
    y, v = left[:, critical].conj(), right[:, critical]
    assert slope == pytest.approx(((y[200:] @ dA @ v[:200]) / (y @ v)).real, rel=1e-6)


# --- singular points ----------------------------------------------------------------------


@pytest.mark.slow
def test_a_free_mass_and_rigid_body_modes():
    for C, rate in [(None, 0.0), ([[6.0]], 0.0), ([[-6.0]], 3.0)]:
        structure = fj.Structure([[2.0]], C, [[0.0]], [])
        assert fj.growth_rate(structure) == pytest.approx(rate, rel=1e-14)
        assert fj.stability(structure).growth_rate == pytest.approx(rate, rel=1e-14)
    # Its double eigenvalue 0 is defective to the last bit: left and right vector are orthogonal.
    free = fj.Structure([[2.0]], None, [[0.0]], [])
    assert jax.grad(lambda C: fj.growth_rate(free.replace(C=C)))(jnp.zeros((1, 1))) == 0
    shapes = jax.jacfwd(lambda C: fj.stability(free.replace(C=C)).shapes.real)(free.C)
    assert np.isfinite(shapes).all()
    M, K = beam(8, free=True)
    undamped = fj.Structure(M, None, K, [])
    assert abs(fj.growth_rate(undamped)) <= fj.stability(undamped).resolution
    damped = undamped.replace(C=1e-7 * K)
    modes = fj.stability(damped)
    assert int((modes.eigenvalues == 0).sum()) == 4
    assert modes.growth_rate == 0
    assert fj.growth_rate(damped) == 0
    assert modes.unstable() == []
    assert 0 < modes.margin < 1
    np.testing.assert_array_equal(modes.damping_ratios[:4], 0)

    def rate(K):
        return fj.growth_rate(damped.replace(K=K))

    np.testing.assert_array_equal(jax.grad(rate)(K), 0)
    assert jax.jvp(rate, (K,), (K,))[1] == 0
    # With mass-proportional damping two of the four move: s = -c/m.
    dragged = fj.stability(damped.replace(C=1e-7 * K + 50.0 * M))
    assert int((dragged.eigenvalues == 0).sum()) == 2
    near = np.sort(np.abs(np.asarray(dragged.eigenvalues) + 50.0))[:2]
    np.testing.assert_allclose(near, 0, atol=1e-3)


@pytest.mark.slow
def test_zero_damping_and_no_force_or_support():
    M, _, K = matrices(6)
    joint = fj.Joint(fj.FixedContact(3e6, 1e6), fj.Coulomb(1e-4), 0, 1)
    structure = fj.Structure(M, None, K, joint)
    modes = fj.stability(structure)
    assert modes.unstable() == [] and len(modes.unresolved()) == 6
    assert abs(modes.growth_rate) <= modes.resolution
    assert np.isfinite(slope_by_friction(1e-4, structure))
    # Flutter: s^2 = -(a + b)/2 +- sqrt((a - b)^2/4 - g).
    a, b, g = 3.0, 4.0, 2.0
    K = np.array([[a, -np.sqrt(g)], [np.sqrt(g), b]])
    s = np.sqrt(-(a + b) / 2 + np.sqrt((a - b) ** 2 / 4 - g + 0j))
    growth = fj.growth_rate(fj.Structure(np.eye(2), None, K, []))
    assert growth == pytest.approx(abs(s.real), rel=1e-13)
    without = STRUCTURE.replace(F=None)
    with pytest.raises(ValueError, match="F must be given where friction depends on the sliding"):
        fj.growth_rate(without)
    K = 1e6 * np.kron(np.eye(2), [[1, -1], [-1, 1]])
    joint = fj.Joint(fj.FixedContact(1e5, 5e4), fj.Stribeck(0.4, 0.2, 0.5), (0, 1), (2, 3), V=0.1)
    free = fj.Structure(np.eye(4), None, K, joint, F=[0, 0, 1.0, 2.0])
    for question in (fj.assemble, fj.growth_rate, fj.stability, fj.margin):
        with pytest.raises(ValueError, match="F has no static equilibrium"):
            question(free)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), free)
    assert np.isnan(jax.vmap(fj.growth_rate)(many)).all()
    assert "callback" not in str(jax.make_jaxpr(fj.growth_rate)(STRUCTURE))
    for held, slope in ((free, False), (free.replace(K=K + 1e3 * np.eye(4)), True)):
        assert all(np.isfinite(X).all() for X in arrays_of(held, slope))


@slow
def test_coalescing_modes_give_finite_numbers():
    """|a - b| = 2 sqrt(g) exactly, in numbers that rounding leaves alone."""

    def all_parts(mu):
        joint = fj.Joint(fj.FixedContact(3.0, 1.0), fj.Coulomb(mu[0]), 0, 1)
        structure = fj.Structure(np.eye(2), None, np.diag([3.0, 3.0]), joint)
        modes, rate = fj.stability(structure), fj.growth_rate(structure)
        s = modes.eigenvalues
        return jnp.concatenate([rate[None], s.real, s.imag, modes.damping_ratios])

    mu = 1 / np.sqrt(3.0)
    found = jax.jit(lambda mu: both_modes(all_parts, mu))
    for exact in (mu, np.nextafter(mu, 0), np.nextafter(mu, 1)):
        values, forward, reverse = found(jnp.array([exact]))
        assert abs(values[0]) < 1e-7
        assert np.isfinite(forward).all() and np.isfinite(reverse).all()


@pytest.mark.slow
def test_equal_uncoupled_modes():
    structure = fj.Structure(np.eye(2), 0.1 * np.eye(2), 4.0 * np.eye(2), [])

    def upper(K):
        s = fj.stability(structure.replace(K=K)).eigenvalues
        return jnp.where(s.imag > 0, s, 0).sum().imag

    # The sum of the equal ones is smooth: ds = -dK/(2 s + c).
    s = complex(-0.05, np.sqrt(4 - 0.05**2))
    found = jax.jacrev(upper)(4.0 * np.eye(2))
    np.testing.assert_allclose(found, (-1 / (2 * s + 0.1)).imag * np.eye(2), atol=1e-12)
    slopes = jax.grad(lambda K: fj.growth_rate(structure.replace(K=K)))(structure.K)
    assert np.isfinite(slopes).all()


# --- what rounding can do -----------------------------------------------------------------


def exact_eigenvalues(M, C, K) -> Any:
    """Of s^2 M + s C + K, as if the entries had no rounding error."""
    n = len(M)
    with mp.workdps(100):
        M, C, K = (mp.matrix(np.asarray(X, float).tolist()) for X in (M, C, K))
        A = mp.zeros(2 * n)
        A[:n, n:], A[n:, :n], A[n:, n:] = mp.eye(n), -mp.inverse(M) * K, -mp.inverse(M) * C
        return np.array([complex(s) for s in mp.eig(A, left=False, right=False)])


def assert_resolved_or_said(structure):
    """Every eigenvalue is right within its resolution; returns the modes and the exact ones."""
    exact = exact_eigenvalues(*fj.assemble(structure))
    modes = fj.stability(structure)
    error = np.asarray(modes.resolutions)[:, None]
    size = np.abs(np.asarray(modes.eigenvalues))[:, None] + error
    apart, pairs = paired(modes.eigenvalues, exact, size)
    assert (apart <= error)[pairs].all()
    growing = exact.real[pairs[1]] > error[:, 0][pairs[0]]
    assert bool(modes.unstable()) == growing.any()
    rate = fj.growth_rate(structure)
    np.testing.assert_allclose(rate, modes.growth_rate, rtol=1e-12, atol=float(modes.resolution))
    return modes, exact


@pytest.mark.slow
@pytest.mark.parametrize("coupling", [0.0, 1e4])
def test_a_stiff_part_elsewhere_hides_no_squeal(coupling):
    K = np.diag([3.0e4, 3.1e4, 1e12]) + coupling * np.outer([1, 0, -1], [1, 0, -1])
    joint = fj.Joint(fj.FixedContact(2e4, 1e4), fj.Coulomb(0.6), 0, 1)
    structure = fj.Structure(np.diag([1.0, 1.0, 1e-8]), np.diag([0.1, 0.1, 1e-3]), K, joint)
    modes, exact = assert_resolved_or_said(structure)
    assert modes.growth_rate == pytest.approx(exact.real.max(), rel=1e-12)
    assert len(modes.unstable()) == 1
    assert modes.unresolved() == []
    up, down = (
        exact_eigenvalues(*fj.assemble(structure.replace(mu=mu))).real.max()
        for mu in (0.6001, 0.5999)
    )
    assert slope_by_friction(0.6, structure) == pytest.approx((up - down) / 2e-4, rel=1e-6)


def any_structure(rng):
    """Three masses and springs over many decades: held or free, damped or not, with a joint."""
    n, decades = 3, rng.choice([1.0, 5.0, 10.0])
    m, k = 10 ** rng.uniform(-decades, decades, (2, n))
    M, K = np.diag(m), np.zeros((n, n))
    for i in range(n - 1):
        K[i : i + 2, i : i + 2] += 1e4 * k[i] * np.array([[1, -1], [-1, 1]])
    if rng.random() < 0.7:
        K += 1e4 * np.diag(k * (rng.random(n) < 0.7))
    each = np.sqrt(m * np.diag(K))
    C = rng.choice([0.0, 1e-3, 1e-2]) * np.diag(each)
    if rng.random() < 0.3:
        C = C + 0.1 * rng.uniform() * np.sqrt(np.outer(each, each)) * (np.tri(n) - np.tri(n).T)
    i, j = map(int, rng.permutation(n)[:2])
    K_n = 10 ** rng.uniform(-2, 1) * np.sqrt(K[i, i] * K[j, j])
    joint = fj.Joint(fj.FixedContact(K_n, 0.4 * K_n), fj.Coulomb(0.7), i, j)
    attached = arrays_of(fj.Structure(np.eye(n), None, np.zeros((n, n)), joint))[2]
    return fj.Structure(M, C, K + attached * (rng.random() < 0.6), [])


def test_what_float32_cannot_hold_is_unresolved():
    def single(M, C, K):
        M, C, K = (X.astype(np.float32) for X in (M, C, K))
        return fj.stability(fj.Structure(M, C, K, []))

    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    K = (Q * [1e2, 1e9, 1e14]) @ Q.T
    arrays = np.eye(3), 1e-2 * np.eye(3), (K + K.T) / 2
    modes = single(*arrays)
    assert modes.unstable() == []
    assert modes.unresolved()
    assert modes.resolution > 10.0
    assert fj.stability(fj.Structure(*arrays, [])).unresolved() == []  # of float64
    # Not rotated, nothing is lost.
    modes = single(*arrays[:2], np.diag([1e2, 1e9, 1e14]))
    np.testing.assert_allclose(np.sort(np.abs(modes.eigenvalues))[:2], 10.0, rtol=1e-6)


@pytest.mark.slow
def test_rounding_counts_and_units_do_not():
    """The slope of friction acts through K x_0 = F, of which a stiff spring leaves few digits."""
    K = 1e13 * np.outer([1, -1], [1, -1]) + np.diag([1e3, 1.1e3])
    joint = fj.Joint(fj.FixedContact(20.0, 10.0), fj.Stribeck(0.4, 0.2, 0.5), 0, 1, V=0.1)
    structure = fj.Structure(np.eye(2), 0.1 * np.eye(2), K, joint, F=[30.0, 30.0])
    coulomb = structure.replace(friction=fj.Coulomb(0.35))
    # Of the soft mode; the stiff one hardly moves under F.
    assert fj.stability(structure).resolutions.min() > 2 * fj.stability(coulomb).resolutions.min()
    scale = np.array([1.0, 1e-6, 1e4, 1e-3])
    both = np.outer(scale, scale)
    M, C, K = (X * both for X in arrays_of(STRUCTURE))
    scaled = fj.Structure(M, C, K, [])
    rate = float(fj.growth_rate(STRUCTURE))
    assert fj.growth_rate(scaled) == pytest.approx(rate, abs=1e-11 * 1e4)
    assert_same_set(fj.stability(scaled).eigenvalues, fj.stability(STRUCTURE).eigenvalues, 1e-7)
    rng, outcomes = np.random.default_rng(0), []
    for _ in range(20):
        modes, exact = assert_resolved_or_said(any_structure(rng))
        outcomes.append(len(modes.unstable()) - len(modes.unresolved()))
        assert all(mode.resolution < 1e-3 * exact.real.max() for mode in modes.unstable())
    assert min(outcomes) < 0 < max(outcomes)


# --- precision, units, batches, and what is not evaluated ---------------------------------


@jax.jit
@jax.value_and_grad
def rate_by_friction(mu_s, structure):
    return fj.growth_rate(structure.replace(mu_s=mu_s))


@pytest.mark.slow
@pytest.mark.parametrize("stiffening", [1.0, 1e12])
def test_float32(stiffening):
    structure = STRUCTURE.replace(
        C=STRUCTURE.C * np.sqrt(stiffening),
        K=STRUCTURE.K * stiffening,
        F=STRUCTURE.F * np.sqrt(stiffening),
        contact=fj.FixedContact(3e6 * stiffening, 1e6 * stiffening),
    )
    small = jax.tree.map(lambda x: x.astype(jnp.float32), structure)
    omega = float(np.abs(fj.stability(structure).eigenvalues).max())
    value, slope = rate_by_friction(jnp.float32(0.5), small)
    exact, exact_slope = rate_by_friction(0.5, structure)
    assert value.dtype == slope.dtype == jnp.float32
    np.testing.assert_allclose(value, exact, rtol=0, atol=1e-6 * omega)
    np.testing.assert_allclose(slope, exact_slope, rtol=1e-4)
    modes = fj.stability(small)
    assert modes.eigenvalues.dtype == modes.shapes.dtype == jnp.complex64


@pytest.mark.slow
def test_vmapped_is_looped():
    K_ns = jnp.array([2e6, 4e6])
    many = jax.vmap(lambda K_n: STRUCTURE.replace(K_n=K_n))(K_ns)
    modes = jax.jit(jax.vmap(fj.stability))(many)
    one_by_one = [float(fj.growth_rate(STRUCTURE.replace(K_n=K_n))) for K_n in K_ns]
    np.testing.assert_allclose(modes.growth_rate, one_by_one, rtol=1e-8)
    for bad, message in (
        (many, "M must have two dimensions"),
        (STRUCTURE.replace(K_n=K_ns), "K_n must be a scalar"),
    ):
        with pytest.raises(ValueError, match=f"{message}.*use jax.vmap"):
            fj.growth_rate(bad)
    mus = jnp.array([0.3, 0.5])
    many = jax.jit(jax.vmap(rate_by_friction, (0, None)))(mus, STRUCTURE)
    one = [rate_by_friction(mu, STRUCTURE) for mu in mus]
    np.testing.assert_allclose(np.transpose(many), one, rtol=1e-8)


def test_what_a_structure_does_not_need_is_not_there():
    def operations(structure, friction_slope):
        return str(jax.make_jaxpr(lambda x: fj.growth_rate(x, friction_slope))(structure))

    coulomb = STRUCTURE.replace(friction=fj.Coulomb(0.3), F=None)
    assert "= lu" in operations(STRUCTURE, True) or " lu[" in operations(STRUCTURE, True)
    assert "= lu" not in operations(STRUCTURE, False)
    for absent in ("= lu", " log ", " exp ", " sort["):
        assert absent not in operations(coulomb, True)
