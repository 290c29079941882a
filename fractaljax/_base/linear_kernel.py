"""Linear functions that JAX does not take apart: their derivatives are such functions again.

Reverse mode computes ahead what does not depend on tangents, and transposes the rest operation by
operation: much to trace, and a kernel for each group of operations that is left over. A whole
function has its own transpose instead, which computes what it needs within `one_kernel`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from .one_kernel import one_kernel


def linear_kernel(function: Callable, given: Any, vector: Any) -> Any:
    """function(given, vector), linear in the vector, one kernel of XLA where it can be one.

    The vector is of floats. All arrays that the function needs, but constants, are given.
    """
    leaves, structure = jax.tree.flatten((given, vector))

    def flat(*leaves):
        return function(*jax.tree.unflatten(structure, leaves))

    jaxpr, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
    found = _bound(jaxpr, len(jax.tree.leaves(vector)), leaves)
    return jax.tree.unflatten(jax.tree.structure(shape), found)


def _bound(jaxpr: ClosedJaxpr, linear: int, leaves: Sequence) -> list:
    return _linear_kernel.bind(*leaves, jaxpr=jaxpr, linear=linear)


# The function of all numbers, linear in the last few.
_linear_kernel = Primitive("linear_kernel")
_linear_kernel.multiple_results = True


def _value(*leaves, jaxpr: ClosedJaxpr, linear: int):
    return one_kernel(jaxpr_as_fun(jaxpr), *leaves)


_linear_kernel.def_impl(lambda *leaves, jaxpr, linear: jax.jit(jaxpr_as_fun(jaxpr))(*leaves))
_linear_kernel.def_abstract_eval(lambda *_, jaxpr, linear: jaxpr.out_avals)
mlir.register_lowering(
    _linear_kernel, mlir.lower_fun(_value, multiple_results=True), cacheable=False
)


def _batched(leaves, axes, *, jaxpr: ClosedJaxpr, linear: int):
    several = jax.vmap(jaxpr_as_fun(jaxpr), tuple(axes))
    found = _bound(jax.make_jaxpr(several)(*leaves), linear, leaves)
    return found, [0] * len(found)


def _jvp(primals, tangents, *, jaxpr: ClosedJaxpr, linear: int):
    found = _bound(jaxpr, linear, primals)
    moving = [i for i, x in enumerate(tangents) if not isinstance(x, ad.Zero)]
    own = len(primals) - linear
    if moving[0] >= own:  # linear in all that moves
        vector = [ad.instantiate_zeros(x) for x in tangents[own:]]
        return found, _bound(jaxpr, linear, [*primals[:own], *vector])

    def derivative(primals, tangents):
        def of(*changed):
            leaves = dict(enumerate(primals)) | dict(zip(moving, changed, strict=True))
            return jaxpr_as_fun(jaxpr)(*leaves.values())

        return jax.jvp(of, [primals[i] for i in moving], tangents)[1]

    return found, linear_kernel(derivative, list(primals), [tangents[i] for i in moving])


def _transposed(cotangents, *leaves, jaxpr: ClosedJaxpr, linear: int):
    own = len(leaves) - linear
    wanted = [i for i, x in enumerate(leaves[own:]) if ad.is_undefined_primal(x)]

    def transpose(given, cotangents):
        # Linear, hence its own derivative. Older versions of JAX transpose a scan only as that.
        nothing = [jnp.zeros(x.shape, x.dtype) for x in jaxpr.in_avals[own:]]
        _, transposed = jax.vjp(lambda *v: jaxpr_as_fun(jaxpr)(*given, *v), *nothing)
        found = transposed(cotangents)
        return [found[i] for i in wanted]

    cotangents = [ad.instantiate_zeros(x) for x in cotangents]
    found = dict(zip(wanted, linear_kernel(transpose, leaves[:own], cotangents), strict=True))
    return [None] * own + [found.get(i) for i in range(linear)]


batching.primitive_batchers[_linear_kernel] = _batched
ad.primitive_jvps[_linear_kernel] = _jvp
ad.primitive_transposes[_linear_kernel] = _transposed
