"""A design as a TOML file: the initial design, every option, the result and the history."""

import dataclasses
import importlib
import inspect
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._base.files import read_bounded
from .._base.parts import brief
from .._base.toml import (
    law_table,
    naming,
    read_law,
    read_toml,
    refuse_unknown,
    table_at,
    write_toml,
)
from .._base.versions import versions, versions_differ
from .._base.warn import warn_user
from .._contact.contact import Contact
from .._mechanism.mechanism import Mechanism
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from . import constraints as known_constraints
from .constraints import Constraint
from .design_search import DesignSearch
from .envelope import Envelope
from .tolerance import Tolerance

# The arguments of `design` that state its problem, and all that a file holds.
STATED = ("bounds", "objective", "target", "K_n_min", "constraints", "envelope", "tolerance")
STATED += ("quantile", "area_ratio_min", "slip_ratio_max", "friction_slope", "laws")
OPTIONS = (*STATED, "risk", "optimiser", "solver", "starts", "lattice", "seed")
OPTIONS += ("quiet_within", "search")
# Fields of a `Design` that are not in the table of results.
_NOT_RESULTS = {"scene", "initial", "result", "history", "options", "least_growth", "sensitivity"}


def design_files(best: Any, path: Path) -> dict[Path, bytes]:
    """The contents of the file of a `Design` at `path` and of the files beside it.

    Structures, given and designed, have separate files: `run.given.toml` beside `run.toml`.
    """
    heads: dict[str, Any] = {
        **versions(),
        "precision": str(jax.tree.leaves(best.initial)[0].dtype),
    }
    files = {}
    for name, x in (("given", best.initial), ("designed", best.scene)):
        heads[name], more = x.embedded(_structure_file(path, name))
        files |= more
    options = dict(best.options)
    options["solver"] = options["solver"] and _function_name(options["solver"])
    options["optimiser"] = options["optimiser"] and "optimiser"  # it has no name
    if (objective := options["objective"]) is not None:
        table = _constraint_table(objective)
        options["objective"] = table if isinstance(objective, Constraint) else table["function"]
    options["constraints"] = [_constraint_table(each) for each in options["constraints"]]
    options["laws"] = {
        f"{i}": law_table("contact", law) for i, law in enumerate(options["laws"], 1)
    }
    if (envelope := options["envelope"]) is not None:
        options["envelope"] = {"ranges": envelope.ranges, "samples": envelope.samples}
    options["search"] = dataclasses.asdict(options["search"])
    if (tolerance := options["tolerance"]) is not None:
        options["tolerance"] = _tolerance_table(tolerance)
    tables = {
        "options": {name: options[name] for name in OPTIONS},
        "result": {"outcome": best.outcome}
        | {name: value for name, value in vars(best).items() if name not in _NOT_RESULTS},
        "history": {name: column.tolist() for name, column in best.history.items()},
    }
    if best.least_growth is not None:
        tables["result"]["least_growth"] = dict(vars(best.least_growth))
    comment = "A fractaljax design, in SI units: `fractaljax design --repeat` runs it again."
    return files | {path: write_toml(comment, heads | tables).encode()}


def read_design(
    path: str | os.PathLike, functions: Mapping[str, Any] | None = None
) -> tuple[Mechanism, dict[str, Any]]:
    """The initial design and the arguments of `design`; errors and warning as `repeat_design`."""
    if not isinstance(functions, Mapping) and functions is not None:
        raise TypeError(f"functions must be a mapping of names to functions, got {functions!r}")
    with naming(path):
        document = read_toml(read_bounded(path))
        # Versions, of any packages, are texts.
        tables = [name for name, value in document.items() if not isinstance(value, str)]
        refuse_unknown("the file", tables, ("options", "result", "history"))
        options = table_at(document, "options")
        try:
            inputs = _read_mechanism(document, Path(path)), _options(options, dict(functions or {}))
        except KeyError as error:
            raise ValueError(f"not a design file, it lacks {error}") from None
    if others := versions_differ(document):
        warn_user(f"{path} was {others}: digits may differ")
    return inputs


def tolerance_text(tolerance: Tolerance, comment: str) -> str:
    """The text of a file that `read_tolerance` reads."""
    return write_toml(comment, {"tolerance": _tolerance_table(tolerance)})


def read_tolerance(path: str | os.PathLike) -> Tolerance:
    """The scatter in a file with a [tolerance]. **Raises:** `OSError`; `ValueError` naming it."""
    with naming(path):
        document = read_toml(read_bounded(path))
        refuse_unknown("the file", document, ("tolerance",))
        return _with_arguments(Tolerance, table_at(document, "tolerance"), "[tolerance]")


def _tolerance_table(tolerance: Tolerance) -> dict[str, Any]:
    covariance = np.asarray(tolerance.covariance, float).tolist()
    q = None if tolerance.q is None else float(tolerance.q)
    return {"names": tolerance.names, "covariance": covariance, "q": q}


def _with_arguments(kind: type, table: Mapping[str, Any], where: str) -> Any:
    refuse_unknown(where, table, inspect.signature(kind).parameters)
    for name in ("names", "covariance") if kind is Tolerance else ():
        if name not in table:
            raise ValueError(f"{where} lacks {name!r}")
    return kind(**table)


def _structure_file(path: Path, name: str) -> Path:
    """The file of a structure beside that of a design."""
    return path.with_name(f"{path.stem}.{name}.toml")


def _read_mechanism(document, path: Path) -> Mechanism:
    text = _text("given", document["given"])
    beside = _structure_file(path, "given")
    x = Structure.load(beside) if text == beside.name else Scene.from_toml(text)
    precision = document["precision"]
    if precision not in ("float32", "float64"):
        raise ValueError(f"precision must be float32 or float64, got {brief(precision)}")
    dtype = jnp.dtype(precision)
    if dtype == jnp.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError('the design is in float64: jax.config.update("jax_enable_x64", True)')
    return jax.tree.map(lambda leaf: leaf.astype(dtype), x)


def _text(name: str, value) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a text, got {brief(value)}")
    return value


def _options(table, functions) -> dict[str, Any]:
    """The arguments of `design`, which checks their values itself."""
    refuse_unknown("[options]", table, OPTIONS)
    options = dict(table)
    options["bounds"] = table_at(options, "bounds", "options.")
    for name in ("objective", "optimiser", "solver"):
        if name in options:
            value = options[name]
            if name == "objective" and isinstance(value, dict):
                options[name] = _constraint(value, functions)
            else:
                options[name] = _function(value, functions)
    kinds = ("envelope", Envelope), ("tolerance", Tolerance), ("search", DesignSearch)
    for name, kind in kinds:
        if name in options:
            arguments = table_at(options, name, "options.")
            options[name] = _with_arguments(kind, arguments, f"[options.{name}]")
    if isinstance(options["risk"], list):
        options["risk"] = tuple(options["risk"])
    laws = table_at(options, "laws", "options.") if "laws" in options else {}
    options["laws"] = [
        read_law(Contact, table_at(laws, name, "options.laws."), f"options.laws.{name}")
        for name in laws
    ]
    constraints = options["constraints"]
    if not (isinstance(constraints, list) and all(isinstance(c, dict) for c in constraints)):
        raise TypeError(f"constraints must be a list of tables, got {brief(constraints)}")
    options["constraints"] = [_constraint(entry, functions) for entry in constraints]
    return options


def _function_name(function) -> str:
    module = getattr(function, "__module__", None) or ""
    name = getattr(function, "__name__", repr(function))
    return f"{module}:{name}" if _belongs_to_package(module) else name


def _belongs_to_package(module: str) -> bool:
    return module.partition(".")[0] == __name__.partition(".")[0]


def _function(name: str, functions):
    """The function of this name, from `functions` or from this package."""
    if _text("a function's name", name) in functions:
        return functions[name]
    module, _, member = name.partition(":")
    if not (_belongs_to_package(module) and member):
        raise ValueError(f"the function {name!r} is not in the file: give it in `functions`")
    try:
        return getattr(importlib.import_module(module), member)
    except (ImportError, AttributeError):
        raise ValueError(f"the package has no function {name!r}") from None


def _constraint_table(constraint) -> dict[str, Any]:
    if not isinstance(constraint, Constraint):
        return {"function": _function_name(constraint)}
    fields = {name: value for name, value in vars(constraint).items() if value is not None}
    return {"kind": type(constraint).__name__} | {
        name: value if isinstance(value, int) else float(value) for name, value in fields.items()
    }


def _constraint(table, functions):
    if "function" in table:
        return _function(table["function"], functions)
    fields = dict(table)
    kind = getattr(known_constraints, _text("the kind of a constraint", fields.pop("kind")), None)
    if not (isinstance(kind, type) and issubclass(kind, Constraint)) or inspect.isabstract(kind):
        raise ValueError(f"there is no constraint {table['kind']!r}")
    parameters = inspect.signature(kind).parameters
    refuse_unknown(f"the constraint {kind.__name__}", fields, parameters)
    for name, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty and name not in fields:
            raise ValueError(f"the constraint {kind.__name__} lacks {name!r}")
    return kind(**fields)
