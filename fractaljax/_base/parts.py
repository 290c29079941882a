"""The parts of a scene: frozen pytrees of named, checked quantities."""

import contextlib
import dataclasses
import functools
import math
import operator
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

Numbers = Float[Array, "..."]  # for one scene, or for a batch of any shape
_PartT = TypeVar("_PartT", bound="Part")


# --- checks --------------------------------------------------------------------------------


def number(
    name: str,
    value: ArrayLike,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    below: float = math.inf,
    at_most: float = math.inf,
) -> Numbers:
    """`value` as a floating-point array of any shape, checked against its domain.

    `above` and `below` are strict. NaN and infinity are always refused. A concrete value raises an
    error with its name, the bound and the value; a traced one becomes NaN (`nan_where`).

    **Raises:** `TypeError` unless `value` is real and numeric; `ValueError` outside the domain.
    """
    array = _floating(name, value)
    domain = [
        ("above", operator.gt, above),
        ("at least", operator.ge, at_least),
        ("below", operator.lt, below),
        ("at most", operator.le, at_most),
    ]
    domain = [(word, holds, bound) for word, holds, bound in domain if math.isfinite(bound)]
    requirement = " and ".join(f"{word} {bound:g}" for word, _, bound in domain) or "finite"

    def outside(x):
        inside = (holds(x, bound) for _, holds, bound in domain)
        return ~functools.reduce(operator.and_, inside, abs(x) < math.inf)

    values = concrete(array)
    if values is None:
        return nan_where(outside(array), array)
    bad = values[outside(values)]
    if bad.size:
        raise ValueError(f"{name} must be {requirement}, got {bad.flat[0].item()!r}")
    return array


def _floating(name: str, value: Any) -> Numbers:
    if isinstance(value, (bool, np.bool_, str, bytes, np.ma.MaskedArray)) or value is None:
        raise TypeError(f"{name} must be a number, got {brief(value)}")
    try:
        dtype = jnp.result_type(value)
        if not (jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)):
            raise TypeError
        # An explicit dtype strips weak types, which would compile every caller twice.
        keeps = hasattr(value, "dtype") and jnp.issubdtype(dtype, jnp.floating)
        # A value that is concrete at trace time stays concrete.
        traced = isinstance(value, Tracer)
        with contextlib.nullcontext() if traced else jax.ensure_compile_time_eval():
            return jnp.asarray(value, dtype=dtype if keeps else float)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{name} must be a real number, got {brief(value)}") from None


def array_like(name: str, value: Any) -> Any:
    """`value` as an array if it is a list or a tuple, of numbers or of rows of them; else itself.

    **Raises:** `TypeError` for a list of something else, and for rows that differ in length.
    """
    if not isinstance(value, (list, tuple)):
        return value
    try:
        array: Any = jnp.asarray(value) if is_traced(value) else np.asarray(value)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be rows of as many numbers, got {brief(value)}") from None
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got {brief(value)}")
    return array


def scalar(name: str, value: ArrayLike, **domain: float) -> Float[Array, ""]:
    """As `number`, for a single number."""
    array = number(name, value, **domain)
    if array.ndim:
        raise ValueError(f"{name} must be a single number, got shape {array.shape}")
    return array


def ordered(name: str, value: Numbers, other_name: str, other: Numbers) -> Numbers:
    """`value`, refused as in `number` unless it is at least `other` everywhere."""
    values, others = concrete(value), concrete(other)
    if values is None or others is None:
        below = value < other
        return nan_where(below if below.shape == value.shape else below.any(), value)
    values, others = np.broadcast_arrays(values, others)
    if (below := values < others).any():
        got, bound = values[below][0].item(), others[below][0].item()
        raise ValueError(f"{name} must be at least {other_name} = {bound!r}, got {got!r}")
    return value


def whole(name: str, value: Any, least: int, most: float = math.inf) -> int:
    """`value` as an int, refused unless it is a whole number from `least` to `most`."""
    native = value if isinstance(value, int) else np.asarray(value).tolist()
    plain = isinstance(native, (int, float)) and not isinstance(native, bool)
    if not (plain and least <= native <= most and native % 1 == 0):
        bound = f"at most {most}" if plain and native > most else f"at least {least}"
        raise ValueError(f"{name} must be a whole number of {bound}, got {brief(value)}")
    return int(native)


def flag(name: str, value: Any) -> bool:
    """`value` as a bool.

    **Raises:** `TypeError` unless it is True or False.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, got {brief(value)}")
    return bool(value)


def require_kind(name: str, value: Any, kind: type) -> None:
    """Refuse a value that is not an instance of `kind`."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise TypeError(f"{name} must be {article} {kind.__name__}, got {brief(value)}")


def concrete(array: jax.Array) -> np.ndarray | None:
    """The values of an array; None while a compiled program is being traced."""
    # Inside an eager `jax.grad` the primal is concrete, and a message can name it.
    primal = jax.lax.stop_gradient(array) if isinstance(array, Tracer) else array
    return None if isinstance(primal, Tracer) else np.asarray(primal)


def is_traced(tree: Any) -> bool:
    """True if any number in the tree belongs to a program that is being traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def nan_where(bad: Bool[ArrayLike, "..."], tree: Any) -> Any:
    """`tree` with NaN for its numbers where they are `bad`; elementwise if the shapes agree.

    This is how a traced value is refused. Raising would take a callback to the host, which stalls
    a GPU at every run of the program, and one bad member would end a whole batch.
    """

    def spoilt(x):
        if not eqx.is_inexact_array(x):
            return x
        # A product, so that derivatives are NaN too: those of `jnp.where` would be 0.
        factor = jnp.where(bad, jnp.nan, 1).astype(x.real.dtype)
        if jnp.iscomplexobj(x):
            return jax.lax.complex(x.real * factor, x.imag * factor)
        return x * factor

    return jax.tree.map(spoilt, tree)


def refused(tree: Any) -> Bool[Array, ""] | None:
    """True if a traced number in the tree was refused, and is NaN; None if none is traced."""
    traced = [x for x in jax.tree.leaves(tree) if isinstance(x, Tracer) and concrete(x) is None]
    nans = [jnp.isnan(x).any() for x in traced if eqx.is_inexact_array(x)]
    return functools.reduce(operator.or_, nans) if nans else None


def enumeration_of(value: Any) -> type[eqx.Enumeration] | None:
    """The enumeration that `value` is a member of, which has its text; None if of none."""
    kinds = eqx.Enumeration.__subclasses__()
    return next((kind for kind in kinds if isinstance(value, kind)), None)


def raise_unless(expected: Any, outcome: Any) -> Any:
    """`outcome` if its `result` is the member `expected`; else `RuntimeError` with its message.

    The numbers of a traced outcome become NaN, and its `result` stays.
    """
    result = outcome.result
    if any(concrete(leaf) is None for leaf in jax.tree.leaves(result)):
        return nan_where(result != expected, outcome)
    if bool(result != expected):
        kind: Any = enumeration_of(result)
        raise RuntimeError(kind[result])
    return outcome


def brief(value: Any) -> str:
    """`value` as messages show it: one line of at most 80 characters."""
    if isinstance(value, Tracer):
        return f"a traced array of shape {value.shape}" if value.ndim else "a traced number"
    if isinstance(value, type) or (callable(value) and hasattr(value, "__name__")):
        return f"the {'class' if isinstance(value, type) else 'function'} {value.__name__}"
    with contextlib.suppress(TypeError, ValueError):  # a dictionary whose keys have no order
        if not isinstance(value, Record) and is_traced(value):
            return f"a {type(value).__name__} with traced numbers"
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python refuses to print integers of thousands of digits
        return "a very large integer"
    return text if len(text) <= 80 else f"{text[:77]}..."


def one_line(error: Exception) -> str:
    """The message of another package's error, in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


# --- parts ---------------------------------------------------------------------------------


def quantity(
    unit: str,
    meaning: str,
    *,
    log: bool = False,
    name: str | None = None,
    argument: str | None = None,
    absent: bool = False,
) -> Any:
    """A numeric field of a part, with its unit and its meaning for files and tables.

    **Arguments:**

    - `unit`: the SI unit as text, "-" where there is none.
    - `meaning`: what the number is, in a few words.
    - `log`: True for a scale, which is designed and swept on a logarithmic axis; False by default.
    - `name`: name of the quantity and of the argument of `__init__`, by default that of the
      attribute.
    - `argument`: name of the argument of `__init__` if the quantity needs another, because some
      other part of a scene has one of that name.
    - `absent`: True for a number that may be None, and is then no quantity; False by default.
    """
    named = {"name": name, "argument": argument, "absent": absent or None}
    named = {key: value for key, value in named.items() if value is not None}
    return eqx.field(metadata={"unit": unit, "meaning": meaning, "log": log, **named})


def quantity_name(field: dataclasses.Field) -> str:
    """The name of a field of a part in files, tables and `replace`."""
    return field.metadata.get("name", field.name)


def is_absent(field: dataclasses.Field, value: Any) -> bool:
    """True for a quantity that a part does not have, for it has no value."""
    return value is None and field.metadata.get("absent", False)


def argument_name(field: dataclasses.Field) -> str:
    """The name of the argument of `__init__` that sets a field of a part."""
    return field.metadata.get("argument", quantity_name(field))


class Record(eqx.Module):
    """A frozen pytree whose repr shows its numbers, not only their types."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._shown())})"

    if not TYPE_CHECKING:  # a checker shall go on refusing assignments

        def __setattr__(self, name: str, value: Any) -> None:
            try:
                super().__setattr__(name, value)
            except dataclasses.FrozenInstanceError:
                message = f"a {type(self).__name__} is frozen: {self._instead_of_setting(name)}"
                raise dataclasses.FrozenInstanceError(message) from None

    def _instead_of_setting(self, name: str) -> str:
        return f"make another one for another {name}"

    def _repr_html_(self) -> str:
        """What Jupyter shows: a table of quantity, value, unit and meaning."""
        from . import html

        rows = html.record_rows(self, self._table_names())
        return html.table(f"fractaljax.{type(self).__name__}", rows)

    def _table_names(self) -> list[str]:
        """The attributes in the table of a notebook."""
        fields = dataclasses.fields(self)
        return [x.name for x in fields if x.repr and not x.name.startswith("_")]

    def _shown(self) -> Iterator[str]:
        for field in dataclasses.fields(self):
            if not field.repr:
                continue
            value = getattr(self, field.name)
            if is_absent(field, value):
                continue
            if isinstance(value, Tracer):
                shape = ",".join(map(str, value.shape))
                yield f"{argument_name(field)}=traced {value.dtype}[{shape}]"
                continue
            if isinstance(value, jax.Array):
                value = value.item() if value.ndim == 0 else np.asarray(value)
            yield f"{argument_name(field)}={value!r}"


class Quantity(NamedTuple):
    """A number of a scene, of a structure or of one of their parts."""

    value: Array | None  # None for an optional number without a value
    unit: str
    meaning: str
    log: bool  # positive, and compared by ratios


class Part(Record):
    """A part of a scene: its numeric leaves are named quantities in SI units."""

    def stored_quantities(self) -> dict[str, Quantity]:
        """The numbers stored here and in the parts below, by name."""
        return _stored_quantities(self)

    def _repr_html_(self) -> str:
        from . import html

        return html.table(f"fractaljax.{type(self).__name__}", part_rows(self))


def _stored_quantities(part: Part) -> dict[str, Quantity]:
    # A function: equinox makes an object of each method that is looked up.
    stored = {}
    for field in dataclasses.fields(part):
        value, meant = getattr(part, field.name), field.metadata
        if isinstance(value, Part):
            stored |= _stored_quantities(value)
        elif "unit" in meant and not is_absent(field, value):
            stored[quantity_name(field)] = Quantity(
                value, meant["unit"], meant["meaning"], meant.get("log", False)
            )
    return stored


def part_rows(part: Part) -> list[tuple[str, Any, str, str]]:
    """The rows of a table: each part by its class, below it its numbers with unit and meaning."""
    rows: list[tuple[str, Any, str, str]] = []
    for field in dataclasses.fields(part):
        value, name, meant = getattr(part, field.name), quantity_name(field), field.metadata
        if isinstance(value, Part):
            rows += [(name, type(value).__name__, "", ""), *part_rows(value)]
        elif "unit" in meant and value is not None:
            rows.append((name, value, meant["unit"], meant["meaning"]))
        elif meant.get("static"):
            rows.append((name, value, "", ""))
    return rows


def quantities(part: Part) -> dict[str, tuple[str, ...]]:
    """Every named quantity and sub-part below `part`, with the attribute path that leads to it."""
    paths = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if is_absent(field, value):
            continue
        paths[quantity_name(field)] = (field.name,)
        if isinstance(value, Part):
            paths |= {name: (field.name, *path) for name, path in quantities(value).items()}
    return paths


def leaf(part: Part, path: tuple[str, ...]) -> Any:
    """The value at the attribute path `path` below `part`."""
    return functools.reduce(getattr, path, part)


def rebuild(part: _PartT, changes: Mapping[str, Any]) -> _PartT:
    """`part` rebuilt and checked, with named quantities changed wherever they are in it.

    If a whole part is among the changes, the quantities in it are changed in the new part.
    """
    arguments, changed = {}, False
    for field in dataclasses.fields(part):
        old, name = getattr(part, field.name), quantity_name(field)
        new = old if is_absent(field, old) else changes.get(name, old)
        if isinstance(new, Part):
            new = rebuild(new, {other: x for other, x in changes.items() if other != name})
        changed |= new is not old
        arguments[argument_name(field)] = new
    return type(part)(**arguments) if changed else part


def substitute(part: _PartT, changes: Mapping[str, Any]) -> _PartT:
    """Like `rebuild`, without checks: for inner loops over values known to be valid."""
    paths = quantities(part)
    chosen = [paths[name] for name in changes]
    return eqx.tree_at(
        lambda tree: [leaf(tree, path) for path in chosen], part, list(changes.values())
    )


def require_scalar(part: Part) -> None:
    """Refuse a part that holds arrays: the laws take one scene, `jax.vmap` takes many."""
    for field in dataclasses.fields(part):
        name, value = quantity_name(field), getattr(part, field.name)
        if isinstance(value, Part):
            require_scalar(value)
        elif isinstance(value, jax.Array) and value.ndim and not field.metadata.get("table", False):
            raise ValueError(
                f"{name} must be a scalar, got shape {value.shape}; use jax.vmap for many scenes"
            )
