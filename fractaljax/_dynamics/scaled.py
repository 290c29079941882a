"""A scene or structure as a hybrid system in scaled units, its start, and its tolerance."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, DTypeLike, Float

from .._base.parts import concrete, number
from .._friction import Coulomb, Friction
from .._mechanism.joint import AnyJoint
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import require_no_memory, require_one, require_sliding
from .._mechanism.scene import Scene, stiffness
from .._mechanism.structure import Structure
from .hybrid import HybridSystem
from .joint_force import JointForce, TwoSidedSpring, joint_force
from .lanes import log_spectral_radius
from .law_scales import law_knots, law_scales


def require_drive(mechanism: Mechanism, excitation: Any) -> None:
    """Refuse a joint with V = 0 without an excitation, as far as V is known.

    **Raises:** `ValueError` naming the joint.
    """
    if excitation is None:
        where = "without an excitation, which simulate and limit_cycle take"
        require_sliding(mechanism, where, "nothing drives the joint")


def moves_without_drive(mechanism: Mechanism, start: Any) -> bool:
    """True for a known V = 0 and a start, or a constant force, that is not known to be 0."""
    speeds = [concrete(j.V) for j in mechanism.joints_by_name().values() if j.V is not None]
    if start is None or not any(V is not None and (V == 0).any() for V in speeds):
        return False
    force = mechanism.F
    known = [concrete(x) for x in (start, force) if x is not None]
    return any(x is None or x.any() for x in known)


def steps_follow_motion(n: int) -> bool:
    """True for so many degrees of freedom that steps do not resolve the highest frequency."""
    return n > 8


def degrees_of_freedom(mechanism: Mechanism) -> int:
    """The number n of degrees of freedom, of a mechanism whose motion is determined.

    **Raises:** `TypeError` for anything else; `ValueError` for one that holds a batch, or has two
    joints that slide in one direction at one V.
    """
    require_one("mechanism", mechanism)
    joints = mechanism.joints_by_name().items()
    for (name, joint), (other, second) in itertools.combinations(joints, 2):
        if _stick_as_one(mechanism, joint, second) or _stick_as_one(mechanism, second, joint):
            raise ValueError(
                f"joints {name} and {other} slide in one direction at one V: how they share the "
                "force in stick is not determined, make them one joint or their V two"
            )
    return mechanism.n


def _stick_as_one(structure: Any, joint: AnyJoint, other: AnyJoint) -> bool:
    """True if one joint sticks along its t exactly when the other does, along its t or its n."""
    V, W = (None if j.V is None else concrete(jnp.asarray(j.V)) for j in (joint, other))
    if V is None or W is None:
        return False
    t = structure.direction(joint.tangential)

    def one(direction) -> bool:
        d = structure.direction(direction)
        ratio = t @ d / (t @ t)
        along = np.allclose(d, ratio * t, rtol=0, atol=1e-12 * np.abs(d).max())
        return bool(along and ratio * V == W)

    if one(other.tangential):
        return True
    # Without a tangential spring nothing rubs along n.
    K_t = concrete(other.stiffness()[1]) if other.normal is not None and one(other.normal) else 0
    return K_t is not None and bool(K_t > 0)


def hybrid_system(
    mechanism: Any, unit_speed: Callable | None = None, memory: bool = False
) -> HybridSystem:
    """The scaled system of a scene or a structure, whose laws all have a `memory` or all have none.

    The unit of velocity is the V of the first joint, or unit_speed(V, omega).

    **Raises:** `ValueError` for other laws.
    """
    if memory:
        _require_memory(mechanism)
    else:
        require_no_memory(mechanism)
    scaled = _uncoupled_system if mechanism.uncoupled else _structure_system
    system = scaled(mechanism, unit_speed)
    if memory:
        return system
    laws = zip(system.laws, system.sharing, strict=True)
    prepared = tuple(
        law.in_motion() if len(joints) == 1 else jax.vmap(lambda law: law.in_motion())(law)
        for law, joints in laws
    )
    system = replace(system, laws=prepared)
    return replace(system, scales=law_scales(system), knots=law_knots(system))


def _require_memory(mechanism: Mechanism) -> None:
    for name, joint in mechanism.joints_by_name().items():
        if not joint.friction.state_size:
            raise ValueError(
                f"friction of joint {name} must have memory, as that of another joint has, got "
                f"{type(joint.friction).__name__}: Dahl or LuGre with stiff bristles come near it"
            )


def smoothing(regularisation: Any, memory: bool) -> Array | None:
    """The checked `regularisation` of a motion, None for laws with memory."""
    if regularisation is None:
        return None
    if memory:
        raise ValueError(f"friction with memory takes no regularisation, got {regularisation!r}")
    return number("regularisation", regularisation, above=0)


def _uncoupled_system(scene: Scene, unit_speed: Callable | None) -> HybridSystem:
    o = scene.oscillator
    K_n, spring = stiffness(scene)
    K_t = jnp.zeros_like(spring) if scene.friction.in_series else spring
    a, b = o.omega_1**2 + K_t / o.m, o.omega_2**2 + K_n / o.m
    omega = jnp.sqrt(a + b)
    speed = o.V if unit_speed is None else unit_speed(o.V, omega)
    f = o.F / o.m / jnp.sqrt(2.0) / omega / speed
    unit, zero = o.m * omega * speed, jnp.zeros_like(f)
    K = jnp.stack([a, b]) / omega**2
    P = zero if scene.normal_load is None else scene.normal_load / unit
    return HybridSystem(
        laws=(scene.friction.at_joint(spring, 1 / omega),),
        speed=speed,
        omega=omega,
        force_unit=unit,
        K=K,
        C=jnp.stack([2 * o.xi_1 * o.omega_1, 2 * o.xi_2 * o.omega_2]) / omega,
        F=jnp.stack([f, -f]),
        T=None,
        B=None,
        L=jnp.stack(
            [jnp.stack([zero, K_n / o.m / omega**2]), jnp.stack([-K_t / o.m / omega**2, zero])]
        ),
        P=jnp.stack([P, zero]),
        V=jnp.ones_like(K) if unit_speed is None else jnp.full_like(K, o.V / speed),
        joint_forces=(joint_force(scene),),
        faces=((0, 1),),
        sharing=((0,),),
    )


def _structure_system(structure: Structure, unit_speed: Callable | None) -> HybridSystem:
    if structure.has_loss:
        raise ValueError(
            "structural damping belongs to an oscillation, not to motion in time: take "
            "x.equivalent_viscous(frequency) in the place of x, with a frequency in Hz"
        )
    n, dtype = structure.n, structure.M.dtype
    K, rows, weights, offsets, speeds, faces = structure.K, [], [], [], [], []
    joint_forces: list[JointForce] = []
    springs = []
    for name, joint in zip(structure.joint_names, structure.joints, strict=True):
        if joint.V is None:
            raise ValueError(f"joint {name}: V must be given, for the motion depends on it")
        K_n, K_t = joint.stiffness()
        springs.append(K_t)
        K_t = jnp.zeros_like(K_t) if joint.friction.in_series else K_t
        t = jnp.asarray(structure.direction(joint.tangential), dtype)
        K = K + K_t * jnp.outer(t, t)
        rows.append(t)
        speeds.append(joint.V)
        faces.append((len(rows) - 1,))
        P = joint.normal_load
        offsets.append(jnp.zeros((), dtype) if P is None else P)
        if joint.normal is None:
            joint_forces.append(TwoSidedSpring())
            weights.append(jnp.zeros(n, dtype))
            continue
        joint_forces.append(joint_force(joint))
        normal = jnp.asarray(structure.direction(joint.normal), dtype)
        K = K + K_n * jnp.outer(normal, normal)
        weights += [K_n * normal, -K_t * t]
        offsets.append(jnp.zeros((), dtype))
        rows.append(normal)
        speeds.append(joint.V)
        faces[-1] = (len(rows) - 2, len(rows) - 1)
    speed_unit = 1e-6  # m/s, of a structure without joints
    laws, sharing = (), ()
    if not structure.joints:
        # A face without load, on a belt too fast for any motion: it never rubs or switches.
        unit = jnp.eye(n, dtype=dtype)[0]
        rows, weights, offsets = [unit], [0 * unit], [0 * unit[0]]
        speeds, faces = [jnp.asarray(1e30 * speed_unit, dtype)], [(0,)]
        joint_forces.append(TwoSidedSpring())
        laws, sharing = (Coulomb(jnp.ones((), dtype)),), ((0,),)
    T, L, V, P = jnp.stack(rows), jnp.stack(weights), jnp.stack(speeds), jnp.stack(offsets)
    force = jnp.zeros(n, dtype) if structure.F is None else structure.F
    # M^-1 times everything at once.
    by_mass = jnp.linalg.solve(
        structure.M, jnp.concatenate([K, structure.C, T.T, force[:, None]], axis=1)
    )
    K, C, B, F = jnp.split(by_mass, [n, 2 * n, 2 * n + len(rows)], axis=1)
    # Between the highest eigenfrequency and n^(1/4) times it.
    omega = jnp.sum(K * K.T) ** 0.25
    if structure.joints:
        pairs = zip(structure.joints, springs, strict=True)
        laws, sharing = _shared([j.friction.at_joint(K_t, 1 / omega) for j, K_t in pairs], faces)
    speed = V[0] if structure.joints else jnp.asarray(speed_unit, dtype)
    speed = speed if unit_speed is None else unit_speed(speed, omega)
    unit = omega * speed
    return HybridSystem(
        laws=laws,
        speed=speed,
        omega=omega,
        force_unit=unit,
        K=K / omega**2,
        C=C / omega,
        F=F[:, 0] / unit,
        T=T,
        B=B,
        L=L / omega**2,
        P=P / unit,
        V=V / speed,
        joint_forces=tuple(joint_forces),
        faces=tuple(faces),
        sharing=sharing,
        jointless=not structure.joints,
        fastest=_fastest(K / omega**2, C / omega) if steps_follow_motion(n) else None,
    ).with_products()


def _fastest(K, C) -> Float[Array, ""]:
    """The largest modulus of the eigenvalues of x'' + C x' + K x = 0, within a per cent."""
    n = len(K)
    eye, zero = jnp.eye(n, dtype=K.dtype), jnp.zeros_like(K)
    A = jax.lax.stop_gradient(jnp.block([[zero, eye], [-K, -C]]))
    # The logarithm is too large by ln(2n) / 2^10 or so.
    return jnp.exp(log_spectral_radius(A, squarings=10))


def _shared(laws: Sequence[Friction], faces: Sequence[tuple[int, ...]]):
    """Laws of one kind stacked over the faces of their joints, and the joints of each kind.

    Programs grow with the kinds, not with the joints.
    """
    kinds: dict[Any, list[int]] = {}
    for j, law in enumerate(laws):
        shapes = tuple(map(jnp.shape, jax.tree.leaves(law)))
        kinds.setdefault((jax.tree.structure(law), shapes), []).append(j)
    shared = []
    for joints in kinds.values():
        of_faces = [laws[j] for j in joints for _ in faces[j]]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *of_faces)
        shared.append(laws[joints[0]] if len(joints) == 1 else stacked)
    return tuple(shared), tuple(map(tuple, kinds.values()))


def start_state(
    start: ArrayLike | Sequence[float], n: int, memory: bool = False
) -> Float[Array, " 2n"]:
    """`start` as an array [x, v]; `ValueError` unless it has that shape.

    With `memory` it may be longer.
    """
    state = number("start", jnp.asarray(start))
    if memory and state.ndim == 1 and len(state) > 2 * n:
        return state
    if state.shape != (2 * n,):
        many = "; use jax.vmap for many" if state.ndim > 1 else ""
        raise ValueError(f"start must have shape ({2 * n},), got {state.shape}{many}")
    return state


def displaced_equilibrium(system: HybridSystem) -> Float[Array, " 2n"]:
    """The sliding equilibrium displaced by V/omega along the first joint's t, in scaled units.

    A law with a jump begins with V along t instead. Where the joint has V = 0 it begins at rest.
    """
    kick = system.section_direction
    kick = jnp.concatenate([kick / jnp.sum(kick**2), jnp.zeros_like(kick)])
    if system.has_jump:
        # Steady sliding may well attract, and this start sticks.
        jumps = system.static_excess()[0] > 64 * jnp.finfo(kick.dtype).eps
        kick = jnp.where(jumps, jnp.roll(kick, system.n), kick)
    if system.excited:
        kick = kick * jnp.sign(system.V[0])
    return system.mechanism_state(system.equilibrium() + kick)


def scaled_start(system: HybridSystem, start: Array | None) -> Float[Array, " 2n"]:
    """The start in scaled units, constant: by default the displaced equilibrium.

    An excitation begins at t = 0.
    """
    y = displaced_equilibrium(system) if start is None else start / system.units
    return jax.lax.stop_gradient(system.with_excitation(y, 0.0))


def check_rtol(rtol: Any, dtype: DTypeLike) -> float:
    """`rtol` if it can be reached in `dtype`; by default 1e-9, or the least that can.

    **Raises:** `ValueError` for one above 0.1, or below 4096 times the rounding error of `dtype`;
    `TypeError` unless it is a number known at trace time.
    """
    least = 4096 * float(jnp.finfo(dtype).eps)
    if rtol is None:
        return max(1e-9, least)
    if isinstance(rtol, (bool, str)) or concrete(rtol) is None or np.ndim(rtol):
        raise TypeError(f"rtol must be a number, got {rtol!r}")
    if not 0 < rtol <= 0.1:
        raise ValueError(f"rtol must be above 0 and at most 0.1, got {rtol!r}")
    if rtol < least:
        raise ValueError(f"rtol must be at least {least:.2g} in {jnp.dtype(dtype)}, got {rtol!r}")
    return float(rtol)
