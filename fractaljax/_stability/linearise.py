"""The linearised equations about the sliding equilibrium: by closed form, or by matrices."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, ScalarLike

from .._base.lapack import solve as solve_linear
from .._base.parts import concrete, flag
from .._base.programs import exported_jit
from .._base.rounding import rounding_error
from .._contact.load_curve import loaded_equilibrium
from .._mechanism.quantities import has_memory, require_no_memory, require_one
from .._mechanism.reduced import CoarseSpace
from .._mechanism.structure import Structure, require_single
from . import quadratic
from .band import among, in_band, leading
from .critical_pair import CriticalPair, critical_pair
from .field_modes import linearised_with_memory
from .margin import least_damping_ratio
from .quadratic import Modes, solve
from .rightmost import rightmost
from .two_directions import Eigensolution, TwoDirections, load_curve, on_curve, two_directions

NO_EQUILIBRIUM = (
    "F has no static equilibrium to rounding: a rigid-body mode is left free; hold the structure, "
    "or leave the slope of the friction law out"
)
NO_PRESSED_EQUILIBRIUM = (
    "F and the friction of the preloaded joints have no static equilibrium to rounding: a "
    "rigid-body mode is left free; hold the structure"
)


class Assembled(eqx.Module):
    """M x'' + C x' + K x = 0, each matrix (n, n), with the joints attached."""

    M: jax.Array
    C: jax.Array
    K: jax.Array
    C_error: jax.Array | None  # bound on the rounding error of C due to the equilibrium
    normal_force: jax.Array | None  # (m,) [N], as `Stability` has it
    supported: jax.Array | None  # whether there is an equilibrium, where one is needed
    band: tuple[float, float] | None = eqx.field(static=True)  # of a reduced structure
    coarse: CoarseSpace | None = eqx.field(static=True)

    @property
    def open(self) -> jax.Array:
        """True if a preloaded joint is open."""
        return jnp.zeros((), bool) if self.normal_force is None else (self.normal_force <= 0).any()

    @property
    def lost(self) -> jax.Array:
        """True if there is no steady sliding: a joint is open, or there is no equilibrium."""
        return self.open if self.supported is None else self.open | ~self.supported

    @property
    def matrices(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """(M, C, K)."""
        return self.M, self.C, self.K

    def leading(self, count: int) -> quadratic.Leading:
        """The modes that grow most, as `quadratic.leading`."""
        return quadratic.leading(*self.matrices, count, self.band)

    def solve(self) -> Modes:
        """All modes, with the rounding errors of their eigenvalues."""
        return solve(*self.matrices, self.C_error)

    def rightmost(self) -> Complex[Array, ""]:
        """The eigenvalue with the largest real part [1/s]."""
        return rightmost(self.matrices, self.band, self.coarse)

    def margin(self, shift: ScalarLike = 0.0) -> Float[Array, ""]:
        """As `margin`."""
        return least_damping_ratio(among(self.solve().s - shift, self.band))

    def modes(self) -> Eigensolution:
        """All modes, those in the band first, the largest real part first."""
        s, x, error, _ = self.solve()
        order = leading(s, self.band)
        s, x, error = s[order], x[order], error[order]
        margin, counted = least_damping_ratio(among(s, self.band)), in_band(s, self.band)
        if jnp.iscomplexobj(self.K):  # structural damping: some places may be left over
            counted &= jnp.isfinite(error)
        return Eigensolution(s, x, error, margin, counted)

    def hopf_test(self, rigid: Array) -> Float[Array, ""]:
        """The Hopf test function; `rigid` is the number of rigid-body eigenvalues."""
        return self.critical(rigid).test

    def critical(self, rigid: Array) -> CriticalPair:
        """The critical mode, as `critical_pair`."""
        return critical_pair(*self.matrices, self.C_error, rigid, self.band)


def linearised(x: Any, friction_slope: bool, refuse: bool = True) -> TwoDirections | Assembled:
    """The linearised equations of a mechanism, in closed form where there is one.

    `refuse` as in `assembled`; with memory what is lost is always NaN.
    """
    require_one("scene", x)
    if has_memory(x):
        field: Any = linearised_with_memory(x, friction_slope)
        return field
    if x.uncoupled:
        return two_directions(x, friction_slope)
    return assembled(x, friction_slope, refuse)


def assemble(
    structure: Structure, friction_slope: bool = True
) -> tuple[Float[Array, "n n"], Float[Array, "n n"], Float[Array, "n n"]]:
    """(M, C, K), each (n, n), with the joints attached, in the units of the structure.

    With t and n the directions of a joint, Eq. 43 in vectors: K_t t t^T + K_n n n^T - mu K_n t n^T
    + mu K_t n t^T is added to K. The slope of the friction law adds mu' N_0 t t^T - mu' K_t (t.x_0)
    n n^T to C, where x_0 is the equilibrium and N_0 = K_n n.x_0. With preload N_0 = P + K_n n.x_0,
    and the equilibrium is that under F and the friction mu P t; for a load curve N_0 = N(n.x_0),
    and the tangent at N_0 takes the place of P + K_n n.x. C and K are NaN where such a joint is
    open, N_0 <= 0, and under `jit` where there is no equilibrium. A joint without normal has N_0 =
    P and no term with n. With structural damping K is complex, K + i K_loss, for Im s > 0, and K_n
    and K_t of a joint with a loss factor are so in all of these terms but the equilibrium's.

    **Arguments:**

    - `structure`: a `Structure`; `jax.vmap` takes many.
    - `friction_slope`: False leaves the slope of friction out of C.

    **Raises:** `ValueError` for a batch, where a slope needs F and there is none, and if there is
    no equilibrium: a rigid-body mode is free.
    """
    return with_equilibrium(structure, friction_slope).matrices


class Attachment(NamedTuple):
    """What one joint adds to the matrices, by its directions t and n."""

    K_n: jax.Array  # complex with a loss factor, as K_t
    K_t: jax.Array
    mu: jax.Array
    c_t: jax.Array  # of t t^T in C
    c_n: jax.Array  # of n n^T in C


class Attachments(NamedTuple):
    """The joints of a structure at its sliding equilibrium."""

    each: list[Attachment]
    errors: list[tuple[jax.Array, jax.Array] | None]  # of c_t and c_n, by the equilibrium
    forces: list[jax.Array]  # the normal forces [N], NaN in the source's form
    loaded: bool  # whether any joint is preloaded
    supported: jax.Array | None  # whether there is an equilibrium, where one is needed


class _Joint(NamedTuple):
    """A joint with what the equilibrium needs of it."""

    K_n: jax.Array
    K_t: jax.Array
    P: jax.Array | None
    slope: jax.Array | None  # of the friction law, where it counts
    t: jax.Array
    n: jax.Array | None
    mu: jax.Array

    @property
    def needs_equilibrium(self) -> bool:
        """True if it needs the static displacements."""
        return self.n is not None and (self.P is not None or self.slope is not None)


def attachments(structure: Structure, friction_slope: bool) -> Attachments:
    """What the joints add to the matrices at the sliding equilibrium."""
    require_single(structure)
    require_no_memory(structure)
    sloping = flag("friction_slope", friction_slope)
    K = structure.K
    F = jnp.zeros(structure.n, K.dtype) if structure.F is None else structure.F
    joints = []
    tangents, F = _tangents(structure, F)
    for joint, (K_n, K_t, P) in zip(structure.joints, tangents, strict=True):
        mu = joint.coefficient()
        t = jnp.asarray(structure.direction(joint.tangential))
        n = None if joint.normal is None else jnp.asarray(structure.direction(joint.normal))
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
        joints.append(_Joint(K_n, K_t, P, slope, t, n, mu))
    loaded = any(joint.P is not None for joint in joints)
    places = [i for i, joint in enumerate(joints) if joint.needs_equilibrium]
    displaced, supported = {}, None  # by joint: t.x_0 and n.x_0, and their errors
    if places:
        for joint in joints:
            K = _with_joint(K, joint.K_n, joint.K_t, joint.mu, joint.t, joint.n)
        directions = jnp.stack([d for i in places for d in (joints[i].t, joints[i].n)])
        along, errors, supported = _equilibrium(F, K, directions)
        displaced = {
            i: (along[2 * k : 2 * k + 2], errors[2 * k : 2 * k + 2]) for k, i in enumerate(places)
        }
    zero = jnp.zeros((), K.dtype)
    each, damping_errors, forces = [], [], []
    for i, (joint, part) in enumerate(zip(joints, structure.joints, strict=True)):
        N, N_error, t_x, t_error = joint.P, 0.0, zero, zero
        if i in displaced:
            (t_x, n_x), (t_error, n_error) = displaced[i]
            N = joint.K_n * n_x if N is None else N + joint.K_n * n_x
            N_error = joint.K_n * n_error
        forces.append(jnp.full((), jnp.nan, K.dtype) if joint.P is None else N)
        c_t, c_n, error = zero, zero, None
        if joint.slope is not None:
            c_t, by_t = joint.slope * N, joint.slope * joint.K_t
            c_n = zero if joint.n is None else -by_t * t_x
            error = jnp.abs(joint.slope) * N_error, jnp.abs(by_t) * t_error
            error = error if i in displaced else None
        K_n, K_t = part.complex_stiffness(joint.K_n, joint.K_t)
        each.append(Attachment(K_n, K_t, joint.mu, c_t, c_n))
        damping_errors.append(error)
    return Attachments(each, damping_errors, forces, loaded, supported)


def assembled(structure: Structure, friction_slope: bool, refuse: bool = True) -> Assembled:
    """As `assemble`, with a bound on the rounding error of C, and the normal forces.

    C and K are NaN where a joint is open and where there is no equilibrium; without `refuse` they
    are numbers there as well. Inside a compiled program nothing is raised.
    """
    attached = attachments(structure, friction_slope)
    C, K = structure.C, structure.complex_K
    error = jnp.zeros_like(C)
    for joint, by, uncertain in zip(structure.joints, attached.each, attached.errors, strict=True):
        t = jnp.asarray(structure.direction(joint.tangential))
        n = None if joint.normal is None else jnp.asarray(structure.direction(joint.normal))
        K = _with_joint(K, by.K_n, by.K_t, by.mu, t, n)
        if not (friction_slope and joint.friction.velocity_dependent):
            continue
        directions = [(t, by.c_t)] if n is None else [(t, by.c_t), (n, by.c_n)]
        for k, (d, c) in enumerate(directions):
            dd = jnp.outer(d, d)
            C = C + c * dd
            error = error if uncertain is None else error + uncertain[k] * jnp.abs(dd)
    uncertain = any(each is not None for each in attached.errors)
    error = jax.lax.stop_gradient(error) if uncertain else None
    forces = jnp.stack(attached.forces) if attached.loaded else None
    about = structure.band, structure.coarse
    system = Assembled(structure.M, C, K, error, forces, attached.supported, *about)
    if not refuse or (forces is None and attached.supported is None):
        return system
    C, K = (jnp.where(system.lost, jnp.nan, X) for X in (C, K))
    return dataclasses.replace(system, C=C, K=K)


# One program: operation by operation the first call would compile sixty.
_assembled = exported_jit(assembled, ("friction_slope", "refuse"))


def _with_joint(K, K_n, K_t, mu, t, n) -> Array:
    """K (n, n) with the springs of a joint and their friction."""
    K = K + K_t * jnp.outer(t, t)
    if n is None:
        return K
    K = K + K_n * jnp.outer(n, n)
    return K - mu * K_n * jnp.outer(t, n) + mu * K_t * jnp.outer(n, t)


def _tangents(structure: Structure, F) -> tuple[list[tuple[Array, Array, Array | None]], Array]:
    """(K_n, K_t, P) of each joint, with the tangent P + K_n n.x to a load curve at equilibrium.

    Also the external forces F, plus what keeps the joints' pressed rest at x = 0.
    """
    tangents = [(*joint.stiffness(), joint.normal_load) for joint in structure.joints]
    curved = [i for i, joint in enumerate(structure.joints) if joint.follows_load_curve]
    if not curved:
        return tangents, F
    K, pushes, total = structure.K, [], F
    for joint, (K_n, K_t, P) in zip(structure.joints, tangents, strict=True):
        mu, t = joint.coefficient(), jnp.asarray(structure.direction(joint.tangential))
        n = None if joint.normal is None else jnp.asarray(structure.direction(joint.normal))
        K = _with_joint(K, K_n, K_t, mu, t, n)
        total = total if P is None else total + mu * P * t
        pushes.append(None if n is None else (n, n - mu * t))
    normals, lacking = (jnp.stack(x) for x in zip(*(pushes[i] for i in curved), strict=True))
    K_n, P = (jnp.stack([jnp.asarray(tangents[i][k]) for i in curved])[:, None] for k in (0, 2))
    # What the loads lack, one column each.
    columns = (lacking * P).T
    displacements = solve_linear(K, jnp.concatenate([total[:, None], columns], axis=1))
    relative_forces = K_n / P * normals @ displacements
    curves = [load_curve(structure.joints[i]) for i in curved]
    displaced = loaded_equilibrium(curves, relative_forces[:, 0], relative_forces[:, 1:])
    for i, curve, e, n in zip(curved, curves, displaced, normals, strict=True):
        contact_stiffness, K_t, load = tangents[i]
        force, slope = on_curve(curve, e)
        load = jnp.asarray(load)
        tangent = load * (force - slope * e)
        F = F + (load - tangent) * n
        tangents[i] = contact_stiffness * slope, K_t, tangent
    return tangents, F


def with_equilibrium(structure: Any, friction_slope: bool) -> Assembled:
    """As `assembled`.

    **Raises:** `ValueError` if the structure has no equilibrium, unless it is traced.
    """
    require_single(structure)
    system = _assembled(structure, flag("friction_slope", friction_slope))
    supported = None if system.supported is None else concrete(system.supported)
    if supported is not None and not supported:
        loaded = any(joint.normal_load is not None for joint in structure.joints)
        raise ValueError(NO_PRESSED_EQUILIBRIUM if loaded else NO_EQUILIBRIUM)
    return system


def require_equilibrium(x: Any, friction_slope: bool, result: Array) -> None:
    """Refuse a structure without equilibrium, if that is why its `result` is NaN.

    Under `jit` and `vmap` it stays NaN: a check of a batch would call back to Python.

    **Raises:** `ValueError` as `with_equilibrium`.
    """
    values = None if x.uncoupled or has_memory(x) else concrete(result)
    if values is not None and values.ndim == 0 and math.isnan(values):
        with_equilibrium(x, friction_slope)


def _equilibrium(F, K, directions) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Eq. 40: d.x_0 [m] along each of the `directions` (k, n), and a bound on its rounding error.

    x_0 (n,) solves K x_0 = F, the joints being in K and their friction under preload in F. The
    last result is True if there is an x_0 to rounding.
    """
    x_0 = solve_linear(K, F)
    along = directions @ x_0
    # K dx = -dK x_0 with |dK| <= eps |K| entry by entry, so that d.dx = -(K^-T d).(dK x_0).
    K, x_0, F, size = jax.lax.stop_gradient((K, jnp.abs(x_0), F, jnp.abs(along)))
    eps = jnp.finfo(K.dtype).eps
    through = jnp.abs(solve_linear(K.T, directions.T))
    errors = rounding_error(K.dtype) * (jnp.abs(K) @ x_0) @ through
    supported = eps * jnp.abs(K).max() * x_0.max() <= 0.01 * jnp.abs(F).max()
    supported |= errors.max() <= 0.01 * size.max()
    return along, errors, supported
