"""The parts a scene is made of: frozen pytrees of named, checked quantities."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np


def number(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    below: float = math.inf,
    at_most: float = math.inf,
) -> jax.Array:
    """Return `value` as a floating-point array of any shape, or say why it cannot be one.

    Strict bounds are `above` and `below`; NaN and infinity are always refused. A concrete value
    outside the domain raises `ValueError` with its name, the bound and the value. A traced one
    gets an `eqx.error_if`, so that the compiled program raises in its place.

    **Raises:** `TypeError` if `value` is not real and numeric; `ValueError` as said.
    """
    if isinstance(value, (bool, np.bool_, str, bytes, np.ma.MaskedArray)) or value is None:
        raise TypeError(f"{name} must be a number, got {brief(value)}")
    try:
        dtype = jnp.result_type(value)
        if not (jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)):
            raise TypeError
        # An explicit dtype also strips weak types, which would compile every caller twice.
        is_float_array = hasattr(value, "dtype") and jnp.issubdtype(dtype, jnp.floating)
        traced = isinstance(value, jax.core.Tracer)
        # A value that is known while a program is traced stays known.
        with contextlib.nullcontext() if traced else jax.ensure_compile_time_eval():
            array = jnp.asarray(value, dtype=dtype if is_float_array else float)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{name} must be a real number, got {brief(value)}") from None

    bounds = [
        (f"above {above:g}", lambda x: x > above, above > -math.inf),
        (f"at least {at_least:g}", lambda x: x >= at_least, at_least > -math.inf),
        (f"below {below:g}", lambda x: x < below, below < math.inf),
        (f"at most {at_most:g}", lambda x: x <= at_most, at_most < math.inf),
    ]
    wanted = " and ".join(text for text, _, given in bounds if given) or "finite"

    def inside(x, xp):
        ok = xp.isfinite(x)
        for _, holds, given in bounds:
            ok = ok & holds(x) if given else ok
        return ok

    values = concrete(array)
    if values is None:
        return eqx.error_if(array, ~inside(array, jnp), f"{name} must be {wanted}")
    bad = values[~inside(values, np)]
    if bad.size:
        raise ValueError(f"{name} must be {wanted}, got {_digits(bad.flat[0])}")
    return array


def brief(value: Any) -> str:
    """`value` as a message shows it: in one line, and not a whole scene or a thousand digits."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python prints no integer that long
        return "a very large integer"
    return text if len(text) <= 80 else f"{text[:77]}..."


def one_line(error: Exception) -> str:
    """An error of another package in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def whole(name: str, value: Any, least: int, most: float = math.inf) -> int:
    """`value` as an int, refused unless it is a whole number from `least` to `most`."""
    found = value
    if isinstance(value, bool) or not isinstance(value, int):
        found = np.empty(1) if isinstance(value, (list, tuple)) else np.asarray(value)
    plain = isinstance(found, int) or (found.dtype.kind in "iuf" and found.ndim == 0)
    # Compared before it is converted: infinity and NaN are no whole numbers either.
    if not (plain and least <= found <= most and found % 1 == 0):
        bound = f"at most {most}" if plain and found > most else f"at least {least}"
        raise ValueError(f"{name} must be a whole number of {bound}, got {brief(value)}")
    return int(found)


def scalar(name: str, value: Any, **domain: float) -> jax.Array:
    """As `number`, but for one number only."""
    array = number(name, value, **domain)
    if array.ndim:
        raise ValueError(f"{name} must be a single number, got shape {array.shape}")
    return array


def flag(name: str, value: Any) -> bool:
    """Return `value` as a bool, or say that it is none.

    **Raises:** `TypeError` unless it is True or False, of Python or of NumPy.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, got {brief(value)}")
    return bool(value)


def ordered(name: str, value: jax.Array, other_name: str, other: jax.Array) -> jax.Array:
    """Return `value`, refused like in `number` unless it is at least `other` everywhere."""
    values, others = concrete(value), concrete(other)
    if values is None or others is None:
        return eqx.error_if(value, value < other, f"{name} must be at least {other_name}")
    below = values < others
    if below.any():
        shown = np.broadcast_to(values, below.shape)[below][0]
        bound = np.broadcast_to(others, below.shape)[below][0]
        raise ValueError(
            f"{name} must be at least {other_name} = {_digits(bound)}, got {_digits(shown)}"
        )
    return value


def concrete(array: jax.Array) -> np.ndarray | None:
    """The values of an array, or None while a compiled program is being traced."""
    # Inside an eager `jax.grad` the primal is concrete, and a message can name it.
    primal = jax.lax.stop_gradient(array) if isinstance(array, jax.core.Tracer) else array
    return None if isinstance(primal, jax.core.Tracer) else np.asarray(primal)


def raise_unless(wanted: Any, outcome: Any) -> Any:
    """`outcome` if its `result` is the member `wanted`; else `RuntimeError` with its message."""
    result = outcome.result
    if concrete(result._value) is None:
        return result.error_if(outcome, result != wanted)
    if bool(result != wanted):
        raise RuntimeError(result._enumeration[result])
    return outcome


def _digits(x) -> str:
    return repr(x.item()) if isinstance(x, np.generic) else repr(x)


def quantity(unit: str, meaning: str) -> Any:
    """A numeric field of a `Part`, with its unit and its meaning for files and tables."""
    return eqx.field(metadata={"unit": unit, "meaning": meaning})


class Record(eqx.Module):
    """A frozen pytree that shows its numbers, not only their types, where it knows them."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._shown())})"

    def _shown(self):
        for field in dataclasses.fields(self):
            if not field.repr:
                continue
            value = getattr(self, field.name)
            if isinstance(value, jax.Array) and not isinstance(value, jax.core.Tracer):
                value = value.item() if value.ndim == 0 else np.asarray(value)
            yield f"{field.name}={value!r}"


class Part(Record):
    """A part of a scene: its numeric leaves are named quantities in SI units."""


def quantities(part: Part) -> dict[str, tuple[str, ...]]:
    """Every named quantity and sub-part below `part`, with the attribute path that leads to it."""
    found = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        found[field.name] = (field.name,)
        if isinstance(value, Part):
            found |= {name: (field.name, *path) for name, path in quantities(value).items()}
    return found


def leaf(part: Part, path: tuple[str, ...]) -> Any:
    """The value at the attribute path `path` below `part`."""
    value = part
    for name in path:
        value = getattr(value, name)
    return value


def rebuild(part: Part, changes: Mapping[str, Any]) -> Any:
    """Construct `part` anew, checks included, with named quantities changed wherever they live.

    Those inside a part that is itself among the changes are changed in the new one.
    """
    arguments, changed = {}, False
    for field in dataclasses.fields(part):
        old = getattr(part, field.name)
        new = changes.get(field.name, old)
        if isinstance(new, Part):
            new = rebuild(new, {name: x for name, x in changes.items() if name != field.name})
        changed |= new is not old
        arguments[field.name] = new
    return type(part)(**arguments) if changed else part


def substitute(part: Part, changes: Mapping[str, Any]) -> Any:
    """Like `rebuild`, without checks: for inner loops over values already known to be valid."""
    paths = quantities(part)
    chosen = [paths[name] for name in changes]
    return eqx.tree_at(
        lambda tree: [leaf(tree, path) for path in chosen], part, list(changes.values())
    )


def require_scalar(part: Part) -> None:
    """Refuse a part that holds arrays: the laws take one scene, `jax.vmap` takes many."""
    for name, path in quantities(part).items():
        value = leaf(part, path)
        if isinstance(value, jax.Array) and value.ndim:
            raise ValueError(
                f"{name} must be a scalar, got shape {value.shape}; use jax.vmap for many scenes"
            )
