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

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import (
    Part,
    brief,
    is_traced,
    number,
    quantities,
    quantity_name,
    require_scalar,
    substitute,
)
from .._base.suggest import did_you_mean
from .mechanism import Mechanism
from .scene import Scene, stiffness
from .structure import Structure, require_single, too_large

STIFFNESS_RATIO, FREQUENCY_RATIO, FRICTION = "K_t/K_n", "omega_1/omega_2", "mu"


def require_one(name: str, x: Any) -> None:
    """Refuse, as argument `name`, anything but a mechanism, and one that holds a batch."""
    if isinstance(x, Structure):
        require_single(x)
        if x.is_sparse:
            raise ValueError(too_large(x))
    elif isinstance(x, Scene):
        require_scalar(x)
    else:
        raise TypeError(f"{name} must be a Scene or a Structure, got {brief(x)}")


def joints_of(x: Mechanism) -> dict[str, Any]:
    """The joints of a structure by name; a scene is its own joint, named ""."""
    if isinstance(x, Structure):
        return dict(zip(x.joint_names, x.joints, strict=True))
    return {"": x}


class Quantity(NamedTuple):
    """A number of a scene or structure."""

    value: Array | None  # None for an optional number without a value
    unit: str
    meaning: str
    log: bool  # positive, and compared by ratios


def stored_quantities(x: Part | Structure) -> dict[str, Quantity]:
    """The numbers stored in a scene, a structure or a part by name, without the parts."""
    stored = {}
    if isinstance(x, Structure):
        for name, joint in zip(x.joint_names, x.joints, strict=True):
            joint_prefix = stored_quantities(joint)
            stored = (
                joint_prefix
                | stored
                | {f"{name}.{plain}": joint_prefix[plain] for plain in joint_prefix}
            )
        parameters = {
            name: Quantity(value, "-", "parameter", False) for name, value in x.parameters.items()
        }
        return parameters | stored
    for field in dataclasses.fields(x):
        value, meant = getattr(x, field.name), field.metadata
        if isinstance(value, Part):
            stored |= stored_quantities(value)
        elif "unit" in meant:
            stored[quantity_name(field)] = Quantity(
                value, meant["unit"], meant["meaning"], meant.get("log", False)
            )
    return stored


def quantity_names(x: Mechanism) -> list[str]:
    """The names that `replaced` takes: stored quantities, then the derived ones of a scene."""
    return list(dict.fromkeys([*stored_quantities(x), *_derived(x)]))


def require_quantity(x: Mechanism, name: str) -> None:
    """Refuse a name that is neither a stored nor a derived quantity, and list the valid names."""
    names = quantity_names(x)
    if name not in names:
        kind = "structure" if isinstance(x, Structure) else "scene"
        near = did_you_mean(str(name), names)
        raise ValueError(f"{kind} has no quantity {name!r}; it has {', '.join(names)}{near}")


def require_independent(x: Mechanism, names: Sequence[str]) -> None:
    """Refuse two names that set the same quantity, such as K_t and K_t/K_n, or D and left.D."""
    for i, name in enumerate(names):
        for other in names[:i]:
            if not target_quantities(x, other).isdisjoint(target_quantities(x, name)):
                raise ValueError(f"quantities must be independent, got {other} and {name}")


def target_quantities(x: Mechanism, name: str) -> set[str]:
    """The stored quantities that a name sets, with joint names in a structure."""
    stored = stored_quantities(x)
    if name not in stored:
        targets = set(_DERIVED[name].set(x, 1.0))
        if (
            isinstance(x, Scene) and "friction" in targets
        ):  # scaled as a whole: any coefficient in it may be its scale
            law = stored_quantities(x.friction)
            targets |= {each for each in law if law[each].unit == "-"}
        return targets
    if isinstance(x, Structure) and "." not in name and name not in x.parameters:
        return {f"{joint}.{name}" for joint in x.joint_names if f"{joint}.{name}" in stored}
    return {name}


def value_of(x: Mechanism, name: str) -> Float[Array, ""]:
    """The value of a named quantity of a scene or structure.

    **Raises:** `ValueError` for an optional quantity without a value, and for a plain name whose
    value differs between the joints of a structure.
    """
    stored = stored_quantities(x)
    if name not in stored:
        return _DERIVED[name].get(x)
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
    derived = _derived(x)
    stored = stored_quantities(x)
    checked = {
        name: value if name in stored else number(name, value, **derived[name].domain)
        for name, value in values.items()
    }
    return x.replace(**_settings(x, checked))


def require_inside(x: Mechanism, axes: Mapping[str, np.ndarray], batch: int = 2**16) -> None:
    """Refuse a grid of independent quantities, with values (n,) each, if a point is not allowed.

    The points are checked `batch` at a time: the whole grid is never built.

    **Raises:** `ValueError` as in `replaced`.
    """
    ends = {name: np.array([values.min(), values.max()]) for name, values in axes.items()}
    # Domains are intervals, and their limits are monotonic in other quantities, so the corners
    # decide. The exception is mu(V), by which `mu` scales the friction law.
    _require_all_inside(x, ends, batch)
    if FRICTION in axes and isinstance(x, Scene):
        law = {"V", *stored_quantities(x.friction)}
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
    settings = _settings(x, values)
    if "friction" in settings:  # a new law, possibly with another tree structure
        x = eqx.tree_at(lambda scene: scene.friction, x, settings.pop("friction"))
    return _substitute(x, settings)


def _substitute(x, values):
    if not isinstance(x, Structure):
        return substitute(x, values)
    joints = []
    for name, joint in zip(x.joint_names, x.joints, strict=True):
        plain_names = {f"{name}.{plain}": plain for plain in quantities(joint)}
        plain = {key: value for key, value in values.items() if key in plain_names.values()}
        named = {plain_names[key]: value for key, value in values.items() if key in plain_names}
        joints.append(substitute(joint, plain | named))
    x = eqx.tree_at(lambda s: s.joints, x, tuple(joints))
    parameters = {name: values[name] for name in x.parameters if name in values}
    return eqx.tree_at(lambda s: s.parameters, x, x.parameters | parameters) if parameters else x


def with_optional(x: Mechanism, names: Sequence[str]) -> Any:
    """`x` with 1 for each quantity set by these names that is None, such as a stiffness ratio.

    None cannot be substituted, and it decides what a program computes.
    """
    stored = stored_quantities(x)
    targets = {name for chosen in names for name in target_quantities(x, chosen)}
    missing = {name: 1.0 for name in targets & stored.keys() if stored[name].value is None}
    return x.replace(**missing) if missing else x


def _settings(x, values):
    """The changes for `replace` or `substitute` that set quantities to these values."""
    stored = stored_quantities(x)
    settings = {name: value for name, value in values.items() if name in stored}
    if len(settings) == len(values):
        return settings
    updated = substitute(
        x, {n: value for n, value in settings.items() if stored[n].value is not None}
    )
    for name, value in values.items():
        if name not in stored:
            settings |= _DERIVED[name].set(updated, value)
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
    stored = stored_quantities(x)
    return stored[name].unit if name in stored else "-"


def meaning(x: Mechanism, name: str) -> str:
    """The meaning of a quantity in words."""
    stored = stored_quantities(x)
    if name not in stored:
        return _DERIVED[name].meaning
    return stored[name].meaning.split(";")[0].split(",")[0]


def label(x: Mechanism, name: str) -> str:
    """Axis label of a quantity: its meaning, symbol and unit."""
    stored = stored_quantities(x)
    if name not in stored:
        return f"{meaning(x, name)} [-]"
    return f"{meaning(x, name)} {name} [{stored[name].unit}]"


# --- friction at the belt velocity --------------------------------------------------------


def sliding_friction(scene: Scene) -> Array:
    """The friction coefficient mu(V) at the belt velocity."""
    friction = scene.friction
    if not friction.velocity_dependent:
        return friction.mu_s
    return friction.mu(scene.oscillator.V)


def with_friction_times(x: Any, factor: ArrayLike) -> Any:
    """A scene or structure with each friction law multiplied by `factor`; not checked."""
    if isinstance(x, Structure):
        joints = tuple(with_friction_times(joint, factor) for joint in x.joints)
        return eqx.tree_at(lambda s: s.joints, x, joints)
    return eqx.tree_at(lambda part: part.friction, x, x.friction.times(factor))


def _friction_times(scene, factor):
    law = scene.friction
    scaled = law.times(factor)
    if not law.amplitudes:
        return {"friction": scaled}
    names = {path[-1]: name for name, path in quantities(law).items() if len(path) == 1}
    return {names[field]: getattr(scaled, field) for field in law.amplitudes}


# --- derived quantities -------------------------------------------------------------------


class _Derived(NamedTuple):
    meaning: str  # and symbol
    domain: dict[str, float]  # as `number` takes it
    get: Callable[[Any], Array]
    set: Callable[[Any, Any], dict[str, Any]]


def _stiffness_ratio(scene):
    K_n, K_t = stiffness(scene)
    return K_t / K_n


def _set_stiffness_ratio(scene, ratio):
    if hasattr(scene.contact, "stiffness_ratio"):
        return {"stiffness_ratio": ratio}
    return {"K_t": ratio * scene.contact.K_n}


_DERIVED = {
    STIFFNESS_RATIO: _Derived(
        "stiffness ratio K_t/K_n", {"at_least": 0}, _stiffness_ratio, _set_stiffness_ratio
    ),
    FREQUENCY_RATIO: _Derived(
        "ratio of natural frequencies ω₁/ω₂",
        {"above": 0},
        lambda scene: scene.oscillator.omega_1 / scene.oscillator.omega_2,
        lambda scene, ratio: {"omega_1": ratio * scene.oscillator.omega_2},
    ),
    FRICTION: _Derived(
        "friction coefficient at the belt velocity µ",
        {"above": 0},
        sliding_friction,
        lambda scene, mu: _friction_times(scene, mu / sliding_friction(scene)),
    ),
}


def _derived(x: Mechanism) -> Mapping[str, _Derived]:
    if not isinstance(x, Scene):
        return {}
    contact = x.contact
    settable = hasattr(contact, "stiffness_ratio") or {"K_n", "K_t"} <= {
        *stored_quantities(contact)
    }
    return {name: _DERIVED[name] for name in _DERIVED if settable or name != STIFFNESS_RATIO}
