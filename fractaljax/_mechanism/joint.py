"""Joints: contact, friction and the directions in which they act."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import Numbers, Part, concrete, number, quantity, require_kind
from .._base.toml import Laws
from .._contact.contact import MU_M_MAX, Contact
from .._contact.fixed import FixedContact
from .._contact.fractal import FractalContact
from .._friction import LAWS, Friction

# By their names in files.
JOINT_LAWS: Laws = {
    "contact": {"fractal": FractalContact, "fixed": FixedContact},
    "friction": LAWS,
    "of": LAWS,  # the law that a `Scaled` one scales
}

Dof = int | str  # a degree of freedom, by index or name


def friction_for(contact: Contact, friction: Friction) -> Friction:
    """The friction law of a joint, checked against its contact.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` if the contact is fractal
    and the smallest friction exceeds 0.9, where Eq. 19 ends.
    """
    require_kind("contact", contact, Contact)
    require_kind("friction", friction, Friction)
    if not contact.fractal:
        return friction
    number(friction.lowest, friction.mu_m, at_most=MU_M_MAX)
    if concrete(friction.mu_m) is None:
        wanted = f"{friction.lowest} must be at most {MU_M_MAX}"
        friction = eqx.error_if(friction, ~(friction.mu_m <= MU_M_MAX), wanted)
    return friction


class Joint(Part):
    """A contact with friction between two bodies of a structure, or a body and the ground.

    `tangential` and `normal` each name a degree of freedom, by its index or its name, or a pair
    (i, j), whose relative displacement x_i - x_j counts. Positive `normal` displacement compresses
    the joint; friction pushes towards positive `tangential`, as the belt does in Eq. 39. `V` is the
    sliding velocity; a law without slope needs none.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` unless V > 0, if a degree of
    freedom stands twice, and where `Scene` refuses the friction.
    """

    contact: Any  # a Contact; its kind decides what else it has
    friction: Friction
    tangential: tuple[Dof, ...] = eqx.field(static=True)
    normal: tuple[Dof, ...] = eqx.field(static=True)
    V: Numbers | None = quantity("m/s", "sliding velocity", log=True)

    def __init__(
        self,
        contact: Contact,
        friction: Friction,
        tangential: Dof | tuple[Dof, ...],
        normal: Dof | tuple[Dof, ...],
        V: ArrayLike | None = None,
    ):
        self.contact = contact
        self.friction = friction_for(contact, friction)
        self.tangential = _direction("tangential", tangential)
        self.normal = _direction("normal", normal)
        if V is None and friction.velocity_dependent:
            raise ValueError("V must be given for friction that depends on the sliding velocity")
        if self.tangential == self.normal:
            raise ValueError(f"tangential and normal must differ, both are {tangential!r}")
        self.V = None if V is None else number("V", V, above=0)

    def stiffness(self) -> tuple[Numbers, Numbers]:
        """(K_n, K_t) [N/m], scalars: Eqs. 30 and 36, or as given."""
        return self.contact.stiffness(self.friction.mu_s, self.friction.mu_m)

    def coefficient(self) -> Numbers:
        """mu at the joint's sliding velocity, a scalar."""
        law = self.friction
        if self.V is None or not law.velocity_dependent:
            return law.mu_s
        return law.mu(self.V)


def _direction(name: str, value: Any) -> tuple[Dof, ...]:
    """One degree of freedom or a pair of different ones, as a tuple."""
    dofs = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    dofs = tuple(int(dof) if isinstance(dof, np.integer) else dof for dof in dofs)
    plain = all(isinstance(dof, (int, str)) and not isinstance(dof, bool) for dof in dofs)
    if not plain or len(dofs) not in (1, 2) or len(set(dofs)) != len(dofs):
        raise ValueError(
            f"{name} must be a degree of freedom or a pair of two, by index or name, got {value!r}"
        )
    return dofs
