"""Stability where friction has memory: the eigenvalues of the Jacobian of the field of motion."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, ScalarLike

from .._base.lapack import one_by_one, solve
from .._base.rounding import rounding_error
from .._mechanism.mechanism import Mechanism
from .band import among, in_band, leading
from .critical_pair import CriticalPair, critical_pair_of_field, least_test_of_field
from .margin import least_damping_ratio
from .quadratic import Leading, leading_among
from .two_directions import Eigensolution


class LinearisedField(NamedTuple):
    """The modes of n degrees of freedom with k - 2n states of laws; the face is that of others."""

    J: Float[Array, "k k"]  # [1/s], of the field in units of its own
    s: Complex[Array, " k"]  # [1/s], the largest real part first
    vectors: Complex[Array, "k k"]  # right ones, in rows, of any length
    x: Complex[Array, "k n"]  # displacements, of any length
    error: Float[Array, " k"]  # how far rounding of the Jacobian can move s [1/s]
    normal_force: Float[Array, " m"] | None  # as `Stability` has it
    band: tuple[float, float] | None  # of a reduced structure

    def rightmost(self) -> Complex[Array, ""]:
        """The eigenvalue with the largest real part [1/s]."""
        return self.s[0]

    def margin(self, shift: ScalarLike = 0.0) -> Float[Array, ""]:
        """As `margin`."""
        return least_damping_ratio(among(self.s - shift, self.band))

    def modes(self) -> Eigensolution:
        """All modes."""
        counted = in_band(self.s, self.band)
        return Eigensolution(self.s, self.x, self.error, self.margin(), counted)

    def leading(self, count: int) -> Leading:
        """As `quadratic.leading`."""
        fixed = jax.lax.stop_gradient(self.s)
        return leading_among(fixed, lambda places: self.s[places], count, self.band)

    @property
    def open(self) -> Array:
        """False: where a joint is open, all results are NaN."""
        return jnp.zeros((), bool)

    @property
    def lost(self) -> Array:
        """True where a joint is open or there is no steady sliding."""
        return jnp.isnan(self.J).any()

    def least_test(self) -> Float[Array, ""]:
        """As `critical_pair.least_test`."""
        return least_test_of_field(self.s, self.error, self.band)

    def hopf_test(self, rigid: Any = None) -> Float[Array, ""]:
        """The Hopf test function; there are no `rigid` bodies."""
        return self.critical().test

    def critical(self, rigid: Any = None) -> CriticalPair:
        """The critical mode, as `critical_pair`."""
        return critical_pair_of_field(self.J, self.s, self.band)


def linearised_with_memory(mechanism: Mechanism, friction_slope: bool) -> LinearisedField:
    """The modes about steady sliding; NaN where a joint is open or nothing slides steadily.

    **Raises:** `ValueError` without the slope of friction, which its states decide.
    """
    # The field is that of motion, which scenes without memory do not load.
    from .._dynamics.smooth_system import linearised_field

    if not friction_slope:
        raise ValueError("friction_slope must be True for friction with memory, got False")
    J, hybrid, loads = linearised_field(mechanism)
    s, vectors = _eigen(J)
    left = solve(vectors, jnp.eye(len(J), dtype=vectors.dtype))
    conditions = jnp.linalg.norm(vectors, axis=0) * jnp.linalg.norm(left, axis=1)
    error = rounding_error(J.dtype) * jnp.linalg.norm(J) * jax.lax.stop_gradient(conditions)
    # Where the states of a law move alone, any shape will do.
    x = vectors[: hybrid.n].T
    x = jnp.where((x == 0).all(axis=1, keepdims=True), jnp.eye(1, hybrid.n, dtype=x.dtype), x)
    pressed = [joint.normal_load is not None for joint in mechanism.joints_by_name().values()]
    forces = jnp.where(jnp.array(pressed), loads, jnp.nan) if any(pressed) else None
    s, band = s * hybrid.omega, mechanism.band
    order, J = leading(s, band), J * hybrid.omega
    rows, error = vectors.T[order], error[order] * hybrid.omega
    return LinearisedField(J, s[order], rows, x[order], error, forces, band)


@one_by_one
def _lapack(A):
    return tuple(jax.lax.linalg.eig(A, compute_left_eigenvectors=False))


@jax.custom_jvp
def _eigen(A: Float[Array, "k k"]) -> tuple[Complex[Array, " k"], Complex[Array, "k k"]]:
    """Eigenvalues and right vectors, columns; derivatives are those of distinct eigenvalues."""
    return _lapack(A)


@_eigen.defjvp
def _eigen_jvp(primals, tangents):
    s, x = _eigen(*primals)
    change = solve(x, tangents[0].astype(s.dtype) @ x)
    distance = s[None] - s[:, None]
    distance = jnp.where(distance == 0, jnp.inf, distance)
    return (s, x), (jnp.diagonal(change), x @ (change / distance))
