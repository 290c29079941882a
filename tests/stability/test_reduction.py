"""Reduction of structures, beside all eigenvalues of the unreduced ones and closed forms."""

import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import scipy.linalg
from scipy.sparse import csr_array

import fractaljax as fj
from fractaljax._stability import reduction
from fractaljax._stability.sparse_modes import Factors, band_modes
from structures import beam, state_matrix
from tools import mostly_slow

BAND = (0.0, 9000.0)
M0, K0 = beam(20)
n = len(M0)
rng = np.random.default_rng(3)
SKEW = rng.standard_normal((n, n)) * np.sqrt(np.outer(np.diag(M0), np.diag(M0)))
SKEW = SKEW - SKEW.T
C0 = 3.0 * M0 + 2e-7 * K0
CONTACT = fj.FixedContact(4e5, 2e5, P=300.0)
FALLING = fj.ExponentialStribeck(0.5, 0.3, 0.5)
JOINTS = {
    "tip": fj.Joint(CONTACT, FALLING, n - 2, n - 6, V=1.0, preload=True),
    "root": fj.Joint(CONTACT, fj.Coulomb(0.4), {n - 12: 1.0, n - 8: 0.5}, n - 10, preload=True),
}
PARAMETERS = {"Omega": 20.0, "kr": 1.0}
DAMPING = [(1, C0), ("Omega", SKEW)]
STIFFNESS = [(1, K0), ("kr", 2e5 * SKEW)]
OVER = {"Omega": (5.0, 60.0), "kr": (0.2, 2.0)}
PROBLEMS = {
    "no joints": dict(M=M0, joints=(), over=OVER),
    "two joints": dict(M=M0, joints=JOINTS, over=OVER | {"tip.K_n": (1e5, 1e6)}),
    "mass": dict(M=[("1 + 0.01 * Omega", M0)], joints=(), over={"Omega": (5.0, 60.0)}),
}


def full_structure(name):
    given = PROBLEMS[name]
    return fj.ParametricStructure(
        given["M"], DAMPING, STIFFNESS, given["joints"], PARAMETERS, F=np.linspace(-5.0, 5.0, n)
    )


@pytest.fixture(scope="module", params=mostly_slow(PROBLEMS, "two joints"))
def problem(request):
    full, over = full_structure(request.param), PROBLEMS[request.param]["over"]
    return full, fj.reduce(full, over, BAND, tol=1e-8), over


def places(over):
    low, high = np.array(list(over.values())).T
    for u in np.random.default_rng(0).uniform(size=(3, len(over))):
        yield dict(zip(over, low + u * (high - low), strict=True))


@jax.jit
def answers(x, values):
    """Stability at values of some quantities, and the slopes of the growth rate in the band."""

    def rate(values):
        modes = fj.stability(x.replace(**values))
        s = modes.eigenvalues
        return jax.numpy.where(in_band(s), s.real, -np.inf).max(), modes

    slopes, modes = jax.grad(rate, has_aux=True)(values)
    return modes, slopes


def first_order(x, values):
    return state_matrix(*map(np.asarray, fj.assemble(x.replace(**values))))


def by_scipy(x, values):
    """Eigenvalues in the band, and slopes of the largest real part by left and right vectors."""
    solved: Any = scipy.linalg.eig(first_order(x, values), left=True)
    s, left, right = solved
    i = np.argmax(np.where(in_band(s), s.real, -np.inf))
    y, v = left[:, i].conj(), right[:, i]
    slopes = {}
    for name, value in values.items():
        up, down = (first_order(x, values | {name: value * (1 + h)}) for h in (1e-5, -1e-5))
        slopes[name] = (y @ (up - down) @ v / (y @ v) / (2e-5 * value)).real
    return s[in_band(s)], slopes


def in_band(s) -> Any:
    return (s.imag > BAND[0]) & (s.imag < BAND[1]) & (abs(s.real) < 0.3 * abs(s))


@pytest.mark.slow
def test_eigenvalues_derivatives_and_errors(problem):
    full, reduced, over = problem
    assert reduced.n < 0.9 * full.n and reduced.reduction.error <= 1e-8
    for values in places(over):
        x = reduced.replace(**values)
        modes, slopes = answers(reduced, values)
        exact, wanted = by_scipy(full, values)
        s: Any = np.asarray(modes.eigenvalues)[np.asarray(modes.counted)]
        found = s[in_band(s)]
        assert len(exact) == len(found) > 5
        off = np.abs(found - exact[np.abs(exact[None] - found[:, None]).argmin(axis=1)])
        assert (off <= 1e-8 * np.abs(found)).all()
        of_one_kind = np.asarray(modes.counted) & (np.imag(np.asarray(modes.eigenvalues)) > 0)
        errors = fj.reduction_errors(x)[of_one_kind]
        seen = off > 1e-10 * np.abs(found)  # above rounding
        assert (off[seen] < 3 * errors[seen]).all() and (errors[seen] < 3 * off[seen]).all()
        np.testing.assert_allclose(fj.growth_rate(x), np.real(exact).max(), atol=1e-4)
        for name, slope in wanted.items():
            assert abs(slopes[name] - slope) * abs(values[name]) < 1e-8 * BAND[1], name


@pytest.mark.slow
def test_joints_and_equilibrium_are_kept():
    full = full_structure("two joints")
    reduced = fj.reduce(full, {}, BAND)
    q = np.random.default_rng(1).standard_normal(reduced.n)
    x = np.asarray(reduced.full(q))
    for small, large in zip(reduced.joints, full.joints, strict=True):
        for which in ("tangential", "normal"):
            along = large_direction = full.direction(getattr(large, which)) @ x
            small_direction = reduced.direction(getattr(small, which)) @ q
            np.testing.assert_allclose(small_direction, large_direction, rtol=1e-12)
            assert along != 0
    forces = [fj.stability(y).normal_force for y in (full, reduced)]
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-9)
    state = np.concatenate([q, 2 * q])
    np.testing.assert_allclose(reduced.full(state), np.concatenate([x, 2 * x]), rtol=1e-12)
    mode = fj.stability(reduced).unstable()[0]
    shape = np.asarray(reduced.full(mode.shape))
    truth = fj.stability(full).unstable()
    truth = min(truth, key=lambda each: abs(each.frequency - mode.frequency)).shape
    assert abs(np.vdot(shape, truth)) == pytest.approx(
        np.linalg.norm(shape) * np.linalg.norm(truth), rel=1e-5
    )


@pytest.mark.slow
def test_few_estimates_and_an_error_below_the_tolerance_everywhere(monkeypatch):
    """Errors are estimated first where they were large, and at every candidate at the end."""
    calls, original = [], reduction.estimated_errors
    monkeypatch.setattr(reduction, "estimated_errors", lambda *x: calls.append(1) or original(*x))
    reduced = fj.reduce(full_structure("no joints"), OVER, BAND, tol=1e-8)
    grid: Any = np.stack(np.meshgrid(*[np.linspace(*ends, 9) for ends in OVER.values()]), axis=-1)
    assert len(calls) < 4 * (32 * len(OVER) + 4)
    for place in grid.reshape(-1, len(OVER)):
        x = reduced.replace(**dict(zip(OVER, place, strict=True)))
        s, errors = original(x, x.parameters, np.zeros((0, 5)))
        assert len(s) > 5 and (errors <= 1e-8 * np.abs(s)).all()


def chain(count: int):
    """A chain of masses between walls: s^2 + alpha s + kappa omega_j^2 = 0, all sparse."""
    from scipy.sparse import diags_array, eye_array

    offsets: Any = [-1, 0, 1]
    K = 1e8 * diags_array([-1.0, 2.0, -1.0], offsets=offsets, shape=(count, count))
    M = eye_array(count).tocsr()
    return fj.ParametricStructure(
        M, [("alpha", M)], [("kappa", K)], parameters={"alpha": 3.0, "kappa": 1.0}
    )


@pytest.mark.slow
def test_a_large_sparse_chain_against_its_closed_form():
    count = 2500
    full = chain(count)
    assert full.is_sparse and full.n == count
    reduced = fj.reduce(full, {"alpha": (1.0, 9.0), "kappa": (0.5, 2.0)}, (0.0, 250.0))
    omega = 2e4 * np.sin(np.pi * np.arange(1, count + 1) / (2 * (count + 1)))
    for alpha, kappa in ((2.0, 1.7), (8.0, 0.6)):
        s = np.sqrt(alpha**2 / 4 - kappa * omega**2 + 0j) - alpha / 2
        s = s[(s.imag > 0) & (s.imag < 250.0) & (np.abs(s.real) < 0.3 * np.abs(s))]
        modes = fj.stability(reduced.replace(alpha=alpha, kappa=kappa))
        found: Any = np.asarray(modes.eigenvalues)[np.asarray(modes.counted)]
        found = np.sort_complex(found[found.imag > 0] * -1j)
        np.testing.assert_allclose(found * 1j, np.sort_complex(s * -1j) * 1j, rtol=1e-9)


def test_a_large_structure_asks_for_its_reduction():
    full = chain(2500)
    wanted = r"the structure is sparse with 2500 degrees of freedom, .* reduce\(structure"
    for question in (fj.growth_rate, fj.stability, fj.critical_friction, fj.limit_cycle):
        with pytest.raises(ValueError, match=wanted):
            question(full)


REFUSED = {
    "band must be": dict(band=(5.0, 1.0)),
    "band must be .* in rad/s": dict(band=(0.0, np.inf)),
    "structure has no quantity 'omega'": dict(over={"omega": (1.0, 2.0)}),
    r"Omega must be \(low, high\) with low < high": dict(over={"Omega": (2.0, 1.0)}),
    "tol must be": dict(tol=0.0),
    "tol = 1e-10 is not met with 1 points": dict(over={"Omega": (5.0, 60.0)}, tol=1e-10, points=1),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refused(message):
    with pytest.raises(ValueError, match=message):
        fj.reduce(full_structure("no joints"), **(dict(over={}, band=BAND) | REFUSED[message]))
    with pytest.raises(TypeError, match="structure must be a Structure"):
        fj.reduce(fj.brake_scene(), {}, BAND)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="search must be a ReductionSearch"):
        fj.reduce(full_structure("no joints"), {}, BAND, search=8)  # type: ignore[arg-type]


@pytest.mark.parametrize("columns", [0, 1, 5, 70])
def test_many_right_hand_sides_on_many_processors(monkeypatch, columns):
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    rng, shift = np.random.default_rng(0), 0.3 + 0.2j
    M, C, K = (np.diag(rng.uniform(1, 2, 30)) + 0.1 * rng.standard_normal((30, 30)) for _ in "MCK")
    factors, Q = Factors(tuple(map(csr_array, (M, C, K))), shift), shift**2 * M + shift * C + K
    b = rng.standard_normal((30, columns))
    np.testing.assert_allclose(Q @ factors.solve(b), b, rtol=0, atol=1e-13)
    np.testing.assert_allclose(Q.T @ factors.solve(b, transposed=True), b, rtol=0, atol=1e-13)


BRAKE = os.environ.get("FRACTALJAX_BRAKE", "")


NEEDS_BRAKE = pytest.mark.skipif(
    not BRAKE, reason="not run: no matrices in the folder FRACTALJAX_BRAKE"
)


def industrial_brake():
    """The structure, and a function of its parameters that gives (M, C, K) without the package."""
    from scipy.sparse import load_npz

    X = {path.stem: load_npz(path) for path in Path(BRAKE).glob("*.npz")}
    full = fj.ParametricStructure(
        X["BMLL"],
        [
            (1, X["BDLL"]),
            ("Omega", X["BYLL"]),
            ("1/Omega - 1", X["BDIWLL"]),
            ("1/(2*pi*1600)", X["BHLL"]),
        ],
        [(1, X["BKLL"]), ("kr", X["BKQLL"]), ("Omega**2 - 1", X["BWLL"])],
        parameters={"Omega": 4 * np.pi, "kr": 1.0},
    )

    def matrices(Omega, kr):
        C = X["BDLL"] + Omega * X["BYLL"] + (1 / Omega - 1) * X["BDIWLL"]
        K = X["BKLL"] + kr * X["BKQLL"] + (Omega**2 - 1) * X["BWLL"]
        return X["BMLL"], C + X["BHLL"] / (2 * np.pi * 1600), K

    return full, matrices


@pytest.mark.slow
@NEEDS_BRAKE
def test_an_industrial_brake_over_wide_ranges():
    """Beside all modes in full, at corners and at random, with slopes in both modes."""
    full, matrices = industrial_brake()
    over = {"Omega": (2 * np.pi, 8 * np.pi), "kr": (0.1, 1.0)}
    reduced = fj.reduce(full, over, (0.0, 20000.0))

    def rate(values):
        return fj.growth_rate(reduced.replace(**values))

    @jax.jit
    def answers(values):
        modes = fj.stability(reduced.replace(**values))
        return modes, rate(values), jax.jacfwd(rate)(values), jax.jacrev(rate)(values)

    corners = np.array(np.meshgrid(*over.values())).reshape(2, -1).T
    for values in (*(dict(zip(over, x, strict=True)) for x in corners), *places(over)):
        modes, growth, *slopes = answers({name: float(x) for name, x in values.items()})
        found: Any = np.asarray(modes.eigenvalues)[np.asarray(modes.counted)]
        M, C, K = matrices(**values)
        full_modes: Any = band_modes((M, C, K), (0.0, 20000.0))
        s, right, left = full_modes
        for each in s:
            assert np.abs(found - each).min() < 1e-8 * abs(each)
        i = np.argmax(s.real)
        assert abs(growth - s[i].real) < 1e-8 * abs(s[i])
        y, x = left[:, i], right[:, i]
        for name, value in values.items():
            up, down = (matrices(**values | {name: value * (1 + h)}) for h in (1e-5, -1e-5))
            dM, dC, dK = ((a - b) @ x for a, b in zip(up, down, strict=True))
            slope = -(y @ (s[i] ** 2 * dM + s[i] * dC + dK)) / (y @ (2 * s[i] * (M @ x) + C @ x))
            for mode in slopes:
                assert abs(mode[name] * value - slope.real / 2e-5) < 1e-7 * abs(s[i])


@pytest.mark.slow
@NEEDS_BRAKE
def test_an_industrial_brake():
    full = industrial_brake()[0]
    reduced = fj.reduce(full, {"Omega": (2 * np.pi, 40 * np.pi)}, (0.0, 20000.0))
    found = np.asarray(fj.stability(reduced).eigenvalues)
    for s in (74.830642475 + 17399.587752736j, 5.474173698 + 4932.238867j):
        assert np.abs(found - s).min() < 1e-8 * abs(s)
    reduced = fj.reduce(full, {"kr": (0.9, 1.1)}, (0.0, 20000.0))

    def mode(kr):
        s = fj.stability(reduced.replace(kr=kr)).eigenvalues
        return s[jax.numpy.argmin(jax.numpy.abs(s - (74.8 + 17399.6j)))]

    slope = jax.jvp(mode, (1.0,), (1.0,))[1]
    assert abs(slope - (101.849147 + 3.428201j)) < 2e-6


@pytest.mark.slow
def test_right_vectors_begin_where_left_ones_are_small():
    """Two chains of unlike stiffness, coupled as by friction: s^2 + 2 s + lambda_j = 0, no joints.

    With derivatives by the coupling: those of a parameter, outside of compiled programs.
    """
    from scipy.sparse import block_array, csr_array, eye_array, kron

    count, f = 2000, 0.35
    ((_, K),) = chain(count)._terms("K")
    coupling = kron(csr_array([[0.0, 1.0], [-1.0, 0.0]]), eye_array(count))
    M = eye_array(2 * count).tocsr()
    full = fj.ParametricStructure(
        M,
        2 * M,
        [(1, block_array([[K, None], [None, 1.02 * K]])), ("200*f", coupling)],
        parameters={"f": 0.3},
    )
    reduced = fj.reduce(full, {"f": (0.1, 0.9)}, (0.0, 100.0))
    omega = 2e4 * np.sin(np.pi * np.arange(1, 12) / (2 * (count + 1)))

    def roots(f) -> Any:
        pairs = [np.linalg.eigvals([[w, 200 * f], [-200 * f, 1.02 * w]]) for w in omega**2]
        s: Any = np.sqrt(1 - np.array(pairs, complex).ravel()) - 1
        return s[(np.abs(s.imag) < 100.0) & (np.abs(s.real) < 0.3 * np.abs(s))]

    modes = fj.stability(reduced.replace(f=f))
    found: Any = np.asarray(modes.eigenvalues)[np.asarray(modes.counted)]
    for s in roots(f):
        assert np.abs(found - s).min() < 1e-8 * np.abs(s)
    assert modes.growth_rate == pytest.approx(roots(f).real.max(), rel=1e-7)
    slope = jax.grad(lambda f: fj.growth_rate(reduced.replace(f=f)))(f)
    step = (roots(f + 1e-5).real.max() - roots(f - 1e-5).real.max()) / 2e-5
    assert slope == pytest.approx(step, rel=1e-5)
