"""Reduction of a structure to few degrees of freedom, with the error that it makes.

Right and left eigenvectors in a band of frequencies, at points of the parameters that are chosen
one after the other where the error is largest, span the reduced space after a proper orthogonal
decomposition (N. Graebner, V. Mehrmann, S. Quraishi, C. Schroeder and U. von Wagner, Z. Angew.
Math. Mech. 96 (2016) 1388). With right vectors x = V q and left ones in W,

    W^T M V q'' + W^T C V q' + W^T K V q = W^T F,

an eigenvalue s with vectors q and p is off by

    (Q^T W p)^T Q^-1 (Q V q) / (p^T W^T Q'(s) V q),   Q(s) = s^2 M + s C + K,

the product of two residuals. One factorised Q for all estimates it, and the residuals of all terms
are known beforehand, so that an estimate takes no work of size n.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import flag, require_kind, scalar, whole
from .._base.ranges import low_discrepancy, within
from .._mechanism.coefficient import Parameters
from .._mechanism.quantities import (
    replaced,
    require_independent,
    require_known,
    substituted,
    with_optional,
)
from .._mechanism.reduced import CoarseSpace, ReducedStructure, Reduction
from .._mechanism.structure import Joint, ParametricStructure, Structure, require_single
from .band import in_band
from .linearise import attachments
from .sparse_modes import BandModes, Factors, band_modes
from .stability import stability

_LINE = 33  # candidates along one quantity
_CANDIDATES = 32  # for each of several quantities, besides the corners
_MOST = 128  # of them
_CORNERS = 5  # quantities up to which corners are candidates
_CHECKED = 2  # fresh points at which the eigenvalues are compared at the end
_CUT = 1e-2  # times sqrt(tol): where the decomposition ends, at first
_FINER = 0.1  # times that, where it is what limits the error
_LEAST_CUT = 1e-10
_REGULAR = 1e-6  # least singular value of W^T M V
_PARTNERS = 0.03  # least cosine, of the largest, between right and left directions
_SPURIOUS = 0.02  # of |s|: an error beyond which a mode may be none
_SIZES = 10  # degrees of freedom less, among which there are none without
_BEYOND = 0.02  # of the band: modes beyond its ends that may enter it
_SAFE = 0.2  # of tol: the estimate is of leading order
_COARSE = 1e-3  # of |s|: to this the coarse space knows the modes
_WORTH = 40, 0.6  # degrees of freedom from which a coarse space of such a share saves time
_POWERS = {"M": 2, "C": 1, "K": 0}  # of s


def reduce(
    structure: Structure,
    over: Mapping[str, Sequence[float]] | None = None,
    band: Sequence[float] = (0.0, np.inf),
    tol: float = 1e-8,
    *,
    friction_slope: bool = True,
    points: int = 40,
    progress: bool = False,
) -> ReducedStructure:
    """A small structure with the eigenvalues of a large one in a band of frequencies.

    `over` maps named quantities, parameters or those of joints, to ranges (low, high) in which the
    reduction holds; without any it holds for the quantities as they are. `band` is (low, high) in
    rad/s. In it, every eigenvalue s is right to `tol` |s| at all candidates, by an estimate, and
    at two fresh points, by comparison: 33 along one quantity, 32 for each of several, 128 at most,
    besides the corners. Eigenvectors are taken at most at so many `points`. Not looked for are
    modes with |Re s| > 0.3 |s|, static divergence among them.

    The result keeps parameters, joints and their directions, and derivatives; `.full(q)` leads
    back to all degrees of freedom, `.reduction` has the bases, the points and the largest error,
    and `reduction_errors` estimates that of each eigenvalue. Without joints, and with a mass
    matrix that does not depend on parameters, the projection is oblique, left vectors against
    right ones; otherwise one space holds both, so that a joint pulls where it is pulled, and
    static displacements under F and along the joints' directions as well.

    Not for use under `jit`; what it returns is.

    **Raises:** `ValueError` for a band or a range that is empty or outside the domain, an unknown
    quantity, and if `tol` is not met with so many points.
    """
    require_kind("structure", structure, Structure)
    require_single(structure)
    low, high = _range("band", band)
    if not (low >= 0 and np.isfinite(high)):
        raise ValueError(f"band must be (low, high) in rad/s, 0 <= low < high, got {band!r}")
    ranges = {name: _range(name, ends) for name, ends in (over or {}).items()}
    for name in ranges:
        require_known(structure, name)
    require_independent(structure, list(ranges))
    for ends in zip(*ranges.values(), strict=True):
        replaced(structure, dict(zip(ranges, ends, strict=True)))
    tol = float(scalar("tol", tol, above=1e-12, at_most=0.1))
    flag("friction_slope", friction_slope)
    snapshots = _Snapshots(
        with_optional(structure, list(ranges)), ranges, (low, high), friction_slope
    )
    most = whole("points", points, 1)
    return _Greedy(snapshots, tol, most, flag("progress", progress)).run()


def reduction_errors(reduced: ReducedStructure) -> Float[np.ndarray, " 2*r"]:
    """How far each eigenvalue of `stability` is off by the reduction, about [1/s].

    In the same order; infinite outside of the band. It is the product of the residuals of the
    right and the left vector (see `reduction.py`): an estimate, right to leading order. Not
    for use under `jit`.
    """
    numbers = _numbers(reduced, reduced.reduction.friction_slope)
    s, errors = _estimated(reduced, reduced.parameters, np.asarray(numbers))
    wanted = stability(reduced, reduced.reduction.friction_slope)
    counted, z = np.asarray(wanted.counted), np.asarray(wanted.eigenvalues)
    if not s.size:
        return np.full(z.shape, np.inf)
    # One of each conjugate pair is known.
    z = np.where(np.imag(z) < 0, np.conj(z), z)
    apart = np.abs(z[:, None] - s[None])
    return np.where(counted, errors[apart.argmin(axis=1)], np.inf)


def _range(name: str, ends: Any) -> tuple[float, float]:
    try:
        low, high = map(float, ends)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be (low, high), got {ends!r}") from None
    if not low < high:
        raise ValueError(f"{name} must be (low, high) with low < high, got {ends!r}")
    return low, high


# --- eigenvectors at points of the large structure -----------------------------------------------


class _Directions(NamedTuple):
    """Those of all joints, tangential ones first, and the place of the normal one of each."""

    D: np.ndarray  # (n, k)
    normal: tuple[int | None, ...]


def _directions(structure: Structure) -> _Directions:
    columns = [structure.direction(joint.tangential) for joint in structure.joints]
    normal = []
    for joint in structure.joints:
        normal.append(None if joint.normal is None else len(columns))
        if joint.normal is not None:
            columns.append(structure.direction(joint.normal))
    D = np.stack(columns, axis=1) if columns else np.zeros((structure.n, 0))
    return _Directions(np.asarray(D, float), tuple(normal))


def _joint_blocks(numbers: np.ndarray, normal: tuple[int | None, ...], k: int):
    """(C, K) (k, k) that the joints add between their directions, from `_numbers` (m, 5)."""
    C, K = np.zeros((2, k, k))
    for t, (n, (K_n, K_t, mu, c_t, c_n)) in enumerate(zip(normal, numbers, strict=True)):
        C[t, t] += c_t
        K[t, t] += K_t
        if n is not None:
            C[n, n] += c_n
            K[n, n] += K_n
            K[t, n] -= mu * K_n
            K[n, t] += mu * K_t
    return C, K


@functools.partial(jax.jit, static_argnames="friction_slope")
def _numbers(structure: Structure, friction_slope: bool) -> Float[Array, "m 5"]:
    """What each joint adds at the equilibrium: K_n, K_t, mu, c_t, c_n."""
    if not structure.joints:
        return jnp.zeros((0, 5))
    found = attachments(structure, friction_slope).each
    return jnp.stack([jnp.stack([*map(jnp.asarray, each)]) for each in found])


def _projected(structure: Structure, V: np.ndarray, W: np.ndarray) -> dict[str, Any]:
    """Matrices, joints, parameters and F of a structure in the space x = V q."""
    joints = {}
    for name, joint in zip(structure.joint_names, structure.joints, strict=True):
        t = structure.direction(joint.tangential) @ V
        n = None if joint.normal is None else structure.direction(joint.normal) @ V
        joints[name] = Joint(joint.contact, joint.friction, t, n, joint.V, joint.preload)
    terms = {
        name: list(zip(held.coefficients, held.projected(W, V).arrays, strict=True))
        for name, held in structure.sums.items()
    }
    F = None if structure.F is None else W.T @ np.asarray(structure.F)
    return {**terms, "joints": joints, "parameters": structure.parameters, "F": F}


class _Snapshot(NamedTuple):
    """What one point contributes to the reduced space."""

    modes: BandModes
    right: np.ndarray  # (n, a) static displacements
    left: np.ndarray  # (n, b)


class _Snapshots:
    """Eigenvectors of a large structure at points u in [0, 1]^d of its quantities."""

    def __init__(self, structure, ranges, band, friction_slope):
        self.structure, self.ranges, self.band = structure, ranges, band
        self.friction_slope = friction_slope
        self.directions = _directions(structure)
        # A force of friction and one of a spring are along one direction: the projection must be
        # the same for both.
        one_mass = structure.sums["M"].coefficients == (None,)
        self.oblique = one_mass and not structure.joints
        self.needs_equilibrium = any(
            joint.normal is not None
            and (joint.normal_load is not None or joint.friction.velocity_dependent)
            for joint in structure.joints
        )

    def values(self, u: np.ndarray) -> dict[str, float]:
        """The quantities at a point."""
        return {
            name: float(within(low, high, x))
            for x, (name, (low, high)) in zip(u, self.ranges.items(), strict=True)
        }

    def at(self, u: np.ndarray) -> Structure:
        """The structure at a point."""
        return substituted(self.structure, {k: jnp.asarray(x) for k, x in self.values(u).items()})

    def candidates(self) -> np.ndarray:
        """Points (k, d) at which the error is estimated."""
        d = len(self.ranges)
        if d == 0:
            return np.zeros((1, 0))
        if d == 1:
            return (1 - np.cos(np.linspace(0, np.pi, _LINE)))[:, None] / 2
        corners = [np.zeros((0, d))]
        if d <= _CORNERS:
            corners = [np.stack(np.meshgrid(*[[0.0, 1.0]] * d), axis=-1).reshape(-1, d)]
        return np.concatenate([*corners, low_discrepancy(min(_CANDIDATES * d, _MOST), d)])

    def fresh(self) -> np.ndarray:
        """Points (k, d) that are no candidates."""
        d = len(self.ranges)
        return low_discrepancy(min(_CANDIDATES * d, _MOST) + 5, d) if d else np.zeros((1, 0))

    def springs(self, x: Structure) -> Any:
        """K of a structure with the springs and the friction of its joints, sparse."""
        numbers = [
            (*map(float, joint.stiffness()), float(joint.coefficient()), 0.0, 0.0)
            for joint in x.joints
        ]
        return self.matrices(x, np.array(numbers).reshape(-1, 5))[2]

    def statics(self, x: Structure) -> tuple[np.ndarray, np.ndarray]:
        """Displacements (n, k) under F and along the joints' directions; left ones of the latter.

        The equilibrium is among the former, whatever the forces in the joints.
        """
        from scipy.sparse.linalg import splu

        F = [] if x.F is None else [np.asarray(x.F, float)[:, None]]
        D = self.directions.D
        forces = np.concatenate([*F, D], axis=1)
        if not forces.shape[1]:
            return forces, forces
        K = self.springs(x)
        if not self.needs_equilibrium:  # a rigid body may be free
            K = K + (1e-3 * self.band[1]) ** 2 * _plain(x, "M")
        factors = splu(K.tocsc())
        solve: Any = factors.solve
        return solve(forces), solve(np.ascontiguousarray(D), "T")

    def numbers(self, x: Structure, statics: np.ndarray) -> Callable:
        """A function of quantities that gives those of the joints (m, 5), see `_numbers`."""
        if not x.joints:
            return lambda values: np.zeros((0, 5))
        basis = statics if self.needs_equilibrium else self.directions.D
        V = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))[0]
        small = ParametricStructure(**_projected(x, V, V))

        def found(values: Mapping[str, ArrayLike]) -> np.ndarray:
            values = {name: jnp.asarray(value) for name, value in values.items()}
            return np.asarray(_numbers(substituted(small, values), self.friction_slope))

        return found

    def matrices(self, x: Structure, numbers: np.ndarray) -> tuple[Any, Any, Any]:
        """(M, C, K), sparse, with the joints attached."""
        from scipy.sparse import csr_array

        D, normal = self.directions
        blocks = _joint_blocks(numbers, normal, D.shape[1])
        D = csr_array(D)
        C, K = (
            _plain(x, name) + D @ csr_array(block) @ D.T
            for name, block in zip("CK", blocks, strict=True)
        )
        return _plain(x, "M").tocsr(), C.tocsr(), K.tocsr()

    def take(self, u: np.ndarray) -> _Snapshot:
        """All modes in the band at a point, and static displacements."""
        x = self.at(u)
        right, left = self.statics(x)
        low, high = self.band
        wider = low * (1 - _BEYOND), high * (1 + _BEYOND)
        found = band_modes(self.matrices(x, self.numbers(x, right)({})), wider)
        return _Snapshot(found, right, left)


def _plain(x: Structure, name: str) -> Any:
    """A matrix without joints, sparse."""
    from scipy.sparse import csr_array

    held = x.sums[name]
    whole = held.at(x.parameters)
    return csr_array(whole if held.sparse else np.asarray(whole, float))


# --- the reduced space ---------------------------------------------------------------------------


def _decomposed(vectors: list[np.ndarray], weight: np.ndarray, cut: float) -> np.ndarray:
    """An orthonormal basis (n, r) in the norm of a lumped mass, of vectors (n, k), complex or not.

    The most important first; those with singular values below `cut` of the largest are left out.
    """
    unit = [weight[:, None] * X for X in vectors]
    unit = [X / np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny) for X in unit]
    parts = [part for X in unit for part in ([X.real, X.imag] if X.dtype.kind == "c" else [X])]
    U, size, _ = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)
    return U[:, size > cut * size[0]] / weight[:, None]


class _Space:
    """Bases of all that is known, the most important directions first, and their residuals."""

    def __init__(self, snapshots: _Snapshots, taken: list[_Snapshot], weight, cut, factors):
        structure = snapshots.structure
        right = [x for each in taken for x in (each.modes.right, each.right) if x.shape[1]]
        left = [x for each in taken for x in (each.modes.left, each.left) if x.shape[1]]
        if snapshots.oblique:
            V, W = (_decomposed(each, weight, cut) for each in (right, left))
            r = min(V.shape[1], W.shape[1])
            self.V, self.W = _paired(_plain(structure, "M"), V[:, :r], W[:, :r])
        else:
            self.V = self.W = _decomposed([*right, *left], weight, cut)
        self.oblique = snapshots.oblique
        self.M = _plain(structure, "M")
        self.mass = self.W.T @ (self.M @ self.V)
        # L^T Q^-1 R of the residuals of every term: R = [X_1 V, ..., D], L = [X_1^T W, ..., D].
        R, L = [], []
        for _, _, X in _terms(structure):
            R.append(X @ self.V)
            L.append(X.T @ self.W)
        D = snapshots.directions.D
        R, L = (np.concatenate([*each, D], axis=1) for each in (R, L))
        self.residuals = L.T @ factors.solve(R)

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return self.V.shape[1]

    def regular(self, r: int) -> bool:
        """Whether the r most important directions of both sides meet, so that W^T M V = 1 can be.

        Right vectors may begin where left ones are small, and vanish where those are large.
        """
        size = np.linalg.svd(self.mass[:r, :r], compute_uv=False)
        return not self.oblique or size[-1] > _REGULAR

    def coarse(self, r: int, smaller: int, tol: float) -> CoarseSpace:
        """The `smaller` most important directions, in coordinates of those of the r."""
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
        terms = len(self.residuals) // self.size
        rest = np.eye(len(self.residuals) - terms * self.size)
        left, right = (_block_diagonal([X] * terms + [rest]) for X in (S, T))
        return self.V @ T, self.W @ S, left.T @ self.residuals @ right


def _paired(M: Any, V: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V and W (n, r), with directions of the other before them where a direction has no partner.

    A right direction that all left ones are orthogonal to, in the sense of M, would be lost.
    """
    P, size, Qt = np.linalg.svd(W.T @ (M @ V))
    alone = size < _PARTNERS * size[0]
    return np.hstack([W @ P[:, alone], V]), np.hstack([V @ Qt.T[:, alone], W])


def _block_diagonal(blocks: list[np.ndarray]) -> Any:
    from scipy.linalg import block_diag

    return block_diag(*blocks)


def _terms(x: Structure) -> Iterator[tuple[int, Callable | None, Any]]:
    """The power of s, the coefficient and the matrix of every term, always in one order."""
    for name, power in _POWERS.items():
        held = x.sums[name]
        matrices = held.matrices if held.sparse else map(np.asarray, held.arrays)
        for coefficient, X in zip(held.coefficients, matrices, strict=True):
            yield power, coefficient, X


def _estimated(
    reduced: ReducedStructure, parameters: Parameters, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (k,) of a reduced structure in its band, Im s > 0, and their errors [1/s]."""
    from scipy.linalg import eig

    terms = [
        (power, 1.0 if c is None else float(c(parameters)), X) for power, c, X in _terms(reduced)
    ]
    D, normal = _directions(reduced)
    blocks = _joint_blocks(numbers, normal, D.shape[1])
    r = reduced.n
    K, C, M = total = np.zeros((3, r, r))
    for power, c, X in terms:
        total[power] += c * X
    C += D @ blocks[0] @ D.T
    K += D @ blocks[1] @ D.T
    omega, inverse = reduced.reduction.band[1], np.linalg.inv(M)
    A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K / omega**2, -inverse @ C / omega]])
    solved: Any = eig(A, left=True, right=True)
    z, left, right = solved
    sought = in_band(omega * z, reduced.band) & (z.imag > 0)
    s, q, p = omega * z[sought], right[:r, sought], inverse.T @ left[r:, sought].conj()
    slope = (p * (2 * s * (M @ q) + C @ q)).sum(axis=0)

    def residual(vectors, transposed):
        along = D.T @ vectors
        of_C, of_K = (X.T if transposed else X for X in blocks)
        parts = [c * s**power * vectors for power, c, _ in terms]
        return np.concatenate([*parts, s * (of_C @ along) + of_K @ along])

    error = (residual(p, True) * (reduced.reduction.residuals @ residual(q, False))).sum(axis=0)
    return s, np.abs(error) / np.maximum(np.abs(slope), np.finfo(float).tiny)


_Estimates = list[tuple[np.ndarray, np.ndarray]]  # eigenvalues and their errors at each point


class _Greedy:
    """Points one after the other, where the error is largest, until it is small everywhere."""

    def __init__(self, snapshots: _Snapshots, tol: float, most: int, progress: bool):
        from tqdm import tqdm

        self.snapshots, self.tol, self.most = snapshots, tol, most
        self.bar = tqdm(disable=not progress, unit="point", desc="reduce")
        self.cut = _CUT * np.sqrt(tol)
        self.points: list[np.ndarray] = []
        self.taken: list[_Snapshot] = []
        middle = np.full(len(snapshots.ranges), 0.5)
        x = snapshots.at(middle)
        self.weight = np.sqrt(_plain(x, "M").diagonal())
        statics, _ = snapshots.statics(x)
        numbers = snapshots.numbers(x, statics)
        low, high = snapshots.band
        shift = 1e-3 * high + 1j * (low + high) / 2
        self.factors = Factors(snapshots.matrices(x, numbers({})), shift)
        candidates, fresh = snapshots.candidates(), snapshots.fresh()
        self.candidates = [(u, numbers(snapshots.values(u))) for u in candidates]
        self.fresh = [(u, numbers(snapshots.values(u))) for u in fresh]
        for u in [middle, *(np.full_like(middle, end) for end in (0.0, 1.0) if middle.size)]:
            self.add(u)

    def add(self, u: np.ndarray) -> _Snapshot:
        """Take the eigenvectors at a point."""
        if len(self.points) >= self.most:
            raise ValueError(
                f"tol = {self.tol:g} is not met with {self.most} points: take more, a narrower "
                "band or narrower ranges"
            )
        self.points.append(u)
        self.taken.append(self.snapshots.take(u))
        self.bar.update()
        return self.taken[-1]

    def run(self) -> ReducedStructure:
        """The smallest reduced structure found that meets the tolerance."""
        while True:
            known = self.snapshots, self.taken, self.weight, self.cut, self.factors
            space = _Space(*known)
            reduced, estimates = self.sound(space)
            errors = _largest(estimates)
            self.bar.set_postfix_str(f"error {errors.max():.1e}, {reduced.n} degrees of freedom")
            worst, _ = self.candidates[errors.argmax()]
            if errors.max() > _SAFE * self.tol:
                # Where its own vectors are known, what was cut off of them is the error.
                if not any(np.array_equal(worst, u) for u in self.points):
                    self.add(worst)
                    continue
                if self.cut < _LEAST_CUT:
                    raise ValueError(f"tol = {self.tol:g} is below what rounding allows")
                self.cut *= _FINER
                continue
            wanted = [s for s, _ in estimates]
            trimmed = self.trimmed(space, wanted, self.tol)
            reduced, estimate = trimmed or (reduced, float(errors.max()))
            compared = self.compared(reduced)
            if compared <= self.tol:
                break
        self.bar.close()
        reduced.reduction.error = max(estimate, compared)
        least, share = _WORTH
        if self.tol < _COARSE and reduced.n >= least:
            coarse = self.trimmed(space, wanted, _COARSE)
            if coarse and coarse[0].n <= share * reduced.n:
                reduced.reduction.coarse = space.coarse(reduced.n, coarse[0].n, _COARSE)
        return reduced

    def sound(self, space: _Space) -> tuple[ReducedStructure, _Estimates]:
        """The largest structure without spurious modes in the band, and the errors at candidates.

        A spurious mode has an error of its own size, and comes and goes with the directions kept.
        """
        found: Any = None
        for r in range(space.size, max(space.size - _SIZES, 1), -2):
            if found is not None and not space.regular(r):
                continue
            reduced = self.reduced(space, r)
            estimates = [self.estimated(reduced, at) for at in self.candidates]
            largest = _largest(estimates).max()
            if found is None or largest < found[0]:
                found = largest, reduced, estimates
            if largest < _SPURIOUS:
                break
        return found[1:]

    def trimmed(
        self, space: _Space, wanted: list[np.ndarray], tol: float
    ) -> tuple[ReducedStructure, float] | None:
        """The smallest that has the eigenvalues `wanted` of all candidates, and its error there.

        None if that is the space itself.
        """
        fails, holds, found = 0, space.size, None
        while holds - fails > 1:
            r = (fails + holds) // 2
            if not space.regular(r):
                fails = r
                continue
            smaller, largest = self.reduced(space, r), 0.0
            for at, s in zip(self.candidates, wanted, strict=True):
                there, errors = self.estimated(smaller, at)
                # A mode that is lost has no error.
                largest = max(largest, _relative(errors, there), _apart(there, s))
                if largest > _SAFE * tol:
                    break
            if largest <= _SAFE * tol:
                holds, found = r, (smaller, largest)
            else:
                fails = r
        return found

    def reduced(self, space: _Space, r: int) -> ReducedStructure:
        """The structure in a space of r degrees of freedom."""
        snapshots = self.snapshots
        V, W, residuals = space.bases(r)
        reduction = Reduction(
            V=V,
            W=W,
            names=snapshots.structure.names,
            over=snapshots.ranges,
            band=snapshots.band,
            tol=self.tol,
            friction_slope=snapshots.friction_slope,
            residuals=residuals,
            points=[snapshots.values(u) for u in self.points],
            touched=snapshots.structure._touched(),
            error=np.inf,
        )
        small = _projected(snapshots.structure, V, W)
        return ReducedStructure(**small, reduction=reduction, mesh=snapshots.structure.mesh)

    def estimated(self, reduced, at: tuple[np.ndarray, np.ndarray]):
        """Eigenvalues and their errors at a point with these numbers of the joints."""
        u, numbers = at
        return _estimated(reduced, self.snapshots.at(u).parameters, numbers)

    def compared(self, reduced) -> float:
        """The largest error at the worst of fresh points, of |s|, by their own eigenvalues."""
        largest = 0.0
        worst = np.argsort(-_largest([self.estimated(reduced, at) for at in self.fresh]))
        low, high = self.snapshots.band
        for i in worst[: _CHECKED if self.snapshots.ranges else 0]:
            u, _ = self.fresh[i]
            values = {name: jnp.asarray(x) for name, x in self.snapshots.values(u).items()}
            # With its own equilibrium.
            numbers = _numbers(substituted(reduced, values), self.snapshots.friction_slope)
            s, _ = self.estimated(reduced, (u, np.asarray(numbers)))
            exact: Any = self.add(u).modes.s
            edge, frequency = self.tol * np.abs(exact), np.imag(exact)
            well_inside = (frequency > low + edge) & (frequency < high - edge)
            well_inside &= in_band(exact, self.snapshots.band)
            largest = max(largest, _apart(s, exact[well_inside]))
        return largest


def _largest(estimates: _Estimates) -> np.ndarray:
    """The largest error at each point, of |s|."""
    return np.array([_relative(errors, s) for s, errors in estimates])


def _relative(errors: np.ndarray, s: np.ndarray) -> float:
    return float((errors / np.abs(s)).max(initial=0.0))


def _apart(found: np.ndarray, wanted: np.ndarray) -> float:
    """How far the nearest of those found is from each eigenvalue wanted, of |s|, at most."""
    nearest = np.abs(found[None] - wanted[:, None]).min(axis=1, initial=np.inf)
    return _relative(nearest, wanted)
