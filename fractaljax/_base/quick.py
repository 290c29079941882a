"""Quicker compilation, of programs for which it is most of what a user waits for."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from .kept import is_staged, kept

_PASSES = "while-loop-invariant-code-motion,simplify-while-loops"
# Of XLA on CPU. Its fusion emitters take most of the time of what is no kernel of `one_kernel`, and
# as much for a small loop as for a large one. A program that runs many times is slower with these,
# by up to two thirds.
_OPTIONS: dict[str, Any] = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": _PASSES,
}
# This pass makes a long sum one of short sums, which is more exact in float32. Ours are short.
_OWN = _OPTIONS | {"xla_disable_hlo_passes": f"{_PASSES},tree_reduction_rewriter"}
_RUNS_ONCE = _OWN | {"xla_backend_optimization_level": 0}  # up to three times as slow


@functools.cache
def _available() -> bool:
    """Whether this version of XLA knows the options, which are none of JAX's public ones."""
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(jnp.negative, compiler_options=_OPTIONS)(0.0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


def quick_compilation() -> dict[str, Any]:
    """Options with which a program of yours compiles in half to four fifths of the time on a CPU.

    `jax.jit(function, compiler_options=fj.quick_compilation())`: fractaljax has such in programs
    of its own, but JAX takes them for the outermost program only. A program runs up to two thirds
    longer with them. Empty where the default backend is no CPU, or XLA does not know them.
    """
    return dict(_OPTIONS) if _available() else {}


def quick_jit(
    function: Callable, static_argnames: str | tuple[str, ...] = (), *, once: bool = False
) -> Callable:
    """`jax.jit`, compiled quickly where it is the outermost program: only there JAX has options.

    It is that too where `jax.vmap`, `jax.jvp` or `jax.jacfwd` call it outside of any other program.
    `once` halves the time again for a program which runs a few times, or on few numbers.
    """
    plain, outermost = _jitted(function, static_argnames, _RUNS_ONCE if once else _OWN)

    @functools.wraps(plain)
    def call(*args, **kwargs):
        return (outermost() if _is_outermost(args, kwargs) else plain)(*args, **kwargs)

    return kept(call, static_argnames, outermost, "once" if once else "")


def _is_outermost(*args: Any) -> bool:
    """Whether what is called with these arguments is compiled at once, as a program of its own."""
    return not is_staged() and all(map(_is_evaluated, jax.tree.leaves(args)))


def _is_evaluated(x: Any) -> bool:
    """Whether x is a number, or batches and tangents of numbers; no name for one in a program."""
    kind = type(x).__name__
    if kind == "BatchTracer":
        return _is_evaluated(x.val)
    if kind == "JVPTracer":
        return _is_evaluated(x.primal) and _is_evaluated(x.tangent)
    return not isinstance(x, Tracer)


def outermost_jit(function: Callable, static_argnames: str | tuple[str, ...] = ()) -> Callable:
    """`quick_jit` of a program that is never traced, without the time to look whether it is."""
    plain, outermost = _jitted(function, static_argnames, _OWN)

    @functools.wraps(plain)
    def call(*args, **kwargs):
        return outermost()(*args, **kwargs)

    return kept(call, static_argnames, outermost)


def command_jit(
    function: Callable, static_argnames: str | tuple[str, ...] = (), *, once: bool = False
) -> Callable:
    """`jax.jit`; a command, which runs the program a few times, compiles it as `quick_jit` does."""
    plain, outermost = _jitted(function, static_argnames, _RUNS_ONCE if once else _OWN)
    return kept(plain, static_argnames, outermost, "once" if once else "")


def _jitted(function, static_argnames, options) -> tuple[Callable, Callable[[], Callable]]:
    """The function jitted, and what gives the same compiled quickly, where options allow it."""
    plain = jax.jit(function, static_argnames=static_argnames)
    quick = jax.jit(function, static_argnames=static_argnames, compiler_options=options)
    return plain, lambda: quick if _available() else plain
