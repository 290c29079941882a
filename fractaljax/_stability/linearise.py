"""The linearised equations about the sliding equilibrium: of a scene, and of a structure."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.parts import flag
from .._mechanism.oscillator import Linearised, linearise
from .._mechanism.scene import Scene, stiffness
from .._mechanism.structure import Structure, require_single

_ROUNDING = 16.0  # of a sum of n products, in units of eps
NO_EQUILIBRIUM = (
    "F has no static equilibrium to rounding: a rigid-body mode is left free; hold the structure, "
    "or leave the slope of the friction law out"
)


def linearised(scene: Scene, friction_slope: bool) -> Linearised:
    """The characteristic polynomial of a scene (Eq. 43), with the stiffness of its contact."""
    K_n, K_t = stiffness(scene)
    return linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope)


class Assembled(NamedTuple):
    """M x'' + C x' + K x = 0, each matrix (n, n), with the joints attached."""

    M: jax.Array
    C: jax.Array
    K: jax.Array
    C_error: jax.Array | None  # bound on the rounding error of C due to the equilibrium


def assemble(
    structure: Structure, friction_slope: bool = True
) -> tuple[Float[Array, "n n"], Float[Array, "n n"], Float[Array, "n n"]]:
    """(M, C, K), each (n, n), with the joints attached, in the units of the structure.

    With t and n the directions of a joint, Eq. 43 in vectors: K_t t t^T + K_n n n^T
    - mu K_n t n^T + mu K_t n t^T is added to K. The slope of the friction law adds
    mu' K_n (n.x_0) t t^T - mu' K_t (t.x_0) n n^T to C, where x_0 is the equilibrium.

    **Raises:** `ValueError` for a batch, and where a slope needs F and there is none.
    """
    M, C, K, _ = assembled(structure, friction_slope)
    return M, C, K


def assembled(structure: Structure, friction_slope: bool) -> Assembled:
    """As `assemble`, with a bound on the rounding error of C."""
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
        return Assembled(structure.M, C, K, None)
    directions = jnp.stack([d for *_, t, n in sloping for d in (t, n)])
    along, errors = _equilibrium(structure.F, K, directions)
    C_error = jnp.zeros_like(C)
    for i, (joint, K_n, K_t, t, n) in enumerate(sloping):
        slope = joint.friction.slope(joint.V)
        tt, nn = jnp.outer(t, t), jnp.outer(n, n)
        C = C + slope * K_n * along[2 * i + 1] * tt - slope * K_t * along[2 * i] * nn
        error = K_n * errors[2 * i + 1] * jnp.abs(tt) + K_t * errors[2 * i] * jnp.abs(nn)
        C_error = C_error + jnp.abs(slope) * error
    return Assembled(structure.M, C, K, jax.lax.stop_gradient(C_error))


def _equilibrium(F, K, directions) -> tuple[jax.Array, jax.Array]:
    """Eq. 40: d.x_0 [m] along each of the `directions` (k, n), and a bound on its rounding error.

    x_0 (n,) solves K x_0 = F, the joints being in K.
    """
    if F is None:
        raise ValueError(
            "F must be given where friction depends on the sliding velocity, for its slope acts "
            "through the static equilibrium; or leave the slope out with friction_slope=False"
        )
    x_0 = jnp.linalg.solve(K, F)
    along = directions @ x_0
    # K dx = -dK x_0 with |dK| <= eps |K| entry by entry, so that d.dx = -(K^-T d).(dK x_0).
    K, x_0, F, size = jax.lax.stop_gradient((K, jnp.abs(x_0), F, jnp.abs(along)))
    eps = jnp.finfo(K.dtype).eps
    through = jnp.abs(jnp.linalg.solve(K.T, directions.T))
    errors = _ROUNDING * eps * (jnp.abs(K) @ x_0) @ through
    supported = eps * jnp.abs(K).max() * x_0.max() <= 0.01 * jnp.abs(F).max()
    supported |= errors.max() <= 0.01 * size.max()
    return eqx.error_if(along, ~supported, NO_EQUILIBRIUM), errors
