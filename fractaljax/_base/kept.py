"""Whole programs kept on disk, which a later run loads instead of tracing and lowering them again.

JAX's own cache saves the compilation alone, after a trace has found what to compile. Here a program
is known by the sources of this package and the structure of its arguments, so that a second run of
a command starts with the numbers. Only the command asks for that: its process runs this code alone.
"""

import contextlib
import functools
import hashlib
import inspect
import os
import pickle
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from .files import write_whole

_MOST_BYTES = 300_000_000  # of all programs; those not used for longest go
LAPACK = b"lapack_", b"blas_"  # in the names of its functions
_OWN = "fractaljax", "builtins", "jax", "jaxlib", "equinox"  # packages whose versions are known

_folder: Path | None = None
_loaded: dict[Any, Any] = {}


def keep_in(folder: Path | None) -> None:
    """Keep programs in a folder, which is made; None: keep none.

    **Raises:** `OSError` if it cannot be made, and `PermissionError` for one of another user, whose
    programs are not to be trusted.
    """
    global _folder
    if folder is not None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            raise PermissionError(f"{folder} belongs to another user")
    _folder = folder


def is_traced(*args: Any) -> bool:
    """Whether JAX traces these arguments, or whatever is computed now."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(args)) or is_staged()


def is_staged() -> bool:
    """Whether what is computed now becomes part of a program instead."""
    return isinstance(jnp.zeros(()), Tracer)


def kept(
    function: Callable, static_argnames: str | tuple[str, ...], jitted: Callable, options: str = ""
) -> Callable:
    """`function`, where programs are kept by the one of `jitted()`, the same function jitted.

    `options` tells apart two programs of one function.
    """
    static = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    parameters = inspect.signature(function)

    @functools.wraps(function)
    def call(*args, **kwargs):
        if _folder is None or is_traced(args, kwargs) or not _one_processor():
            return function(*args, **kwargs)
        given = parameters.bind(*args, **kwargs).arguments
        dynamic = {name: x for name, x in given.items() if name not in static}
        program = _program(_folder, function, options, jitted, given, dynamic)
        return function(*args, **kwargs) if program is None else program(**dynamic)

    return call


def _one_processor() -> bool:
    """Whether programs run on the CPU, as one device."""
    return jax.default_backend() == "cpu" and jax.device_count() == 1


def _program(folder: Path, function, options, jitted, given, dynamic) -> Callable | None:
    leaves, tree = jax.tree.flatten(dynamic)
    kinds = tuple(map(_kind, leaves))
    static = tuple((name, x) for name, x in given.items() if name not in dynamic)
    key = function, static, tree, kinds
    if key not in _loaded:
        _loaded[key] = None
        name = f"{function.__module__}.{function.__qualname__} {options}"
        stated = f"{_surroundings()} {name} {key[1:]}"
        if _belongs(tree) and " at 0x" not in stated:  # a function that has no name of its own
            file = folder / hashlib.sha256(stated.encode()).hexdigest()
            _loaded[key] = _read(file, dynamic) or _compiled(file, jitted(), given)
    return _loaded[key]


def _kind(x) -> tuple:
    of = jax.typeof(x)
    placed = x.sharding if getattr(x, "committed", False) else None
    return of.shape, of.dtype, of.weak_type, placed


def _read(file: Path, dynamic: dict) -> Callable | None:
    from jax.experimental.serialize_executable import deserialize_and_load

    try:
        executable, result = pickle.loads(file.read_bytes())
        if any(name in executable for name in LAPACK):
            _find_lapack()
        tree = jax.tree.structure(((), dynamic))
        found = deserialize_and_load(executable, tree, jax.tree.structure(result))
        os.utime(file)
        return found
    except Exception:  # none yet, damaged, or of a machine that has changed: compiled anew
        return None


@functools.cache
def _find_lapack() -> None:
    """Let XLA know the addresses of LAPACK's functions, as lowering a program with one does.

    They are SciPy's, whose import is a tenth of a command.
    """
    jax.jit(jax.lax.linalg.cholesky).lower(jnp.ones((1, 1)))


def _compiled(file: Path, jitted, given: dict) -> Callable:
    from jax.experimental.serialize_executable import serialize

    lowered = jitted.lower(**given)
    with _without_cache():
        compiled = lowered.compile()
    with contextlib.suppress(OSError, NotImplementedError, ValueError):  # slower next time
        result = jax.tree.map(lambda _: 0, compiled.out_info)
        write_whole(file, pickle.dumps((serialize(compiled)[0], result)), durable=False)
        _make_room(file.parent)
    return compiled


@contextlib.contextmanager
def _without_cache():
    """Without JAX's own cache: a program from there lacks parts of what is written here."""
    from jax.experimental.compilation_cache import compilation_cache

    setting = "jax_enable_compilation_cache"
    before = getattr(jax.config, setting)
    jax.config.update(setting, False)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update(setting, before)
        compilation_cache.reset_cache()


def _make_room(folder: Path) -> None:
    known = sorted((x.stat().st_mtime, x.stat().st_size, x) for x in folder.iterdir())
    over = sum(size for _, size, _ in known) - _MOST_BYTES
    for _, size, file in known:
        if over <= 0:
            return
        file.unlink(missing_ok=True)
        over -= size


def _belongs(tree) -> bool:
    """Whether every class in a tree is of this package, or of one whose version is known."""
    node = tree.node_data()
    known = node is None or node[0].__module__.partition(".")[0] in _OWN
    return known and all(map(_belongs, tree.children()))


@functools.cache
def _surroundings() -> str:
    """What else decides on a program: sources, versions, settings, processor."""
    sources = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        sources.update(file.read_bytes())
    settings = {name: x for name, x in jax.config.values.items() if "cache" not in name}
    processor = platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    versions = platform.python_version(), *map(version, ("jax", "jaxlib", "equinox", "diffrax"))
    flags = os.environ.get("XLA_FLAGS")
    return f"{sources.hexdigest()} {versions} {sorted(settings.items())} {flags} {processor}"
