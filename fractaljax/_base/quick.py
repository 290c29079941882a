"""Compilation for programs that run once or twice, where it is nearly all of the time."""

import functools

import jax

quick_jit = functools.partial(
    jax.jit,
    compiler_options={
        "xla_backend_optimization_level": 1,
        "xla_cpu_use_fusion_emitters": False,
    },
)
