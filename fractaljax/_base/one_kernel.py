"""Functions of few numbers as one kernel of XLA on a CPU.

XLA compiles a kernel for each group of operations, in some 25 ms, and starts it in some 40 ns,
however few numbers it has. One kernel of all the operations compiles in half the time and runs
faster. XLA makes it where an attribute asks for that, which other backends ignore.
"""

import math
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .kept import is_staged

# Versions of JAX whose XLA was seen to do so. It may refuse what others make of an operation.
_FIRST, _BEYOND = (0, 9), (0, 11)
_ATTRIBUTE = "xla_cpu_small_call"
_ATTRIBUTES = {_ATTRIBUTE: "true", "inlineable": "false"}
_ATTRIBUTES_OF = "mhlo.frontend_attributes"
# Operations that XLA compiles itself into any kernel; no library's, no search and no scatter.
_NAMES = """
abs add and atan2 broadcast_in_dim case cbrt ceil clamp compare complex concatenate constant
convert cosine divide dynamic_slice dynamic_update_slice exponential exponential_minus_one floor
gather if imag iota is_finite log log_plus_one logistic maximum minimum multiply negate not
optimization_barrier or pad power real remainder reshape return reverse round_nearest_afz
round_nearest_even rsqrt select sign sine slice sqrt subtract tan tanh transpose while xor
"""
_CHLO = "acos acosh asin asinh atan atanh cosh erf erfc next_after sinh square tan"
_KNOWN = frozenset(f"stablehlo.{name}" for name in _NAMES.split())
_KNOWN |= frozenset(f"chlo.{name}" for name in _CHLO.split()) | {"func.return"}
_MOVES = {f"stablehlo.{name}" for name in ("concatenate", "convert", "reshape", "slice")}
_SUMMED = 4095  # floats; more may go to a library
_FEW, _LARGEST = 2**13, 2**16  # numbers; loops over more are left to several threads


def one_kernel(
    function: Callable,
    *given: Any,
    wanted: bool = True,
    largest: int = _LARGEST,
    changed: int = 0,
) -> Any:
    """function(*given), on a CPU one kernel where it is `wanted` and XLA can make one.

    Whether it can is seen in what `jit`, `vmap` and derivatives have made of the function. All
    arrays that it needs, but constants, are among those given. Of the first `changed` arrays it
    returns each, changed in a part: these are not copied. There is no kernel of its derivatives.
    """
    possible = is_staged() and _available() and all(jnp.size(x) for x in jax.tree.leaves(given))
    if not wanted or not possible:
        return function(*given)

    @jax.jit
    def kernel(given):
        # An argument that optimisation leaves without a use would stop XLA: each goes out again.
        leaves = jax.tree.leaves(given)[changed:]
        used = [x.reshape(-1)[:1].astype(float) for x in leaves]
        return function(*given), jnp.concatenate(used)

    result, used = kernel(jax.tree.map(jnp.asarray, given))
    # What uses any of the results keeps the arguments that go out.
    stated = {"largest": largest, "changed": changed}
    return jax.tree.map(lambda x: _kernel_result.bind(x, used, **stated), result)


def small_kernel(function: Callable, *given: Any) -> Any:
    """`one_kernel` of some numbers each for a few scenes: of more, several threads are faster."""
    return one_kernel(function, *given, largest=_FEW)


def _available() -> bool:
    return _FIRST <= jax.__version_info__ < _BEYOND and jax.default_backend() == "cpu"


# A result of the call that is to be one kernel, and what else goes out of that.
_kernel_result = Primitive("kernel_result")
_kernel_result.def_impl(lambda x, *used, **_: x)
_kernel_result.def_abstract_eval(lambda x, *used, **_: x)


def _batched(arguments, axes, **parameters):
    return _kernel_result.bind(*arguments, **parameters), axes[0]


def _jvp(primals, tangents, **parameters):
    x, dx = primals[0], tangents[0]
    if parameters["changed"]:
        return x, dx
    if not isinstance(dx, ad.Zero):
        # Tangents are arguments too.
        moving = [x for x in tangents[1:] if not isinstance(x, ad.Zero)]
        dx = _kernel_result.bind(dx, *primals[1:], *moving, **parameters)
    return _kernel_result.bind(*primals, **parameters), dx


def _transposed(cotangent, x, *used, **_):
    return cotangent, *[None] * len(used)


batching.primitive_batchers[_kernel_result] = _batched
ad.primitive_jvps[_kernel_result] = _jvp
ad.primitive_transposes[_kernel_result] = _transposed


def _lowered(context, x, *used, largest, changed):
    """On a CPU: the call gets the attributes if it has only operations that allow it."""
    call = x.owner
    if getattr(call, "name", "") != "func.call" or _ATTRIBUTES_OF in call.attributes:
        return [x]
    functions = context.module_context.symbol_table
    if not _all_go_out(call, functions[_called(call)], used, changed):
        return [x]
    possible = _Possible(functions, largest)(call)
    if possible:
        _hide_constants(call)
    texts = _ATTRIBUTES if possible else {_ATTRIBUTE: "false"}
    attributes: dict[str, mlir.ir.Attribute]
    attributes = {name: mlir.ir.StringAttr.get(text) for name, text in texts.items()}
    call.attributes[_ATTRIBUTES_OF] = mlir.ir.DictAttr.get(attributes)
    return [x]


mlir.register_lowering(_kernel_result, lambda _, x, *used, **__: [x])
# Elsewhere the value may be an argument, of which nobody sees where it comes from.
mlir.register_lowering(_kernel_result, _lowered, platform="cpu", cacheable=False)


def _hide_constants(call) -> None:
    """Put the arguments behind a barrier. Those XLA knows would lose their use in the kernel."""
    given = [*call.operands]
    barrier = mlir.ir.Operation.create(
        "stablehlo.optimization_barrier",
        results=[x.type for x in given],
        operands=given,
        loc=call.location,
        ip=mlir.ir.InsertionPoint(call),
    )
    for i, hidden in enumerate(barrier.results):
        call.operands[i] = hidden


def _called(call) -> str:
    return mlir.ir.FlatSymbolRefAttr(call.attributes["callee"]).value


def _all_go_out(call, function, used, changed: int) -> bool:
    """Whether each argument, but those changed, reaches what is `used` of its results, only moved.

    Not so of a linear part on its own, as reverse mode has it, and of what was not among the given.
    """
    body = function.regions[0].blocks[0]
    *_, end = body
    left = [end.operands[mlir.ir.OpResult(x).result_number] for x in used if x.owner == call]
    reached = set(range(changed))
    while left:
        value = left.pop()
        if isinstance(value.owner, mlir.ir.Block):
            reached.add(mlir.ir.BlockArgument(value).arg_number)
        elif value.owner.name in _MOVES:
            left += value.owner.operands
    return len(reached) == len(body.arguments)


class _Possible:
    """Whether XLA compiles an operation of StableHLO, and those in it, into any kernel."""

    def __init__(self, functions, largest: int):
        self.functions, self.largest = functions, largest
        self.seen: dict[str, bool] = {}

    def __call__(self, operation) -> bool:
        if operation.name == "func.call":
            name = _called(operation)
            if name not in self.seen:
                self.seen[name] = self.inside(self.functions[name])
            return self.seen[name]
        if any(math.prod(_shape(x)) > self.largest for x in operation.results):
            return False
        if operation.name == "stablehlo.dot_general":
            # With vectors XLA's own loop.
            return any(len(_shape(x)) == 1 for x in operation.operands)
        if operation.name == "stablehlo.reduce":
            summed = operation.operands[0]
            return "xf" not in str(summed.type) or math.prod(_shape(summed)) <= _SUMMED
        return operation.name in _KNOWN and self.inside(operation)

    def inside(self, operation) -> bool:
        blocks = (block for region in operation.regions for block in region.blocks)
        return all(self(x.operation) for block in blocks for x in block)


def _shape(value) -> list[int]:
    """Of a token, or where a length is not known yet, larger than any array."""
    kind = value.type
    shape = list(kind.shape) if isinstance(kind, mlir.ir.RankedTensorType) else [-1]
    return [sys.maxsize if length < 0 else length for length in shape]


def equations(jaxpr) -> Iterator[Any]:
    """All, those of loops and calls included."""
    for equation in jaxpr.eqns:
        yield equation
        for value in jax.tree.leaves(tuple(equation.params.values())):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from equations(inner)
