"""Calls that do not fit, answered in one line that says what to type instead.

Only a call that fails is looked at, so that one that works costs nothing more.
"""

import functools
import inspect
import os
import types
import typing
from collections.abc import Callable, Mapping
from numbers import Number
from typing import Any

import numpy as np

from .parts import Record, brief
from .suggest import did_you_mean

# How each kind of object is made, by the name of its class.
_RECIPES = {
    "Basin": "basin(scene, radius=5)",
    "BifurcationMap": 'bifurcation_map(scene, ("D", 2.3, 2.8), ("G", 1e-11, 1e-9))',
    "Boundary": 'hopf_boundary(scene, ("D", 2.3, 2.8), ("G", 1e-11, 1e-9))',
    "Branch": 'continue_cycle(scene, "D", (2.3, 2.8))',
    "Contact": "FractalContact(Surface(D, G), material, P)",
    "Design": 'design(scene, bounds={"D": (2.3, 2.8)})',
    "DesignMany": 'design_many(scenes, bounds={"D": (2.3, 2.8)})',
    "Friction": "Coulomb(0.4)",
    "Front": "pareto(scene, first, second)",
    "Identification": "identify(z, dx)",
    "LawComparison": "compare_laws(surface, material, loads)",
    "LimitCycle": "limit_cycle(scene)",
    "Material": "Material(E, nu, sigma_y, H)",
    "ModeTracks": 'track_modes(scene, "D", [2.3, 2.4, 2.5])',
    "Oscillator": "Oscillator(m, omega_1, omega_2, xi_1, xi_2, F, V)",
    "Spectrum": "Surface(D, G)",
    "Stability": "stability(scene)",
    "Structure": "Structure(M, C, K, joints)",
    "Surface": "Surface(D, G)",
    "Sweep": "sweep(stability, scene, D=[2.3, 2.4], G=[1e-10, 1e-9])",
    "Trajectory": "simulate(scene)",
}
_CONTAINERS = {"Spectrum": "surface", "Surface": "surface", "Material": "material"}


def explained(function: Callable, name: str, module: str) -> Callable:
    """`function`, which explains calls that do not fit its signature, as `name` of `module`."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        try:
            return function(*args, **kwargs)
        except (TypeError, AttributeError):
            message = misuse(function, name, args, kwargs)
            if message is None:
                raise
        raise TypeError(message)

    # Where it is read from, so that it can be sent to other processes by its name.
    call.__module__, call.__qualname__ = module, name
    return call


def explain_class(kind: type) -> None:
    """Let a class explain calls that do not fit its `__init__`."""
    init = vars(kind).get("__init__")
    if not inspect.isfunction(init) or init.__name__ == "_explained_init":
        return

    def construct(self, *args, **kwargs):
        try:
            return init(self, *args, **kwargs)
        except TypeError:
            message = misuse(init, kind.__name__, (self, *args), kwargs)
            if message is None:
                raise
        raise TypeError(message)

    wrapped = functools.wraps(init)(construct)
    wrapped.__name__ = "_explained_init"
    kind.__init__ = wrapped


def misuse(function: Callable, name: str, args: tuple, kwargs: Mapping[str, Any]) -> str | None:
    """What to type instead of this call of `name`; None if its arguments fit."""
    signature = inspect.signature(function)
    try:
        arguments = signature.bind(*args, **kwargs).arguments
    except TypeError:
        return _unfit(name, signature, args, kwargs)
    return _first_misfit(name, signature, arguments)


def usage(name: str, signature: inspect.Signature) -> str:
    """How a function is called: its required arguments, and ... for others."""
    texts, more = [], False
    for parameter in signature.parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            texts.append(f"**{parameter.name}")
        elif parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            texts.append(f"*{parameter.name}")
        elif parameter.default is not inspect.Parameter.empty:
            more = True
        elif parameter.kind is inspect.Parameter.KEYWORD_ONLY:
            texts.append(f"{parameter.name}=...")
        else:
            texts.append(parameter.name)
    return (
        f"{name}({', '.join([*texts, *['...'] * (more and 'axes' not in signature.parameters)])})"
    )


# --- arguments that do not fit ---------------------------------------------------------------

_VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def _unfit(name, signature, args, kwargs) -> str:
    """The message for a missing, unknown or surplus argument."""
    form = usage(name, signature)
    parameters = {key: x for key, x in signature.parameters.items() if key != "self"}
    kinds = [x.kind for x in parameters.values()]
    if inspect.Parameter.VAR_KEYWORD not in kinds:
        for key, value in kwargs.items():
            if key not in parameters:
                listed = f"it takes {', '.join(parameters)}" if parameters else f"type {form}"
                instead = _instead(key, value, name, signature, args)
                suggested = did_you_mean(key, parameters)
                return f"{name} has no argument {key!r}{instead or suggested or f': {listed}'}"
    places = {k: x for k, x in signature.parameters.items() if x.kind not in _VARIADIC}
    there = dict(zip(places, args, strict=False)) | kwargs
    # What there is may be wrong: the name of a file, or a number.
    message = _first_misfit(name, signature, there)
    if message is not None:
        return message
    missing = [
        key
        for key, x in places.items()
        if x.default is inspect.Parameter.empty and key not in there
    ]
    if missing:
        return f"{name} needs {', '.join(missing)}: type {form}"
    return f"{name} takes fewer arguments, or one only once: type {form}"


def _first_misfit(name, signature, arguments) -> str | None:
    """The message for the first argument of a wrong kind; None if there is none."""
    checked = {
        key: x
        for key, x in signature.parameters.items()
        if key in arguments and x.kind not in _VARIADIC and not _fits(x, arguments[key])
    }
    for key, parameter in checked.items():
        value = arguments[key]
        others = [x for other, x in arguments.items() if other not in (key, "self")]
        swapped = any(_fits(parameter, x) and not isinstance(x, type(None)) for x in others)
        hint = f"the order is {usage(name, signature)}" if swapped else _hint(parameter, value)
        message = f"{key} must be {_allowed(parameter)}, got {_described(value)}"
        return f"{message}: {hint or f'type {usage(name, signature)}'}"
    return None


def _instead(key: str, value: Any, name: str, signature, args) -> str:
    """What to type for an argument that is the name of a quantity."""
    parameters = signature.parameters
    pair = isinstance(value, (tuple, list)) and len(value) == 2
    if pair and "bounds" in parameters:
        return f': type bounds={{"{key}": {tuple(value)}}}'
    if pair and {"x", "y"} <= {*parameters}:
        return f': type ("{key}", {value[0]}, {value[1]}) for x or y'
    if "ranges" in parameters:
        return f': type {name}({{"{key}": {value!r}}})'
    if not parameters:
        return f": type {name}().replace({key}=...)"
    if {"contact", "friction", "oscillator"} <= {*parameters}:
        form = usage(name, signature)
        return f": a scene is built of parts, {form}; type brake_scene().replace({key}=...)"
    mechanism = next((x for x in args if hasattr(x, "_quantity_names")), None)
    if mechanism is not None and key in mechanism._quantity_names():
        return f": change it before, by .replace({key}=...)"
    return ""


def _kinds(parameter: inspect.Parameter) -> tuple[type, ...]:
    """The classes of this package that an annotation names; none if it allows others."""
    annotation = parameter.annotation
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        members = typing.get_args(annotation)
    else:
        members = (annotation,)
    ours = [x for x in members if isinstance(x, type) and x.__module__.startswith("fractaljax")]
    return tuple(ours) if len(ours) + (types.NoneType in members) == len(members) else ()


def _fits(parameter: inspect.Parameter, value: Any) -> bool:
    """False where an argument is not of the class of its annotation."""
    if typing.get_origin(parameter.annotation) is Callable:
        return callable(value)
    kinds = _kinds(parameter)
    return not kinds or isinstance(value, kinds) or value is parameter.default


def _allowed(parameter: inspect.Parameter) -> str:
    names = [kind.__name__ for kind in _kinds(parameter)] or ["function"]
    if names == ["Mechanism"]:
        names = ["Scene", "Structure"]
    return " or ".join(f"an {x}" if x[0] in "AEIOU" else f"a {x}" for x in names)


def _described(value: Any) -> str:
    kind = type(value).__name__
    article = "an" if kind[0] in "AEIOU" else "a"
    return f"{article} {kind}" if isinstance(value, Record) else brief(value)


def _hint(parameter: inspect.Parameter, value: Any) -> str | None:
    """What to pass instead of `value`."""
    kinds = _kinds(parameter)
    if not kinds:
        if isinstance(value, str) and value.isidentifier():
            return f"type fractaljax.{value} without quotes, the function itself"
        return "the function itself, such as fractaljax.growth_rate, and not its value"
    names = [kind.__name__ for kind in kinds]
    if {"Mechanism", "Scene", "Structure"} & {*names}:
        return _mechanism_hint(value, names)
    name = names[0]
    part = _CONTAINERS.get(name)
    contact = getattr(value, "contact", value)
    if part and isinstance(value, Record) and isinstance(getattr(contact, part, None), kinds):
        return f"take its {'contact.' * (contact is not value)}{part}"
    return f"make one by {_RECIPES[name]}" if name in _RECIPES else None


def _mechanism_hint(value: Any, names: list[str]) -> str | None:
    if isinstance(value, (str, os.PathLike)):
        path = str(value)
        if path.endswith(".toml"):
            kind = "Scene" if names == ["Scene"] else ""
            return f"read it by fractaljax.{kind + '.' * bool(kind)}load({path!r})"
        return "fractaljax.load reads a TOML file, fractaljax.read_matrices those of M, C and K"
    if inspect.isclass(value):
        return f"an object of the class is needed, such as {value.__name__}.load('brake.toml')"
    if callable(value):
        return f"call it, {getattr(value, '__name__', 'it')}()"
    if isinstance(value, (Number, np.ndarray, np.generic)) or hasattr(value, "dtype"):
        return "put numbers into one, fractaljax.brake_scene().replace(D=2.4, G=1e-10)"
    if isinstance(value, (list, tuple)):
        return "jax.vmap takes many" if any(isinstance(x, Record) for x in value) else None
    if isinstance(value, Mapping):
        return "put numbers into one, fractaljax.brake_scene().replace(**{...})"
    if hasattr(value, "scene"):
        return "take its scene"
    if "Scene" in names or "Mechanism" in names:
        if hasattr(value, "joints"):
            return "a structure has its joints, structure.joints[0].stiffness()"
        return "fractaljax.brake_scene() is one, fractaljax.load(file) reads one"
    if hasattr(value, "oscillator"):
        return "fractaljax.Structure.from_scene(scene) makes one"
    return f"make one by {_RECIPES['Structure']}"
