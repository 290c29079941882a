"""The rightmost mode from a coarse space, beside SciPy's eigenvalues and all modes of LAPACK."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from fractaljax._mechanism.reduced import CoarseSpace
from fractaljax._stability.quadratic import solve
from fractaljax._stability.rightmost import _refined, rightmost
from structures import state_matrix

N, BAND = 24, (0.0, 8.5)


def problem(seed: int = 0):
    """Oscillators at 1, 2, ... rad/s, with gyroscopic and circulatory coupling; some grow."""
    rng = np.random.default_rng(seed)
    S, C = rng.standard_normal((2, N, N))
    M, K = np.eye(N) + 0.02 * (S + S.T), np.diag(np.arange(1.0, N + 1) ** 2)
    return M, 0.02 * (S - S.T) + 0.005 * C, K + 0.1 * (C - C.T)


def modes_of(M, C, K):
    """Eigenvalues in the upper half plane and their vectors, in columns, by SciPy."""
    found: Any = scipy.linalg.eig(state_matrix(M, C, K), left=True)
    s, left, right = found
    up = s.imag > 0
    return s[up], right[:N, up], np.linalg.solve(M.T, left[N:, up].conj())


def largest(matrices) -> complex:
    s = modes_of(*matrices)[0]
    s = s[s.imag <= BAND[1]]
    return s[np.argmax(s.real)]


def coarse_space(matrices, off: float = 1e-3, tol: float = 1e-3):
    """A space of 10 of the vectors of frequencies up to 10, each off by so much.

    Of one size, so that one program is compiled for all.
    """
    s, right, left = modes_of(*matrices)
    kept = s.imag < 10
    rng, bases = np.random.default_rng(9), []
    for X in (right[:, kept], left[:, kept]):
        X = np.concatenate([X.real, X.imag], axis=1) / np.linalg.norm(X, axis=0).repeat(2)
        bases.append(np.linalg.svd(X + off * rng.standard_normal(X.shape))[0][:, :10])
    V, W = bases
    return CoarseSpace(V, W @ np.linalg.inv(V.T @ matrices[0] @ W), tol)


modes = jax.jit(solve)


@jax.jit
def refined(band, V, W, tol, *matrices):
    """`_refined`, compiled once for all spaces of one size."""
    return _refined(band, CoarseSpace(V, W, tol), *matrices)


@functools.partial(jax.jit, static_argnums=0)
def by(coarse, *matrices):
    """`rightmost` by a space, or by all modes."""
    return rightmost(matrices, BAND, coarse)


# In the last three another mode seems to grow most.
@pytest.mark.parametrize(
    ("seed", "off"), [(0, 1e-3), (1, 1e-3), (17, 3e-3), (25, 3e-3), (32, 3e-3)]
)
def test_the_rightmost_of_rough_modes_is_refined_to_rounding(seed, off):
    M, C, K = matrices = problem(seed)
    coarse, wanted = coarse_space(matrices, off), largest(matrices)
    assert coarse.V.shape[1] < N
    rough: Any = np.asarray(modes(*(coarse.W.T @ X @ coarse.V for X in matrices)).s)
    assert np.abs(rough - wanted).min() > 1e-9 * abs(wanted)
    seems = rough[np.argmax(np.where((rough.imag > 0) & (rough.imag < BAND[1]), rough.real, -9))]
    assert (abs(seems - wanted) > 0.1) == (off == 3e-3)
    (s, x, y), settled = refined(BAND, *vars(coarse).values(), M, C, K)
    assert settled and abs(s - wanted) < 1e-13 * abs(wanted)
    Q = s**2 * M + s * C + K
    for residual, vector in ((Q @ x, x), (y @ Q, y)):
        assert np.abs(residual).max() < 1e-11 * K.max() * np.abs(vector).max()
    assert abs(y @ ((2 * s * M + C) @ x) - 1) < 1e-12


@pytest.mark.slow
def test_a_mode_just_beyond_the_band_nan_and_a_batch():
    matrices = problem()
    s = modes_of(*matrices)[0]
    s = s[s.imag < 8.5]
    first, second = s[np.argsort(-s.real)[:2]]
    assert second.imag < first.imag
    band = 0.0, first.imag - 1e-6
    (found, *_), settled = refined(band, *vars(coarse_space(matrices)).values(), *matrices)
    assert settled and abs(found - second) < 1e-12
    M, C, K = problem()
    assert jnp.isnan(by(coarse_space((M, C, K)), M, C, np.nan * K))
    both = [jax.vmap(jax.value_and_grad(f)) for f in along_a_line()]
    found, wanted = jax.jit(lambda t: [f(t) for f in both])(jnp.linspace(0, 1e-4, 5))
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)


def twice(matrices):
    """The same structure two times: every eigenvalue is double."""
    return [np.kron(np.eye(2), X) for X in matrices]


def rough_beyond_its_tolerance(matrices):
    return matrices, coarse_space(matrices, tol=1e-9)


def every_mode_twice(matrices):
    space = coarse_space(matrices)
    V, W = (np.kron(np.eye(2), X) for X in (space.V, space.W))
    return twice(matrices), CoarseSpace(V, W, space.tol)


def none_in_the_band(matrices):
    M, C, K = matrices
    return (M, C, 400 * K), coarse_space(matrices)


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", [rough_beyond_its_tolerance, every_mode_twice, none_in_the_band])
def test_all_modes_decide_where_rough_ones_do_not(spoilt):
    matrices, coarse = spoilt(problem())
    assert not refined(BAND, *vars(coarse).values(), *matrices)[1]
    assert by(coarse, *matrices).real == by(None, *matrices).real


@functools.cache
def along_a_line():
    """The growth rate at t of a line of matrices, from a coarse space and from all modes."""
    matrices, other = problem(), problem(1)
    coarse = coarse_space(matrices)

    def at(t):
        return tuple(X + t * (Y - X) for X, Y in zip(matrices, other, strict=True))

    def of_all(t):
        s = solve(*at(t)).s
        return jnp.where((s.imag > 0) & (s.imag <= BAND[1]), s.real, -jnp.inf).max()

    return lambda t: rightmost(at(t), BAND, coarse).real, of_all


def kept(slope):
    """A slope, and the same beside its own derivative: one program has several orders."""
    return lambda t: (value := slope(t), value)


DERIVATIVES = {
    "first and third": lambda f: jax.jacfwd(
        jax.jacfwd(kept(jax.jacfwd(f)), has_aux=True), has_aux=True
    ),
    "first and second, reverse": lambda f: jax.grad(kept(jax.grad(f)), has_aux=True),
    "second, forward over reverse": lambda f: lambda t: (jax.jacfwd(jax.grad(f))(t),),
}


@pytest.mark.slow
@pytest.mark.parametrize("orders", DERIVATIVES)
def test_derivatives_of_every_order_are_those_of_all_modes(orders):
    program = jax.jit(lambda t: [DERIVATIVES[orders](f)(t) for f in along_a_line()])
    for found, wanted in zip(*program(0.01), strict=True):
        assert abs(wanted) > 1e-4
        assert found == pytest.approx(float(wanted), rel=1e-9)


@pytest.mark.slow
def test_a_reduced_structure_keeps_its_coarse_space(tmp_path):
    """On disk too; growth rates and slopes are those of all its modes."""
    M, C, K = problem()
    skew = [("kr", C - C.T)]
    joint = fj.Joint(fj.FixedContact(0.5, 0.2), fj.Coulomb(0.4), 1, 2)
    full = fj.ParametricStructure(M, C, [(1, (K + K.T) / 2), *skew], joint, {"kr": 0.1})
    search = fj.ReductionSearch(coarse_from=10, coarse_share=1.0)
    reduced = fj.reduce(full, {"kr": (0.0, 0.2), "mu": (0.2, 0.6)}, BAND, 1e-7, search=search)
    coarse = reduced.coarse
    assert coarse is not None and coarse.V.shape[1] < reduced.n < N
    reduced.save(tmp_path / "x.toml")
    read: Any = fj.load(tmp_path / "x.toml")
    np.testing.assert_array_equal([read.coarse.V, read.coarse.W], [coarse.V, coarse.W])

    @jax.jit
    def slopes(p):
        def of(measure):
            return jax.value_and_grad(lambda p: measure(reduced.replace(**p)))(p)

        return of(fj.growth_rate), of(lambda x: fj.stability(x).growth_rate)

    for kr in (0.01, 0.15):
        found, wanted = slopes({"kr": kr, "mu": 0.3})
        for ours, theirs in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
            assert ours == pytest.approx(float(theirs), rel=1e-9)


def even(matrices):
    """The same without what makes one mode grow before all others: many are to be told apart."""
    M, C, K = matrices
    return M, C - C.T, (K + K.T) / 2 + 0.02 * (K - K.T)


@pytest.mark.slow
@pytest.mark.parametrize("matrices", [problem(), even(problem())], ids=["uneven", "even"])
@pytest.mark.parametrize("at", [0.0, 0.37, 1.0])
def test_the_short_cut_holds_at_the_ends_of_a_range_in_both_modes(matrices, at):
    """Without all modes: settled, few factorisations, and slopes forwards and in reverse."""
    M, C, K = matrices
    coarse = coarse_space(matrices)
    other = problem(1)[1]

    def moved(t):
        return M, C + 1e-3 * t * other, (1 + 1e-3 * t) * K

    (s, *_), settled = refined(BAND, *vars(coarse).values(), *moved(at))
    assert settled and abs(s - largest(moved(at))) < 1e-12 * abs(s)

    def rate(t):
        return rightmost(moved(t), BAND, coarse).real

    up, down = (largest(moved(at + h)).real for h in (1e-3, -1e-3))
    for mode in (jax.jacfwd, jax.jacrev):
        slope = jax.jit(mode(rate))(at)
        assert slope == pytest.approx((up - down) / 2e-3, rel=1e-5, abs=1e-10)
