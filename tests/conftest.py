"""Strict numerics for every test: 64 bits, no silent broadcasting, warnings are errors."""

import functools
import gc
import os
import sys
import warnings
from pathlib import Path

# Read when NumPy and SciPy load. Two workers with two threads each wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "standard")


def pytest_addoption(parser):
    parser.addoption("--once", action="store_true", help="each test with its first parameters only")


@pytest.hookimpl(trylast=True)  # of what `-m` has left
def pytest_collection_modifyitems(config, items):
    if config.getoption("once"):
        first, others = {}, []
        for item in items:
            if first.setdefault(item.nodeid.partition("[")[0], item) is not item:
                others.append(item)
        config.hook.pytest_deselected(items=others)
        items[:] = first.values()


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", "error")
    # An entry of the cache that another worker is still writing is compiled anew.
    cache = "Error (reading|writing) persistent compilation cache"
    config.addinivalue_line("filterwarnings", f"ignore:{cache}")
    warnings.simplefilter("error")
    # Most of a run is compilation. It takes a fifth less time so.
    # Split for several threads, of which workers have none to spare, it takes a tenth more.
    flags = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    passes = "while-loop-invariant-code-motion,simplify-while-loops,tree_reduction_rewriter"
    os.environ.setdefault("XLA_FLAGS", f"{flags} --xla_disable_hlo_passes={passes}")
    # Workers, subprocesses and later runs share what is compiled.
    from fractaljax._base import quick
    from fractaljax._cli.compiled import FIRST_QUIET_JAX

    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(config.cache.mkdir("jax"))
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # Of older ones, which print notes when they load a program, only pytest sees standard error.
    if jax.__version_info__ >= FIRST_QUIET_JAX:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # Of every operation only the innermost line is kept with it, not ten: some 4 to 10 % less time.
    jax.config.update("jax_traceback_in_locations_limit", 1)
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "1")
    # The library's own options have some optimisation, and would win over a run without.
    asked = quick._available
    quick._available = functools.wraps(asked)(lambda: optimised() and asked())
    # A quarter of tracing is a search for garbage among the modules, which stay.
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def pytest_sessionfinish():
    """pytest collects garbage five times at the end, of which once is enough."""
    gc.collect()
    gc.freeze()


def optimised() -> bool:
    return not jax.config.read("jax_disable_most_optimizations")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Without optimisation a cycle with both gradients compiles in 4 s instead of 10.

    Slow tests that are marked so have it, as users do: most compile much and compute little.
    """
    compute = item.get_closest_marker("slow") and item.get_closest_marker("optimised")
    jax.config.update("jax_disable_most_optimizations", not compute)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "0" if compute else "1"  # of subprocesses


most_memory = 7e9  # of a worker [bytes]


@pytest.fixture(autouse=True, scope="module")
def bounded_memory():
    """Files share what is compiled. Beyond a bound on memory all of it goes, and the bound rises.

    What is let go of is used again, but most of it stays with the process.
    """
    global most_memory
    yield
    if memory() > most_memory:
        jax.clear_caches()
        most_memory = memory() + 1e9


def memory() -> float:
    """What this process holds now, or has held at most where that is not known [bytes]."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return float("inf")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024)
