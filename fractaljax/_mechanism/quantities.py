"""Numbers of a scene or structure by name: stored ones and, for a scene, derived ones.

| name | meaning | what it sets |
|---|---|---|
| `K_t/K_n` | stiffness ratio | K_t at the scene's K_n; the given ratio of a fractal contact |
| `omega_1/omega_2` | ratio of natural frequencies | omega_1 at the scene's omega_2 |
| `mu` | friction coefficient mu(V) at the belt velocity | the friction law, scaled as a whole |

The mu that a `Coulomb` law stores is mu(V) as well. Where several quantities are set at once,
derived ones come last: K_t/K_n = 0.5 beside K_n = 1e8 N/m sets K_t = 5e7 N/m. A structure has the
quantities of its joints, such as "left.D", and "D" for the D of all joints that have one.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Quantity, brief, concrete, is_traced, number, substitute
from .._base.suggest import did_you_mean
from .._contact.fixed import FixedContact
from .mechanism import Mechanism
from .scene import FRICTION


def require_one(name: str, x: Any) -> None:
    """Refuse, as argument `name`, anything but a mechanism, and one that holds a batch."""
    if not isinstance(x, Mechanism):
        raise TypeError(f"{name} must be a Scene or a Structure, got {brief(x)}")
    x.require_one()


def require_sliding(x: Any, where: str, why: str = "the joint only sticks") -> Any:
    """`x`, whose joints must have V above 0 `where` that is needed, or no V.

    **Raises:** `ValueError` naming the joint, as far as V is known.
    """
    if not isinstance(x, Mechanism):
        return x
    for name, joint in x.joints_by_name().items():
        stored = None if joint.V is None else concrete(joint.V)
        if stored is not None and (stored == 0).any():
            of = f" of joint {name}" if name else ""
            raise ValueError(f"V{of} must be above 0 {where}, got 0.0: {why}")
    return x


def has_memory(x: Mechanism) -> bool:
    """True if the friction of any joint has internal states."""
    if not isinstance(x, Mechanism):  # refused, by its name, where it is used
        return False
    return any(joint.friction.state_size > 0 for joint in x.joints_by_name().values())


def require_no_memory(x: Mechanism) -> None:
    """Refuse friction with memory, where its internal states are not followed."""
    for joint in x.joints_by_name().values():
        if joint.friction.state_size:
            raise ValueError(
                "friction must be without memory here, for its internal states are followed in "
                "stability, designs, simulate and limit_cycle alone, got "
                f"{type(joint.friction).__name__}"
            )


def quantity_names(x: Mechanism) -> list[str]:
    """The names that `replaced` takes: stored quantities, then the derived ones of a scene."""
    return list(dict.fromkeys([*x.stored_quantities(), *x.derived_quantities()]))


def require_quantity(x: Mechanism, name: str) -> None:
    """Refuse a name that is neither a stored nor a derived quantity, and list the valid names."""
    names = quantity_names(x)
    if name not in names:
        near = did_you_mean(str(name), names)
        raise ValueError(f"{x.kind} has no quantity {name!r}; it has {', '.join(names)}{near}")


def require_independent(x: Mechanism, names: Sequence[str]) -> None:
    """Refuse two names that set the same quantity, such as K_t and K_t/K_n, or D and left.D."""
    for i, name in enumerate(names):
        for other in names[:i]:
            if not target_quantities(x, other).isdisjoint(target_quantities(x, name)):
                raise ValueError(f"quantities must be independent, got {other} and {name}")


def target_quantities(x: Mechanism, name: str) -> set[str]:
    """The stored quantities that a name sets, with joint names in a structure."""
    stored = x.stored_quantities()
    if name not in stored:
        targets = set(x.derived_quantities()[name].set(x, 1.0))
        if "friction" in targets:  # scaled as a whole: any coefficient in it may be its scale
            (joint,) = x.joints_by_name().values()
            law = joint.friction.stored_quantities()
            targets |= {each for each in law if law[each].unit == "-"}
        return targets
    return {f"{joint}.{name}" for joint in x.joint_names} & stored.keys() or {name}


def separate_quantities(x: Mechanism) -> dict[str, Quantity]:
    """The stored quantities without plain names for those of several joints."""
    stored = x.stored_quantities()
    shared = {name for name in stored if any(f"{j}.{name}" in stored for j in x.joint_names)}
    return {name: stored[name] for name in stored if name not in shared}


def value_of(x: Mechanism, name: str) -> Float[Array, ""]:
    """The value of a named quantity of a scene or structure.

    **Raises:** `ValueError` for an optional quantity without a value, and for a plain name whose
    value differs between the joints of a structure.
    """
    stored = x.stored_quantities()
    if name not in stored:
        return x.derived_quantities()[name].get(x)
    values = {each: stored[each].value for each in sorted(target_quantities(x, name))}
    first, *others = values.values()
    if first is None or any(value is None for value in others):
        raise ValueError(f"{name} is not given")
    if not is_traced((first, others)) and any(value != first for value in others):
        raise ValueError(
            f"{name} differs between the joints: name {' and '.join(values)} by themselves, or "
            f"replace({name}=...) first"
        )
    return first


def replaced(x: Mechanism, values: Mapping[str, ArrayLike]) -> Any:
    """The scene or structure with quantities set to values of any shape, as by its `replace`.

    **Raises:** `ValueError` for values outside their domain; traced values become NaN instead.
    """
    derived = x.derived_quantities()
    stored = x.stored_quantities()
    checked = {
        name: value if name in stored else number(name, value, **derived[name].domain)
        for name, value in values.items()
    }
    new = x.replace(**_settings(x, checked))
    if any(name.rpartition(".")[2] == "V" for name in values):
        require_sliding(new, "where it is varied")
    return new


def require_inside(x: Mechanism, axes: Mapping[str, np.ndarray], batch: int = 2**16) -> None:
    """Refuse a grid of independent quantities, with values (n,) each, if a point is not allowed.

    The points are checked `batch` at a time: the whole grid is never built.

    **Raises:** `ValueError` as in `replaced`.
    """
    ends = {name: np.array([values.min(), values.max()]) for name, values in axes.items()}
    # Domains are intervals, and their limits are monotonic in other quantities, so the corners
    # decide. The exception is mu(V), by which `mu` scales the friction law.
    _require_all_inside(x, ends, batch)
    if FRICTION in axes and FRICTION in x.derived_quantities():
        (joint,) = x.joints_by_name().values()
        law = {"V", *joint.friction.stored_quantities()}
        among = {name: values for name, values in axes.items() if name in law}
        if among:
            _require_all_inside(x, {FRICTION: ends[FRICTION], **among}, batch)


def _require_all_inside(x, axes, batch):
    shape = tuple(values.size for values in axes.values())
    points = math.prod(shape)
    batch = min(points, batch)
    for begin in range(0, points, batch):
        # The last batch overlaps the one before, so that all batches share one compiled shape.
        begin = min(begin, points - batch)
        places = np.unravel_index(np.arange(begin, begin + batch), shape)
        replaced(x, {name: axes[name][i] for name, i in zip(axes, places, strict=True)})


def substituted(x: Mechanism, values: Mapping[str, ArrayLike]) -> Any:
    """Like `replaced`, without checks; every quantity must have a value (`with_optional`)."""
    return x.substituted(_settings(x, values))


def with_optional(x: Mechanism, names: Sequence[str]) -> Any:
    """`x` with 1 for each quantity set by these names that is None, such as a stiffness ratio.

    None cannot be substituted, and it decides what a program computes.
    """
    stored = x.stored_quantities()
    targets = {name for chosen in names for name in target_quantities(x, chosen)}
    missing = {name: 1.0 for name in targets & stored.keys() if stored[name].value is None}
    return x.replace(**missing) if missing else x


def _settings(x, values):
    """The changes for `replace` or `substitute` that set quantities to these values."""
    stored = x.stored_quantities()
    settings = {name: value for name, value in values.items() if name in stored}
    if len(settings) == len(values):
        return settings
    updated = substitute(
        x, {n: value for n, value in settings.items() if stored[n].value is not None}
    )
    for name, value in values.items():
        if name not in stored:
            settings |= x.derived_quantities()[name].set(updated, value)
    return settings


def axis_values(x: Mechanism, name: str, values: ArrayLike | Sequence[float]) -> Array:
    """The values (n,) of a quantity along an axis, from a list or an array, traced or not.

    **Raises:** `ValueError` for an unknown name and values that are not one-dimensional.
    """
    require_quantity(x, name)
    # Lists are read by NumPy; arrays may be traced and are kept.
    values = number(name, values if isinstance(values, (Array, np.ndarray)) else np.array(values))
    if values.ndim != 1 or not values.size:
        got = f"shape {values.shape}" + ": type [2.3, 2.4]" * (not values.ndim)
        raise ValueError(f"the values of {name} must be a list, got {got}")
    return values


def unit(x: Mechanism, name: str) -> str:
    """The unit of a quantity, "-" for a ratio."""
    stored = x.stored_quantities()
    return stored[name].unit if name in stored else "-"


def meaning(x: Mechanism, name: str) -> str:
    """The meaning of a quantity in words."""
    stored = x.stored_quantities()
    if name not in stored:
        return x.derived_quantities()[name].meaning
    return stored[name].meaning.split(";")[0].split(",")[0]


def label(x: Mechanism, name: str) -> str:
    """Axis label of a quantity: its meaning, symbol and unit."""
    stored = x.stored_quantities()
    if name not in stored:
        return f"{meaning(x, name)} [-]"
    return f"{meaning(x, name)} {name} [{stored[name].unit}]"


def with_friction_times(x: Mechanism, factor: ArrayLike) -> Any:
    """A scene or structure with each friction law multiplied by `factor`; not checked."""
    joints = x.joints_by_name().items()
    return x.with_joints(
        {
            name: eqx.tree_at(lambda part: part.friction, joint, joint.friction.times(factor))
            for name, joint in joints
        }
    )


def with_stiffness(x: Mechanism, states: Mapping[str, Any]) -> Any:
    """`x` with contacts of fixed stiffness in the joints whose states (by name) are given."""
    joints, zero = x.joints_by_name(), FixedContact(0.0, 0.0, 1.0)
    for name, state in states.items():
        P = getattr(joints[name].contact, "P", zero.P)  # of a preloaded joint
        fixed = substitute(zero, {"K_n": state.K_n, "K_t": state.K_t, "P": P})
        joints[name] = eqx.tree_at(lambda part: part.contact, joints[name], fixed)
    return x.with_joints(joints)
