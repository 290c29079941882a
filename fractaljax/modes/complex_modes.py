"""Does a structure squeal: complex eigenvalues of matrices with joints attached.

(s^2 M + s C + K) x = 0 in coordinates in which M is the identity (Cholesky) and in units of
omega = sqrt(|K|), as one eigenvalue problem of size 2n: rows and columns are then of order one,
whatever the units of the degrees of freedom, so that a float32 survives. Derivatives are those of
distinct eigenvalues, ds = w dA v for left and right vectors w and v with w v = 1. Those of the
vectors themselves are given as well, so that derivatives of every order are right.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import Record
from ..mechanism.matrices import mass_normalised
from ..mechanism.structure import Structure, require_single

# Multiples of the rounding error below which something counts as zero: the square of a rigid-body
# mode's eigenvalue, a real part; both in units of omega. Free beams of 200 degrees of freedom
# reach 0.3.
_ROUNDING = 16.0


class Mode(NamedTuple):
    """One mode of a structure, as `ComplexModes.unstable` and `least_damped` list them."""

    growth_rate: float  # [1/s]; > 0: it squeals
    frequency: float  # [Hz]
    damping_ratio: float  # -Re/|s|
    shape: np.ndarray  # (n,) complex displacements, the largest of them 1
    largest: int | str  # the degree of freedom of that one, by name where it has one


class ComplexModes(Record):
    """Linear stability of a structure about steady sliding, as `stability` returns it.

    A rigid-body mode has eigenvalue and damping ratio 0 exactly. `margin` is the least damping
    ratio of all other modes: > 0 where they are all stable, but unlike that of a scene not smooth
    where modes cross or coalesce. A smooth measure needs a Lyapunov equation of size 2n for every
    value, which hundreds of degrees of freedom make dear.
    """

    eigenvalues: jax.Array  # (2n,) complex [1/s], largest real part first
    growth_rate: jax.Array  # largest real part [1/s]; > 0: it squeals
    frequency: jax.Array  # of the eigenvalue with the largest real part [Hz]
    damping_ratio: jax.Array  # of the same eigenvalue, -Re/|s|
    margin: jax.Array  # least damping ratio of all but rigid-body modes
    frequencies: jax.Array  # (2n,) [Hz]
    damping_ratios: jax.Array  # (2n,)
    shapes: jax.Array  # (2n, n) complex displacements, the largest of each 1
    resolution: jax.Array  # what rounding can make of a real part [1/s]
    names: tuple[str, ...] | None = eqx.field(static=True)

    def unstable(self) -> list[Mode]:
        """The modes that grow, the fastest first; one of each conjugate pair.

        A real part within `resolution` of 0 does not count: without damping, it is rounding.

        **Raises:** `ValueError` for a batch.
        """
        return [mode for mode in self._modes() if mode.growth_rate > float(self.resolution)]

    def least_damped(self, count: int = 10) -> list[Mode]:
        """The `count` oscillating modes of least damping ratio, that one first.

        **Raises:** `ValueError` for a batch.
        """
        modes = [mode for mode in self._modes() if mode.frequency > 0]
        return sorted(modes, key=lambda mode: mode.damping_ratio)[:count]

    def _modes(self) -> list[Mode]:
        if self.eigenvalues.ndim != 1:
            raise ValueError(f"modes are listed of one structure, got {self.eigenvalues.shape}")
        s, shapes = np.asarray(self.eigenvalues), np.asarray(self.shapes)
        rows = zip(s, self.frequencies.tolist(), self.damping_ratios.tolist(), shapes, strict=True)
        return [
            Mode(float(s.real), frequency, ratio, shape, self._named(int(np.abs(shape).argmax())))
            for s, frequency, ratio, shape in rows
            if s.imag >= 0
        ]

    def _named(self, dof: int) -> int | str:
        return dof if self.names is None else self.names[dof]

    def _shown(self):
        for name in ("growth_rate", "frequency", "damping_ratio", "margin"):
            yield f"{name}={getattr(self, name)}"
        yield f"eigenvalues: {self.eigenvalues.shape}"


def assemble(structure: Structure, friction_slope: bool = True):
    """(M, C, K), each (n, n), with the joints attached, in the units of the structure.

    With t and n the directions of a joint, Eq. 43 in vectors: K_t t t^T + K_n n n^T
    - mu K_n t n^T + mu K_t n t^T is added to K. The slope of the law adds mu' K_n (n.x_0) t t^T
    - mu' K_t (t.x_0) n n^T to C, x_0 being the equilibrium; laws without slope trace neither.

    **Raises:** `ValueError` for a batch, and where a slope needs F and there is none.
    """
    require_single(structure)
    C, K = structure.C, structure.K
    joints = []
    for joint in structure.joints:
        K_n, K_t = joint.stiffness()
        mu = joint.coefficient()
        t, n = map(jnp.asarray, map(structure.direction, (joint.tangential, joint.normal)))
        K = K + K_t * jnp.outer(t, t) + K_n * jnp.outer(n, n)
        K = K - mu * K_n * jnp.outer(t, n) + mu * K_t * jnp.outer(n, t)
        joints.append((joint, K_n, K_t, t, n))
    sloping = [joint for joint in joints if joint[0].friction.velocity_dependent]
    if friction_slope and sloping:
        x_0 = _equilibrium(structure.F, K)
        for joint, K_n, K_t, t, n in sloping:
            slope = joint.friction.slope(joint.V)
            C = C + slope * K_n * (n @ x_0) * jnp.outer(t, t)
            C = C - slope * K_t * (t @ x_0) * jnp.outer(n, n)
    return structure.M, C, K


def _equilibrium(F, K) -> jax.Array:
    """Eq. 40: the displacements x_0 (n,) [m] with K x_0 = F, the joints being in K."""
    if F is None:
        raise ValueError(
            "F must be given where friction depends on the sliding velocity, for its slope acts "
            "through the static equilibrium; or leave the slope out with friction_slope=False"
        )
    x_0 = jnp.linalg.solve(K, F)
    # |dx|/|x| <= eps |K| |x|/|F|: what rounding of K can make of x_0.
    spread = jnp.finfo(K.dtype).eps * jnp.abs(K).max() * jnp.abs(x_0).max()
    return eqx.error_if(x_0, ~(spread <= 0.01 * jnp.abs(F).max()), UNSUPPORTED)


UNSUPPORTED = (
    "F has no static equilibrium to rounding: a rigid-body mode is left free; hold the structure, "
    "or leave the slope of the friction law out"
)


class _Scaled(eqx.Module):
    """z v = A v in units of omega, its vectors v being (L^T x, z L^T x)."""

    A: jax.Array  # (2n, 2n)
    L: jax.Array  # (n, n), M = L L^T
    omega: jax.Array  # [rad/s]


def _scaled(structure: Structure, friction_slope: bool) -> _Scaled:
    M, C, K = assemble(structure, friction_slope)
    L = jnp.linalg.cholesky(M)
    C, K = mass_normalised(L, C), mass_normalised(L, K)
    damping, stiffness = _row_sum(C), _row_sum(K)
    omega = jnp.where(stiffness > 0, jnp.sqrt(stiffness), damping)
    # The eigenvalues do not depend on the unit of time.
    omega = jax.lax.stop_gradient(jnp.where(omega > 0, omega, 1))
    zero, one = jnp.zeros_like(K), jnp.eye(structure.n, dtype=K.dtype)
    return _Scaled(jnp.block([[zero, one], [-K / omega**2, -C / omega]]), L, omega)


def _row_sum(X) -> jax.Array:
    return jnp.abs(X).sum(axis=1).max()


def _inverse(x) -> jax.Array:
    """1/x for complex x; where it is infinite, some finite number."""
    size = x.real**2 + x.imag**2
    return x.conj() / jnp.maximum(size, jnp.finfo(size.dtype).eps ** 2)


@jax.custom_jvp
def _eigenvectors(A):
    """Eigenvalues z (k,) of A, right vectors V in columns, left vectors W in rows: W V = 1."""
    z, left, right = jax.lax.linalg.eig(
        A, compute_left_eigenvectors=True, compute_right_eigenvectors=True
    )
    left = left.conj().T
    return z, right, left * _inverse((left * right.T).sum(axis=1))[:, None]


@_eigenvectors.defjvp
def _eigenvectors_jvp(primals, tangents):
    (A,), (dA,) = primals, tangents
    z, V, W = _eigenvectors(A)
    P = W @ dA.astype(V.dtype) @ V
    # Of all lengths the vectors could take, the ones with w dv = 0: eigenvalues and shapes do not
    # depend on the choice.
    apart = (z[None] - z[:, None]) + jnp.eye(len(z), dtype=z.dtype)
    turn = P * _inverse(apart) * (1 - jnp.eye(len(z), dtype=z.dtype))
    return (z, V, W), (jnp.diagonal(P), V @ turn, -turn @ W)


@jax.custom_jvp
def _eigenvalues(A):
    """The same eigenvalues by a cheaper route, in any order."""
    return jnp.linalg.eigvals(A)


@_eigenvalues.defjvp
def _eigenvalues_jvp(primals, tangents):
    (A,), (dA,) = primals, tangents
    z, V, W = _eigenvectors(A)
    return z, ((W @ dA.astype(V.dtype)) * V.T).sum(axis=1)


def _rigid_at_rest(z):
    """Eigenvalues with those of rigid-body modes, which rounding splits, put to 0."""
    rigid = z.real**2 + z.imag**2 <= _ROUNDING * jnp.finfo(z.dtype).eps
    return jnp.where(rigid, 0, z)


def growth_rate_of_structure(structure: Structure, friction_slope: bool) -> jax.Array:
    """Largest real part of the eigenvalues [1/s], a scalar: `growth_rate` of a structure."""
    scaled = _scaled(structure, friction_slope)
    real = _rigid_at_rest(_eigenvalues(scaled.A)).real
    return scaled.omega * real[jnp.argmax(real)]


def complex_modes(structure: Structure, friction_slope: bool) -> ComplexModes:
    """Every mode of a structure: its `stability`."""
    scaled = _scaled(structure, friction_slope)
    z, V, _ = _eigenvectors(scaled.A)
    z = _rigid_at_rest(z)
    order = jnp.lexsort((-z.imag, -z.real))
    z, V = z[order], V[:, order]
    rigid = z == 0
    size = jnp.abs(jnp.where(rigid, 1, z))
    ratios = jnp.where(rigid, 0, -z.real / size)
    frequencies = scaled.omega * jnp.abs(z.imag) / (2 * jnp.pi)
    x = jax.scipy.linalg.solve_triangular(
        scaled.L.astype(V.dtype), V[: structure.n], lower=True, trans="T"
    ).T
    largest = jnp.abs(jax.lax.stop_gradient(x)).argmax(axis=1)
    return ComplexModes(
        eigenvalues=scaled.omega * z,
        growth_rate=scaled.omega * z[0].real,
        frequency=frequencies[0],
        damping_ratio=ratios[0],
        margin=jnp.where(rigid, 1, ratios).min(),  # no damping ratio exceeds 1
        frequencies=frequencies,
        damping_ratios=ratios,
        shapes=x / jnp.take_along_axis(x, largest[:, None], axis=1),
        resolution=_ROUNDING * jnp.finfo(scaled.omega.dtype).eps * scaled.omega,
        names=structure.names,
    )
