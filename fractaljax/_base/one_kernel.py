"""Loops over small arrays as one kernel of XLA on a CPU.

XLA starts a kernel for each operation, which takes some 40 ns. So a loop over a few numbers takes
longer for starts than for operations. Loops below a size XLA makes one kernel by itself; where a
loop also fills a larger array it has to be asked to, by an attribute that other backends ignore.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

# Versions of JAX whose XLA was seen to do so. It may refuse what others make of an operation.
_FIRST, _BEYOND = (0, 9), (0, 11)
_ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}
# Operations that XLA compiles itself into any kernel; no library's, no search and no scatter.
_NAMES = """
abs acos acosh add add_any and argmax argmin asin asinh atan atan2 atanh broadcast_in_dim cbrt
ceil clamp concatenate cond convert_element_type copy copy_p cos cosh custom_jvp_call
custom_vjp_call div dynamic_slice dynamic_update_slice eq erf exp exp2 expand_dims expm1 floor
ge gt integer_pow iota is_finite jit le log log1p logistic lt max min mul ne neg nextafter not
or pad pjit pow reduce_and reduce_max reduce_min reduce_or reduce_sum rem reshape rev round
rsqrt scan select_n sign sin sinh slice split sqrt square squeeze stack stop_gradient sub tan
tanh transpose while xor
"""
_KNOWN = frozenset(_NAMES.split())
_MOST_REDUCED = 1024  # numbers; more may go to a library


def one_kernel(function: Callable, large: Any, *small: Any, wanted: bool = True) -> Any:
    """function(large, *small), on a CPU one kernel where XLA can make one of its operations.

    `large` are arrays of which the function changes a part. All others are small: where they are
    not, one kernel is not `wanted`.
    """
    empty = not all(jnp.size(x) for x in jax.tree.leaves((large, small)))
    if empty or not wanted or not _available():
        return function(large, *small)
    program, out = jax.make_jaxpr(function, return_shape=True)(large, *small)
    if not all(_is_known(equation) for equation in equations(program.jaxpr)):
        return function(large, *small)
    from jax.experimental.xla_metadata import set_xla_metadata  # none of JAX's stable parts

    @jax.jit
    def kernel(consts, large, small):
        run = jaxpr_as_fun(ClosedJaxpr(program.jaxpr, consts))
        # An argument that optimisation leaves without a use would stop XLA: each goes out again.
        used = [jnp.ravel(x)[0].astype(float) for x in jax.tree.leaves((consts, small))]
        return run(*jax.tree.leaves((large, *small))), jnp.stack(used)

    leaves, used = kernel(program.consts, large, small)
    leaves[0] = set_xla_metadata(leaves[0], **_ATTRIBUTES)
    leaves[0], _ = jax.lax.optimization_barrier((leaves[0], used))  # so that JAX keeps these
    return jax.tree.unflatten(jax.tree.structure(out), leaves)


def _available() -> bool:
    return _FIRST <= jax.__version_info__ < _BEYOND and jax.default_backend() == "cpu"


def equations(jaxpr) -> Iterator[Any]:
    """All, those of loops and calls included."""
    for equation in jaxpr.eqns:
        yield equation
        for value in jax.tree.leaves(tuple(equation.params.values())):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from equations(inner)


def _is_known(equation) -> bool:
    name = equation.primitive.name
    reduces = name.startswith(("reduce", "arg"))
    small = not reduces or all(x.aval.size <= _MOST_REDUCED for x in equation.invars)
    return name in _KNOWN and small
