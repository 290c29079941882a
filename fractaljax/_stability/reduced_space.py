"""The space of a reduction, and the errors of its eigenvalues, as `reduction.py` explains them."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .._mechanism.coefficient import Parameters
from .._mechanism.reduced import CoarseSpace, ReducedStructure
from .._mechanism.structure import Structure
from .band import in_band
from .snapshots import Snapshot, Snapshots, joint_blocks, joint_directions, plain

_FACTORS = {"M": (2, 1), "C": (1, 1), "K": (0, 1), "K_loss": (0, 1j)}  # power of s, and unit


def decomposed(vectors: list[np.ndarray], weight: np.ndarray, cut: float) -> np.ndarray:
    """An orthonormal basis (n, r) in the norm of a lumped mass, of vectors (n, k), complex or not.

    The most important first; any with a singular value below `cut` of the largest is left out.
    """
    unit = [weight[:, None] * X for X in vectors]
    unit = [X / np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny) for X in unit]
    parts = [part for X in unit for part in ([X.real, X.imag] if X.dtype.kind == "c" else [X])]
    U, size, _ = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)
    return U[:, size > cut * size[0]] / weight[:, None]


class Space:
    """Bases of all snapshots, the most important directions first, and their residuals."""

    def __init__(self, snapshots: Snapshots, taken: list[Snapshot], weight, cut, factors):
        structure = snapshots.structure
        right = [x for each in taken for x in (each.modes.right, each.right) if x.shape[1]]
        left = [x for each in taken for x in (each.modes.left, each.left) if x.shape[1]]
        if snapshots.oblique:
            V, W = (decomposed(each, weight, cut) for each in (right, left))
            r = min(V.shape[1], W.shape[1])
            self.V, self.W = _paired(plain(structure, "M"), V[:, :r], W[:, :r])
        else:
            self.V = self.W = decomposed([*right, *left], weight, cut)
        self.oblique = snapshots.oblique
        self.M = plain(structure, "M")
        self.mass = self.W.T @ (self.M @ self.V)
        # L^T Q^-1 R of the residuals of every term: R = [X_1 V, ..., D], L = [X_1^T W, ..., D].
        R, L = [], []
        for _, _, X in _terms(structure):
            R.append(X @ self.V)
            L.append(X.T @ self.W)
        D = snapshots.directions.D
        R, L = (np.concatenate([*each, D], axis=1) for each in (R, L))
        solution = factors.solve(R)
        # In parts: a product of L as a complex matrix would take four times the time.
        self.residuals = L.T @ solution.real + 1j * (L.T @ solution.imag)

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return self.V.shape[1]

    def regular(self, r: int) -> bool:
        """True if the r most important directions of both sides meet: W^T M V = 1 can hold.

        Right vectors may begin where left ones are small, and vanish where those are large.
        """
        size = np.linalg.svd(self.mass[:r, :r], compute_uv=False)
        return not self.oblique or size[-1] > 1e-6

    def coarse(self, r: int, smaller: int, tol: float) -> CoarseSpace:
        """The `smaller` most important directions, in coordinates of the r most important."""
        if not self.oblique:
            V = W = np.eye(r)[:, :smaller]
            return CoarseSpace(V, W, tol)
        (V, W, _), (v, w, _) = self.bases(r), self.bases(smaller)
        M = self.M
        return CoarseSpace(W.T @ (M @ v), V.T @ (M.T @ w), tol)

    def bases(self, r: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """V and W (n, r) by the r most important directions, and their residuals (k, k).

        W^T M V = 1 where the projection is oblique.
        """
        T = S = np.eye(self.size)[:, :r]
        if self.oblique:
            P, size, Qt = np.linalg.svd(self.mass[:r, :r])
            T, S = T @ Qt.T / np.sqrt(size), S @ P / np.sqrt(size)
        residuals = _in_space(_in_space(self.residuals, S).T, T).T
        return self.V @ T, self.W @ S, residuals


def _paired(M: Any, V: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V and W (n, r), preceded by directions of the other one that have no partner.

    A right direction that all left ones are orthogonal to, in the sense of M, would be lost.
    """
    P, size, Qt = np.linalg.svd(W.T @ (M @ V))
    alone = size < 0.03 * size[0]
    return np.hstack([W @ P[:, alone], V]), np.hstack([V @ Qt.T[:, alone], W])


def _in_space(rows: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Rows (k, ...) of all terms, each reduced by T^T (r, size), then the rows of the joints."""
    terms = len(rows) // len(T)
    of_terms, rest = np.split(rows, [terms * len(T)])
    reduced = T.T @ of_terms.reshape(terms, len(T), -1)
    return np.concatenate([reduced.reshape(-1, rows.shape[1]), rest])


def _terms(x: Structure) -> Iterator[tuple[str, Callable | None, Any]]:
    """The name of its matrix, the coefficient and the matrix of every term, always in one order."""
    for name in _FACTORS:
        if name not in x.sums:
            continue
        held = x.sums[name]
        matrices = held.matrices if held.sparse else map(np.asarray, held.arrays)
        for coefficient, X in zip(held.coefficients, matrices, strict=True):
            yield name, coefficient, X


def estimated_errors(
    reduced: ReducedStructure, parameters: Parameters, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (k,) of a reduced structure in its band, Im s > 0, and their errors [1/s]."""
    from scipy.linalg import eig

    terms = [
        (*_FACTORS[name], 1.0 if c is None else float(c(parameters)), X)
        for name, c, X in _terms(reduced)
    ]
    D, normal = joint_directions(reduced)
    blocks = joint_blocks(numbers, normal, D.shape[1])
    r = reduced.n
    lossy = "K_loss" in reduced.sums or np.iscomplexobj(numbers)
    K, C, M = total = np.zeros((3, r, r), complex if lossy else float)
    for power, unit, c, X in terms:
        total[power] += unit * c * X
    C += D @ blocks[0] @ D.T
    K += D @ blocks[1] @ D.T
    omega, inverse = reduced.reduction.band[1], np.linalg.inv(M)
    A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K / omega**2, -inverse @ C / omega]])
    eigensystem: Any = eig(A, left=True, right=True)
    z, left, right = eigensystem
    sought = in_band(omega * z, reduced.band) & (z.imag > 0)
    s, q, p = omega * z[sought], right[:r, sought], inverse.T @ left[r:, sought].conj()
    slope = (p * (2 * s * (M @ q) + C @ q)).sum(axis=0)

    def residual(vectors, transposed):
        along = D.T @ vectors
        of_C, of_K = (X.T if transposed else X for X in blocks)
        parts = [unit * c * s**power * vectors for power, unit, c, _ in terms]
        return np.concatenate([*parts, s * (of_C @ along) + of_K @ along])

    error = (residual(p, True) * (reduced.reduction.residuals @ residual(q, False))).sum(axis=0)
    return s, np.abs(error) / np.maximum(np.abs(slope), np.finfo(float).tiny)
