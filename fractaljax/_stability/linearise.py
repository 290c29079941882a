"""The linearised equations about the sliding equilibrium: of a scene, and of a structure."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.parts import flag
from .._contact.load_curve import LoadCurve, loaded_equilibrium
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


class Pressed(NamedTuple):
    """The joint of a scene as it is at the equilibrium."""

    K_n: Array
    K_t: Array
    rest: tuple[Array, Array] | None  # x_01 and the normal force, where a load curve decides them


def pressed(scene: Scene) -> Pressed:
    """Stiffness at the equilibrium: the contact's own, or on a load curve its slope there."""
    (K_n, K_t), P = stiffness(scene), scene.normal_load
    if P is None or not scene.follows_load_curve:
        return Pressed(K_n, K_t, None)
    o, mu, curve = scene.oscillator, sliding_friction(scene), _curve_of(scene)
    r_1, r_2 = 1 / (o.m * o.omega_1**2 + K_t), 1 / (o.m * o.omega_2**2 + K_n)
    # A missing load does not push along x_2, nor rub along x_1.
    by = K_n * r_2 * (1 + mu**2 * K_t * r_1) / (1 + mu**2 * K_n * r_2 * K_t * r_1)
    linear = static_normal_force(o, K_n, K_t, mu, P) / P - 1
    e = loaded_equilibrium([curve], linear[None], by[None, None])[0]
    force, slope = _on_curve(curve, e)
    x_01 = (o.F / jnp.sqrt(2.0) + mu * P * force) * r_1
    return Pressed(K_n * slope, K_t, (x_01, P * force))


def linearised(scene: Scene, friction_slope: bool) -> Linearised:
    """The characteristic polynomial of a scene (Eq. 43), with the stiffness of its contact."""
    return linearised_at(scene, pressed(scene), friction_slope)


def linearised_at(scene: Scene, at: Pressed, friction_slope: bool) -> Linearised:
    """As `linearised`, with a joint that is known already."""
    load = scene.normal_load
    o, law = scene.oscillator, scene.friction
    return linearise(o, law, at.K_n, at.K_t, friction_slope, load, at.rest)


def normal_force(scene: Scene, at: Pressed) -> Float[Array, " 1"] | None:
    """The normal force [N] at the equilibrium, if the scene is preloaded; at most 0: it is open."""
    if scene.normal_load is None:
        return None
    if at.rest is not None:
        return at.rest[1][None]
    mu, P = sliding_friction(scene), scene.normal_load
    return static_normal_force(scene.oscillator, at.K_n, at.K_t, mu, P)[None]


def _curve_of(joint: Any) -> LoadCurve:
    """That of a scene or a joint which follows it."""
    return joint.contact.load_curve(joint.friction.mu_s, joint.friction.mu_m)


def _on_curve(curve: LoadCurve, e) -> tuple[Array, Array]:
    """N/P and its slope."""
    return jax.jvp(curve, (e,), (jnp.ones_like(e),))


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
    With preload N_0 = P + K_n n.x_0, and the equilibrium is that under F and the friction mu P t;
    of a load curve N_0 = N(n.x_0), and the tangent at N_0 takes the place of P + K_n n.x.
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
    tangents, F = _tangents(structure, F)
    for joint, (K_n, K_t, P) in zip(structure.joints, tangents, strict=True):
        mu = joint.coefficient()
        t = jnp.asarray(structure.direction(joint.tangential))
        n = None if joint.normal is None else jnp.asarray(structure.direction(joint.normal))
        K = _with_joint(K, K_n, K_t, mu, t, n)
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


def _with_joint(K, K_n, K_t, mu, t, n) -> Array:
    """K (n, n) with the springs of a joint and their friction."""
    K = K + K_t * jnp.outer(t, t)
    if n is None:
        return K
    K = K + K_n * jnp.outer(n, n)
    return K - mu * K_n * jnp.outer(t, n) + mu * K_t * jnp.outer(n, t)


def _tangents(structure: Structure, F) -> tuple[list[tuple[Array, Array, Array | None]], Array]:
    """(K_n, K_t, P) of each joint, with the tangent P + K_n n.x to a load curve at equilibrium.

    And the external forces F with what keeps the joints' pressed rest at x = 0.
    """
    found = [(*joint.stiffness(), joint.normal_load) for joint in structure.joints]
    curved = [i for i, joint in enumerate(structure.joints) if joint.follows_load_curve]
    if not curved:
        return found, F
    K, pushes, total = structure.K, [], F
    for joint, (K_n, K_t, P) in zip(structure.joints, found, strict=True):
        mu, t = joint.coefficient(), jnp.asarray(structure.direction(joint.tangential))
        n = None if joint.normal is None else jnp.asarray(structure.direction(joint.normal))
        K = _with_joint(K, K_n, K_t, mu, t, n)
        total = total if P is None else total + mu * P * t
        pushes.append(None if n is None else (n, n - mu * t))
    normals, lacking = (jnp.stack(x) for x in zip(*(pushes[i] for i in curved), strict=True))
    K_n, P = (jnp.stack([jnp.asarray(found[i][k]) for i in curved])[:, None] for k in (0, 2))
    # What the loads lack, one a column.
    columns = (lacking * P).T
    solved = jnp.linalg.solve(K, jnp.concatenate([total[:, None], columns], axis=1))
    solved = K_n / P * normals @ solved
    curves = [_curve_of(structure.joints[i]) for i in curved]
    displaced = loaded_equilibrium(curves, solved[:, 0], solved[:, 1:])
    for i, curve, e, n in zip(curved, curves, displaced, normals, strict=True):
        own, K_t, load = found[i]
        force, slope = _on_curve(curve, e)
        tangent = load * (force - slope * e)
        F = F + (load - tangent) * n
        found[i] = own * slope, K_t, tangent
    return found, F


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
