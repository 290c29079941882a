"""Coefficients of matrices: numbers, functions of a structure's parameters, and formulas."""

import ast
import math
import operator
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import brief, scalar

Parameters = Mapping[str, Float[Array, ""]]
_CONSTANTS = {"pi": math.pi}
_FUNCTIONS = {name: getattr(jnp, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan")}
_OPERATORS: dict[type, Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


class Expression(NamedTuple):
    """A coefficient as text, "Omega**2 - 1": the only kind of function that a file can hold."""

    text: str

    def __call__(self, p: Parameters) -> Any:
        return _value(_parse(self.text), p)


def check_coefficient(name: str, coefficient: Any, parameters: Parameters) -> Callable | ArrayLike:
    """A number, or a function of the parameters; a text becomes an `Expression`.

    A function that reads no parameter is replaced by its value.

    **Raises:** `ValueError` or `TypeError`, naming it `name`, for anything else, and for a
    function whose value at these parameters is not a finite number.
    """
    if isinstance(coefficient, str):
        coefficient = Expression(coefficient)
    if not callable(coefficient):
        return scalar(name, coefficient)
    watched = _Watched(parameters)
    try:
        value: Any = coefficient(watched)
    except (KeyError, NameError) as error:
        raise ValueError(
            f"{name} needs the parameter {error.args[0]!r}; given are {_listed(parameters)}"
        ) from None
    except (OverflowError, ZeroDivisionError):
        shown = f", got {brief(coefficient.text)}" if isinstance(coefficient, Expression) else ""
        raise ValueError(f"{name} must be a finite number of these parameters{shown}") from None
    if jnp.iscomplexobj(value):
        raise TypeError(
            f"{name} must be real where it is a function: give the imaginary part as a term of "
            "K_loss"
        )
    value = scalar(name, value)
    return coefficient if watched.read else value


class _Watched(Mapping):
    """Parameters that record in `read` whether any of them was read."""

    def __init__(self, parameters: Parameters):
        self.parameters, self.read = parameters, False

    def __getitem__(self, name: str):
        self.read = True
        return self.parameters[name]

    def __iter__(self):
        return iter(self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)


def evaluated(coefficient: Callable | None, p: Parameters) -> Any:
    """The value of a coefficient, or None for None, which stands for 1."""
    return None if coefficient is None else coefficient(p)


def _parse(text: str) -> ast.expr:
    wrong = ValueError(
        f"a coefficient must be a formula of parameters, numbers, pi, + - * / ** and "
        f"{', '.join(_FUNCTIONS)}, got {brief(text)}"
    )
    if len(text) > 500:  # `_value` must not recurse deeper than Python allows
        raise wrong
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise wrong from None
    for node in ast.walk(tree):
        allowed = (ast.BinOp, ast.UnaryOp, ast.Name, ast.Load, *_OPERATORS)
        number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
        if isinstance(node, ast.Call):
            function = node.func
            allowed_call = isinstance(function, ast.Name) and function.id in _FUNCTIONS
            if not allowed_call or len(node.args) != 1 or node.keywords:
                raise wrong
        elif not (number or isinstance(node, allowed)):
            raise wrong
    return tree


def _value(node: Any, p: Parameters) -> Any:
    match node:
        case ast.Constant():
            number: Any = node.value
            return float(number)  # powers of integers can grow without limit
        case ast.Name():
            if node.id in p:
                return p[node.id]
            if node.id in _CONSTANTS:
                return _CONSTANTS[node.id]
            raise NameError(node.id)
        case ast.UnaryOp():
            return _OPERATORS[type(node.op)](_value(node.operand, p))
        case ast.Call(func=ast.Name(id=function)):
            return _FUNCTIONS[function](_value(node.args[0], p))
    return _OPERATORS[type(node.op)](_value(node.left, p), _value(node.right, p))


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
