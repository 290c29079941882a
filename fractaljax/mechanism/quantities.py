"""The numbers of a scene by name: its own, and three derived ones that it does not store.

| name | meaning | what it sets |
|---|---|---|
| `K_t/K_n` | stiffness ratio | K_t at the scene's K_n; the given ratio of a fractal contact |
| `omega_1/omega_2` | ratio of natural frequencies | omega_1 at the scene's omega_2 |
| `mu` | friction coefficient mu(V) at the belt velocity | the friction law, scaled as a whole |

The mu that a `Coulomb` law stores is mu(V) as well. Where several quantities are set at once,
derived ones come last: K_t/K_n = 0.5 beside K_n = 1e8 N/m sets K_t = 5e7 N/m.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ..base.parts import Part, leaf, number, quantities, substitute
from .scene import Scene

_CHECKED_AT_ONCE = 1 << 16  # points of a grid
STIFFNESS_RATIO, FREQUENCY_RATIO, FRICTION = "K_t/K_n", "omega_1/omega_2", "mu"


class Quantity(NamedTuple):
    """A number of a scene."""

    value: jax.Array | None  # None where it is optional, and not given
    unit: str
    meaning: str


def own_quantities(part: Part) -> dict[str, Quantity]:
    """The numbers stored in a scene or a part of it, by name; no parts among them."""
    found = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if isinstance(value, Part):
            found |= own_quantities(value)
        elif "unit" in field.metadata:
            meant = field.metadata
            found[field.name] = Quantity(value, meant["unit"], meant["meaning"])
    return found


def known_quantities(scene: Scene) -> list[str]:
    """The names that `replaced` takes: the scene's own, then the derived ones."""
    return list(dict.fromkeys([*own_quantities(scene), *_DERIVED]))


def require_known(scene: Scene, name: str) -> None:
    """Refuse a name that is neither an own nor a derived quantity, listing those there are."""
    known = known_quantities(scene)
    if name not in known:
        raise ValueError(f"scene has no quantity {name!r}; it has {', '.join(known)}")


def require_independent(scene: Scene, names: Sequence[str]) -> None:
    """Refuse names two of which set one quantity of the scene, such as K_t and K_t/K_n."""
    for i, name in enumerate(names):
        for other in names[:i]:
            if not set(_moved(scene, other)).isdisjoint(_moved(scene, name)):
                raise ValueError(f"quantities must be independent, got {other} and {name}")


def replaced(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """The scene with these quantities changed, of any shape, as by `Scene.replace`.

    **Raises:** `ValueError` for values outside their domain; under `jit` when it runs.
    """
    own = own_quantities(scene)
    checked = {
        name: value if name in own else number(name, value, **_DERIVED[name].domain)
        for name, value in values.items()
    }
    return scene.replace(**_settings(scene, checked))


def require_inside(scene: Scene, axes: Mapping[str, np.ndarray]) -> None:
    """Refuse a grid of independent quantities, each with its values (n,), unless all is inside.

    In batches: the grid is never made.

    **Raises:** `ValueError` as `replaced`.
    """
    ends = {name: np.array([values.min(), values.max()]) for name, values in axes.items()}
    # Domains are intervals, also of one quantity beside another, and all that moves a limit is
    # monotonic, so that the corners decide; but for mu(V), by which `mu` scales the friction law.
    _require_all_inside(scene, ends)
    if FRICTION in axes:
        law = {"V", *own_quantities(scene.friction)}
        among = {name: values for name, values in axes.items() if name in law}
        if among:
            _require_all_inside(scene, {FRICTION: ends[FRICTION], **among})


def _require_all_inside(scene, axes):
    shape = tuple(values.size for values in axes.values())
    points = math.prod(shape)
    batch = min(points, _CHECKED_AT_ONCE)
    for begin in range(0, points, batch):
        # The last batch goes back to the one before: one shape compiles once.
        begin = min(begin, points - batch)
        places = np.unravel_index(np.arange(begin, begin + batch), shape)
        values = {name: axes[name][i] for name, i in zip(axes, places, strict=True)}
        replaced(scene, values)


def substituted(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """Like `replaced`, without checks, for a scene that has all of them (`with_optional`)."""
    return substitute(scene, _settings(scene, values))


def with_optional(scene: Scene, names: Sequence[str]) -> Scene:
    """The scene with 1 for what these names set and it was not given: a stiffness ratio.

    What is None cannot be substituted, and decides what a program computes.
    """
    own = own_quantities(scene)
    moved = {name for chosen in names for name in _moved(scene, chosen)}
    return scene.replace(**{name: 1.0 for name in moved if own[name].value is None})


def _settings(scene, values):
    """What `Scene.replace` and `substitute` take to give quantities these values."""
    own = own_quantities(scene)
    found = {name: value for name, value in values.items() if name in own}
    moved = substitute(scene, {n: value for n, value in found.items() if own[n].value is not None})
    for name, value in values.items():
        if name not in own:
            found |= _DERIVED[name].set(moved, value)
    return found


def axis_values(scene: Scene, name: str, values: Any) -> jax.Array:
    """The values (n,) of an axis over a quantity, a list or an array, traced or not.

    **Raises:** `ValueError` for an unknown name and values that are not one-dimensional.
    """
    require_known(scene, name)
    # A list as NumPy reads it; what is an array already may be traced.
    values = number(name, values if hasattr(values, "dtype") else np.array(values))
    if values.ndim != 1 or not values.size:
        raise ValueError(f"the values of {name} must be a list, got shape {values.shape}")
    return values


def unit(scene: Scene, name: str) -> str:
    """The unit of a quantity, "-" for a ratio."""
    own = own_quantities(scene)
    return own[name].unit if name in own else "-"


def label(scene: Scene, name: str) -> str:
    """Meaning, symbol and unit of a quantity, as axes show them."""
    own = own_quantities(scene)
    if name not in own:
        return f"{_DERIVED[name].meaning} [-]"
    meaning = own[name].meaning.split(";")[0].split(",")[0]
    return f"{meaning} {name} [{own[name].unit}]"


# --- friction at the velocity of the belt -------------------------------------------------


def sliding_friction(scene: Scene) -> jax.Array:
    """mu(V), the friction coefficient at the velocity of the belt."""
    friction = scene.friction
    if not friction.velocity_dependent:
        return friction.mu_s
    return friction.coefficient(scene.oscillator.V)


def with_friction_times(scene: Scene, factor) -> Scene:
    """The friction law as a whole times `factor`; not checked."""
    return substitute(scene, _friction_times(scene, factor))


def _friction_times(scene, factor):
    names = [name for name in quantities(scene.friction) if name in ("mu", "mu_s", "mu_m")]
    return {name: factor * leaf(scene.friction, (name,)) for name in names}


# --- derived quantities -------------------------------------------------------------------


class _Derived(NamedTuple):
    meaning: str  # and symbol
    domain: dict[str, float]  # as `number` takes it
    set: Callable[[Scene, Any], dict[str, Any]]


def _set_stiffness_ratio(scene, ratio):
    if scene.contact.fractal:
        return {"stiffness_ratio": ratio}
    return {"K_t": ratio * scene.contact.K_n}


def _set_frequency_ratio(scene, ratio):
    return {"omega_1": ratio * scene.oscillator.omega_2}


def _set_friction(scene, mu):
    return _friction_times(scene, mu / sliding_friction(scene))


_DERIVED = {
    STIFFNESS_RATIO: _Derived("stiffness ratio K_t/K_n", {"at_least": 0}, _set_stiffness_ratio),
    FREQUENCY_RATIO: _Derived(
        "ratio of natural frequencies ω₁/ω₂", {"above": 0}, _set_frequency_ratio
    ),
    FRICTION: _Derived("friction coefficient at the belt velocity µ", {"above": 0}, _set_friction),
}


def _moved(scene, name):
    """The own quantities that a name sets."""
    if name in own_quantities(scene):
        return {name}
    return set(_DERIVED[name].set(scene, 1.0))
