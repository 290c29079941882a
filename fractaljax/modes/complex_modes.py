"""Does a structure squeal: complex eigenvalues of matrices with joints attached.

LAPACK solves (s^2 M + s C + K) x = 0 in coordinates in which M is the identity (Cholesky), as one
eigenvalue problem of size 2n. Its left and right vectors y and x then correct each eigenvalue by
y (s^2 M + s C + K) x, with y (2 s M + C) x = 1, and tell what rounding can have made of it:
entry by entry, so that stiff parts take no digits from soft ones that hardly move them.
Derivatives are those of distinct eigenvalues, ds = -y (s^2 dM + s dC + dK) x. Those of the vectors
themselves are given as well, so that derivatives of every order are right.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import Record, flag
from ..mechanism.matrices import mass_normalised
from ..mechanism.structure import Structure, require_single

# Multiples of the rounding error that sums of n products may have.
_ROUNDING = 16.0


class Mode(NamedTuple):
    """One mode of a structure, as `ComplexModes.unstable` and `least_damped` list them."""

    growth_rate: float  # [1/s]; > 0: it squeals
    frequency: float  # [Hz]
    damping_ratio: float  # -Re/|s|
    shape: np.ndarray  # (n,) complex displacements, the largest of them 1
    largest: int | str  # the degree of freedom of that one, by name where it has one
    resolution: float  # what rounding can make of the growth rate [1/s]


class ComplexModes(Record):
    """Linear stability of a structure about steady sliding, as `stability` returns it.

    `resolutions` are what rounding of M, C and K can make of the eigenvalues: a real part that is
    smaller says nothing. A rigid-body mode, for which K x = 0 within that, has eigenvalue and
    damping ratio 0 exactly. `margin` is the least damping ratio of all other modes: > 0 where they
    are all stable, but unlike that of a scene not smooth where modes cross or coalesce. A smooth
    measure needs a Lyapunov equation of size 2n for every value, which hundreds of degrees of
    freedom make dear.
    """

    eigenvalues: jax.Array  # (2n,) complex [1/s], largest real part first
    growth_rate: jax.Array  # largest real part [1/s]; > 0: it squeals
    frequency: jax.Array  # of the eigenvalue with the largest real part [Hz]
    damping_ratio: jax.Array  # of the same eigenvalue, -Re/|s|
    margin: jax.Array  # least damping ratio of all but rigid-body modes
    resolution: jax.Array  # what rounding can make of the growth rate [1/s]
    frequencies: jax.Array  # (2n,) [Hz]
    damping_ratios: jax.Array  # (2n,)
    resolutions: jax.Array  # (2n,) what rounding can make of each eigenvalue [1/s]
    shapes: jax.Array  # (2n, n) complex displacements, the largest of each 1
    names: tuple[str, ...] | None = eqx.field(static=True)

    def unstable(self) -> list[Mode]:
        """The modes that grow, the fastest first; one of each conjugate pair.

        A real part within its resolution of 0 does not count: see `unresolved`.

        **Raises:** `ValueError` for a batch.
        """
        return [mode for mode in self._modes() if mode.growth_rate > mode.resolution]

    def unresolved(self) -> list[Mode]:
        """The modes of which rounding leaves open whether they grow or die out.

        So are those without damping. Rigid-body modes are not among them.

        **Raises:** `ValueError` for a batch.
        """
        # Not "at most": where the range of numbers ends both may be NaN.
        modes = [mode for mode in self._modes() if not abs(mode.growth_rate) > mode.resolution]
        return [mode for mode in modes if mode.growth_rate or mode.frequency]

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
        numbers = self.frequencies, self.damping_ratios, self.resolutions
        rows = zip(s, shapes, *(x.tolist() for x in numbers), strict=True)
        return [
            Mode(
                growth_rate=float(s.real),
                frequency=frequency,
                damping_ratio=ratio,
                shape=shape,
                largest=self._named(int(np.abs(shape).argmax())),
                resolution=resolution,
            )
            for s, shape, frequency, ratio, resolution in rows
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
    M, C, K, _ = _attached(structure, friction_slope)
    return M, C, K


def _attached(structure: Structure, friction_slope: bool):
    """As `assemble`, and what rounding of the equilibrium can make of C (n, n), if anything."""
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
    if not (flag("friction_slope", friction_slope) and sloping):
        return structure.M, C, K, None
    directions = jnp.stack([d for *_, t, n in sloping for d in (t, n)])
    along, errors = _equilibrium(structure.F, K, directions)
    doubt = jnp.zeros_like(C)
    for i, (joint, K_n, K_t, t, n) in enumerate(sloping):
        slope = joint.friction.slope(joint.V)
        tt, nn = jnp.outer(t, t), jnp.outer(n, n)
        C = C + slope * K_n * along[2 * i + 1] * tt - slope * K_t * along[2 * i] * nn
        error = K_n * errors[2 * i + 1] * jnp.abs(tt) + K_t * errors[2 * i] * jnp.abs(nn)
        doubt = doubt + jnp.abs(slope) * error
    return structure.M, C, K, jax.lax.stop_gradient(doubt)


def _equilibrium(F, K, directions) -> tuple[jax.Array, jax.Array]:
    """Eq. 40: d.x_0 [m] for each of the `directions` (k, n), and what rounding can make of it.

    x_0 (n,) solves K x_0 = F, the joints being in K.
    """
    if F is None:
        raise ValueError(
            "F must be given where friction depends on the sliding velocity, for its slope acts "
            "through the static equilibrium; or leave the slope out with friction_slope=False"
        )
    x_0 = jnp.linalg.solve(K, F)
    along = directions @ x_0
    # K dx = -dK x_0, where |dK| <= eps |K| entry by entry: d.dx = -(K^-T d).(dK x_0).
    K, x_0, F, size = jax.lax.stop_gradient((K, jnp.abs(x_0), F, jnp.abs(along)))
    eps = jnp.finfo(K.dtype).eps
    through = jnp.abs(jnp.linalg.solve(K.T, directions.T))
    errors = _ROUNDING * eps * (jnp.abs(K) @ x_0) @ through
    supported = eps * jnp.abs(K).max() * x_0.max() <= 0.01 * jnp.abs(F).max()
    supported |= errors.max() <= 0.01 * size.max()
    return eqx.error_if(along, ~supported, UNSUPPORTED), errors


UNSUPPORTED = (
    "F has no static equilibrium to rounding: a rigid-body mode is left free; hold the structure, "
    "or leave the slope of the friction law out"
)


class _Scaled(NamedTuple):
    """(z^2 M + z C + K) x = 0 in units, all of them powers of two, that leave no rounding."""

    M: jax.Array  # (n, n), its diagonal from 1 to 4
    C: jax.Array  # (n, n)
    K: jax.Array  # (n, n), like C of order one where it is largest
    units: jax.Array  # (n,) of the degrees of freedom
    doubt: jax.Array | None  # (n, n), of C
    omega: jax.Array  # [rad/s]


def _scaled(structure: Structure, friction_slope: bool) -> _Scaled:
    M, C, K, doubt = _attached(structure, friction_slope)
    units = _power_of_two(-_half_exponent(jnp.diagonal(M)), K.dtype)
    M, C, K, doubt = jax.tree.map(lambda X: X * units[:, None] * units[None], (M, C, K, doubt))
    stiffness, damping = _row_sum(K), _row_sum(C)
    exponent = jnp.maximum(
        jnp.where(stiffness > 0, _half_exponent(stiffness), _LEAST),
        jnp.where(damping > 0, jnp.frexp(damping)[1], _LEAST),
    )
    # The eigenvalues do not depend on the unit of time.
    omega = _power_of_two(jnp.where(exponent > _LEAST, exponent, 0), K.dtype)
    doubt = None if doubt is None else doubt / omega
    return _Scaled(M, C / omega, K / omega / omega, units, doubt, omega)


_LEAST = -2000  # below the exponent of any number


def _row_sum(X) -> jax.Array:
    return jax.lax.stop_gradient(jnp.abs(X).sum(axis=1).max())


def _half_exponent(x) -> jax.Array:
    """Of the square root of x, by powers of two."""
    return jnp.frexp(jax.lax.stop_gradient(x))[1] // 2


def _power_of_two(exponent, dtype) -> jax.Array:
    return jnp.ldexp(jnp.ones_like(exponent, dtype), exponent)


class _Modes(NamedTuple):
    """Of a scaled problem: y_i (z_i^2 M + z_i C + K) = 0 as well, and y_i (2 z_i M + C) x_i = 1."""

    z: jax.Array  # (2n,) eigenvalues
    X: jax.Array  # (n, 2n), right vectors in columns
    Y: jax.Array  # (2n, n), left vectors in rows
    error: jax.Array  # (2n,) what rounding can make of an eigenvalue
    rigid: jax.Array  # (2n,) whether K x = 0 and z = 0, both to rounding


@jax.custom_jvp
def _modes(M, C, K, doubt) -> _Modes:
    z, X, Y = _lapack(M, C, K)
    eps = jnp.finfo(M.dtype).eps
    row, size = z[None], _size(z)[None]
    MX, CX, KX = (A @ X for A in (M, C, K))
    M_size, C_size, K_size = (jnp.abs(A) @ _size(X) for A in (M, C, K))
    slope = (Y.T * (2 * MX * row + CX)).sum(axis=0)
    most = (_size(Y.T) * (2 * M_size * size + C_size)).sum(axis=0)
    # Defective to the last bit: as rounding would have split it.
    slope = jnp.where(_size(slope) > eps * most, slope, jnp.sqrt(eps) * most)
    Y = Y / jnp.where(slope == 0, 1, slope)[:, None]
    # What is left of the problem, and what of that may be rounding: between all of the modes.
    left = -Y @ ((MX * row + CX) * row + KX)
    off = _size(left) + _ROUNDING * eps * (_size(Y) @ ((M_size * size + C_size) * size + K_size))
    if doubt is not None:
        off = off + _size(Y) @ (doubt @ _size(X) * size)
    z, error = _pairwise(z, jnp.diagonal(left), _shift(z, off))
    inertia = _size((Y.T * MX).sum(axis=0))
    stiffness = _ROUNDING * eps * (_size(Y.T) * K_size).sum(axis=0)
    force = (_size(Y.T) * _size(KX)).sum(axis=0)
    rigid = (size[0] ** 2 * inertia <= stiffness) & (force <= stiffness)
    double = jnp.minimum(jnp.sqrt(stiffness / jnp.where(inertia > 0, inertia, 1)), error)
    # Told from elastic modes by far; else it is one of those, lost in rounding.
    rigid &= double < 0.01 * jnp.where(rigid | (size[0] < error), jnp.inf, size[0]).min()
    error = jnp.where(rigid, double, error)
    return _Modes(z, X, Y, error + jnp.sqrt(jnp.finfo(M.dtype).tiny), rigid)


def _size(x) -> jax.Array:
    """A modulus of complex x from 1 to 1.5 times the usual one, which compiles slowly."""
    return jnp.abs(x.real) + jnp.abs(x.imag)


def _lapack(M, C, K):
    """Eigenvalues (2n,), right vectors (n, 2n) and left ones (2n, n), as good as LAPACK makes them.

    Of degrees of freedom that differ by orders of magnitude it keeps the slow ones only where the
    fast ones come first; Cholesky's factors keep them where the fast ones come last.
    """
    n = len(M)
    unit = jnp.diagonal(M)
    rate = jnp.maximum(jnp.sqrt(jnp.abs(jnp.diagonal(K)) / unit), jnp.abs(jnp.diagonal(C)) / unit)
    # Sorted by counting, which compiles in a fraction of the time.
    place = jnp.arange(n)
    earlier = (rate[None] < rate[:, None]) | (
        (rate[None] == rate[:, None]) & (place[None] < place[:, None])
    )
    undo = earlier.sum(axis=1)
    slow_first = jnp.argmax(undo[None] == place[:, None], axis=1)
    L = jnp.linalg.cholesky(M[slow_first][:, slow_first])
    C, K = (mass_normalised(L, A[slow_first][:, slow_first]) for A in (C, K))
    A = jnp.block([[jnp.zeros_like(K), jnp.eye(n, dtype=K.dtype)], [-K, -C]])
    fast_first = np.arange(2 * n).reshape(2, n).T[::-1].ravel()
    z, left, right = jax.lax.linalg.eig(
        A[fast_first][:, fast_first],
        compute_left_eigenvectors=True,
        compute_right_eigenvectors=True,
    )
    back = np.argsort(fast_first)
    # Of a state (x, z x) the upper half, of its left vector the lower.
    halves = jnp.concatenate([right[back][:n], left[back][n:].conj()], axis=1)
    halves = jax.scipy.linalg.solve_triangular(L.astype(z.dtype), halves, lower=True, trans="T")
    halves = halves[undo]
    return z, halves[:, : 2 * n], halves[:, 2 * n :].T


def _shift(z, off):
    """(k,): how far an eigenvalue can be moved by errors `off` (k, k) between all of them."""
    both = jnp.sqrt(off) * jnp.sqrt(off.T)
    apart = _size(z[None] - z[:, None]) / 1.5
    # Of [[0, e], [f, g]] they move by e f/g, and where they meet by sqrt(e f); of more than two,
    # by more.
    moved = 4 * both * jnp.where(both < apart, both / jnp.where(apart > 0, apart, 1), 1)
    return moved.sum(axis=1) - jnp.diagonal(moved) + jnp.diagonal(off)


def _pairwise(z, correction, error):
    """Corrected eigenvalues and their errors, conjugate to the last bit where they were."""
    second = (z.imag < 0) & (z == jnp.roll(z, 1).conj())
    correction = jnp.where(second, jnp.roll(correction, 1).conj(), correction)
    return z + correction, jnp.where(second, jnp.roll(error, 1), error)


@_modes.defjvp
def _modes_jvp(primals, tangents):
    at = _modes(*primals)
    z, X, Y = at.z, at.X, at.Y
    dM, dC, dK = (dA.astype(X.dtype) for dA in tangents[:3])
    drawn = Y @ (dM @ X)
    P = -(drawn * z[None] ** 2 + Y @ (dC @ X) * z[None] + Y @ (dK @ X))
    # Of all lengths the vectors could take, the ones with w dv = 0, w and v being those of the
    # states: eigenvalues and shapes do not depend on the choice.
    same = jnp.eye(len(z), dtype=z.dtype)
    apart = z[None] - z[:, None]
    least = jnp.finfo(z.dtype).eps * (_size(z)[None] + _size(z)[:, None])
    turn = P * _inverse(apart + same, least) * (1 - same)
    none: Any = jnp.zeros_like(at.error), np.zeros(at.rigid.shape, jax.dtypes.float0)
    return at, _Modes(jnp.diagonal(P), X @ turn, -(turn + drawn * z[None]) @ Y, *none)


def _inverse(x, least) -> jax.Array:
    """1/x for complex x; where that is above 1/least, some finite number."""
    size = jnp.maximum(x.real**2 + x.imag**2, jnp.maximum(least**2, jnp.finfo(x.dtype).tiny))
    return x.conj() / size


def growth_rate_of_structure(structure: Structure, friction_slope: bool) -> jax.Array:
    """Largest real part of the eigenvalues [1/s], a scalar: `growth_rate` of a structure."""
    scaled = _scaled(structure, friction_slope)
    modes = _modes(scaled.M, scaled.C, scaled.K, scaled.doubt)
    # Sorting them would compile for as long as all the rest.
    real = jnp.where(modes.rigid, 0, modes.z.real)
    return scaled.omega * real[jnp.argmax(real)]


def complex_modes(structure: Structure, friction_slope: bool) -> ComplexModes:
    """Every mode of a structure: its `stability`."""
    scaled = _scaled(structure, friction_slope)
    z, X, _, error, rigid = _modes(scaled.M, scaled.C, scaled.K, scaled.doubt)
    z = jnp.where(rigid, 0, z)
    order = jnp.lexsort((-z.imag, -z.real))
    z, x, error, rigid = z[order], (X.T * scaled.units[None])[order], error[order], rigid[order]
    size = jnp.abs(jnp.where(rigid, 1, z))
    ratios = jnp.where(rigid, 0, -z.real / size)
    frequencies = scaled.omega * jnp.abs(z.imag) / (2 * jnp.pi)
    resolutions = scaled.omega * error
    largest = jnp.abs(jax.lax.stop_gradient(x)).argmax(axis=1)
    return ComplexModes(
        eigenvalues=scaled.omega * z,
        growth_rate=scaled.omega * z[0].real,
        frequency=frequencies[0],
        damping_ratio=ratios[0],
        margin=jnp.where(rigid, 1, ratios).min(),  # no damping ratio exceeds 1
        resolution=resolutions[0],
        frequencies=frequencies,
        damping_ratios=ratios,
        resolutions=resolutions,
        shapes=x / jnp.take_along_axis(x, largest[:, None], axis=1),
        names=structure.names,
    )
