"""The joints of a scene, or of a structure, which has several, as designs need them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.parts import is_traced, rebuild
from .._contact.contact import Contact, on_the_same_joint
from .._contact.fixed import FixedContact
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import target_quantities
from .._stability.band import in_band
from .._surface.spectrum import Spectrum


def joint_prefix(name: str) -> str:
    """The prefix of the quantities of a joint; empty for a scene."""
    return f"{name}." if name else ""


class _Stiffness(NamedTuple):
    """The fields of a `ContactState` that designs need, for a law without one."""

    K_n: Array
    K_t: Array
    log_area_ratio: None = None
    slip_ratio: None = None


class _Part(NamedTuple):
    """The fields of a scene or a joint that `joint_state` needs."""

    contact: Any
    friction: Any


def joint_state(part) -> Any:
    """The `ContactState` of a scene or a joint, or the stiffness by other laws."""
    law, friction = part.contact, part.friction
    if law.fractal:
        return law.state(friction.mu_s, friction.mu_m)
    return _Stiffness(*law.stiffness(friction.mu_s, friction.mu_m))


def joint_states(parts: Mapping[str, Any]) -> dict[str, Any]:
    """`joint_state` for many parts, by name; a law that more than two share is compiled once."""
    same_kind: dict[Any, list[str]] = {}
    pairs = {name: (part.contact, part.friction) for name, part in parts.items()}
    for name, pair in pairs.items():
        leaves, structure = jax.tree.flatten(pair)
        kind = structure, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        same_kind.setdefault(kind, []).append(name)
    states = {}
    for names in same_kind.values():
        if len(names) <= 2:
            states |= {name: joint_state(parts[name]) for name in names}
            continue
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(pairs[name] for name in names))
        batch = jax.vmap(lambda contact, friction: joint_state(_Part(contact, friction)))(*stacked)
        for i, name in enumerate(names):
            states[name] = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
    return {name: states[name] for name in parts}


def is_fractal(x, name) -> bool:
    """True if a contact has the source's law."""
    return x.joints_by_name()[name].contact.fractal


def slips(x, name) -> bool:
    """True if a contact has the source's tangential law, which slips."""
    return is_fractal(x, name) and x.joints_by_name()[name].contact.stiffness_ratio is None


def with_contacts(x: Mechanism, contacts: Mapping[str, Contact]) -> Any:
    """`x` with other contact laws in the joints of these names; the joint of a scene is "".

    **Raises:** `ValueError` naming the joint that a law does not suit.
    """
    joints = x.joints_by_name()
    for name, contact in contacts.items():
        try:
            joints[name] = rebuild(joints[name], {"contact": contact})
        except ValueError as error:
            where = f"joint {name}" if name else "the joint"
            raise ValueError(f"{where} by {type(contact).__name__}: {error}") from None
    return x.with_joints(joints)


def with_contact_law(x: Mechanism, law: Contact) -> Any:
    """`x` with another contact law for its surface, material and load.

    For a structure, in every joint whose contact has a surface; errors as `with_contacts`.
    """
    contacts = {
        name: on_the_same_joint(law, part.contact)
        for name, part in x.joints_by_name().items()
        if part.contact.has_surface or not name
    }
    return with_contacts(x, contacts)


def changed_contacts(x, names) -> tuple[str, ...]:
    """The contacts with a law whose stiffness depends on these quantities."""
    affected = {each for name in names for each in target_quantities(x, name)}
    contacts = []
    for name, part in x.joints_by_name().items():
        quantities = {*part.contact.stored_quantities(), *part.friction.stored_quantities()}
        law = not isinstance(part.contact, FixedContact)
        if law and affected & {joint_prefix(name) + each for each in quantities}:
            contacts.append(name)
    return tuple(contacts)


def least_damping(x) -> tuple[Any, Any]:
    """The least damping rate [1/s] without friction, and the least frequency [rad/s]."""
    xp: Any = jnp if is_traced(x) else np
    if x.uncoupled:
        o = x.oscillator
        omega = xp.asarray([o.omega_1, o.omega_2], float)
        return (xp.asarray([o.xi_1, o.xi_2], float) * omega).min(), omega.min()
    kind = complex if x.has_loss else float
    M, C, K = (xp.asarray(X, float) for X in (x.M, x.C, x.K))
    K = K if x.K_loss is None else K + 1j * xp.asarray(x.K_loss, float)
    for joint in x.joints:
        stiffness = joint.complex_stiffness(*joint.stiffness())
        for each, dofs in zip(stiffness, (joint.normal, joint.tangential), strict=True):
            if dofs is None:
                continue
            d = xp.asarray(x.direction(dofs), float)
            K = K + xp.asarray(each, kind) * xp.outer(d, d)
    zero, eye = xp.zeros_like(M), xp.eye(len(M))
    A = xp.block([[zero, eye], [-xp.linalg.solve(M, K), -xp.linalg.solve(M, C)]])
    s = xp.linalg.eigvals(A)
    inside = xp.asarray(in_band(jnp.asarray(s), x.band))
    if x.has_loss:
        inside = inside & (s.imag > 0)
    inside = inside | ~inside.any()
    damping = -xp.where(inside, s.real, -xp.inf).max()
    return xp.maximum(damping, 0.0), xp.where(inside, abs(s), xp.inf).min()


def joint_surfaces(x: Mechanism) -> dict[str, Spectrum]:
    """The surfaces of the joints whose contact has one, a `Spectrum`, by the joint's name."""
    return {
        joint: surface
        for joint, part in x.joints_by_name().items()
        if isinstance(surface := getattr(part.contact, "surface", None), Spectrum)
    }


def joint_with_surface(x: Mechanism, name: str | None, what: str) -> tuple[str, Spectrum]:
    """A joint whose contact has a surface, a `Spectrum`, and it: the only one, or that of a name.

    **Raises:** `ValueError` in the name of `what` needs it, if there is none or several.
    """
    surfaces = joint_surfaces(x)
    if not surfaces:
        raise ValueError(f"{what} needs a scene whose contact has a surface, or a joint with one")
    if name is None and len(surfaces) == 1:
        return next(iter(surfaces.items()))
    if name not in surfaces:
        raise ValueError(
            f"{what} needs joint=, the name of a joint with a surface: "
            f"{', '.join(surfaces)}; got {name!r}"
        )
    return name, surfaces[name]
