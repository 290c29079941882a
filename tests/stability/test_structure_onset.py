"""Onset of squeal in structures: closed forms, roots in 40 digits, traced boundaries."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.quantities import with_friction_times
from preloaded import Oracle, problem
from tools import both_modes

slow = pytest.mark.slow


# --- two degrees of freedom ---------------------------------------------------------------

NAMES = ("k11", "k12", "k21", "k22", "c1", "c2", "K_n", "K_t", "F1", "F2", "P")
PLAIN = dict(c1=0, c2=0, K_t=0, F1=0, F2=0, P=1)
HOFFMANN = PLAIN | dict(k11=2, k12=1, k21=1, k22=2 - 4 / 3, K_n=4 / 3)
DIVERGING = HOFFMANN | dict(k21=-1, k22=6 - 4 / 3)
W_1, W_2 = 6283.185307179586, 5026.548245743669
BELT = dict(k11=W_1**2, k12=0, k21=0, k22=W_2**2, c1=0.002 * W_1, c2=0.014 * W_2)
BELT |= dict(K_n=4e8, K_t=6e7, F1=5, F2=-5, P=1907.3)
PAIRS: dict[str, dict[str, float]] = {
    "hoffmann": HOFFMANN,
    "hoffmann, off resonance": HOFFMANN | dict(k11=2.2),
    "light damping": HOFFMANN | dict(c1=1e-6, c2=7e-6, k11=2.1),
    "damping": HOFFMANN | dict(c1=0.05, c2=0.3, K_t=0.1),
    "divergence": DIVERGING,
    "divergence, damped": DIVERGING | dict(c1=0.1, c2=0.3),
    "belt": BELT,
    "belt, undamped": BELT | dict(c1=0, c2=0),
    "one direction undamped": BELT | dict(c2=0),
    "no coupling": BELT | dict(K_t=0),
    "opens first": BELT | dict(K_t=2e8, F1=495, F2=-495, P=500),
}
WITHOUT = {"one direction undamped": 0.0, "no coupling": np.inf, "opens first": np.nan}


def row(name):
    return jnp.array([float(PAIRS[name][number]) for number in NAMES])


def two_masses(x):
    """Two masses of 1 kg and a joint with constant friction, whose own value does not count."""
    k, c, K_n, K_t, F, P = x[:4].reshape(2, 2), x[4:6], x[6], x[7], x[8:10], x[10]
    joint = fj.Joint(fj.FixedContact(1.0, 1.0, 1.0), fj.Coulomb(0.3), 0, 1, preload=True)
    template = fj.Structure(np.eye(2), None, np.eye(2), joint, F=[0.0, 0.0])
    return template.replace(K=k, C=jnp.diag(c), K_n=K_n, K_t=K_t, F=F, P=P)


@jax.jit
@jax.vmap
def onsets(x):
    """Critical friction, its derivative by all numbers in both modes, and the growth rate."""
    return both_modes(lambda x: fj.critical_friction(two_masses(x)), x)


@functools.cache
def found(name):
    columns = onsets(jnp.stack([row(each) for each in PAIRS]))
    return [np.asarray(column[list(PAIRS).index(name)]) for column in columns]


def exact(*numbers):
    """The least mu at which (k12 - mu K_n)(k21 + mu K_t) is a b, or minus the critical coupling.

    s^2 + c_1 s + a and s^2 + c_2 s + b are the uncoupled modes: H_3 = 0 is flutter, a b divergence.
    """
    k11, k12, k21, k22, c1, c2, K_n, K_t = map(mp.mpf, numbers[:8])
    a, b = k11 + K_t, k22 + K_n
    share = c1 * c2 / (c1 + c2) ** 2 if c1 + c2 else mp.mpf(1) / 4
    flutter = -share * ((a - b) ** 2 + (c1 + c2) * (c1 * b + c2 * a))
    roots = []
    for product in (flutter, a * b):
        two, one, none = -K_n * K_t, k12 * K_t - k21 * K_n, k12 * k21 - product
        root = mp.sqrt(one**2 - 4 * two * none)
        larger = -(one + (root if one > 0 else -root)) / 2
        roots += [none / larger, *([larger / two] if two else [])]
    return min(mu for mu in roots if mp.im(mu) == 0 and mu > 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PAIRS if name not in WITHOUT])
def test_closed_forms(name):
    """Flutter with and without damping and static divergence, and all derivatives."""
    x = [float(number) for number in row(name)]
    value, *slopes = found(name)
    # Eigenvalues are known to eps of the frequency, thus p to eps over the damping ratio.
    light = name == "light damping"
    accuracy = 1e-9 if light else 1e-12
    assert float(value) == pytest.approx(float(exact(*x)), rel=1e-10 if light else 1e-13)
    if name == "hoffmann":
        assert float(value) == pytest.approx(0.75, rel=1e-15)
    for i, number in enumerate(NAMES):
        if number in ("F1", "F2", "P"):
            wanted = 0.0
        elif number in ("c1", "c2") and not (x[4] or x[5]):
            continue  # depends on how damping vanishes
        else:
            h = mp.mpf(max(abs(x[i]), 1e-3)) * mp.mpf(10) ** -15
            ends = [exact(*x[:i], mp.mpf(x[i]) + sign * h, *x[i + 1 :]) for sign in (1, -1)]
            wanted = float((ends[0] - ends[1]) / (2 * h))
        for slope in slopes:
            scale = abs(wanted) + abs(float(value) / max(abs(x[i]), 1e-3))
            assert slope[i] == pytest.approx(wanted, abs=accuracy * scale), number


@pytest.mark.slow
@pytest.mark.parametrize("name", WITHOUT)
def test_without_a_number(name):
    """0, infinite or NaN as for a scene, with a derivative of 0."""
    value, forward, reverse = found(name)
    np.testing.assert_equal(float(value), WITHOUT[name])
    if name != "opens first":
        assert not forward.any() and not reverse.any()


@slow
def test_one_is_the_same_as_many():
    for name in ("hoffmann", "divergence", "belt"):
        single = fj.critical_friction(two_masses(row(name)))
        assert float(single) == pytest.approx(float(found(name)[0]), rel=1e-12)


# --- many degrees of freedom, and all kinds of joints -------------------------------------


def more_damped(name):
    """Problems that are stable at some friction."""
    x, oracle = problem(name)
    more = Oracle(oracle.M, 10 * oracle.C, oracle.K, oracle.F, oracle.joints)
    return x.replace(C=10 * x.C), more


SCALED = ("mu", "mu_s", "mu_m", "mu_d", "viscous")


def scaled(oracle: Oracle, factor, **changes):
    """The numbers of an oracle with the friction of all joints times a factor."""
    numbers = oracle.exact()
    for name, joint in ((name, oracle.joints[int(name.split(".")[0])]) for name in numbers):
        if name.split(".")[1] in SCALED and name.split(".")[1] in joint["numbers"]:
            numbers[name] = numbers[name] * factor
    return numbers | {name: mp.mpf(value) for name, value in changes.items()}


def root(oracle, factor, omega, **changes):
    """The factor at which i omega is an eigenvalue, from det(A - i omega) = 0."""

    def equations(factor, omega):
        A, _ = oracle.state_matrix(scaled(oracle, factor, **changes), True)
        value = mp.det(A - mp.mpc(0, omega) * mp.eye(A.rows)) / scale
        return mp.re(value), mp.im(value)

    scale = mp.mpf(omega) ** (2 * oracle.n)
    return mp.findroot(equations, (mp.mpf(factor), mp.mpf(omega)), tol=1e-50)[0]


@slow
@pytest.mark.parametrize("name", ["lever arms", "three kinds"])
def test_the_first_root_in_many_digits(name):
    """No growth below it, the root of a determinant, and its derivatives in both modes."""
    x, oracle = more_damped(name)
    joint = x.joint_names[-1]
    quantities = ["0.K_n", "0.V", f"{len(x.joints) - 1}.P"]
    at = jnp.array([oracle.numbers[each] for each in quantities])

    def factor(values):
        moved = x.replace(**{f"j{each}": v for each, v in zip(quantities, values, strict=True)})
        mu = moved.joints[-1].coefficient()
        return fj.critical_friction(moved, joint=joint) / mu

    value, forward, reverse = jax.jit(lambda at: both_modes(factor, at))(at)
    critical = fj.stability(with_friction_times(x, value))
    assert abs(float(critical.growth_rate)) < 1e-9 * float(critical.frequency)
    omega = 2 * np.pi * float(critical.frequency)
    wanted = root(oracle, float(value), omega)
    assert float(value) == pytest.approx(float(wanted), rel=1e-11)
    below = jax.vmap(lambda f: fj.growth_rate(with_friction_times(x, f)))
    growths = below(jnp.linspace(0.001, 1 - 1e-6, 300) * value)
    assert (growths < 0).all()
    assert float(fj.growth_rate(with_friction_times(x, value * (1 + 1e-6)))) > 0
    for i, each in enumerate(quantities):
        h = oracle.numbers[each] * mp.mpf(10) ** -10
        ends = [
            root(oracle, wanted, omega, **{each: oracle.numbers[each] + sign * h})
            for sign in (1, -1)
        ]
        slope = float((ends[0] - ends[1]) / (2 * h))
        for mode in (forward, reverse):
            size = 1e-8 * abs(float(wanted) / oracle.numbers[each])
            assert float(mode[i]) == pytest.approx(slope, rel=1e-7, abs=size), each


@slow
def test_fractal_joints_follow_their_friction():
    """Of the reference brake as a structure: the search of the scene, which has closed forms."""
    for scene in (fj.brake_scene(), fj.brake_scene().replace(preload=True, xi_1=0.05, xi_2=0.05)):
        same = fj.Structure.from_scene(scene)
        wanted = jax.jit(
            jax.value_and_grad(lambda D, s=scene: fj.critical_friction(s.replace(D=D)))
        )
        found = jax.jit(jax.value_and_grad(lambda D, s=same: fj.critical_friction(s.replace(D=D))))
        np.testing.assert_allclose(found(2.4), wanted(2.4), rtol=1e-9)


@slow
def test_a_beam_of_twenty_degrees_of_freedom():
    """Light damping, modes far apart in frequency, two joints: where the growth rate changes."""
    from structures import beam

    M, K = beam(10)
    contact = fj.FixedContact(1e7, 4e6, 200.0)
    joints = {
        "tip": fj.Joint(contact, fj.Coulomb(0.2), 19, 18, preload=True),
        "middle": fj.Joint(contact, fj.Coulomb(0.1), 9, 8, preload=True),
    }
    x = fj.Structure(M, 1e-7 * K, K, joints)
    mu = fj.critical_friction(x, joint="tip")
    assert 0 < float(mu) < np.inf
    assert float(fj.critical_friction(x, joint="middle")) == pytest.approx(float(mu) / 2)
    rate = jax.jit(lambda mu: fj.growth_rate(x.replace(**{"tip.mu": mu, "middle.mu": mu / 2})))
    growths = [float(rate(mu * share)) for share in (0.25, 0.5, 0.75, 1 - 1e-7, 1 + 1e-7)]
    assert max(growths[:-1]) < 0 < growths[-1]


# --- boundaries ---------------------------------------------------------------------------

WINDOWS = {
    "flutter": (("K_n", 0.5, 3.0), ("mu", 0.2, 3.0)),
    "divergence": (("K_n", 0.5, 3.0), ("mu", 1.0, 30.0)),
}


@functools.cache
def boundary(name):
    # Both axes linear: one program for all.
    window = WINDOWS["divergence" if "divergence" in name else "flutter"]
    return fj.hopf_boundary(two_masses(row(name)), *window, lines=9)


@slow
@pytest.mark.parametrize("name", ["damping", "hoffmann", "divergence", "divergence, damped"])
def test_boundaries_in_closed_form(name):
    """Flutter and divergence over a stiffness and friction, with frequency."""
    (branch,) = boundary(name).branches
    diverges = "divergence" in name
    assert len(branch.x) > 30 and branch.divergence == diverges
    assert ("static divergence" in repr(boundary(name))) == diverges
    numbers = [float(number) for number in row(name)]
    for K_n, mu, frequency in list(zip(branch.x, branch.y, branch.frequency, strict=True))[::5]:
        numbers[6] = K_n
        assert mu == pytest.approx(float(exact(*numbers)), rel=1e-9)
        here = two_masses(jnp.array(numbers)).replace(mu=mu)
        # With preload a divergence has no equilibrium; without slope that counts for nothing else.
        here = fj.stability(here.replace(**{"joint_1.preload": False}))
        # Without damping all modes are on the boundary, and any may come first.
        listed = np.asarray(here.frequencies) if name == "divergence" else [here.frequency]
        assert np.abs(np.asarray(listed) - frequency).min() < 1e-6
        assert abs(float(here.growth_rate)) < 1e-6
    for end in (branch.start, branch.end):
        assert bool(end == fj.BoundaryEnd.window)


def two_minimal_models():
    """Hoffmann's model twice, the second of twice the frequency, each with a joint and damping."""
    K, C = np.zeros((2, 4, 4))
    K[:2, :2], K[2:, 2:] = [[2, 1], [1, 2 - 4 / 3]], np.array([[2, 1], [1, 2 - 4 / 3]]) * 4
    C[:2, :2], C[2:, 2:] = np.diag([0.02, 0.03]), np.diag([0.1, 0.02])
    joints = {
        "left": fj.Joint(fj.FixedContact(4 / 3, 0.0, 1.0), fj.Coulomb(0.1), 0, 1, preload=True),
        "right": fj.Joint(fj.FixedContact(16 / 3, 0.0, 1.0), fj.Coulomb(0.2), 2, 3, preload=True),
    }
    return fj.Structure(np.eye(4), C, K, joints)


@slow
def test_a_corner_between_two_modes():
    """Two models that know nothing of each other: two straight branches that end at one place."""
    x = two_minimal_models()
    found = fj.hopf_boundary(x, ("left.mu", 0.3, 1.2), ("right.mu", 0.3, 1.2), lines=7)
    left = float(exact(2, 1, 1, 2 - 4 / 3, 0.02, 0.03, 4 / 3, 0))
    right = float(exact(8, 4, 4, 8 - 16 / 3, 0.1, 0.02, 16 / 3, 0))
    assert len(found.branches) == 2 and found.untraced == 0 and not found.squeals
    for branch in found.branches:
        upright = np.ptp(branch.x) < 1e-9
        along, across, wanted, other = (
            (branch.y, branch.x, left, right) if upright else (branch.x, branch.y, right, left)
        )
        np.testing.assert_allclose(across, wanted, rtol=1e-9)
        assert (along.min(), along.max()) == pytest.approx((0.3, other), abs=1e-5)
        assert {end_name(branch.start), end_name(branch.end)} == {"window", "corner"}
    assert "at a corner, where a second mode loses its damping" in repr(found)


def end_name(end):
    return next(name for name in ("window", "corner") if bool(end == getattr(fj.BoundaryEnd, name)))


@slow
def test_boundary_of_preloaded_joints_of_all_kinds():
    """Squeal to the right of each point and not to the left, by the matrices of the oracle."""
    x, oracle = more_damped("three kinds")
    factor = fj.critical_friction(x, joint="j2") / x.joints[2].coefficient()
    x = with_friction_times(x, factor)  # a point of the boundary
    window = ("j0.P", 200.0, 1500.0), ("j1.V", 0.05, 0.6)
    found = fj.hopf_boundary(x, *window, lines=7)
    assert found.branches
    for branch in found.branches:
        steps = np.diff(np.stack([branch.x, branch.y]) / [[1300.0], [0.55]])
        for i in range(1, len(branch.x) - 1, max(1, len(branch.x) // 5)):
            along = steps[:, i] / np.linalg.norm(steps[:, i])
            right = np.array([along[1], -along[0]]) * [1300.0, 0.55] * 1e-4
            growths = []
            for sign in (1, -1):
                numbers = scaled(oracle, mp.mpf(float(factor)))
                P, V = np.array([branch.x[i], branch.y[i]]) + sign * right
                numbers |= {"0.P": mp.mpf(P), "1.V": mp.mpf(V)}
                growths.append(max(s.real for s in oracle.eigenvalues(numbers=numbers)))
            assert growths[1] < 0 < growths[0]


# --- refusals -----------------------------------------------------------------------------


def test_what_has_no_meaning_is_refused_by_name():
    x, _ = problem("three kinds")
    with pytest.raises(ValueError, match="friction differs between the joints: j0, j1, j2"):
        fj.critical_friction(x)
    with pytest.raises(ValueError, match="no joint 'left'; it has j0, j1, j2"):
        fj.critical_friction(x, joint="left")
    with pytest.raises(ValueError, match="joint names one of a structure, got 'left' for a scene"):
        fj.critical_friction(fj.brake_scene(), joint="left")
    bare: Any = fj.Structure(np.eye(2), None, np.eye(2), {})
    with pytest.raises(ValueError, match="needs a joint, and the structure has none"):
        fj.critical_friction(bare)
    with pytest.raises(ValueError, match="structure has no quantity 'mu'; it has K_n, "):
        fj.hopf_boundary(x, ("mu", 0.1, 0.5), ("P", 1.0, 2.0))
