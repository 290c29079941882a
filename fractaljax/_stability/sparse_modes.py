"""Eigenvalues of large sparse matrices in a band of frequencies, with their vectors.

(s^2 M + s C + K) x = 0 is inverted about a shift by one sparse LU factorisation of the size of M,
and ARPACK finds the nearest eigenvalues (R. B. Lehoucq, D. C. Sorensen and C. Yang, 1998). Left
vectors are those of the transposed problem, by the same factors. SciPy, outside of JAX.

Solutions run in threads: SuperLU releases the interpreter's lock.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, cast

import numpy as np


class BandModes(NamedTuple):
    """Modes with |Im s| in a band, one of each conjugate pair."""

    s: np.ndarray  # (k,) [1/s]
    right: np.ndarray  # (n, k), vectors in columns
    left: np.ndarray  # (n, k): left^T (s^2 M + s C + K) = 0, each with the s of its place


class Factors:
    """Q = s^2 M + s C + K at a shift s, factorised: solves Q x = b and Q^T x = b."""

    def __init__(self, matrices: tuple[Any, Any, Any], shift: complex):
        from scipy.sparse.linalg import splu

        M, C, K = matrices
        self.shift = shift
        Q = (shift**2 * M + shift * C + K).tocsc()
        # The order of rows is that of columns, and pivots are on the diagonal unless they are so
        # small: for the entries of a structure this fills two fifths less and is no less exact.
        self._lu = splu(
            Q,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.1,
            options={"SymmetricMode": True},
        )

    def solve(self, b: np.ndarray, transposed: bool = False) -> np.ndarray:
        """x (n,) or (n, k) for right-hand sides of that shape, complex."""
        how = "T" if transposed else "N"
        if b.ndim == 1:
            return self._lu.solve(np.ascontiguousarray(b, complex), how)

        def some(columns):
            return self._lu.solve(np.asfortranarray(columns, complex), how)

        parts = min(os.cpu_count() or 1, b.shape[1]) or 1  # one without a column
        return np.concatenate(side_by_side(some, np.array_split(b, parts, axis=1)), axis=1)


def side_by_side(function: Callable, arguments: Iterable) -> list[Any]:
    """The values of a function for each of the arguments, computed in threads."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, arguments))


def band_modes(matrices: tuple[Any, Any, Any], band: tuple[float, float]) -> BandModes:
    """All modes of (M, C, K), sparse (n, n), with Im s in the band (low, high) [rad/s].

    Modes damped beyond a ratio of about 0.3 may be missed: they are far from the shifts.

    **Raises:** `ValueError` if more eigenvalues crowd together than can be found.
    """
    low, high = band
    parts = _modes_by_halving(matrices, low, high, high - low)
    s, right, left = (np.concatenate([each[i] for each in parts], axis=-1) for i in range(3))
    order = np.argsort(np.imag(s))
    return BandModes(s[order], right[:, order], left[:, order])


def _modes_by_halving(matrices, low, high, width, nearest: int = 40) -> list[BandModes]:
    """The modes in a band, halved until it has fewer than the `nearest` eigenvalues to a shift."""
    half = (high - low) / 2
    # Not on the axis, where lightly damped eigenvalues are.
    factors = Factors(matrices, half * 1e-3 + 1j * (low + high) / 2)
    n = matrices[0].shape[0]
    count = min(nearest, 2 * n - 2)
    # Side by side, though the left ones are wasted where the band must be halved.
    (s, right), (z, left) = side_by_side(
        lambda transposed: _solve_nearest(matrices, factors, count, transposed), (False, True)
    )
    # The disc about the shift must reach a little beyond its part of the band.
    if np.abs(s - factors.shift).max() < 1.05 * half and count == nearest:
        if half < 1e-6 * width:
            raise ValueError(f"too many eigenvalues near {high:g} rad/s: choose a narrower band")
        middle = (low + high) / 2
        parts = (low, middle), (middle, high)
        return [each for part in parts for each in _modes_by_halving(matrices, *part, width)]
    # The low end of a band at 0 has no mode of its own: real eigenvalues do not oscillate.
    inside = (s.imag > low) & (s.imag <= high)
    s, right = s[inside], right[:, inside]
    place = [int(np.abs(z - each).argmin()) for each in s]
    return [BandModes(s, right, left[:, place])]


def _solve_nearest(matrices, factors: Factors, count: int, transposed: bool):
    """The eigenvalues (k,) nearest to the shift, and their vectors (n, k)."""
    from scipy.sparse.linalg import LinearOperator, eigs

    M, C, _ = (X.T.tocsr() for X in matrices) if transposed else matrices
    n, shift, unit = M.shape[0], factors.shift, abs(factors.shift)
    moving = (C + shift * M).tocsr()

    # It acts on states (x, s x/unit), with halves of one size.
    def inverse(state):
        x, v = state[:n], state[n:]
        y = factors.solve(-(unit * (M @ v) + moving @ x), transposed)
        return np.concatenate([y, (x + shift * y) / unit])

    start = np.random.default_rng(0).standard_normal(2 * n) + 0j
    linear, arpack = cast(Any, LinearOperator), cast(Any, eigs)
    operator = linear((2 * n, 2 * n), inverse, dtype=complex)
    reciprocals, states = arpack(operator, count, which="LM", v0=start, tol=1e-11)
    return shift + 1 / reciprocals, states[:n]
