"""Joints: contact, friction, and the directions in which they act."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import ArrayLike

from .._base.laws import refused_where
from .._base.parts import (
    Numbers,
    Part,
    brief,
    concrete,
    flag,
    nan_where,
    number,
    quantity,
    require_kind,
)
from .._contact.contact import MU_M_MAX, Contact, refused_stiffness
from .._friction import Friction
from .oscillator import belt_velocity

PRELOAD_NOTE = (
    'false: friction acts on K_n x, "linear": on P + K_n x, true: on the load curve of the law, '
    "if it has one"
)

Dof = int | str  # a degree of freedom, by index or name
Direction = Dof | Sequence[Any] | Mapping[Any, float] | ArrayLike
Stored = tuple[Any, ...]  # a direction as returned by `stored_direction`


def friction_for(contact: Contact, friction: Friction) -> Friction:
    """The friction law of a joint, checked against its contact.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` if the contact yields
    and the smallest friction exceeds 0.9, the limit of Eq. 19, and if the stiffness of a user's
    law is negative or not a number under this friction.
    """
    require_kind("contact", contact, Contact)
    require_kind("friction", friction, Friction)
    if not contact.built_in and contact.depends_on_friction:
        bad = refused_stiffness(contact, friction.mu_s, friction.mu_m)
        if bad is not None:
            friction = refused_where(bad, friction)
    if not contact.yields:
        return friction
    number(friction.lowest, friction.mu_m, at_most=MU_M_MAX)
    if concrete(friction.mu_m) is None:
        # The stiffness depends on mu_m alone, so mu_m becomes NaN with a refused mu_s.
        friction = nan_where(~(friction.mu_m <= MU_M_MAX) | jnp.isnan(friction.mu_s), friction)
    return friction


def preload_form(value: Any) -> bool | str:
    """The checked `preload` of a joint: True, False or "linear".

    **Raises:** `TypeError` for anything else.
    """
    if isinstance(value, str) and value == "linear":
        return value
    try:
        return flag("preload", value)
    except TypeError:
        message = f'preload must be True, False or "linear", got {brief(value)}'
        raise TypeError(message) from None


def require_load(contact: Contact, what: str) -> None:
    """Require a contact with a normal load P, which `what` needs.

    **Raises:** `ValueError` for a contact without P.
    """
    if getattr(contact, "P", None) is None:
        raise ValueError(f"{what} needs a contact with a normal load P, got {brief(contact)}")


class AnyJoint(Part):
    """The common face of a `Joint` and of a `Scene`, which is its own joint."""

    contact: eqx.AbstractVar[Any]
    friction: eqx.AbstractVar[Friction]
    tangential: eqx.AbstractVar[Stored]
    normal: eqx.AbstractVar[Stored | None]
    V: eqx.AbstractVar[Numbers | None]
    preload: eqx.AbstractVar[bool | str]

    @property
    def normal_load(self) -> Numbers | None:
        """P [N], if the friction's normal force includes it; None in the source's form."""
        return self.contact.P if self.preload or self.normal is None else None

    @property
    def follows_load_curve(self) -> bool:
        """True if the normal force is the load curve of the contact law."""
        curve = self.preload is True and self.normal is not None
        return curve and self.contact.opening_exponent is not None

    def stiffness(self) -> tuple[Numbers, Numbers]:
        """(K_n, K_t) [N/m], scalars, from Eqs. 30 and 36 or as given."""
        return self.contact.stiffness(self.friction.mu_s, self.friction.mu_m)

    def coefficient(self) -> Numbers:
        """The friction coefficient mu at the joint's sliding velocity, a scalar."""
        law = self.friction
        if self.V is None or not law.velocity_dependent:
            return law.kinetic_limit()
        return law.mu(self.V)


class Joint(AnyJoint):
    """A contact with friction between two bodies of a structure, or between a body and the ground.

    `tangential` and `normal` are directions t and n, rows (n,) of weights of the degrees of
    freedom. Each is a degree of freedom, by index or name, a pair (i, j) for the relative
    displacement x_i - x_j, a mapping {degree of freedom: weight}, or all weights as an array or
    floats. Positive `normal` displacement n.x compresses the joint. Friction pushes towards
    positive t.x, as the belt does in Eq. 39. `V` is the sliding velocity; a law without slope needs
    no V. With a `loss_factor` eta, structural damping, the stiffnesses of the joint in an
    oscillation are K_n (1 + i eta) and K_t (1 + i eta), also in the normal force that rubs. With
    V = 0 nothing drives the joint, as in a friction damper: only a motion under an excitation
    slides it. A V that is traced must be above 0.

    The normal force N on which friction acts is K_n n.x, the source's form. With `preload`, x = 0
    is the state of rest under the load P of the contact, where N = P: N(n.x) is the load curve of
    the contact law, dN/du = K_n(N), or P + K_n n.x for a law without a load curve and with
    `preload="linear"`. Without `normal`, N is the constant P, and there is neither a normal spring
    nor a friction face normal to the belt. The tangential spring K_t is present in all forms.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` unless V >= 0, for directions
    that are zero or have one degree of freedom twice, for a missing P where it is needed, and for
    friction that `Scene` refuses.
    """

    contact: Any = eqx.field(metadata={"kind": Contact})  # its attributes depend on its class
    friction: Friction  # friction law, evaluated at the sliding velocity of the joint
    tangential: Stored = eqx.field(static=True)
    normal: Stored | None = eqx.field(static=True)
    preload: bool | str = eqx.field(static=True, metadata={"note": PRELOAD_NOTE})
    V: Numbers | None = quantity("m/s", "sliding velocity", log=True)
    loss_factor: Numbers | None = quantity("-", "loss factor of the springs")

    def __init__(
        self,
        contact: Contact,
        friction: Friction,
        tangential: Direction,
        normal: Direction | None = None,
        V: ArrayLike | None = None,
        preload: bool | str = False,
        loss_factor: ArrayLike | None = None,
    ):
        self.contact = contact
        self.friction = friction_for(contact, friction)
        self.tangential = stored_direction("tangential", tangential)
        self.normal = None if normal is None else stored_direction("normal", normal)
        self.preload = preload_form(preload)
        if self.preload or self.normal is None:
            require_load(contact, "preload" if self.preload else "a joint without normal")
        if V is None and friction.velocity_dependent:
            raise ValueError("V must be given for friction that depends on the sliding velocity")
        if self.tangential == self.normal:
            raise ValueError(f"tangential and normal must differ, both are {tangential!r}")
        self.V = None if V is None else belt_velocity(V)
        self.loss_factor = (
            None if loss_factor is None else number("loss_factor", loss_factor, at_least=0)
        )

    def complex_stiffness(self, K_n: Numbers, K_t: Numbers) -> tuple[Numbers, Numbers]:
        """K_n (1 + i eta) and K_t (1 + i eta) of an oscillation; K_n and K_t without eta."""
        if self.loss_factor is None:
            return K_n, K_t
        complex_one = 1 + 1j * self.loss_factor
        return K_n * complex_one, K_t * complex_one


# --- directions --------------------------------------------------------------------------------


def stored_direction(name: str, value: Any) -> Stored:
    """A direction in a hashable form: (dof,), (dof, dof), ((dof, weight), ...) or weights (n,).

    **Raises:** `ValueError` for anything else; `TypeError` for weights that are traced.
    """
    wrong = ValueError(
        f"{name} must be a degree of freedom or a pair of two, by index or name, a mapping of them "
        f"to weights or a vector of floats, got {brief(value)}"
    )
    if isinstance(value, (np.ndarray, Array)):
        if value.ndim != 1:
            raise wrong
        return _weights(name, list(value), wrong)
    several = isinstance(value, (Mapping, list, tuple))
    items: list[Any] = [value]
    if several:
        items = list(value.items() if isinstance(value, Mapping) else value)
    if all(isinstance(item, (list, tuple)) and len(item) == 2 for item in items):
        dofs, weights = _dofs([dof for dof, _ in items]), [weight for _, weight in items]
        if not dofs:
            raise wrong
        return tuple(zip(dofs, _weights(name, weights, wrong), strict=True))
    if len(items) <= 2 and (dofs := _dofs(items)):
        return dofs
    # Integers are degrees of freedom: (1, 2, 3) is a mistake, (1.0, 2.0, 3.0) a vector.
    if not several or all(isinstance(item, int) for item in items):
        raise wrong
    return _weights(name, items, wrong)


def _dofs(items: Sequence[Any]) -> tuple[Dof, ...]:
    """Distinct degrees of freedom, or () if `items` are anything else."""
    plain = tuple(int(item) if isinstance(item, np.integer) else item for item in items)
    good = all(isinstance(dof, (int, str)) and not isinstance(dof, bool) for dof in plain)
    return plain if good and len(set(plain)) == len(plain) else ()


def _weights(name: str, values: Sequence[Any], wrong: Exception) -> tuple[float, ...]:
    if any(isinstance(value, Tracer) for value in values):
        raise TypeError(f"{name} must be known when a program is traced, got traced weights")
    if not values or any(isinstance(value, (str, bool, np.bool_)) for value in values):
        raise wrong
    try:
        weights = tuple(map(float, values))
    except (TypeError, ValueError):
        raise wrong from None
    if not all(map(math.isfinite, weights)):
        raise ValueError(f"the weights of {name} must be finite, got {brief(weights)}")
    if not any(weights):
        raise ValueError(f"{name} must not be zero, got {brief(weights)}")
    return weights
