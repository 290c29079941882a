"""A design as a TOML file: the scene given, every option, what came of it, and the way there."""

import importlib
import inspect
import math
import os
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from ..base.scene_file import quoted, read, read_bounded, refuse_unknown, table_of, write_whole
from ..base.versions import versions, versions_differ
from ..mechanism.scene import Scene
from . import constraints as known_constraints
from .constraints import Constraint
from .design import Design, design
from .envelope import Envelope

_PACKAGE = __name__.split(".")[0]


def save_design(best: Design, path: str | os.PathLike) -> None:
    """Write a design to a file that `repeat_design` runs again; whole or not at all.

    **Raises:** `OSError` if the file cannot be written.
    """
    write_whole(path, design_text(best).encode())


def repeat_design(
    path: str | os.PathLike,
    functions: Mapping[str, Callable[[Scene], Any]] | None = None,
    *,
    progress: bool = True,
) -> Design:
    """Run again what a file of `save_design` holds: with the same versions, to the last bit.

    A file of other versions is run under a warning.

    Functions of the user's own, an objective or constraints, are in the file by name only: give
    them as `functions`, {name: function}.

    **Raises:** `OSError` if the file cannot be read; `ValueError` naming the file for anything
    unknown or missing in it, and for a precision that JAX is not set to.
    """
    scene, options = read_design(path, functions)
    return design(scene, **options, progress=progress)


def design_text(best: Design) -> str:
    """The text of the file of a design."""
    dtype = best.initial.contact.surface.D.dtype
    lines = ["# A fractaljax design, in SI units: `fractaljax design --repeat` runs it again.", ""]
    lines += [_row(name, version) for name, version in versions().items()]
    lines += [_row("precision", str(dtype))]
    lines += [f"{name} = '''\n{scene.to_toml()}'''" for name, scene in _scenes(best).items()]
    options = dict(best.options)
    objective, constraints = options.pop("objective"), options.pop("constraints")
    envelope = options.pop("envelope")
    if objective is not None:
        options["objective"] = _function_name(objective)
    if envelope is not None:
        options["envelope"] = {"ranges": envelope.ranges, "samples": envelope.samples}
    options["constraints"] = [_constraint_table(asked) for asked in constraints]
    lines += _table("options", options)
    result = {
        "outcome": best.outcome,
        "active": best.active,
        "violated": best.violated,
        "value": best.value,
        "growth_rate": best.growth_rate,
        "growth_rates": best.growth_rates,
        "worst": best.worst,
        "worst_of": best.worst_of,
        "squeal_probability": best.squeal_probability,
        "squeal_probability_error": best.squeal_probability_error,
        "initial_squeal_probability": best.initial_squeal_probability,
        "starts": best.starts,
        "failed_starts": best.failed_starts,
    }
    lines += _table("result", result)
    lines += _table("history", {name: column.tolist() for name, column in best.history.items()})
    return "\n".join(lines) + "\n"


def read_design(
    path: str | os.PathLike, functions: Mapping[str, Callable[[Scene], Any]] | None = None
) -> tuple[Scene, dict[str, Any]]:
    """The scene given and the arguments of `design`; errors and warning as `repeat_design`."""
    if not isinstance(functions, Mapping) and functions is not None:
        raise TypeError(f"functions must be a mapping of names to functions, got {functions!r}")
    try:
        document = read(read_bounded(path))
        # Versions are texts, of whatever packages.
        tables = [name for name, value in document.items() if not isinstance(value, str)]
        refuse_unknown("the file", tables, ("options", "result", "history"))
        options = table_of(document, "options")
        found = _scene(document), _options(options, dict(functions or {}))
    except KeyError as error:
        raise ValueError(f"{path}: not a design file, it lacks {error}") from None
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
    others = versions_differ(document)
    if others:
        warnings.warn(f"{path} was {others}: digits may differ", stacklevel=3)
    return found


def _scenes(best):
    return {"given": best.initial, "designed": best.scene}


def _scene(document) -> Scene:
    scene = Scene.from_toml(_text("given", document["given"]))
    precision = document["precision"]
    if precision not in ("float32", "float64"):
        raise ValueError(f"precision must be float32 or float64, got {precision!r}")
    dtype = jnp.dtype(precision)
    if dtype == jnp.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError('the design is in float64: jax.config.update("jax_enable_x64", True)')
    return jax.tree.map(lambda x: x.astype(dtype), scene)


def _text(name: str, value) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a text, got {value!r}")
    return value


def _options(table, functions) -> dict[str, Any]:
    """The arguments of `design`, which checks their values itself."""
    arguments = inspect.signature(design).parameters
    refuse_unknown("[options]", table, [*arguments][1:-1])  # but the scene and the progress bar
    options = dict(table)
    options["bounds"] = {
        name: tuple(ends) if isinstance(ends, list) else ends
        for name, ends in table_of(options, "bounds", "options.").items()
    }
    if "objective" in options:
        options["objective"] = _function(options["objective"], functions)
    if "envelope" in options:
        conditions = table_of(options, "envelope", "options.")
        refuse_unknown("[options.envelope]", conditions, ("ranges", "samples"))
        options["envelope"] = Envelope(**conditions)
    if isinstance(options["risk"], list):
        options["risk"] = tuple(options["risk"])
    constraints = options["constraints"]
    if not (isinstance(constraints, list) and all(isinstance(c, dict) for c in constraints)):
        raise TypeError(f"constraints must be a list of tables, got {constraints!r}")
    options["constraints"] = [_constraint(asked, functions) for asked in constraints]
    return options


def _function_name(function) -> str:
    module = getattr(function, "__module__", None) or ""
    name = getattr(function, "__name__", repr(function))
    own = module.split(".")[0] == _PACKAGE
    return f"{module}:{name}" if own else name


def _function(name: str, functions):
    """The function of this name: one of those given, or of this package."""
    if _text("a function's name", name) in functions:
        return functions[name]
    module, _, member = name.partition(":")
    if module.split(".")[0] != _PACKAGE or not member:
        raise ValueError(f"the function {name!r} is not in the file: give it in `functions`")
    try:
        return getattr(importlib.import_module(module), member)
    except (ImportError, AttributeError):
        raise ValueError(f"the package has no function {name!r}") from None


def _constraint_table(asked) -> dict[str, Any]:
    if not isinstance(asked, Constraint):
        return {"function": _function_name(asked)}
    fields = {name: value for name, value in vars(asked).items() if value is not None}
    return {"kind": type(asked).__name__} | {
        name: value if isinstance(value, bool) else float(value) for name, value in fields.items()
    }


def _constraint(table, functions):
    if "function" in table:
        return _function(table["function"], functions)
    fields = dict(table)
    kind = getattr(known_constraints, _text("the kind of a constraint", fields.pop("kind")), None)
    if not (isinstance(kind, type) and issubclass(kind, Constraint)) or kind is Constraint:
        raise ValueError(f"there is no constraint {table['kind']!r}")
    known = inspect.signature(kind).parameters
    refuse_unknown(f"the constraint {kind.__name__}", fields, known)
    for name, parameter in known.items():
        if parameter.default is inspect.Parameter.empty and name not in fields:
            raise ValueError(f"the constraint {kind.__name__} lacks {name!r}")
    return kind(**fields)


def _table(name: str, entries: Mapping[str, Any]) -> list[str]:
    return ["", f"[{name}]", *(_row(key, x) for key, x in entries.items() if x is not None)]


def _row(key: str, value) -> str:
    return f"{_key(key)} = {_value(value)}"


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() and name.isascii() else quoted(name)


def _value(value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(_row(key, inner) for key, inner in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(float(value)) if math.isfinite(value) else str(float(value))
