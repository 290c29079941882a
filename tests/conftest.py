"""Strict numerics for every test: 64 bits, no silent broadcasting, warnings are errors."""

import os
import warnings

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "standard")


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", "error")
    # An entry of the cache that another worker is still writing is compiled anew.
    cache = "Error (reading|writing) persistent compilation cache"
    config.addinivalue_line("filterwarnings", f"ignore:{cache}")
    warnings.simplefilter("error")
    # Most of a run is compilation. It takes a fifth less time so.
    quick = "--xla_cpu_use_fusion_emitters=false"
    passes = "while-loop-invariant-code-motion,simplify-while-loops"
    os.environ.setdefault("XLA_FLAGS", f"{quick} --xla_disable_hlo_passes={passes}")
    # Workers, subprocesses and later runs share what is compiled.
    from fractaljax._cli.compiled import FIRST_QUIET_JAX

    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(config.cache.mkdir("jax"))
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # Of older ones, which print notes when they load a program, only pytest sees standard error.
    if jax.__version_info__ >= FIRST_QUIET_JAX:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


@pytest.fixture(autouse=True, scope="module")
def bounded_memory():
    """What one file compiled is let go after it: of all files together it takes gigabytes."""
    yield
    jax.clear_caches()
