"""Eigenvectors in a band of a large structure at points of its quantities, for its reduction."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.ranges import low_discrepancy, within
from .._mechanism.quantities import substituted
from .._mechanism.structure import Joint, ParametricStructure, Structure
from .linearise import attachments
from .reduction_search import ReductionSearch
from .sparse_modes import BandModes, band_modes


class _Directions(NamedTuple):
    """Directions of all joints, tangential ones first, and the place of each normal one."""

    D: np.ndarray  # (n, k)
    normal: tuple[int | None, ...]


def joint_directions(structure: Structure) -> _Directions:
    columns = [structure.direction(joint.tangential) for joint in structure.joints]
    normal = []
    for joint in structure.joints:
        normal.append(None if joint.normal is None else len(columns))
        if joint.normal is not None:
            columns.append(structure.direction(joint.normal))
    D = np.stack(columns, axis=1) if columns else np.zeros((structure.n, 0))
    return _Directions(np.asarray(D, float), tuple(normal))


def joint_blocks(numbers: np.ndarray, normal: tuple[int | None, ...], k: int):
    """(C, K) (k, k) that the joints add between their directions, from `joint_numbers` (m, 5)."""
    C, K = np.zeros((2, k, k), numbers.dtype)
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
def joint_numbers(structure: Structure, friction_slope: bool) -> Float[Array, "m 5"]:
    """What joints add at the equilibrium: K_n, K_t, mu, c_t, c_n; complex with a loss factor."""
    if not structure.joints:
        return jnp.zeros((0, 5))
    attached = attachments(structure, friction_slope).each
    return jnp.stack([jnp.stack([*map(jnp.asarray, each)]) for each in attached])


def projected(structure: Structure, V: np.ndarray, W: np.ndarray) -> dict[str, Any]:
    """Matrices, joints, parameters and F of a structure in the space x = V q."""
    joints = {}
    for name, joint in zip(structure.joint_names, structure.joints, strict=True):
        t = structure.direction(joint.tangential) @ V
        n = None if joint.normal is None else structure.direction(joint.normal) @ V
        joints[name] = Joint(
            joint.contact, joint.friction, t, n, joint.V, joint.preload, joint.loss_factor
        )
    terms = {
        name: list(zip(held.coefficients, held.projected(W, V).arrays, strict=True))
        for name, held in structure.sums.items()
    }
    F = None if structure.F is None else W.T @ np.asarray(structure.F)
    return {**terms, "joints": joints, "parameters": structure.parameters, "F": F}


class Snapshot(NamedTuple):
    """What one point contributes to the reduced space."""

    modes: BandModes
    right: np.ndarray  # (n, a) static displacements
    left: np.ndarray  # (n, b)


class Snapshots:
    """Eigenvectors of a large structure at points u in [0, 1]^d of its quantities."""

    def __init__(self, structure, ranges, band, friction_slope, search: ReductionSearch):
        self.structure, self.ranges, self.band = structure, ranges, band
        self.friction_slope, self.search = friction_slope, search
        self.directions = joint_directions(structure)
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
            return (1 - np.cos(np.linspace(0, np.pi, self.search.line)))[:, None] / 2
        corners = [np.zeros((0, d))]
        if d <= self.search.corners:
            corners = [np.stack(np.meshgrid(*[[0.0, 1.0]] * d), axis=-1).reshape(-1, d)]
        return np.concatenate([*corners, low_discrepancy(self._count(), d)])

    def fresh(self) -> np.ndarray:
        """Points (k, d) that are no candidates."""
        d = len(self.ranges)
        # Another number of points lies elsewhere.
        return low_discrepancy(self._count() + 5, d) if d else np.zeros((1, 0))

    def _count(self) -> int:
        """The number of candidates besides the corners."""
        return min(self.search.candidates * len(self.ranges), self.search.most_candidates)

    def springs(self, x: Structure) -> Any:
        """K of a structure with the springs and the friction of its joints, sparse and real."""
        numbers = [
            (*map(float, joint.stiffness()), float(joint.coefficient()), 0.0, 0.0)
            for joint in x.joints
        ]
        return self.matrices(x, np.array(numbers).reshape(-1, 5), static=True)[2]

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
            K = K + (1e-3 * self.band[1]) ** 2 * plain(x, "M")
        factors = splu(K.tocsc())
        solve: Any = factors.solve
        return solve(forces), solve(np.ascontiguousarray(D), "T")

    def numbers(self, x: Structure, statics: np.ndarray) -> Callable:
        """A function of the quantities that gives `joint_numbers` (m, 5)."""
        if not x.joints:
            return lambda values: np.zeros((0, 5))
        basis = statics if self.needs_equilibrium else self.directions.D
        V = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))[0]
        small = ParametricStructure(**projected(x, V, V))

        def numbers_at(values: Mapping[str, ArrayLike]) -> np.ndarray:
            values = {name: jnp.asarray(value) for name, value in values.items()}
            return np.asarray(joint_numbers(substituted(small, values), self.friction_slope))

        return numbers_at

    def matrices(
        self, x: Structure, numbers: np.ndarray, static: bool = False
    ) -> tuple[Any, Any, Any]:
        """(M, C, K), sparse, with the joints attached; K is complex with structural damping.

        Not if it is `static`.
        """
        from scipy.sparse import csr_array

        D, normal = self.directions
        blocks = joint_blocks(numbers, normal, D.shape[1])
        D = csr_array(D)
        C, K = (
            plain(x, name) + D @ csr_array(block) @ D.T
            for name, block in zip("CK", blocks, strict=True)
        )
        if "K_loss" in x.sums and not static:
            K = K + 1j * plain(x, "K_loss")
        return plain(x, "M").tocsr(), C.real.tocsr(), K.tocsr()

    def take(self, u: np.ndarray) -> Snapshot:
        """All modes in the band at a point, and static displacements."""
        x = self.at(u)
        right, left = self.statics(x)
        low, high = self.band
        wider = low * (1 - self.search.beyond), high * (1 + self.search.beyond)
        modes = band_modes(self.matrices(x, self.numbers(x, right)({})), wider)
        return Snapshot(modes, right, left)


def plain(x: Structure, name: str) -> Any:
    """A matrix without joints, sparse."""
    from scipy.sparse import csr_array

    held = x.sums[name]
    whole = held.at(x.parameters)
    return csr_array(whole if held.sparse else np.asarray(whole, float))
