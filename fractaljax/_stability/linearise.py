"""The linearised equations about the sliding equilibrium: of a scene, and of a structure."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.parts import flag
from .._mechanism.oscillator import Linearised, linearise, static_normal_force
from .._mechanism.quantities import sliding_friction
from .._mechanism.scene import Scene, stiffness
from .._mechanism.structure import Structure, require_single

_ROUNDING = 16.0  # of a sum of n products, in units of eps
NO_EQUILIBRIUM = (
    "F has no static equilibrium to rounding: a rigid-body mode is left free; hold the structure, "
    "or leave the slope of the friction law out"
)
NO_PRESSED_EQUILIBRIUM = (
    "F and the friction of the preloaded joints have no static equilibrium to rounding: a "
    "rigid-body mode is left free; hold the structure"
)


def linearised(scene: Scene, friction_slope: bool) -> Linearised:
    """The characteristic polynomial of a scene (Eq. 43), with the stiffness of its contact."""
    K_n, K_t = stiffness(scene)
    return linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope, scene.normal_load)


def normal_force(scene: Scene) -> Float[Array, " 1"] | None:
    """P + K_n x_02 [N] at the equilibrium, if the scene is preloaded; at most 0: it is open."""
    if scene.normal_load is None:
        return None
    friction = sliding_friction(scene)
    K_n, K_t = stiffness(scene)
    return static_normal_force(scene.oscillator, K_n, K_t, friction, scene.normal_load)[None]


class Assembled(NamedTuple):
    """M x'' + C x' + K x = 0, each matrix (n, n), with the joints attached."""

    M: jax.Array
    C: jax.Array
    K: jax.Array
    C_error: jax.Array | None  # bound on the rounding error of C due to the equilibrium
    normal_force: jax.Array | None  # (m,) [N], as `Stability` has it

    @property
    def open(self) -> jax.Array:
        """Whether a preloaded joint is."""
        return jnp.zeros((), bool) if self.normal_force is None else (self.normal_force <= 0).any()

    @property
    def matrices(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]:
        """What `solve` takes."""
        return self.M, self.C, self.K, self.C_error


def assemble(
    structure: Structure, friction_slope: bool = True
) -> tuple[Float[Array, "n n"], Float[Array, "n n"], Float[Array, "n n"]]:
    """(M, C, K), each (n, n), with the joints attached, in the units of the structure.

    With t and n the directions of a joint, Eq. 43 in vectors: K_t t t^T + K_n n n^T
    - mu K_n t n^T + mu K_t n t^T is added to K. The slope of the friction law adds
    mu' N_0 t t^T - mu' K_t (t.x_0) n n^T to C, where x_0 is the equilibrium and N_0 = K_n n.x_0.
    With preload N_0 = P + K_n n.x_0, and the equilibrium is that under F and the friction mu P t.
    C and K are NaN where such a joint is open, N_0 <= 0. A joint without normal has N_0 = P and no
    term with n.

    **Raises:** `ValueError` for a batch, and where a slope needs F and there is none.
    """
    return assembled(structure, friction_slope)[:3]


class _Attached(NamedTuple):
    """A joint with all that the matrices need of it."""

    K_n: jax.Array
    K_t: jax.Array
    P: jax.Array | None
    slope: jax.Array | None  # of the friction law, where it counts
    t: jax.Array
    n: jax.Array | None

    @property
    def of_equilibrium(self) -> bool:
        """Whether it needs the static displacements."""
        return self.n is not None and (self.P is not None or self.slope is not None)


def assembled(structure: Structure, friction_slope: bool, refuse: bool = True) -> Assembled:
    """As `assemble`, with a bound on the rounding error of C, and the normal forces.

    Without `refuse` there are numbers where a joint is open as well, and no error where the
    equilibrium is lost to rounding: near a static divergence.
    """
    require_single(structure)
    sloping = flag("friction_slope", friction_slope)
    C, K = structure.C, structure.K
    F = jnp.zeros(structure.n, K.dtype) if structure.F is None else structure.F
    joints = []
    for joint in structure.joints:
        K_n, K_t = joint.stiffness()
        mu, P = joint.coefficient(), joint.normal_load
        t = jnp.asarray(structure.direction(joint.tangential))
        n = None if joint.normal is None else jnp.asarray(structure.direction(joint.normal))
        K = K + K_t * jnp.outer(t, t)
        if n is not None:
            K = K + K_n * jnp.outer(n, n)
            K = K - mu * K_n * jnp.outer(t, n) + mu * K_t * jnp.outer(n, t)
        if P is not None:
            F = F + mu * P * t
        slopes = sloping and joint.friction.velocity_dependent
        if slopes and P is None and structure.F is None:
            raise ValueError(
                "F must be given where friction depends on the sliding velocity, for its slope "
                "acts through the static equilibrium; or leave the slope out with "
                "friction_slope=False"
            )
        slope = joint.friction.slope(joint.V) if slopes and joint.V is not None else None
        joints.append(_Attached(K_n, K_t, P, slope, t, n))
    loaded = any(joint.P is not None for joint in joints)
    places = [i for i, joint in enumerate(joints) if joint.of_equilibrium]
    displaced = {}  # by joint: t.x_0 and n.x_0, and their errors
    if places:
        directions = jnp.stack([d for i in places for d in (joints[i].t, joints[i].n)])
        why = NO_PRESSED_EQUILIBRIUM if loaded else NO_EQUILIBRIUM
        along, errors = _equilibrium(F, K, directions, why if refuse else None)
        displaced = {
            i: (along[2 * k : 2 * k + 2], errors[2 * k : 2 * k + 2]) for k, i in enumerate(places)
        }
    forces, error = [], jnp.zeros_like(C)
    for i, joint in enumerate(joints):
        N, N_error = joint.P, 0.0
        if i in displaced:
            (t_x, n_x), (t_error, n_error) = displaced[i]
            N = joint.K_n * n_x if N is None else N + joint.K_n * n_x
            N_error = joint.K_n * n_error
        forces.append(jnp.full((), jnp.nan, C.dtype) if joint.P is None else N)
        if joint.slope is None:
            continue
        tt = jnp.outer(joint.t, joint.t)
        C, error = C + joint.slope * N * tt, error + jnp.abs(joint.slope * tt) * N_error
        if joint.n is not None:
            nn = joint.slope * joint.K_t * jnp.outer(joint.n, joint.n)
            C, error = C - t_x * nn, error + t_error * jnp.abs(nn)
    error = (
        jax.lax.stop_gradient(error) if any(joints[i].slope is not None for i in places) else None
    )
    if not loaded:
        return Assembled(structure.M, C, K, error, None)
    found = Assembled(structure.M, C, K, error, jnp.stack(forces))
    if not refuse:
        return found
    C, K = (jnp.where(found.open, jnp.nan, X) for X in (C, K))
    return found._replace(C=C, K=K)


def with_equilibrium(structure: Structure, friction_slope: bool) -> Assembled:
    """As `assembled`, outside compiled programs.

    **Raises:** `ValueError` in a line if the structure has no equilibrium.
    """
    try:
        return assembled(structure, friction_slope)
    except RuntimeError:  # a message of many lines from inside a compiled program
        loaded = any(joint.normal_load is not None for joint in structure.joints)
        raise ValueError(NO_PRESSED_EQUILIBRIUM if loaded else NO_EQUILIBRIUM) from None


def _equilibrium(F, K, directions, otherwise: str | None) -> tuple[jax.Array, jax.Array]:
    """Eq. 40: d.x_0 [m] along each of the `directions` (k, n), and a bound on its rounding error.

    x_0 (n,) solves K x_0 = F, the joints being in K and their friction under preload in F. The
    error where there is none says `otherwise`, if that is given.
    """
    x_0 = jnp.linalg.solve(K, F)
    along = directions @ x_0
    # K dx = -dK x_0 with |dK| <= eps |K| entry by entry, so that d.dx = -(K^-T d).(dK x_0).
    K, x_0, F, size = jax.lax.stop_gradient((K, jnp.abs(x_0), F, jnp.abs(along)))
    eps = jnp.finfo(K.dtype).eps
    through = jnp.abs(jnp.linalg.solve(K.T, directions.T))
    errors = _ROUNDING * eps * (jnp.abs(K) @ x_0) @ through
    supported = eps * jnp.abs(K).max() * x_0.max() <= 0.01 * jnp.abs(F).max()
    supported |= errors.max() <= 0.01 * size.max()
    if otherwise is not None:
        along = eqx.error_if(along, ~supported, otherwise)
    return along, errors
