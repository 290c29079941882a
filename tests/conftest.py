"""Strict numerics for every test: 64 bits, no silent broadcasting, warnings are errors."""

import gc
import itertools
import os
import sys
import warnings
import zlib
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
    tenths = "of the slow tests only those of this tenth, 0 to 9"
    parser.addoption("--tenth", type=int, choices=range(10), help=tenths)


@pytest.hookimpl(trylast=True)  # of what `-m` has left
def pytest_collection_modifyitems(config, items):
    if (tenth := config.getoption("tenth")) is not None:
        kept, others = [], []
        for item in items:
            left_out = item.get_closest_marker("slow") and _tenth(item) != tenth
            (others if left_out else kept).append(item)
        config.hook.pytest_deselected(items=others)
        items[:] = kept
    if config.getoption("once"):
        first, others = {}, []
        for item in items:
            if first.setdefault(item.nodeid.partition("[")[0], item) is not item:
                others.append(item)
        config.hook.pytest_deselected(items=others)
        items[:] = first.values()


def _tenth(item) -> int:
    """The tenth of a test: all of its parameters are in the same one."""
    return zlib.crc32(item.nodeid.partition("[")[0].encode()) % 10


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", "error")
    # An entry of the cache that another worker is still writing is compiled anew.
    cache = "Error (reading|writing) persistent compilation cache"
    config.addinivalue_line("filterwarnings", f"ignore:{cache}")
    warnings.simplefilter("error")
    # Workers, subprocesses and later runs share what is compiled.
    folder = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(config.cache.mkdir("jax")))
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # Of every operation only the innermost line is kept with it, not ten: some 4 to 10 % less time.
    jax.config.update("jax_traceback_in_locations_limit", 1)
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "1")
    # A quarter of tracing is a search for garbage among the modules, which stay.
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def pytest_report_header():
    from fractaljax._base.versions import untested_jax

    return untested_jax() or f"JAX {jax.__version__}"


def pytest_sessionfinish():
    """pytest collects garbage five times at the end, of which once is enough."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Most tests compile much and compute little: JAX leaves optimisation out, but where marked.

    A cycle with both gradients then compiles in 4 s instead of 10. tests/test_optimised.py
    compiles every public function as users do.
    """
    optimised = bool(item.get_closest_marker("optimised"))
    jax.config.update("jax_disable_most_optimizations", not optimised)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(not optimised))  # of subprocesses


most_memory = 7e9  # of a worker [bytes]
MOST_MAPPINGS = 40_000  # of its memory: Linux ends a process beyond 65,530
_tests = itertools.count()


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


@pytest.fixture(autouse=True)
def bounded_mappings():
    yield
    if next(_tests) % 8 == 0 and mappings() > MOST_MAPPINGS:
        jax.clear_caches()


def mappings() -> int:
    """The mappings of memory of this process: each compiled program has some."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:  # not Linux
        return 0


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
