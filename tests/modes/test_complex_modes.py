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
from structures import (
    DIGITS,
    beam,
    eigenvalue_near,
    linearised,
    matrices,
    numbers_of,
    slope_of,
    two_joints,
)
from tools import reference_scene

MODES = pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
SLOPE = pytest.mark.parametrize("friction_slope", [True, False])


def quadratic(M, C, K):
    """Eigenvalues of the quadratic problem by SciPy, as a generalised linear one."""
    n = len(M)
    zero, one = np.zeros((n, n)), np.eye(n)
    scale = np.sqrt(np.abs(K).max() / np.abs(M).max())
    unit = np.abs(M).max()
    A = np.block([[zero, one], [-K / unit / scale**2, -C / unit / scale]])
    B = np.block([[one, zero], [zero, M / unit]])
    return scale * scipy.linalg.eig(A, B, right=False)


def assert_same_set(left, right, atol):
    left, right = np.asarray(left), np.asarray(right)
    assert left.shape == right.shape
    apart = np.abs(left[:, None] - right[None])
    pairs = scipy.optimize.linear_sum_assignment(apart)
    assert apart[pairs].max() <= atol


@functools.cache
def pair():
    """A structure of four degrees of freedom, and its critical eigenvalue from elsewhere."""
    structure = two_joints(4)
    M, C, K = fj.assemble(structure)
    s = quadratic(*(np.asarray(X) for X in (M, C, K)))
    s = s[s.imag > 0]
    return structure, complex(s[s.real.argmax()])


@SLOPE
@pytest.mark.parametrize("law", [fj.Stribeck(0.4, 0.25, 0.5), fj.Coulomb(0.4)])
def test_the_oscillator_is_the_case_of_two_degrees_of_freedom(law, friction_slope):
    scene = reference_scene().replace(friction=law)
    structure = fj.Structure.from_scene(scene)
    modes, closed = (fj.stability(x, friction_slope) for x in (structure, scene))
    omega = 6000.0
    assert_same_set(modes.eigenvalues, closed.eigenvalues, 1e-13 * omega)
    for name in ("growth_rate", "frequency"):
        np.testing.assert_allclose(
            getattr(modes, name), getattr(closed, name), rtol=0, atol=1e-13 * omega
        )
    np.testing.assert_allclose(modes.damping_ratio, closed.damping_ratio, rtol=1e-9)
    rate = fj.growth_rate(structure, friction_slope)
    np.testing.assert_allclose(rate, closed.growth_rate, rtol=0, atol=1e-13 * omega)


@MODES
def test_the_oscillators_derivatives_are_those_of_the_closed_form(mode):
    scene = reference_scene()
    structure = fj.Structure.from_scene(scene)

    def slopes(x):
        def rate(values):
            names = ("K_n", "K_t", "mu_s", "mu_m", "v_m", "V")
            return fj.growth_rate(x.replace(**dict(zip(names, values, strict=True))))

        return jax.jit(mode(rate))([4e8, 2e8, 0.4, 0.25, 0.5, 0.15])

    np.testing.assert_allclose(slopes(structure), slopes(scene), rtol=1e-10)


def test_second_and_third_derivatives_are_those_of_the_closed_form():
    scene = reference_scene()
    structure = fj.Structure.from_scene(scene)

    def bends(x):
        def rate(K_n):
            return fj.growth_rate(x.replace(K_n=K_n), False)

        second = jax.grad(jax.grad(rate))
        return jax.jit(second)(4e8), jax.jit(jax.jacfwd(second))(4e8)

    np.testing.assert_allclose(bends(structure), bends(scene), rtol=1e-10)


@pytest.mark.parametrize("n", [4, 12])
def test_eigenvalues_are_scipys(n):
    structure = two_joints(n)
    M, C, K = (np.asarray(X) for X in fj.assemble(structure))
    modes = fj.stability(structure)
    omega = np.abs(modes.eigenvalues).max()
    assert_same_set(modes.eigenvalues, quadratic(M, C, K), 1e-12 * omega)
    assert (np.diff(modes.eigenvalues.real) <= 0).all()
    np.testing.assert_allclose(
        fj.growth_rate(structure), modes.growth_rate, rtol=0, atol=1e-12 * omega
    )


def test_shapes_solve_the_quadratic_problem():
    structure = two_joints(12)
    M, C, K = (np.asarray(X) for X in fj.assemble(structure))
    modes = fj.stability(structure)
    for s, x in zip(np.asarray(modes.eigenvalues), np.asarray(modes.shapes), strict=True):
        assert np.abs(x).max() == pytest.approx(1)
        assert x[np.abs(x).argmax()] == pytest.approx(1)
        left = (s**2 * M + s * C + K) @ x
        assert np.abs(left).max() <= 1e-12 * np.abs(K).max()


@SLOPE
def test_the_assembled_matrices_are_the_jacobians_of_the_joints_forces(friction_slope):
    structure = two_joints(4)
    with mp.workdps(DIGITS):
        expected = linearised(numbers_of(structure), friction_slope)
    for X, exact in zip(fj.assemble(structure, friction_slope), expected, strict=True):
        exact = np.array(exact.tolist(), dtype=float)
        np.testing.assert_allclose(X, exact, rtol=0, atol=1e-13 * np.abs(exact).max())


def moved(name, *place):
    """A function from dp to the numbers of `pair`'s structure with one of them moved by dp."""
    numbers = numbers_of(pair()[0])

    def change(dp):
        new = copy.deepcopy(numbers)
        if name in "MCKF":
            entry = place if len(place) == 2 else (place[0], 0)
            new[name][entry] += dp
            if name == "M" and entry[0] != entry[1]:
                new[name][entry[::-1]] += dp
        else:
            new["joints"][place[0]][name] += dp
        return new

    return change


JOINT_QUANTITIES = ("K_n", "K_t", "mu_s", "mu_m", "v_m", "V")


@functools.cache
def exact_slopes():
    """Value and slopes of the growth rate of `pair`'s structure from 50 digits."""
    structure, s = pair()
    value = float(eigenvalue_near(numbers_of(structure), True, s).real)
    by_joint = np.array(
        [
            [
                slope_of(moved(name, i), s, float(numbers_of(structure)["joints"][i][name]))
                for name in JOINT_QUANTITIES
            ]
            for i in range(2)
        ]
    )
    places = {
        "M": [(0, 0), (1, 3), (2, 2)],
        "C": [(0, 0), (1, 2), (3, 0)],
        "K": [(1, 1), (0, 3), (2, 1)],
        "F": [(0,), (2,)],
    }
    by_entry = {
        name: {
            place: slope_of(moved(name, *place), s, float(np.abs(getattr(structure, name)).max()))
            for place in at
        }
        for name, at in places.items()
    }
    return value, by_joint, by_entry


def test_the_growth_rate_is_that_of_many_digits():
    structure, s = pair()
    assert fj.growth_rate(structure) == pytest.approx(exact_slopes()[0], abs=1e-12 * abs(s))
    assert exact_slopes()[0] > 0  # or the test would be of little use


@MODES
def test_derivatives_by_every_quantity_of_each_joint(mode):
    structure, _ = pair()

    def rate(values):
        names = [f"{joint}.{q}" for joint in ("left", "right") for q in JOINT_QUANTITIES]
        return fj.growth_rate(structure.replace(**dict(zip(names, values, strict=True))))

    numbers = numbers_of(structure)["joints"]
    at = [float(joint[q]) for joint in numbers for q in JOINT_QUANTITIES]
    found = np.reshape(jax.jit(mode(rate))(at), (2, -1))
    np.testing.assert_allclose(found, exact_slopes()[1], rtol=1e-9)


@MODES
def test_derivatives_by_the_entries_of_the_matrices(mode):
    structure, _ = pair()

    def rate(changes):
        return fj.growth_rate(structure.replace(**changes))

    found = jax.jit(mode(rate))({name: getattr(structure, name) for name in "MCKF"})
    for name, slopes in exact_slopes()[2].items():
        scale = np.abs(found[name]).max()
        for place, slope in slopes.items():
            # M is symmetric: its two entries move together.
            twice = 2 if name == "M" and place[0] != place[1] else 1
            assert found[name][place] * twice == pytest.approx(slope, abs=1e-9 * scale)
    np.testing.assert_array_equal(found["M"], found["M"].T)


@MODES
def test_derivatives_of_all_eigenvalues_and_shapes(mode):
    structure, _ = pair()

    @jax.jit
    def everything(K_n):
        modes = fj.stability(structure.replace(**{"left.K_n": K_n}))
        picked = modes.eigenvalues, modes.shapes, modes.damping_ratios, modes.margin
        return jax.tree.map(lambda x: jnp.concatenate([x.real.ravel(), x.imag.ravel()]), picked)

    at, h = 3e6, 3.0
    found = jax.jit(mode(everything))(at)
    ends = [everything(at + h), everything(at - h)]
    for slope, high, low in zip(found, *ends, strict=True):
        by_differences = (high - low) / (2 * h)
        scale = np.abs(by_differences).max()
        np.testing.assert_allclose(slope, by_differences, rtol=0, atol=1e-5 * scale)


@pytest.mark.slow
def test_hessian_against_many_digits():
    structure, s = pair()

    def rate(x):
        return fj.growth_rate(structure.replace(**{"left.K_n": x[0], "right.mu_s": x[1]}))

    found = jax.jit(jax.hessian(rate))(jnp.array([3e6, 0.4]))

    def change(x, y):
        numbers = numbers_of(structure)
        numbers["joints"][0]["K_n"] += 3e6 * x
        numbers["joints"][1]["mu_s"] += 0.4 * y
        return numbers

    with mp.workdps(DIGITS):
        h = mp.mpf("1e-8")
        value = {
            (i, j): eigenvalue_near(change(i * h, j * h), True, s).real
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        }
        xx = (value[1, 0] - 2 * value[0, 0] + value[-1, 0]) / h**2
        yy = (value[0, 1] - 2 * value[0, 0] + value[0, -1]) / h**2
        xy = (value[1, 1] - value[1, -1] - value[-1, 1] + value[-1, -1]) / (4 * h**2)
        exact = np.array([[xx, xy], [xy, yy]], dtype=float)
    scale = np.array([3e6, 0.4])
    np.testing.assert_allclose(found * np.outer(scale, scale), exact, rtol=1e-8)


def fractal_pair():
    """The same with fractal contacts of different surfaces."""
    brake = fj.brake_scene().contact
    structure = two_joints(4)
    return structure.replace(
        **{
            "left.contact": fj.FractalContact(fj.Surface(2.5, 2e-10), brake.material, 20.0),
            "right.contact": fj.FractalContact(fj.Surface(2.5, 4e-10), brake.material, 30.0),
        }
    )


def test_gradients_by_the_surface_of_each_joint():
    structure = fractal_pair()
    names = [f"{joint}.{q}" for joint in ("left", "right") for q in ("D", "G")]
    at = [2.5, 2e-10, 2.5, 4e-10]

    def rate(values):
        return fj.growth_rate(structure.replace(**dict(zip(names, values, strict=True))))

    # The same through the stiffness of each joint, whose own derivatives have tests of their own.
    @jax.jit
    def contact(joint):
        def stiffness(surface):
            moved = joint.contact.surface
            moved = fj.Surface(surface[0], surface[1], moved.gamma)
            return jnp.stack(
                fj.FractalContact(moved, joint.contact.material, joint.contact.P).stiffness(
                    joint.friction.mu_s, joint.friction.mu_m
                )
            )

        surface = joint.contact.surface
        surface = jnp.stack([surface.D, surface.G])
        return stiffness(surface), jax.jacfwd(stiffness)(surface)

    def of_stiffness(K):
        contacts = [fj.FixedContact(K[0], K[1]), fj.FixedContact(K[2], K[3])]
        changes = dict(zip(("left.contact", "right.contact"), contacts, strict=True))
        return fj.growth_rate(structure.replace(**changes))

    (K_left, left), (K_right, right) = map(contact, structure.joints)
    slopes = jax.jit(jax.grad(of_stiffness))(jnp.concatenate([K_left, K_right]))
    chain = jnp.concatenate([slopes[:2] @ left, slopes[2:] @ right])
    assert (chain != 0).all()
    np.testing.assert_allclose(jax.jit(jax.jacrev(rate))(at), chain, rtol=1e-9)
    along = [0.1, 1e-11, -0.2, 2e-11]
    _, found = jax.jit(lambda at, along: jax.jvp(rate, (at,), (along,)))(at, along)
    assert found == pytest.approx(float(chain @ jnp.array(along)), rel=1e-9)


def test_a_plain_name_moves_every_joint():
    structure, _ = pair()

    def slope(names):
        def rate(dK):
            joints = zip(structure.joint_names, structure.joints, strict=True)
            own = {name: joint.contact.K_n for name, joint in joints}
            return fj.growth_rate(structure.replace(**names(own, dK)))

        return float(jax.jit(jax.grad(rate))(0.0))

    left = slope(lambda K_n, dK: {"left.K_n": K_n["left"] + dK})
    right = slope(lambda K_n, dK: {"right.K_n": K_n["right"] + dK})
    # The plain name sets both to one value; the dotted one counts where both are given.
    both = slope(lambda K_n, dK: {"K_n": K_n["right"] + dK, "left.K_n": K_n["left"] + dK})
    assert both == pytest.approx(left + right, rel=1e-10)


def test_a_relative_joint_moves_no_common_mode():
    M, K = np.eye(4), np.zeros((4, 4))
    joint = fj.Joint(fj.FixedContact(4e6, 2e6), fj.Coulomb(0.3), (0, 1), (2, 3))
    _, _, total = fj.assemble(fj.Structure(M, None, K, joint))
    np.testing.assert_array_equal(total @ np.ones(4), np.zeros(4))
    t, n = np.array([1, -1, 0, 0]), np.array([0, 0, 1, -1])
    x = np.array([2.0, 1.0, 7.0, 4.0])
    # K x = K_t t (t.x) + K_n n (n.x) - mu K_n t (n.x) + mu K_t n (t.x)
    expected = (2e6 - 0.3 * 4e6 * 3) * t + (4e6 * 3 + 0.3 * 2e6) * n
    np.testing.assert_allclose(total @ x, expected, rtol=1e-15)


# A real finite-element model.


@functools.cache
def disc_and_pad():
    """Two clamped beams of 50 elements each, tip against tip: 200 degrees of freedom."""
    (M_1, K_1), (M_2, K_2) = beam(50), beam(50, height=0.0115)
    M, K = scipy.linalg.block_diag(M_1, M_2), scipy.linalg.block_diag(K_1, K_2)
    return fj.Structure(
        M,
        fj.rayleigh_damping(M, K, 3.0, 1e-7),
        K,
        fj.Joint(fj.FixedContact(2e5, 1e5), fj.Coulomb(0.6), 98, 198),
    )


def test_a_clamped_beam_of_200_degrees_of_freedom():
    M, K = beam(100)
    structure = fj.Structure(M, fj.rayleigh_damping(M, K, 3.0, 1e-7), K, [])
    modes = fj.stability(structure)
    slow = modes.eigenvalues[modes.frequencies < 200]
    slow = slow[slow.imag > 0]
    slow = slow[slow.imag.argsort()]
    # Closed form: omega = (beta L)^2 sqrt(E I/(rho A)), and damping (alpha + beta omega^2)/2.
    roots = np.array([1.875104068711961, 4.694091132974175, 7.854757438237612])
    omega = roots**2 * np.sqrt(2.1e11 * 0.01**2 / 12 / 7800)
    np.testing.assert_allclose(np.abs(slow), omega, rtol=1e-6)
    np.testing.assert_allclose(slow.real, -(3.0 + 1e-7 * np.abs(slow) ** 2) / 2, atol=1e-7)
    assert modes.eigenvalues.shape == (400,)
    assert modes.unstable() == []
    assert modes.margin > 0


@pytest.mark.slow
def test_two_beams_of_200_degrees_of_freedom_squeal_as_scipy_says():
    structure = disc_and_pad()
    M, C, K = (np.asarray(X) for X in fj.assemble(structure))
    found: Any = scipy.linalg.eig(
        np.block([[np.zeros((200, 200)), np.eye(200)], [-np.linalg.solve(M, np.hstack([K, C]))]]),
        left=True,
    )
    s, left, right = found
    critical = np.lexsort((-s.imag, -s.real))[0]
    omega = np.abs(s).max()
    modes = fj.stability(structure)
    assert_same_set(modes.eigenvalues, s, 1e-9 * omega)
    # A third from plain M^-1 K, whose rows differ by the units of deflection and rotation.
    assert modes.growth_rate == pytest.approx(s[critical].real, abs=1e-13 * omega)
    unstable = modes.unstable()
    assert len(unstable) == 1
    assert unstable[0].growth_rate == pytest.approx(s[critical].real, abs=1e-13 * omega)
    assert unstable[0].frequency == pytest.approx(abs(s[critical].imag) / 2 / np.pi)
    x = right[:200, critical] / right[unstable[0].largest, critical]
    np.testing.assert_allclose(unstable[0].shape, x, rtol=0, atol=1e-6)

    slope = jax.jit(jax.grad(lambda K_n: fj.growth_rate(structure.replace(K_n=K_n))))(2e5)
    t, n = np.eye(200)[[98, 198]]
    dA = -np.linalg.solve(M, np.outer(n, n) - 0.6 * np.outer(t, n))
    y, v = left[:, critical].conj(), right[:, critical]
    expected = (y[200:] @ dA @ v[:200]) / (y @ v)
    assert slope == pytest.approx(expected.real, rel=1e-6)


# Singular points.


def test_rigid_body_modes_are_at_rest():
    M, K = beam(8, free=True)
    structure = fj.Structure(M, None, K, [])
    assert abs(fj.growth_rate(structure)) <= fj.stability(structure).resolution
    damped = structure.replace(C=1e-7 * K)
    modes = fj.stability(damped)
    assert int((modes.eigenvalues == 0).sum()) == 4
    assert modes.growth_rate == 0
    assert fj.growth_rate(damped) == 0
    assert modes.unstable() == []
    assert 0 < modes.margin < 1
    np.testing.assert_array_equal(modes.damping_ratios[:4], 0)
    slopes = jax.grad(lambda K: fj.growth_rate(damped.replace(K=K)))(K)
    np.testing.assert_array_equal(slopes, 0)
    _, slope = jax.jvp(lambda K: fj.growth_rate(damped.replace(K=K)), (K,), (K,))
    assert slope == 0
    # Dragged along, two of the four move: s = -c/m.
    dragged = fj.stability(damped.replace(C=1e-7 * K + 50.0 * M))
    assert int((dragged.eigenvalues == 0).sum()) == 2
    near = np.sort(np.abs(np.asarray(dragged.eigenvalues) + 50.0))[:2]
    np.testing.assert_allclose(near, 0, atol=1e-3)


def test_nothing_but_a_free_mass():
    for C, rate in [(None, 0.0), ([[6.0]], 0.0), ([[-6.0]], 3.0)]:
        structure = fj.Structure([[2.0]], C, [[0.0]], [])
        assert fj.growth_rate(structure) == pytest.approx(rate, rel=1e-14)
        assert fj.stability(structure).growth_rate == pytest.approx(rate, rel=1e-14)
    # Its double eigenvalue 0 is defective to the last bit: left and right vector are orthogonal.
    free = fj.Structure([[2.0]], None, [[0.0]], [])
    assert jax.grad(lambda C: fj.growth_rate(free.replace(C=C)))(jnp.zeros((1, 1))) == 0
    assert np.isfinite(
        jax.jacfwd(lambda C: fj.stability(free.replace(C=C)).shapes.real)(free.C)
    ).all()


def test_zero_damping():
    M, _, K = matrices(6)
    still = fj.Structure(M, None, K, fj.Joint(fj.FixedContact(3e6, 1e6), fj.Coulomb(1e-4), 0, 1))
    modes = fj.stability(still)
    assert modes.unstable() == []
    assert abs(modes.growth_rate) <= modes.resolution
    assert np.isfinite(jax.grad(lambda mu: fj.growth_rate(still.replace(mu=mu)))(1e-4))
    # Undamped flutter in closed form: s^2 = -(a + b)/2 +- sqrt((a - b)^2/4 - g).
    scene = fj.brake_scene().replace(
        xi_1=0.0, xi_2=0.0, friction=fj.Coulomb(0.6), contact=fj.FixedContact(4e8, 2e8)
    )
    a, b = 6283.185307179586**2 + 2e8, 5026.548245743669**2 + 4e8
    s = np.sqrt(-(a + b) / 2 + np.sqrt((a - b) ** 2 / 4 - 0.6**2 * 8e16 + 0j))
    flutter = fj.growth_rate(fj.Structure.from_scene(scene))
    assert flutter == pytest.approx(abs(s.real), rel=1e-11)


@MODES
def test_coalescing_modes_give_finite_numbers(mode):
    # |a - b| = 2 sqrt(g) exactly, in numbers that rounding leaves alone.
    a, b, K_n, K_t = 3.0, 3.0, 3.0, 1.0

    def rate(mu, read):
        joint = fj.Joint(fj.FixedContact(K_n, K_t), fj.Coulomb(mu), 0, 1)
        structure = fj.Structure(np.eye(2), None, np.diag([a, b]), joint)
        return read(structure)

    def all_parts(structure):
        modes = fj.stability(structure, True)
        return jnp.stack([modes.eigenvalues.real, modes.eigenvalues.imag, modes.damping_ratios])

    mu = 1 / np.sqrt(3.0)
    for exact in (mu, np.nextafter(mu, 0), np.nextafter(mu, 1)):
        assert abs(rate(exact, fj.growth_rate)) < 1e-7
        for read in (fj.growth_rate, all_parts):
            assert np.isfinite(mode(lambda mu, read=read: rate(mu, read))(exact)).all()


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-9])
def test_derivatives_towards_coalescing_modes_are_those_of_the_closed_form(distance):
    scene = reference_scene().replace(friction=fj.Coulomb(0.5), xi_1=0.003, xi_2=0.003)
    a, b = scene.oscillator.omega_1**2, scene.oscillator.omega_2**2
    K_n, K_t = 4e8, 2e8
    mu = float(abs(a + K_t - b - K_n) / (2 * np.sqrt(K_n * K_t))) * (1 + distance)
    structure = fj.Structure.from_scene(scene)
    slopes = [
        jax.grad(lambda mu, x=x: fj.growth_rate(x.replace(mu=mu)))(mu) for x in (structure, scene)
    ]
    assert slopes[0] == pytest.approx(float(slopes[1]), rel=1e-14 / distance + 1e-9)


def test_equal_uncoupled_modes():
    structure = fj.Structure(np.eye(2), 0.1 * np.eye(2), 4.0 * np.eye(2), [])

    def upper(K):
        modes = fj.stability(structure.replace(K=K))
        return jnp.where(modes.eigenvalues.imag > 0, modes.eigenvalues, 0).sum().imag

    # The sum of the equal ones is smooth: ds = -dK/(2 s + c).
    s = complex(-0.05, np.sqrt(4 - 0.05**2))
    found = jax.jacrev(upper)(4.0 * np.eye(2))
    np.testing.assert_allclose(found, (-1 / (2 * s + 0.1)).imag * np.eye(2), atol=1e-12)
    assert np.isfinite(
        jax.grad(lambda K: fj.growth_rate(structure.replace(K=K)))(structure.K)
    ).all()


def test_far_beyond_critical_damping():
    structure = fj.Structure(np.eye(2), np.diag([1e6, 2e6]), np.diag([1.0, 3.0]), [])
    s = jnp.sort(fj.stability(structure).eigenvalues.real)
    np.testing.assert_allclose(
        s, [-2e6 + 1.5e-6, -1e6 + 1e-6, -1.5e-6, -1e-6], rtol=0, atol=1e-15 * 2e6
    )
    assert fj.growth_rate(structure) == pytest.approx(-1e-6, abs=1e-15 * 2e6)


# Structures of widely differing stiffness, against many digits.


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
    found, error = np.asarray(modes.eigenvalues), np.asarray(modes.resolutions)[:, None]
    apart = np.abs(found[:, None] - exact[None])
    pairs = scipy.optimize.linear_sum_assignment(apart / (np.abs(found)[:, None] + error))
    assert (apart <= error)[pairs].all()
    growing = exact.real[pairs[1]] > error[:, 0][pairs[0]]
    assert bool(modes.unstable()) == growing.any()
    rate = fj.growth_rate(structure)
    np.testing.assert_allclose(rate, modes.growth_rate, rtol=1e-12, atol=float(modes.resolution))
    return modes, exact


@pytest.mark.parametrize("coupling", [0.0, 1e4])
def test_a_stiff_part_elsewhere_hides_no_squeal(coupling):
    K = np.diag([3.0e4, 3.1e4, 1e12]) + coupling * np.outer([1, 0, -1], [1, 0, -1])
    joint = fj.Joint(fj.FixedContact(2e4, 1e4), fj.Coulomb(0.6), 0, 1)
    structure = fj.Structure(np.diag([1.0, 1.0, 1e-8]), np.diag([0.1, 0.1, 1e-3]), K, joint)
    modes, exact = assert_resolved_or_said(structure)
    assert modes.growth_rate == pytest.approx(exact.real.max(), rel=1e-12)
    assert len(modes.unstable()) == 1
    assert modes.unresolved() == []
    slope = jax.grad(lambda mu: fj.growth_rate(structure.replace(mu=mu)))(0.6)
    ends = [
        exact_eigenvalues(*fj.assemble(structure.replace(mu=mu))).real.max()
        for mu in (0.6001, 0.5999)
    ]
    assert slope == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-6)


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
    i, j = rng.permutation(n)[:2]
    K_n = 10 ** rng.uniform(-2, 1) * np.sqrt(K[i, i] * K[j, j])
    K += fj.assemble(
        fj.Structure(
            np.eye(n),
            None,
            np.zeros((n, n)),
            fj.Joint(fj.FixedContact(K_n, 0.4 * K_n), fj.Coulomb(0.7), int(i), int(j)),
        )
    )[2] * (rng.random() < 0.6)
    return fj.Structure(M, C, K, [])


def test_any_structure_is_resolved_or_said_not_to_be():
    rng = np.random.default_rng(0)
    outcomes = []
    for _ in range(20):
        modes, exact = assert_resolved_or_said(any_structure(rng))
        outcomes.append(len(modes.unstable()) - len(modes.unresolved()))
        assert all(mode.resolution < 1e-3 * exact.real.max() for mode in modes.unstable())
    assert min(outcomes) < 0 < max(outcomes)


def single(M, C, K):
    return fj.Structure(M.astype(np.float32), C.astype(np.float32), K.astype(np.float32), [])


def test_what_float32_cannot_hold_is_unresolved():
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    K = (Q * [1e2, 1e9, 1e14]) @ Q.T
    arrays = np.eye(3), 1e-2 * np.eye(3), (K + K.T) / 2
    modes = fj.stability(single(*arrays))
    assert modes.unstable() == []
    assert modes.unresolved()
    assert modes.resolution > 10.0
    assert fj.stability(fj.Structure(*arrays, [])).unresolved() == []  # of float64
    # Without the turn nothing is lost.
    arrays = np.eye(3), 1e-2 * np.eye(3), np.diag([1e2, 1e9, 1e14])
    modes = fj.stability(single(*arrays))
    np.testing.assert_allclose(np.sort(np.abs(modes.eigenvalues))[:2], 10.0, rtol=1e-6)


def test_rounding_of_the_equilibrium_counts_in_the_resolution():
    """The slope of friction acts through K x_0 = F, of which a stiff spring leaves few digits."""
    K = 1e13 * np.outer([1, -1], [1, -1]) + np.diag([1e3, 1.1e3])
    joint = fj.Joint(fj.FixedContact(20.0, 10.0), fj.Stribeck(0.4, 0.2, 0.5), 0, 1, V=0.1)
    structure = fj.Structure(np.eye(2), 0.1 * np.eye(2), K, joint, F=[30.0, 30.0])
    coulomb = structure.replace(friction=fj.Coulomb(0.35))
    # Of the soft mode; the stiff one hardly moves under F.
    assert fj.stability(structure).resolutions.min() > 2 * fj.stability(coulomb).resolutions.min()


# Precision, units, batches, and what is not evaluated.


def test_units_of_the_degrees_of_freedom_do_not_matter():
    structure = two_joints(4)
    M, C, K = fj.assemble(structure)
    scale = np.array([1.0, 1e-6, 1e4, 1e-3])
    both = np.outer(scale, scale)
    scaled = fj.Structure(M * both, C * both, K * both, [])
    rate = fj.growth_rate(structure)
    assert fj.growth_rate(scaled) == pytest.approx(float(rate), abs=1e-11 * 1e4)
    assert_same_set(fj.stability(scaled).eigenvalues, fj.stability(structure).eigenvalues, 1e-7)


@jax.jit
@jax.value_and_grad
def rate_by_friction(mu_s, structure):
    return fj.growth_rate(structure.replace(mu_s=mu_s))


@pytest.mark.parametrize("stiffening", [1.0, 1e12])
def test_float32(stiffening):
    structure = two_joints(4)
    structure = structure.replace(
        C=structure.C * np.sqrt(stiffening),
        K=structure.K * stiffening,
        F=structure.F * np.sqrt(stiffening),
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
    assert modes.eigenvalues.dtype == jnp.complex64
    assert modes.shapes.dtype == jnp.complex64


def test_jit_and_vmap():
    structure = two_joints(4)
    K_ns = jnp.linspace(2e6, 4e6, 5)

    def rate(K_n):
        return fj.growth_rate(structure.replace(K_n=K_n))

    one_by_one = jnp.stack([rate(K_n) for K_n in K_ns])
    np.testing.assert_allclose(jax.jit(jax.vmap(rate))(K_ns), one_by_one, rtol=1e-8)
    slopes = jax.jit(jax.vmap(jax.grad(rate)))(K_ns)
    np.testing.assert_allclose(slopes[2], jax.jit(jax.grad(rate))(K_ns[2]), rtol=1e-8)

    many = jax.vmap(lambda K_n: structure.replace(K_n=K_n))(K_ns)
    modes = jax.vmap(fj.stability)(many)
    np.testing.assert_allclose(modes.growth_rate, one_by_one, rtol=1e-8)
    with pytest.raises(ValueError, match="modes are listed of one structure"):
        modes.unstable()
    with pytest.raises(ValueError, match=r"M must have two dimensions.*use jax.vmap"):
        fj.growth_rate(many)
    only_joints = structure.replace(K_n=K_ns)
    with pytest.raises(ValueError, match=r"K_n must be a scalar.*use jax.vmap"):
        fj.growth_rate(only_joints)


def test_what_a_structure_does_not_need_is_not_there():
    structure = two_joints(4)

    def operations(structure, friction_slope):
        return str(jax.make_jaxpr(lambda x: fj.growth_rate(x, friction_slope))(structure))

    assert " lu[" in operations(structure, True) or "= lu" in operations(structure, True)
    assert "= lu" not in operations(structure, False)
    coulomb = structure.replace(friction=fj.Coulomb(0.3), F=None)
    assert "= lu" not in operations(coulomb, True)
    # Left vectors are: rigid-body modes and the errors of eigenvalues are told by them.
    for absent in (" log ", " exp ", " sort["):
        assert absent not in operations(coulomb, True)


@pytest.mark.parametrize("question", [fj.growth_rate, fj.stability, fj.assemble])
def test_friction_slope_is_true_or_false(question):
    structure = two_joints(4)
    for wrong in ("no", 0, None):
        with pytest.raises(TypeError, match="friction_slope must be True or False, got"):
            question(structure, wrong)


def test_slope_without_force():
    structure = two_joints(4).replace(F=None)
    with pytest.raises(ValueError, match="F must be given where friction depends on the sliding"):
        fj.growth_rate(structure)
    assert np.isfinite(fj.growth_rate(structure, friction_slope=False))


def test_slope_without_support():
    K = 1e6 * np.kron(np.eye(2), [[1, -1], [-1, 1]])
    joint = fj.Joint(fj.FixedContact(1e5, 5e4), fj.Stribeck(0.4, 0.2, 0.5), (0, 1), (2, 3), V=0.1)
    structure = fj.Structure(np.eye(4), None, K, joint, F=[0, 0, 1.0, 2.0])
    with pytest.raises(RuntimeError, match="F has no static equilibrium"):
        fj.assemble(structure)
    assert np.isfinite(fj.growth_rate(structure, friction_slope=False))
    # Held by springs, or without a force, there is one.
    assert np.isfinite(fj.growth_rate(structure.replace(K=K + 1e3 * np.eye(4))))


def test_modes_are_shown_and_listed():
    names = ("a", "b", "c", "d")
    structure = two_joints(4)
    structure = fj.Structure(
        structure.M, structure.C, structure.K, structure.joints, structure.F, names
    )
    modes = fj.stability(structure)
    assert "growth_rate=" in repr(modes)
    assert "\n" not in repr(modes)
    unstable, least = modes.unstable(), modes.least_damped()
    assert unstable[0].growth_rate == modes.growth_rate
    assert unstable[0].largest in names
    assert len(least) == 4
    assert len(modes.least_damped(2)) == 2
    assert least[0].damping_ratio == pytest.approx(float(modes.margin))
    assert [m.damping_ratio for m in least] == sorted(m.damping_ratio for m in least)
