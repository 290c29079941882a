"""Structural damping: the complex quadratic problem by SciPy and in 40 digits, and what follows."""

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
from tools import both_modes

RNG = np.random.default_rng(5)
ETA = (0.02, 0.1)  # loss factors of two parts


def definite(n, least=0.5, rng=RNG):
    A = rng.standard_normal((n, n))
    return A @ A.T / n + least * np.eye(n)


def solutions(M, C, K) -> Any:
    """All 2n numbers s with det(s^2 M + s C + K) = 0, by SciPy; K may be complex."""
    n = len(M)
    return scipy.linalg.eigvals(
        np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, np.hstack([K, C]))]])
    )


def deck(i):
    """M, C, K and K_loss of three degrees of freedom: a third circulatory, a third overdamped."""
    rng = np.random.default_rng(i)
    A, B = rng.standard_normal((2, 3, 3))
    C = (3.0 if i % 3 == 1 else 0.02) * definite(3, rng=rng) + 0.2 * (A - A.T)
    K = 4 * definite(3, rng=rng) + (i % 3 == 2) * (B - B.T)
    return definite(3, rng=rng), C, K, rng.uniform(0.01, 0.3) * definite(3, 0.0, rng)


@functools.cache
def answers():
    """Eigenvalues, growth rates and margins of 1,000 decks, in one program."""

    def answer(M, C, K, K_loss):
        x = fj.Structure(M, C, K, K_loss=K_loss)
        return fj.stability(x).eigenvalues, fj.growth_rate(x), fj.margin(x)

    decks = [deck(i) for i in range(1000)]
    program = jax.jit(jax.vmap(answer))
    return decks, [np.asarray(x) for x in program(*map(jnp.array, zip(*decks, strict=True)))]


def test_thousand_decks_beside_scipy():
    unequal = 0
    for (M, C, K, K_loss), s, growth, margin in zip(*answers()[:1], *answers()[1], strict=True):
        right = solutions(M, C, K + 1j * K_loss)
        right = right[right.imag > 0]
        ours = s[s.imag > 0]
        apart = np.abs(ours[:, None] - right[None])
        pairs = scipy.optimize.linear_sum_assignment(apart)
        assert len(ours) == len(right)
        assert (apart[pairs] <= 1e-10 * np.abs(right)[pairs[1]]).all()
        unequal += len(ours) != 3
        if len(ours) == 3:
            mirror = np.sort_complex(s[s.imag < 0].conj())
            np.testing.assert_array_equal(mirror, np.sort_complex(ours))
        diverging = solutions(M, C, K)
        diverging = diverging[(diverging.imag == 0) & (diverging.real > 0)].real
        assert abs(growth - max([right.real.max(), *diverging])) <= 1e-10 * np.abs(right).max()
        least = min((-right.real / np.abs(right)).min(), -1.0 if diverging.size else 1.0)
        assert abs(margin - least) <= 1e-10
    assert 0 < unequal < 20  # where a solution passes through the real axis


# --- a joint with a loss factor, in 40 digits ---------------------------------------------------

M, C, K, PART = definite(3), 0.02 * definite(3), 4 * definite(3), np.diag([0.0, 3.0, 1.0])
K_N, K_T, MU = 2.5, 1.1, 0.9


def structure(mu: Any = MU, eta: Any = ETA[1], loss: Any = ETA[0], **more):
    """A part with one loss factor, and a joint with another."""
    joint = fj.Joint(fj.FixedContact(K_N, K_T), fj.Coulomb(mu), 0, 1, loss_factor=eta)
    return fj.Structure(M, C, K, {"pad": joint}, K_loss=loss * PART, **more)


def rightmost_in_digits(mu: Any, eta: Any, loss: Any) -> Any:
    """The eigenvalue with Im s > 0 that grows most, from the definitions."""
    matrix = [mp.matrix(X.tolist()) for X in (M, C, K)]
    stiffness = matrix[2] + mp.mpc(0, 1) * loss * mp.matrix(PART.tolist())
    k_n, k_t = (k * (1 + mp.mpc(0, 1) * eta) for k in (mp.mpf(K_N), mp.mpf(K_T)))
    stiffness[0, 0] += k_t
    stiffness[1, 1] += k_n
    stiffness[0, 1] -= mu * k_n
    stiffness[1, 0] += mu * k_t
    inverse, A = matrix[0] ** -1, mp.zeros(6)
    A[:3, 3:] = mp.eye(3)
    A[3:, :3], A[3:, 3:] = -inverse * stiffness, -inverse * matrix[1]
    s = mp.eig(A, left=False, right=False)
    return max((z for z in s if mp.im(z) > 0), key=mp.re)


def slopes_in_digits(function, at):
    """Derivatives by central differences in 40 digits."""
    h = mp.mpf(10) ** -12
    for i in range(len(at)):
        ends = [[x + sign * h * (i == j) for j, x in enumerate(at)] for sign in (1, -1)]
        yield float((function(*ends[0]) - function(*ends[1])) / (2 * h))


def gradients(function, at):
    """In forward and reverse mode, from one program."""
    return jax.jit(lambda v: both_modes(function, v)[1:])(jnp.array(at))


def test_growth_rate_and_its_slopes_in_40_digits():
    with mp.workdps(40):
        at = [mp.mpf(x) for x in (MU, ETA[1], ETA[0])]
        s = complex(rightmost_in_digits(*at))
        slopes = [*slopes_in_digits(lambda *x: mp.re(rightmost_in_digits(*x)), at)]
    x = structure()
    modes = fj.stability(x)
    assert abs(complex(modes.eigenvalues[0]) - s) < 1e-13 * abs(s)
    np.testing.assert_allclose(fj.growth_rate(x), s.real, atol=1e-13 * abs(s))
    assert modes.resolution < 1e-12 * abs(s)
    for measure in (fj.growth_rate, lambda x: fj.stability(x).eigenvalues[0].real):
        for row in gradients(lambda v, f=measure: f(structure(*v)), (MU, *ETA[::-1])):
            np.testing.assert_allclose(row, slopes, rtol=1e-9)


@pytest.mark.slow
def test_critical_friction_and_its_slopes():
    def growth(mu, eta, loss):
        return mp.re(rightmost_in_digits(mu, eta, loss))

    with mp.workdps(40):

        def critical(eta, loss):
            return mp.findroot(lambda mu: growth(mu, eta, loss), (1.42, 1.5), solver="anderson")

        at = [mp.mpf(x) for x in ETA[::-1]]
        right, slopes = float(critical(*at)), [*slopes_in_digits(critical, at)]
    np.testing.assert_allclose(fj.critical_friction(structure()), right, rtol=1e-11)
    for row in gradients(lambda v: fj.critical_friction(structure(MU, *v)), ETA[::-1]):
        np.testing.assert_allclose(row, slopes, rtol=1e-7)
    tracks = fj.track_modes(structure(), "mu", np.linspace(0.8, 1.3, 5) * right)
    crossing = tracks.crossings()[0]
    np.testing.assert_allclose(crossing.value, right, rtol=1e-10)
    assert crossing.starts and (tracks.mac > 0.8).all() and tracks.eigenvalues.shape == (5, 3)
    boundary = fj.hopf_boundary(structure(), ("mu", 0.5, 4.0), ("loss_factor", 0.02, 0.2), lines=5)
    (branch,) = boundary.branches
    for mu, eta in zip(branch.x[::9], branch.y[::9], strict=True):
        assert abs(fj.growth_rate(structure(mu, eta))) < 1e-9


@pytest.mark.slow
def test_what_does_not_oscillate_has_no_hysteresis():
    """Rigid bodies rest, static divergence is that of K, and heavy damping decays."""
    one, diag = np.eye(2), np.diag
    free = fj.stability(fj.Structure(one, None, diag([0.0, 4.0]), K_loss=diag([0.0, 0.2])))
    s = np.sqrt(-4 - 0.2j)
    right = sorted([s if s.imag > 0 else -s, 0, 0], key=lambda z: -z.real)
    np.testing.assert_allclose(np.sort(free.eigenvalues.imag)[1:], np.sort(np.imag(right)))
    assert (free.eigenvalues == 0).sum() == 2 and free.margin > 0.02 and free.growth_rate == 0
    loose = fj.Structure(one, diag([3.0, 0.0]), diag([0.0, 4.0]), K_loss=diag([0.0, 0.2]))
    real = fj.stability(loose).eigenvalues
    np.testing.assert_allclose(np.sort(real[real.imag == 0].real), [-3, 0], atol=1e-15)
    fallen = fj.Structure(one, None, diag([-1.0, 4.0]), K_loss=diag([0.3, 0.2]))
    first, second = diag([1.0, 0.0]), diag([0.0, 4.0])
    value = jax.value_and_grad(lambda k: fj.growth_rate(fallen.replace(K=k * first + second)))
    growth, slope = value(-1.0)
    np.testing.assert_allclose([growth, slope], [1.0, -0.5], rtol=1e-14)
    assert fj.margin(fallen) == -1
    modes = fj.stability(fallen)
    assert modes.unstable()[0].frequency == 0 and len(modes.unstable()) == 1


@pytest.mark.slow
def test_static_divergence_by_friction():
    """Where 1 + K_n n.(n - mu t) = 0, K_loss or not."""
    one = np.eye(2)
    joint = fj.Joint(fj.FixedContact(3.0, 0.0), fj.Coulomb(0.2), [1.0, 0.0], [1.0, 0.2])
    x = fj.Structure(one, 0.1 * one, one, joint, K_loss=0.1 * one)
    critical = jax.value_and_grad(lambda K_n: fj.critical_friction(x.replace(K_n=K_n)))
    np.testing.assert_allclose(critical(3.0), (1.04 + 1 / 3, -1 / 9), rtol=1e-10)


# --- reduction, shares, viscous damping ---------------------------------------------------------


@pytest.mark.slow
def test_reduction_keeps_structural_damping():
    n = 30
    chain = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    near = np.diag(np.arange(n) < 10.0)
    part = near @ chain @ near
    joint = fj.Joint(fj.FixedContact(0.3, 0.2), fj.Coulomb(0.3), 4, 20, loss_factor=0.05)
    x = fj.ParametricStructure(
        np.eye(n),
        1e-4 * chain,
        [(1 + 0.01j, chain)],
        joint,
        {"eta": 0.1},
        K_loss=[("eta", part)],
    )
    small = fj.reduce(x, {"eta": (0.0, 0.2)}, (0.0, 0.8), tol=1e-7)
    assert small.n < n and small.K_loss is not None
    for eta in (0.03, 0.17):
        ends: Any = (np.asarray(fj.stability(y.replace(eta=eta)).eigenvalues) for y in (x, small))
        whole, few = ends
        whole = whole[(whole.imag > 0.05) & (whole.imag < 0.75)]
        assert np.abs(whole[:, None] - few[None]).min(axis=1).max() < 1e-7
    assert (fj.reduction_errors(small)[: len(whole)] < 1e-6).all()
    back: Any = small.replace(eta=0.17)
    np.testing.assert_allclose(fj.growth_rate(back), fj.stability(back).growth_rate, rtol=1e-12)


def test_shares_sum_to_growth_rates():
    shares = fj.energy_shares(structure())
    assert shares.parts == ("M", "C", "K", "K_loss", "pad")
    rates = np.real(shares.eigenvalues)
    np.testing.assert_allclose(shares.growth.sum(axis=1), rates, atol=1e-14)
    np.testing.assert_allclose(shares.strain.sum(axis=1), 1)
    assert (shares.growth[:, 3] < 0).all() and np.abs(shares.strain[:, 3]).max() < 1e-15
    # With K_loss = eta K and nothing else, s^2 = -omega^2 (1 + i eta).
    x = fj.Structure(M, None, K, K_loss=0.05 * K)
    omega = np.sqrt(scipy.linalg.eigvalsh(K, M))
    ours: Any = np.asarray(fj.stability(x).eigenvalues)
    right: Any = 1j * omega * np.sqrt(1 + 0.05j)
    np.testing.assert_allclose(np.sort_complex(ours[ours.imag > 0]), np.sort_complex(right))


def test_equivalent_viscous_damping():
    """At its frequency it is the same to all digits, and motion in time takes it."""
    x = structure()
    for refused in (lambda: fj.simulate(x, np.zeros(6), 1.0), lambda: fj.attractors(x)):
        with pytest.raises(ValueError, match=r"take x\.equivalent_viscous\(frequency\)"):
            refused()
    free = fj.Structure(M, C, K, K_loss=0.03 * K + 0.1 * PART)
    Omega = 1.7
    viscous = free.equivalent_viscous(Omega / (2 * np.pi))
    assert viscous.K_loss is None and not viscous.has_loss
    Q = [-(Omega**2) * y.M + 1j * Omega * y.C + y.complex_K for y in (free, viscous)]
    np.testing.assert_allclose(Q[0], Q[1], rtol=1e-14)
    dashed = x.equivalent_viscous(Omega / (2 * np.pi))
    loss = ETA[1] * np.diag([K_T, K_N, 0]) + ETA[0] * PART
    np.testing.assert_allclose(dashed.C, C + loss / Omega, rtol=1e-14)
    assert dashed.joints[0].loss_factor is None
    with pytest.raises(ValueError, match="frequency must be above 0"):
        x.equivalent_viscous(0.0)
    one = fj.Structure([[1.0]], None, [[4.0]], K_loss=[[0.2]]).equivalent_viscous(1 / np.pi)
    motion = fj.simulate(one, [1.0, 0.0], 10.0)
    s = complex(-0.05, np.sqrt(4 - 0.05**2))
    t = np.asarray(motion.times)
    exact = np.exp(s.real * t) * (np.cos(s.imag * t) - s.real / s.imag * np.sin(s.imag * t))
    np.testing.assert_allclose(np.asarray(motion.states)[:, 0], exact, atol=1e-7)


def test_complex_terms_are_structural_damping():
    x: Any
    x = fj.ParametricStructure(
        M, C, [((1 + 0.02j), K), ("a", PART * 0.1j)], parameters={"a": 2.0}, K_loss=PART
    )
    np.testing.assert_allclose(x.K, K, rtol=1e-15)
    np.testing.assert_allclose(x.K_loss, 0.02 * K + 1.2 * PART, rtol=1e-15)
    x = fj.Structure(M, C, K + 1j * PART)
    np.testing.assert_allclose(x.K_loss, PART)
    assert fj.Structure(M, C, K).K_loss is None
    assert fj.Structure(M, C, K).replace(K_loss=PART).K_loss is not None
    # A complex K replaces both; a real one keeps the loss that is there.
    for other in (x.complex_K, 2 * x.complex_K):
        again = x.replace(K=other)
        np.testing.assert_allclose(again.complex_K, other, rtol=1e-15)
    np.testing.assert_allclose(x.replace(K=2 * K).complex_K, 2 * K + 1j * PART, rtol=1e-15)
    with pytest.raises(TypeError, match=r"must be real where it is a function: .* K_loss"):
        fj.ParametricStructure(M, C, [(lambda p: 1 + 1j * p["a"], K)], parameters={"a": 0.1})
    for name in "MC":
        with pytest.raises(TypeError, match=f"{name} must be an array of real numbers"):
            fj.Structure(1j * M if name == "M" else M, 1j * C if name == "C" else C, K)
    with pytest.raises(ValueError, match=r"K_loss must have shape \(3, 3\) as M demands"):
        fj.Structure(M, C, K, K_loss=np.eye(2))
    with pytest.raises(ValueError, match="loss_factor must be at least 0"):
        structure(eta=-0.1)
