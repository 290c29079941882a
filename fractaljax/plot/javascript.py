"""Functions of numbers as JavaScript: their jaxprs, line by line.

A page without Python then computes by the equations of the package, not by a copy of them. Each
number of an array has a line of its own.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_INFIX = {
    **{"add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/"},
    **{"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "===", "ne": "!=="},
    **{"and": "&&", "or": "||"},
}
_MATH = "exp", "log", "log1p", "expm1", "sqrt", "cbrt", "abs", "floor", "ceil", "pow", "max", "min"
_MATH += "sin", "cos", "tan", "tanh", "atan2", "sign"
_CALLS = {name: f"Math.{name}" for name in _MATH}
_CALLS |= {"is_finite": "Number.isFinite", "erf": "erf"}
_OTHERS = "neg", "not", "square", "integer_pow", "select_n", "stop_gradient", "copy", "copy_p"
_ELEMENTWISE = {*_INFIX, *_CALLS, *_OTHERS, "convert_element_type"}
# Operations that only rearrange the numbers of arrays.
_MOVES = (
    "broadcast_in_dim",
    "reshape",
    "squeeze",
    "slice",
    "concatenate",
    "stack",
    "transpose",
    "rev",
)
# A sum of positive terms, so that no digit is lost.
_ERF = """const erf=x=>{
if(!(Math.abs(x)<6))return x!==x?x:Math.sign(x);
let term=1,sum=1;
for(let n=1;term>1e-17*sum;n++){term*=2*x*x/(2*n+1);sum+=term;}
return 2/Math.sqrt(Math.PI)*x*Math.exp(-x*x)*sum;
};
"""
_INSIDE = ("jaxpr", "call_jaxpr", "fun_jaxpr")  # parameters that hold a program in the program


def javascript(
    function: Callable[..., Any], count: int, name: str, *, max_lines: int = 20_000
) -> str:
    """`function name(q)` that returns the numbers of `function(*q)`, a list of `count` numbers.

    `function` gives a pytree of real numbers; JavaScript gets them as a list, in the order of its
    leaves, a truth value as true or false. Lines that no result needs are left out, and equal ones
    are written once.

    **Raises:** `ValueError` for a program with loops, with an operation without a counterpart, or
    of more than `max_lines`, for which a browser would be too slow.
    """
    closed = jax.make_jaxpr(function)(*[jnp.zeros(())] * count)
    program = _Program(max_lines)
    inputs = [f"q[{i}]" for i in range(count)]
    results = program.run(closed.jaxpr, [_literal(x) for x in closed.consts], inputs)
    body = "".join(f"const {key}={text};\n" for key, text in program.needed(results))
    used = _ERF if "=erf(" in body else ""
    return f"function {name}(q){{\n{used}{body}return [{','.join(results)}];\n}}\n"


class _Program:
    """Lines, each a name for an expression of the names before it."""

    def __init__(self, max_lines: int):
        self.max_lines = max_lines
        self.names: dict[str, str] = {}  # by expression
        self.lines: dict[str, tuple[str, Sequence[str]]] = {}  # expression and what it needs

    def name(self, text: str, needs: Sequence[str]) -> str:
        if text not in self.names:
            self.names[text] = key = f"v{len(self.names)}"
            self.lines[key] = text, [need for need in needs if need in self.lines]
        return self.names[text]

    def needed(self, results: Sequence[str]):
        required = {key for key in results if key in self.lines}
        for key in reversed(self.lines):  # a line needs only lines before it
            if key in required:
                required.update(self.lines[key][1])
        return [(key, text) for key, (text, _) in self.lines.items() if key in required]

    def run(self, jaxpr: Any, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
        environment = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))

        def value(atom):
            return _literal(atom.val) if hasattr(atom, "val") else environment[atom]

        for eqn in jaxpr.eqns:
            results = self.step(eqn, [value(atom) for atom in eqn.invars])
            environment.update(zip(eqn.outvars, results, strict=True))
        return [value(atom) for atom in jaxpr.outvars]

    def step(self, eqn: Any, values: list[Any]) -> list[Any]:
        """The names of the results of one equation; for a complex number, of its two parts."""
        kind, params = eqn.primitive.name, eqn.params
        inner = next((params[key] for key in _INSIDE if key in params), None)
        if inner is not None and kind not in ("scan", "while", "cond"):
            return self.run(
                getattr(inner, "jaxpr", inner), [*map(_literal, _consts(inner))], values
            )
        if kind == "complex":
            return [tuple(values)]
        if kind in ("real", "imag"):
            return [values[0][kind == "imag"]]
        if kind not in (*_ELEMENTWISE, *_MOVES, "iota", "reduce_sum", "unstack"):
            raise _refusal(eqn)
        if any(isinstance(value, tuple) for value in values):
            raise ValueError(f"no JavaScript for the operation {kind} of complex numbers")
        arrays = [np.asarray(value, object) for value in values]
        if kind in _MOVES:
            return [_plain(_rearrange(eqn, arrays))]
        if kind == "unstack":
            return [_plain(part) for part in np.moveaxis(arrays[0], params["axis"], 0)]
        if kind == "iota":
            return [_literal(eqn.primitive.bind(**params))]
        if kind == "reduce_sum":
            summed = np.moveaxis(arrays[0], params["axes"], range(len(params["axes"])))
            rows = summed.reshape(-1, *eqn.outvars[0].aval.shape)
            parts = np.moveaxis(rows, 0, -1)
            return [self.each(eqn, lambda row: "+".join(row), parts.shape[:-1], parts)]
        together = np.broadcast_arrays(*arrays)
        parts = np.stack(together, axis=-1)
        return [self.each(eqn, lambda row: _expression(eqn, kind, row), parts.shape[:-1], parts)]

    def each(self, eqn: Any, text_of: Callable[[list[str]], str | None], shape, parts) -> Any:
        """A line for each number of a result of this shape, from its k operands (*shape, k)."""
        out = eqn.outvars[0].aval
        names = np.empty(shape, object)
        for place in np.ndindex(*shape):
            needs = parts[place].tolist()
            text = text_of(needs)
            if text is None:
                raise _refusal(eqn)
            if out.dtype == jnp.float32:
                text = f"Math.fround({text})"
            names[place] = text if text in needs else self.name(text, needs)
        if len(self.lines) > self.max_lines:
            raise ValueError(f"no JavaScript for a program of more than {self.max_lines} lines")
        return _plain(names)


def _refusal(eqn: Any) -> ValueError:
    out = eqn.outvars[0].aval
    return ValueError(f"no JavaScript for the operation {eqn.primitive.name}, which gives {out}")


def _rearrange(eqn: Any, arrays: list[np.ndarray]) -> np.ndarray:
    """The numbers of arrays in their new places, from the same operation on their indices."""
    ends = np.cumsum([0, *(array.size for array in arrays)])
    indices = [
        jnp.arange(start, stop).reshape(array.shape)
        for array, start, stop in zip(arrays, ends, ends[1:], strict=False)
    ]
    pool = np.concatenate([array.ravel() for array in arrays])
    return pool[np.asarray(eqn.primitive.bind(*indices, **eqn.params))]


def _plain(names: Any) -> Any:
    """An array of names, or the name if it is a single number."""
    return names if np.shape(names) else np.asarray(names, object).item()


def _expression(eqn: Any, kind: str, values: list[str]) -> str | None:
    if kind in _INFIX:
        if kind == "div" and eqn.outvars[0].aval.dtype.kind != "f":
            return None  # whole numbers drop the remainder
        return f"{values[0]}{_INFIX[kind]}{values[1]}"
    if kind in _CALLS:
        return f"{_CALLS[kind]}({','.join(values)})"
    match kind:
        case "neg":
            return f"-({values[0]})"
        case "not":
            return f"!{values[0]}"
        case "square":
            return f"{values[0]}*{values[0]}"
        case "integer_pow":
            return f"Math.pow({values[0]},{eqn.params['y']})"
        case "select_n" if eqn.invars[0].aval.dtype == bool:
            which, no, yes = values
            return f"{which}?{yes}:{no}"
        case "stop_gradient" | "copy" | "copy_p":
            return values[0]
        case "convert_element_type":
            return _converted(values[0], eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype)
    return None


def _converted(value: str, old: np.dtype, new: np.dtype) -> str | None:
    match old.kind, new.kind:
        case ("b", "b") | ("f" | "i" | "u", "f"):
            return value
        case "b", _:
            return f"{value}?1:0"
        case _, "b":
            return f"{value}!==0"
    return None


def _consts(inner: Any) -> Sequence[Any]:
    return getattr(inner, "consts", ())


def _literal(value: Any) -> Any:
    """A number as JavaScript writes it, or an array of such texts."""
    value = np.asarray(value)
    if value.shape:
        texts = np.empty(value.shape, object)
        for place in np.ndindex(*value.shape):
            texts[place] = _literal(value[place])
        return texts
    if value.dtype == bool:
        return "true" if value else "false"
    number = value.item()
    if number != number or number in (float("inf"), float("-inf")):
        return {"inf": "Infinity", "-inf": "(-Infinity)", "nan": "NaN"}[repr(number)]
    return f"({number!r})" if number < 0 else repr(number)
