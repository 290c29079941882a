"""Compilation in half the time, of programs for which it is most of what a user waits for."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from .kept import is_traced, kept

# Of XLA on CPU. A program that runs many times is slower with them, by up to two thirds.
_OPTIONS = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": "while-loop-invariant-code-motion,simplify-while-loops",
}


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


def quick_jit(function: Callable, static_argnames: str | tuple[str, ...] = ()) -> Callable:
    """`jax.jit`, compiled quickly where it is the outermost program: only there JAX has options."""
    plain, outermost = _jitted(function, static_argnames)

    @functools.wraps(plain)
    def call(*args, **kwargs):
        return (plain if is_traced(args, kwargs) else outermost())(*args, **kwargs)

    return kept(call, static_argnames, outermost)


def outermost_jit(function: Callable, static_argnames: str | tuple[str, ...] = ()) -> Callable:
    """`quick_jit` of a program that is never traced, without the time to look whether it is."""
    _, outermost = _jitted(function, static_argnames)

    @functools.wraps(function)
    def call(*args, **kwargs):
        return outermost()(*args, **kwargs)

    return kept(call, static_argnames, outermost)


def command_jit(function: Callable, static_argnames: str | tuple[str, ...] = ()) -> Callable:
    """`jax.jit`; a command, which runs the program a few times, compiles it quickly."""
    plain, outermost = _jitted(function, static_argnames)
    return kept(plain, static_argnames, outermost)


def _jitted(function, static_argnames) -> tuple[Callable, Callable[[], Callable]]:
    """The function jitted, and what gives the same compiled quickly, where options allow it."""
    plain = jax.jit(function, static_argnames=static_argnames)
    quick = jax.jit(function, static_argnames=static_argnames, compiler_options=_OPTIONS)
    return plain, lambda: quick if _available() else plain
